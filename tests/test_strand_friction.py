"""Friction between strands: its law, its place in Newton's system, and what it does to a motion."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rodjax as rx
from rodjax.equations import coupling
from rodjax.equations.equations import step_equations
from rodjax.interactions import contact_capacities, screening
from rodjax.interactions.contact_report import report
from rodjax.numerics import newton, rotations
from rodjax.numerics.front_order import FrontSize

DIAMETER = 0.02
SECTION = rx.circular_section(DIAMETER, 1e7, 0.4e7, density=1500.0, extensible=True)
FRICTION, SLIP_SPEED = 0.3, 1e-4


def crossing(friction, angle=1.2, gap=0.0193, elements=(6, 5), relaxation=1e-3):
    """A rod and another across it, nearer than their diameter."""
    lower = rx.straight_rod(0.2, elements[0], SECTION, direction=(1, 0, 0), origin=(-0.1, 0, 0))
    way = np.array([np.cos(angle), np.sin(angle), 0.0])
    origin = np.array([0, 0, gap]) - 0.1 * way
    upper = rx.straight_rod(0.2, elements[1], SECTION, direction=way, origin=origin)
    contact = rx.Contact.solid(lower, 5.0, friction=friction, relaxation=relaxation)
    return rx.Scene(rods=(lower, upper), contact=contact)


def of_upper(scene, value):
    """The vector for the nodes of the second rod, zero for the others."""
    rows = np.zeros((scene.rod.elements + 1, 3))
    rows[scene.rod.parts[1].nodes] = value
    return jnp.asarray(rows)


def reported(scene, velocity, spin):
    position = scene.rod.position
    return report(scene.contact, scene.rod, position, velocity, False, spin)


def exerted(scene, velocity, spin):
    """Wrenches on the nodes."""
    frames = scene.rod.quaternion
    state = dataclasses.replace(
        rx.placing(scene),
        rate=jnp.concatenate([velocity, rotations.rotate_inverse(frames, spin)], 1),
    )
    motion = rx.measures.energy.node_motion(state)
    return scene.self_contact.exerted(scene.rod, motion, scene.find_contact(state.position))


def test_surfaces_that_slide_are_held_back_by_the_coefficient_times_the_load():
    # without damping, which holds back the points that slide away from each other
    scene = crossing(rx.SlidingFriction(FRICTION, SLIP_SPEED), relaxation=0.0)
    speed = np.array([0.3, -0.4, 0.0])
    still = of_upper(scene, 0.0)
    found = reported(scene, of_upper(scene, speed), still)
    pressed = reported(scene, still, still)
    assert float(pressed.total) > 1.0 and float(pressed.friction) == 0.0
    np.testing.assert_allclose(found.friction, FRICTION * found.total, rtol=1e-6)
    np.testing.assert_allclose(found.mobilised, 1.0, rtol=1e-6)
    upper = jnp.sum(found.force[scene.rod.parts[1].nodes], 0)
    # pairs of points stand at angles to each other, the normal at the middle is along z
    np.testing.assert_allclose(upper[:2], -FRICTION * found.total * speed[:2] / 0.5, rtol=0.06)
    np.testing.assert_allclose(found.power, 0.5 * FRICTION * found.total, rtol=0.06)


def test_slow_surfaces_creep():
    """At a tenth of the slip speed the law gives a tenth of mu (over sqrt(1.01))."""
    scene = crossing(rx.SlidingFriction(FRICTION, 1e-2), angle=np.pi / 2)
    slow = reported(scene, of_upper(scene, (1e-3, 0.0, 0.0)), of_upper(scene, 0.0))
    assert 0.08 < float(slow.mobilised) < 0.1 / np.sqrt(1.01)


@pytest.mark.parametrize("spins, slips", [((1.0, -1.0), 0.0), ((1.0, 1.0), 1.0), ((2.0, 0.0), 1.0)])
def test_surfaces_of_spinning_strands(spins, slips):
    """Parallel strands that turn as two gears do roll on each other; in one sense they rub."""
    gap = 0.0193
    scene = crossing(rx.SlidingFriction(FRICTION, SLIP_SPEED), angle=0.0, gap=gap)
    spin = np.zeros((scene.rod.elements + 1, 3))
    for part, rate in zip(scene.rod.parts, spins, strict=True):
        spin[part.nodes, 0] = rate
    found = reported(scene, of_upper(scene, 0.0), jnp.asarray(spin))
    # the mean spin times the distance of the lines
    expected = FRICTION * float(found.total) * slips * gap
    np.testing.assert_allclose(found.power, expected, rtol=1e-2, atol=1e-12)


def test_it_keeps_momentum_and_does_not_feel_rigid_motion():
    scene = crossing(rx.SlidingFriction(FRICTION, SLIP_SPEED))
    rng, position = np.random.default_rng(3), scene.rod.position
    velocity, spin = (jnp.asarray(rng.normal(size=position.shape)) for _ in range(2))
    wrench = exerted(scene, velocity, spin)
    force = wrench[:, :3]
    moment = jnp.cross(position, force) + rotations.rotate(scene.rod.quaternion, wrench[:, 3:])
    scale = float(jnp.sum(jnp.abs(force)))
    np.testing.assert_allclose(jnp.sum(force, 0), 0.0, atol=1e-13 * scale)
    np.testing.assert_allclose(jnp.sum(moment, 0), 0.0, atol=1e-13 * scale)
    turning, going = jnp.asarray([0.3, -0.2, 0.5]), jnp.asarray([1.0, 2.0, 3.0])
    rigid = going[None] + jnp.cross(turning[None], position)
    found = reported(scene, rigid, jnp.broadcast_to(turning[None], position.shape))
    assert float(found.total) > 1.0
    np.testing.assert_allclose(found.friction, 0.0, atol=1e-9 * float(found.total))


@pytest.mark.slow
def test_what_it_takes_away_is_its_power():
    """By the wrenches on the nodes, and none of it is put in."""
    scene = crossing(rx.SlidingFriction(FRICTION, 1e-2))
    rng, shape = np.random.default_rng(4), scene.rod.position.shape
    for _ in range(3):
        velocity, spin = (jnp.asarray(0.1 * rng.normal(size=shape)) for _ in range(2))
        smooth = dataclasses.replace(scene.contact, friction=None)
        rough = exerted(scene, velocity, spin)
        friction = rough - exerted(dataclasses.replace(scene, contact=smooth), velocity, spin)
        body = rotations.rotate_inverse(scene.rod.quaternion, spin)
        power = -jnp.sum(friction * jnp.concatenate([velocity, body], 1))
        found = reported(scene, velocity, spin)
        assert float(found.power) > 0
        np.testing.assert_allclose(found.power, power, rtol=1e-10)


@pytest.fixture(scope="module")
def moving():
    """Newton's system of a scene in contact with random rates, its ends free."""
    scene = crossing(rx.SlidingFriction(FRICTION, 0.05))
    rng = np.random.default_rng(0)
    state = rx.start(scene)
    rates = jnp.asarray(rng.normal(size=state.rate.shape)) * 0.2
    return scene, dataclasses.replace(state, rate=rates)


def system_of(scene, state):
    dt = jnp.asarray(1e-4)
    found = scene.find(state.position, dt * state.velocity)
    equations = step_equations(scene, state, dt, jnp.asarray(0.8), found)
    x = equations.guess(state.force)
    noise = jnp.asarray(np.random.default_rng(1).normal(size=x.shape))
    return equations, x + 1e-4 * noise


def test_the_newton_system_is_the_exact_derivative(moving):
    equations, x = system_of(*moving)
    system = equations.linearize(x)
    assert float(jnp.max(jnp.abs(system.coupling.derivative[..., 3:]))) > 0
    b = jnp.asarray(np.random.default_rng(2).normal(size=x.shape))
    of = jax.jit(
        lambda b: jax.jvp(lambda d: equations.residual(equations.retract(x, d)), (0 * x,), (b,))
    )
    expected = of(b)[1]
    scale = float(jnp.max(jnp.abs(expected)))
    np.testing.assert_allclose(system.multiply(b), expected, atol=1e-11 * scale)
    solution, adjoint = system.solve(b), system.solve_transpose(b)
    np.testing.assert_allclose(system.multiply(solution), b, atol=1e-9)
    np.testing.assert_allclose(jnp.vdot(adjoint, system.multiply(b)), jnp.vdot(b, b), rtol=1e-9)


@pytest.mark.slow
def test_a_strip_is_solved_as_a_dense_system(moving, monkeypatch):
    scene, state = moving
    b = jnp.asarray(np.random.default_rng(1).normal(size=(scene.rod.elements + 1, 9)))

    def solutions():
        equations, x = system_of(scene, state)
        system = equations.linearize(x)
        front = system.coupling.capacities[int(system.coupling.pairs.capacity) - 1].front
        return front, (system.solve(b), system.solve_transpose(b), system.eliminate().solve(b))

    front, expected = solutions()
    assert front is None
    whole = contact_capacities.capacities(scene.contact, scene.rod.elements)[-1]
    size = FrontSize(24, 8)
    for module in (screening, coupling):
        monkeypatch.setattr(
            module, "capacities", lambda *given: (whole._replace(front=size), whole)
        )
    front, found = solutions()
    assert front == size
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-8, atol=1e-10)


def sledge(coefficient, slip_speed=1e-3):
    """A bar that lies on two that are held, and slides along itself."""
    along = dict(direction=(0, 1, 0))
    posts = [rx.straight_rod(0.1, 2, SECTION, origin=(x, -0.05, 0), **along) for x in (0.1, 0.3)]
    bar = rx.straight_rod(0.4, 4, SECTION, direction=(1, 0, 0), origin=(0, 0.0, 0.0197))
    friction = rx.SlidingFriction(coefficient, slip_speed)
    contact = rx.Contact.solid(bar, 2.0, friction=friction, relaxation=4e-3)
    held, free = rx.Clamped(), rx.Free()
    gravity = rx.Gravity((0, 0, -9.81))
    ends = dict(first_end=(held, held, free), last_end=(held, held, free))
    return rx.Scene(rods=(*posts, bar), loads=(gravity,), contact=contact, **ends)


def slid(coefficient, speed, times, slip_speed=1e-3):
    scene = sledge(coefficient, slip_speed)
    velocity = np.zeros((scene.rod.elements + 1, 3))
    velocity[scene.rod.parts[2].nodes] = speed
    return scene, rx.rollout(scene, rx.start(scene, velocity=velocity), times)


@pytest.mark.slow
def test_a_bar_is_braked_to_rest():
    """Along itself, and then it stays; across it rolls on."""
    scene, run = slid(FRICTION, (0.1, 0.05, 0.0), np.arange(1, 61) * 1e-3)
    speed = np.mean(run.states.velocity[:, scene.rod.parts[2].nodes], 1)
    assert int(run.result) == 0
    np.testing.assert_allclose(speed[-1, 0], 0.0, atol=0.01)
    # two thirds of the speed are left where nothing else takes it
    assert 0.5 < speed[-1, 1] / 0.05 < 2 / 3
    last, bar = run.states, scene.rod.parts[2].nodes
    spin = rotations.rotate(last.quaternion[-1], last.angular_velocity[-1])[bar]
    height = np.mean(last.position[-1, bar, 2])
    np.testing.assert_allclose(speed[-1, 1], -np.mean(spin[:, 0]) * height / 2, rtol=0.02)
    found = rx.measures.contacts(scene, run)
    assert float(np.min(found.power)) >= 0
    ledger = rx.energy.ledger(scene, run)
    assert abs(float(ledger.residual[-1])) < 0.01 * float(ledger.kinetic[0])


def test_anchors_are_refused():
    with pytest.raises(ValueError, match="friction: strands have no anchors.*SlidingFriction"):
        crossing(rx.Friction(0.3))


@pytest.mark.slow
def test_at_rest_there_is_none():
    """Statics leave it out, and with it the unknowns that it couples."""
    scene = sledge(FRICTION)
    assert scene.resting.contact.friction is None
    still = of_upper(scene, 0.0)
    np.testing.assert_array_equal(exerted(scene, still, still)[:, 3:], 0.0)


@pytest.mark.slow
def test_derivatives_while_it_slides_and_when_it_sticks():
    """Of where the bar gets to, by the coefficient: reverse, forward and differences."""
    scene = sledge(FRICTION)
    velocity = np.zeros((scene.rod.elements + 1, 3))
    velocity[scene.rod.parts[2].nodes] = (0.03, 0.0, 0.0)
    state = rx.start(scene, velocity=velocity)

    def reached(coefficient):
        rubbed = eqx.tree_at(lambda s: s.contact.friction.coefficient, scene, coefficient)
        run = rx.rollout(rubbed, state, np.array([0.005, 0.03]))
        return run.states.position[1:, scene.rod.parts[2].last, 0]

    mu, h = jnp.asarray(FRICTION), 1e-5
    forward = jax.jit(jax.jacfwd(reached))(mu)
    reverse = jax.jit(jax.jacrev(reached))(mu)
    run = jax.jit(reached)
    differences = (run(mu + h) - run(mu - h)) / (2 * h)
    assert np.all(np.abs(forward) > 1e-5)
    np.testing.assert_allclose(reverse, forward, rtol=1e-9)
    np.testing.assert_allclose(forward, differences, rtol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("slip_speed", [1e-2, 1e-4, 1e-6])
def test_sticking_starts_do_not_fail(slip_speed):
    """A hundred pushes of strands pressed together; without duals ten fail at the slower two."""
    scene = crossing(rx.SlidingFriction(0.5, slip_speed))
    state = rx.start(scene)
    advance = jax.jit(lambda state: rx.step(scene, state, jnp.asarray(1e-3)))
    rng, lever = np.random.default_rng(7), np.array([1, 1, 0.3, 30, 30, 30])
    for _ in range(100):
        rate = 10 ** rng.uniform(-3, 0) * rng.normal(size=state.rate.shape) * lever
        _, info = advance(dataclasses.replace(state, rate=jnp.asarray(rate)))
        assert int(info.result) == 0


@pytest.mark.slow
def test_a_held_derivative_leads_to_the_same_motion():
    """With its duals, for strands that slip, and that stick."""
    scene = crossing(rx.SlidingFriction(0.5, 1e-3))
    state, stop = rx.start(scene), jnp.asarray(1e-3)

    @jax.jit
    def solved(rate):
        moving = dataclasses.replace(state, rate=rate)
        equations = step_equations(scene, moving, stop, jnp.asarray(0.5))
        guess = equations.guess(moving.force)
        near = scene.find(moving.position, equations.increment(guess)[:, :3])
        equations = dataclasses.replace(equations, found=near)
        guess = equations.limited(guess)
        way = lambda held: newton.iterate_dual(equations, guess, 1e-12, 40, held=held)
        return way(False), way(True)

    rng, lever = np.random.default_rng(3), np.array([1, 1, 0.3, 30, 30, 30])
    for size in (1e-3, 1e-1, 1.0):
        for _ in range(5):
            rate = jnp.asarray(size * rng.normal(size=state.rate.shape) * lever)
            (fresh, info), (held, other) = solved(rate)
            assert int(info.result) == int(other.result) == 0
            np.testing.assert_allclose(held, fresh, rtol=1e-9, atol=1e-10)
