"""Obstacles and friction with them, against the mechanics of rigid bodies."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rodjax as rx
from rodjax.measuring import energy, measures
from rodjax.numerics import rotations
from rodjax.rods.state import at_rest
from rodjax.rods.strains import curvature
from rodjax.scenes.placing import placing

ELEMENTS, DIAMETER, MASS, STIFFNESS, WEIGHT = 4, 0.05, 1.0, 1e5, 9.8


def dip(load, stiffness=STIFFNESS, diameter=DIAMETER):
    """How deep a load per length presses a rod into an obstacle."""
    width = 0.05 * diameter
    soft = np.sqrt(2 * width * load / stiffness)
    return soft if soft < width else load / stiffness + 0.5 * width


def lying(*loads, friction=None, slope=0.0, elements=ELEMENTS, direction=None, **changes):
    """A rod at rest on a plane that falls along x by the slope [degrees], and down the plane."""
    angle = np.deg2rad(slope)
    down, normal = (
        np.array([np.cos(angle), 0, -np.sin(angle)]),
        np.array([np.sin(angle), 0, np.cos(angle)]),
    )
    section = rx.circular_section(DIAMETER, 1e9, 4e8, density=MASS / (np.pi * DIAMETER**2 / 4))
    rod = rx.straight_rod(
        1.0, elements, section, direction=tuple(down) if direction is None else direction
    )
    up = 0.5 * DIAMETER - dip(WEIGHT * np.cos(angle))
    rod = dataclasses.replace(rod, position=rod.position + jnp.asarray(up * normal)[None])
    plane = rx.Obstacle(rx.Plane(normal=tuple(normal)), STIFFNESS, friction, **changes)
    return rx.Scene(rod, loads=(rx.Gravity((0, 0, -WEIGHT)), plane, *loads)), down


def pull(parameters, s, motion):
    return jnp.ones_like(s)[:, None] * jnp.zeros((1, 6)).at[0, 0].set(parameters)


def pulled(force, friction):
    """The rod on a floor, pulled along itself."""
    return lying(rx.DistributedLoad(pull, jnp.asarray(force)), friction=friction)[0]


STEPS, FINE = np.linspace(0, 1, 101)[1:], np.linspace(0, 1, 1001)[1:]


@pytest.mark.slow
@pytest.mark.parametrize("force", [6.0, 3.0])
def test_a_rod_pulled_on_a_floor(force):
    """Kinetic energy (F - mu m g)^2/2 after a second, none below; PyElastica and DisMech's case."""
    scene = pulled(force, rx.Friction(0.4, 1e7))
    run = rx.rollout(scene, rx.start(scene), FINE)
    ledger = energy.ledger(scene, run)
    net = max(force - 0.4 * MASS * WEIGHT, 0)
    np.testing.assert_allclose(ledger.kinetic[-1], 0.5 * net**2, rtol=5e-3, atol=2e-6)
    way = 0.5 * net
    np.testing.assert_allclose(run.final.position[0, 0], way, rtol=2e-3, atol=1e-5)
    np.testing.assert_allclose(ledger.contact_loss[-1], 0.4 * WEIGHT * way, rtol=3e-3, atol=1e-4)
    assert np.max(np.abs(ledger.residual)) < 1e-4
    assert np.all(ledger.contact_loss >= -1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("mu", [0.5, 0.1])
@pytest.mark.parametrize("kind", ["stick", "speed"])
def test_a_rod_on_a_slope(mu, kind):
    """It holds at mu = 0.5 > tan 20, else slides with g (sin 20 - mu cos 20)."""
    friction = rx.Friction(mu, 1e7) if kind == "stick" else rx.SlidingFriction(mu, 1e-3)
    scene, down = lying(friction=friction, slope=20.0)
    run = rx.rollout(scene, rx.start(scene), FINE if mu < 0.3 else STEPS)
    speed = float(run.final.velocity[2] @ down)
    gain = WEIGHT * (np.sin(np.deg2rad(20)) - mu * np.cos(np.deg2rad(20)))
    if gain > 0:
        np.testing.assert_allclose(speed, gain, rtol=5e-3)
    elif kind == "speed":  # it creeps
        part = np.tan(np.deg2rad(20)) / mu
        np.testing.assert_allclose(speed, 1e-3 * part / np.sqrt(1 - part**2), rtol=1e-3)
    else:
        assert abs(speed) < 1e-5
        rest = rx.rollout(scene, run.final, 1 + np.linspace(0, 100, 201)[1:])
        way = np.asarray(rest.states.position[:, 2]) @ down - run.states.position[0, 2] @ down
        assert 0 < way[0] < 1e-4 and np.max(np.abs(way[100:] - way[-1])) < 1e-12
    ledger = energy.ledger(scene, run)
    assert np.max(np.abs(ledger.residual)) < 2e-4


def test_what_a_floor_exerts_on_a_rod_moved_along_it():
    """Normal force, friction up to its limit, and its couple about the tangent."""
    scene, _ = lying(friction=rx.Friction(0.4, 1e6), direction=(0.0, 1.0, 0.0))
    floor, rod = scene.loads[1], scene.rod
    rest = at_rest(jnp.asarray(0.0), rod.position, rod.quaternion)
    floor = floor.recalling(floor.first_memory(rod, rest))
    for way, traction in ((1e-6, 1.0), (1e-3, 0.4 * WEIGHT)):
        wrench = floor.wrench(rod, rest._replace(position=rod.position.at[:, 0].add(way)))
        force, moment = wrench[:, :3], rotations.rotate(rod.quaternion, wrench[:, 3:])
        per_length = np.asarray(force / rod.node_length[:, None])
        np.testing.assert_allclose(per_length, [[-traction, 0, WEIGHT]] * len(force), rtol=1e-9)
        np.testing.assert_allclose(moment[:, 1], -0.5 * DIAMETER * force[:, 0], rtol=1e-9)


@pytest.mark.slow
def test_a_rod_that_spins_begins_to_roll():
    """Friction acts on its surface: of a spin w about itself a third is left, v = w R/3."""
    scene, _ = lying(friction=rx.Friction(0.4, 1e6), direction=(0.0, 1.0, 0.0))
    spin, radius = 20.0, 0.5 * DIAMETER
    turning = jnp.zeros((ELEMENTS + 1, 3)).at[:, 2].set(spin)
    run = rx.rollout(scene, rx.start(scene, angular_velocity=turning), 0.2 * STEPS)
    expected = spin * radius / 3
    speed = np.asarray(run.states.velocity[:, :, 0])
    np.testing.assert_allclose(np.mean(speed[-30:], 0), expected, rtol=2e-2)
    np.testing.assert_allclose(run.final.angular_velocity[:, 2], spin / 3, rtol=4e-2)
    # until it rolls, it is pushed by mu m g
    gain, time = speed[15] - speed[5], run.times[15] - run.times[5]
    np.testing.assert_allclose(gain, 0.4 * WEIGHT * time, rtol=1e-3)
    touch = measures.obstacle_contact(scene, run, 1)
    assert np.all(touch.slides[10]) and np.all(touch.sticks[-1]) and not np.any(touch.sticks[10])
    np.testing.assert_allclose(np.sum(touch.normal_force, 1)[10], MASS * WEIGHT, rtol=1e-3)
    np.testing.assert_allclose(touch.friction[10, :, 0], 0.4 * touch.normal_force[10], rtol=1e-6)
    with pytest.raises(ValueError, match="is no obstacle"):
        measures.obstacle_contact(scene, run, 0)


@pytest.mark.slow
def test_a_belt_takes_a_rod_along():
    """A floor that moves: what drives it is booked, half of it lost by slipping."""
    belt, mu = 0.5, 0.4
    way = rx.PiecewiseLinear([0.0, 2.0], [(0, 0, 0), (2 * belt, 0, 0)])
    scene, _ = lying(friction=rx.Friction(mu, 1e6), displacement=way)
    run = rx.rollout(scene, rx.start(scene), STEPS[:60])
    gain, time = run.states.velocity[9] - run.states.velocity[4], run.times[9] - run.times[4]
    np.testing.assert_allclose(gain[:, 0], mu * WEIGHT * time, rtol=1e-3)
    np.testing.assert_allclose(np.mean(run.states.velocity[-15:, :, 0]), belt, rtol=1e-2)
    ledger = energy.ledger(scene, run)
    moved = 0.5 * MASS * belt**2
    np.testing.assert_allclose(ledger.drive_work[-1], 2 * moved, rtol=3e-2)
    np.testing.assert_allclose(ledger.contact_loss[-1], moved, rtol=3e-2)
    assert np.max(np.abs(ledger.residual)) < 0.01 * ledger.drive_work[-1]


@pytest.mark.slow
def test_what_must_stick_stops_newtons_method_never():
    """100 random starts whose steps bring every node to stick, by either law, stiff or not."""
    scene, _ = lying(friction=rx.Friction(0.5, 1e8), elements=12)
    laws = rx.Friction(0.5), rx.Friction(0.5, 1e8), rx.SlidingFriction(0.5, 1e-8)
    random = np.random.default_rng(0)
    rates = 0.1 * random.normal(size=(100, 13, 6)) * np.repeat([1.0, 10.0], 3)

    @jax.jit
    @jax.vmap
    def failures(rate):
        start = rx.start(scene, velocity=rate[:, :3], angular_velocity=rate[:, 3:])
        results = []
        for law in laws:
            other = lying(friction=law, elements=12)[0]
            state = dataclasses.replace(start, memory=None)
            results.append(rx.rollout(other, state, 0.1 * STEPS[:10], throw=False).infos.result)
        return jnp.stack(results)

    assert np.count_nonzero(failures(jnp.asarray(rates))) == 0


@pytest.mark.slow
@pytest.mark.parametrize("force", [6.0, 3.0], ids=["sliding", "stuck"])
def test_derivatives_by_friction_and_place(force):
    def end(p):
        friction = rx.Friction(p[0], 1e5)
        scene = pulled(force, friction)
        scene = dataclasses.replace(
            scene,
            loads=(
                scene.loads[0],
                rx.Obstacle(rx.Plane((0, 0, p[1])), STIFFNESS, friction),
                scene.loads[2],
            ),
        )
        final = rx.rollout(scene, rx.start(scene), STEPS[4:40:5], throw=False).final
        return final.position[0, 0] + 0.3 * final.position[1, 2]

    at = jnp.asarray([0.4, 1e-4])
    backward = jax.grad(end)(at)
    forward = jax.jacfwd(end)(at)
    np.testing.assert_allclose(backward, forward, rtol=1e-9, atol=1e-14)
    small = jnp.asarray([1e-5, 1e-8])
    either = [
        (end(at.at[i].add(small[i])) - end(at.at[i].add(-small[i]))) / (2 * small[i])
        for i in (0, 1)
    ]
    np.testing.assert_allclose(forward, either, rtol=1e-5, atol=1e-9)


def laid(friction, load, first_end, last_end, elements, *loads, compliance=None, stiffness=1e5):
    """A rod of length 4, bending stiffness 1 and weight 1 per length on a floor, as placed."""
    section = rx.Section((1.0, 1.0, 1.0), mass=1.0, diameter=DIAMETER, compliance=compliance)
    rod = rx.straight_rod(4.0, elements, section, direction=(1, 0, 0))
    up = 0.5 * DIAMETER - dip(load, stiffness)
    rod = dataclasses.replace(rod, position=rod.position.at[:, 2].add(up))
    floor = rx.Obstacle(rx.Plane(), stiffness, friction)
    scene = rx.Scene(rod, first_end, last_end, (rx.Gravity((0, 0, -1.0)), floor, *loads))
    return scene, placing(scene)


@pytest.mark.slow
@pytest.mark.parametrize(
    "height, stiffness, force, curved",
    [(1.0, 1e5, 1.286617, 0.574755), (0.1, 1e7, 0.625120, 0.193319)],
)
def test_a_heavy_elastica_lifted_from_a_floor(height, stiffness, force, curved):
    """B = w = 1, lifted at its end by a vertical force, to a thousandth."""
    lift = rx.Pinned(displacement=rx.PiecewiseLinear([0.0, 1.0], [(0, 0, 0), (0, 0, height)]))
    ends = rx.Slider((1, 0, 0)), lift
    scene, state = laid(None, 1.0, *ends, 160, stiffness=stiffness)
    state, _ = rx.equilibrium(scene, state, time=1.0, relax=False)
    np.testing.assert_allclose(energy.reactions(scene, state).force[1], [0, 0, force], atol=1e-3)
    largest = np.max(np.abs(curvature(scene.rod, state.quaternion)))
    np.testing.assert_allclose(largest, curved, rtol=1e-3)


@pytest.mark.slow
def test_a_stretched_rod_at_rest_remembers_its_load_steps():
    """Pulled by F it slips as far as friction has not taken that up, F/(mu w): its end moves by
    F^2/(2 EA mu w), and back by half of that when it is let go.
    """
    stiff, mu, most = 1e3, 0.5, 1.2
    pulls = rx.PiecewiseLinear([0.0, 1.0, 2.0], [(0, 0, 0), (most, 0, 0), (0, 0, 0)])
    loads = (rx.PointLoad(-1, force=pulls),)
    friction = rx.Friction(mu, 1e5)
    give = (0.0, 0.0, 1 / stiff)
    scene, state = laid(friction, 1.0, rx.Clamped(), rx.Free(), 80, *loads, compliance=give)
    place, ends = float(state.position[-1, 0]), []
    for time in (0.0, 1.0, 2.0):
        state, _ = rx.equilibrium(scene, state, time=time, relax=False)
        ends.append(float(state.position[-1, 0]) - place)
    moved = most**2 / (2 * stiff * mu)
    np.testing.assert_allclose(ends, [0.0, moved, 0.5 * moved], atol=0.02 * moved)


@pytest.mark.slow
def test_friction_goes_on_from_a_file(tmp_path):
    """What sticks by its anchors is resumed bit for bit."""
    scene = pulled(3.0, rx.Friction(0.4, 1e5))
    start = rx.start(scene)
    control = rx.StepControl(max_step=2e-3, min_step=1e-12)
    whole = rx.adaptive_rollout(scene, start, 0.2, control=control)
    half = rx.adaptive_rollout(scene, start, 0.1, control=control)
    rx.storage.save(tmp_path / "half.h5", scene, half, control=control)
    functions = {"scene.loads[2].function": pull}
    rest = rx.storage.load(tmp_path / "half.h5", functions=functions).resume(0.2)
    assert float(jnp.max(whole.final.memory.loads[1].stretch)) > 1e-6
    for one, other in zip(jax.tree.leaves(rest.final), jax.tree.leaves(whole.final), strict=True):
        np.testing.assert_array_equal(one, other)
