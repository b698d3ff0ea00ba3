"""Obstacles that act between nodes, and those that come between the points where they are felt."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import primitives, random_arrays
from hypothesis import given, settings
from hypothesis import strategies as st

import rodjax as rx
from rodjax import rotations
from rodjax.equations.equations import step_equations
from rodjax.equations.imbalance import node_tangent
from rodjax.equilibria import admissible
from rodjax.interactions.element_points import ElementPoints
from rodjax.measuring import energy, measures
from rodjax.rods.state import NodeMotion, at_rest, moved, node_motion

SECTION = rx.circular_section(0.02, 1e9, 4e8, density=1500.0)
WEIGHT = 9.81 * 1500 * np.pi * 1e-4  # of a metre
RADIUS = 0.01
WAY = rx.PiecewiseLinear([0.0, 1.0], [(0, 0, 0), (0.02, 0.01, 0.03)])


def peg(x=0.5, radius=0.004, down=0.02, **changes):
    """One across the rod, its top so far below the centreline."""
    changes = {"stiffness": 1e6} | changes
    return rx.Obstacle(rx.Cylinder((x, 0, -down - radius), (0, 1, 0), radius), **changes)


def rod(elements=5, **changes):
    return rx.straight_rod(1.0, elements, SECTION, direction=(1, 0, 0), **changes)


def two_rods(*loads):
    """One with a taper, and another beside it."""
    tapered = dataclasses.replace(rod(4), diameter=jnp.asarray([0.02, 0.03, 0.025, 0.02]))
    return rx.Scene(rods=(tapered, rod(3, origin=(0.1, 0.3, 0.01))), loads=loads)


def motion_of(rod, seed=0):
    """A random motion of a rod near where it is placed."""
    nodes = rod.elements + 1
    moves, rates = random_arrays(seed, (nodes, 6), (nodes, 6))
    rest = moved(at_rest(jnp.asarray(0.4), rod.position, rod.quaternion), 0.02 * moves)
    return rest._replace(velocity=rates[:, :3], angular_velocity=5 * rates[:, 3:])


# what presses all that is near it, from below
BALL = rx.Sphere((0.45, 0.1, -10.0), 10.0)


def on_ball(points, friction=None, **changes):
    return rx.Obstacle(BALL, 1e4, friction, points_per_element=points, **changes)


@pytest.mark.parametrize("thin", [0.004, 0.0005])
def test_what_comes_between_points_is_told(thin):
    """Sinking slowly, or all at once; nodes that see it, and points near enough, do not fail."""
    one, place = rod(), rod().position.at[:, 2].set
    asked = rx.jit(lambda obstacle, *places: obstacle.verdict(one, *places, None))
    verdict = lambda obstacle, before, after: int(asked(obstacle, place(before), place(after)))
    passed, well = rx.Result.OBSTACLE_PASSED, rx.Result.SUCCESS
    top = -0.02
    for points in (1, 3):
        between = peg(0.5 + 0.02 * (points > 1), thin, points_per_element=points)
        assert verdict(between, 0.0, top + 0.005) == well
        assert verdict(between, top + 1e-5, top - 1e-4) == passed  # slowly
        assert verdict(between, 0.0, top - 20 * thin) == passed  # at once
    # a point every 10 mm, the radius
    assert verdict(peg(0.5, thin, points_per_element=20), top + 1e-5, top - 1e-4) == well
    assert verdict(peg(0.4, thin), top + 1e-5, top - 1e-4) == well  # at a node
    assert verdict(peg(0.4, thin), top - 0.9 * thin, top - 1.1 * thin) == passed  # through it
    drum = rx.Obstacle(rx.Cylinder((0.5, 0, -3), (0, 1, 0), 3.0), 1e4)
    assert verdict(drum, 0.0095, 0.009) == well
    for away in (rx.Plane(), rx.Sphere((0, 0, 0), 5.0, inside=True)):
        assert rx.Obstacle(away, 1e4).path_verdict(one, one.position, one.position) is None


def test_a_rod_is_a_polygon_on_a_drum():
    """The middles of its chords are in the drum, as their ends see where these are not too long."""
    one, drum = rod(4), rx.Obstacle(rx.Cylinder((0, 0, 0), (0, 1, 0), 0.5), 1e5)
    for angle, expected in ((0.5, rx.Result.SUCCESS), (1.2, rx.Result.OBSTACLE_PASSED)):
        around = angle * np.arange(5)
        place = (0.5 + 0.99 * RADIUS) * np.stack([np.sin(around), 0 * around, np.cos(around)], 1)
        assert (0.5 + RADIUS) * np.cos(0.5 * angle) < 0.5
        at = jnp.asarray(place)
        assert int(drum.path_verdict(one, at, at)) == expected


def test_a_start_between_nodes_is_refused():
    with pytest.raises(ValueError, match=r"inside the obstacle, between nodes 2 and 3 by 0.00"):
        rx.Scene(rod(), loads=(peg(0.52, down=-0.002),))
    with pytest.raises(ValueError, match=r"inside the obstacle, between nodes 2 and 3 by 0.00"):
        rx.Scene(rod(), loads=(peg(0.5, down=-0.002, points_per_element=4),))
    with pytest.raises(ValueError, match="points_per_element: must be a whole number"):
        rx.Obstacle(rx.Plane(), 1e4, points_per_element=0)
    # nodes of two rods, between which is no element
    apart = rx.Scene(
        rods=(rod(3), rod(3, origin=(1.2, 0, 0))),
        loads=(peg(1.1, down=-0.002, points_per_element=3), peg(0.5)),
    )
    assert len(apart.loads) == 2


def test_the_nodes_alone_cost_nothing_more():
    """No block beside those of the nodes, no look between what lies on a plane."""
    one, two = (rx.Scene(rod(), loads=(rx.Obstacle(rx.Plane((0, 0, -1)), 1e4),)), two_rods())
    for scene in (one, two):
        rest = at_rest(jnp.asarray(0.0), scene.rod.position, scene.rod.quaternion)
        blocks = jax.eval_shape(lambda scene=scene, rest=rest: node_tangent(scene, rest))
        assert blocks.before is None and blocks.after is None and not scene.between_nodes
    points, rows = ElementPoints(one.rod, 1), one.rod.position
    assert points.at(rows) is rows and points.to_nodes(rows) is rows
    plane = one.loads[0]
    jaxpr = jax.make_jaxpr(lambda a: plane.verdict(one.rod, a, a, None))(rows)
    assert "cond" not in primitives(jaxpr.jaxpr)


@settings(deadline=None, max_examples=10)
@given(st.integers(0, 1000), st.integers(1, 4), st.sampled_from([None, 0.3]))
def test_forces_and_moments_of_the_points_are_those_of_the_nodes(seed, points, mu):
    """Of rods beside each other, about the origin, and their power."""
    friction = None if mu is None else rx.SlidingFriction(mu, 0.1)
    scene = two_rods()
    whole, ball = scene.rod, on_ball(points, friction)
    motion = motion_of(whole, seed)
    wrench = ball.wrench(whole, motion)
    touch, at = ball.touch(whole, motion), ElementPoints(whole, points)
    force = touch.load[:, None] * touch.normal
    if friction is not None:
        force = force + friction.traction(touch.rubbing)
    force = np.asarray(at.length[:, None] * force)
    place, arm = np.asarray(at.at(motion.position)), np.asarray(touch.arm)
    np.testing.assert_allclose(np.sum(wrench[:, :3], 0), np.sum(force, 0), atol=1e-9)
    turning = np.asarray(rotations.rotate(motion.quaternion, wrench[:, 3:]))
    moment = np.sum(turning + np.cross(motion.position, wrench[:, :3]), 0)
    np.testing.assert_allclose(moment, np.sum(np.cross(place + arm, force), 0), atol=1e-9)
    spin = at.at(rotations.rotate(motion.quaternion, motion.angular_velocity))
    speed = np.asarray(at.at(motion.velocity)) + np.cross(spin, arm)
    rate = np.concatenate([motion.velocity, motion.angular_velocity], 1)
    np.testing.assert_allclose(np.sum(wrench * rate), np.sum(force * speed), atol=1e-8)
    assert np.all(np.isfinite(wrench))


@pytest.mark.parametrize("friction", [None, rx.Friction(0.0)])
def test_the_wrench_is_the_slope_of_the_energy(friction):
    scene = two_rods()
    ball, motion = on_ball(3, friction), motion_of(scene.rod)
    rest = at_rest(*motion[:3])
    zero = jnp.zeros((scene.rod.elements + 1, 6))
    slope = jax.grad(lambda z: ball.energy(scene.rod, moved(rest, z)))(zero)
    wrench = ball.wrench(scene.rod, rest)
    assert float(jnp.max(jnp.abs(wrench))) > 1.0
    np.testing.assert_allclose(slope, -wrench, atol=1e-9)


def test_two_rods_are_as_each_alone():
    both = two_rods()
    alone = [rx.Scene(one).rod for one in both.rods]
    motion, ball = motion_of(both.rod), on_ball(3, rx.SlidingFriction(0.3, 0.1), relaxation=1e-2)
    whole = ball.wrench(both.rod, motion)
    for one, part in zip(alone, both.rod.parts, strict=True):
        nodes = slice(part.first, part.last + 1)
        own = NodeMotion(motion.time, *(rows[nodes] for rows in motion[1:]))
        np.testing.assert_allclose(ball.wrench(one, own), whole[nodes], rtol=1e-12, atol=1e-12)


def test_the_tangent_is_the_derivative():
    """Of a step of two rods on what moves, with friction that remembers, slides and sticks."""
    loads = (
        on_ball(2, rx.Friction(0.3, 1e4), relaxation=0.02, displacement=WAY),
        on_ball(3, rx.SlidingFriction(0.2, 0.1), suction=True),
        rx.LinearDrag(0.3, 0.2),
    )
    scene = two_rods(*loads)
    state = rx.start(scene, velocity=0.2 * random_arrays(3, (scene.rod.elements + 1, 3))[0])
    equations = step_equations(scene, state, jnp.asarray(0.02), jnp.asarray(0.5))
    x = equations.guess(state.force)
    moves, direction = random_arrays(4, x.shape, x.shape)
    x = (x + 0.01 * moves).at[0, 3:6].set(0.0)
    touch = equations.scene.loads[0].touch(scene.rod, equations.motion(x))
    assert np.any(touch.load > 0) and np.any(touch.load == 0)

    @jax.jit
    def both(x, direction):
        derivative = jax.jvp(equations.residual, (x,), (equations.lift(x, direction),))[1]
        return equations.linearize(x).multiply(direction), derivative

    found, expected = both(x, direction)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9 * np.max(np.abs(expected)))


def resting(points, x=0.5, **changes):
    """A rod whose first end slides upwards, on a peg of which one node at most is near."""
    loads = (
        rx.Gravity((0, 0, -9.81)),
        peg(x, 0.1, RADIUS, stiffness=1e5, points_per_element=points, **changes),
    )
    return rx.Scene(rod(), rx.Slider((0, 0, 1)), loads=loads)


@pytest.mark.slow
def test_a_rod_at_rest_on_a_peg_between_its_nodes():
    """Its weight is the normal force, its height that at which the points give it."""
    scene = resting(6)
    state, info = rx.equilibrium(scene, rx.placing(scene), load_steps=2)
    contact = scene.loads[1].contact(scene.rod, node_motion(state))
    np.testing.assert_allclose(np.sum(contact.normal_force), WEIGHT, rtol=1e-7)
    assert contact.gap.shape == (6,) and np.all(contact.gap > 0)  # no node feels it
    forces = energy.reactions(scene, state).force
    np.testing.assert_allclose(forces[0][2], 0.0, atol=1e-8)
    # what the points in the middle and beside it feel where the rod is, which bends little
    height = float(0.5 * (state.position[2, 2] + state.position[3, 2]))
    gap = np.hypot(np.arange(-3, 4) / 30, height + RADIUS + 0.1) - 0.1 - RADIUS
    depth, width = np.maximum(-gap, 0), 0.05 * 2 * RADIUS
    indented = np.where(depth < width, depth**2 / (2 * width), depth - 0.5 * width)
    np.testing.assert_allclose(np.sum(1e5 * indented / 30), WEIGHT, rtol=0.02)
    assert int(info.unstable) == 0


@pytest.mark.slow
def test_an_equilibrium_with_a_peg_between_nodes_is_none():
    scene = resting(1)
    _, info = rx.equilibrium(scene, rx.placing(scene), load_steps=2, relax=False, throw=False)
    assert int(info.result) == rx.Result.OBSTACLE_PASSED


class Stretched(rx.AbstractLoad):
    """Springs and dampers between neighbours, or nodes further off."""

    stiffness: jax.Array
    reach: int = 1
    damping: float = 0.0
    added: bool = False
    between_nodes = True

    @property
    def inertia(self):
        return self.added

    def wrench(self, rod, motion):
        pull = self.stiffness * (motion.position[self.reach :] - motion.position[: -self.reach])
        rate = motion.velocity[self.reach :] - motion.velocity[: -self.reach]
        pull, none = pull + self.damping * rate, jnp.zeros((self.reach, 3))
        force = jnp.concatenate([pull, none]) - jnp.concatenate([none, pull])
        return jnp.concatenate([force, jnp.zeros_like(force)], 1)

    def added_mass(self, rod, motion):
        if not self.added:
            return None
        middle = jnp.roll(motion.position, 1, 0)
        return jnp.eye(3)[None] * (1 + jnp.sum(middle**2, 1)[:, None, None])


def test_users_loads_between_nodes():
    """Their neighbours are let in, what is further off is refused, as is a mass by neighbours."""
    five = jnp.asarray(5.0)
    scene = rx.Scene(rod(7), rx.Clamped(), loads=(Stretched(five),))
    assert scene.between_nodes
    with pytest.raises(ValueError, match="those beside it in its rod only"):
        rx.Scene(rod(7), loads=(Stretched(five, 2),))
    with pytest.raises(ValueError, match="mass added to it, changes"):
        rx.Scene(rod(7), loads=(Stretched(five, added=True),))
    with pytest.raises(ValueError, match="changes with the motion of node 5"):
        two_rods(Stretched(five))  # from one rod to the next


def test_a_heat_bath_takes_no_drag_between_nodes():
    section = rx.Section((1.0, 1.0, 1.0), mass=None, compliance=(1e-3, 1e-3, 1e-3))
    loads = rx.LinearDrag(1.0, 1.0, 1e-3), Stretched(jnp.asarray(5.0), damping=0.3)
    scene = rx.Scene(rx.straight_rod(1.0, 5, section), loads=loads)
    with pytest.raises(ValueError, match="must be on its own motion"):
        rx.thermal_start(scene, jax.random.key(0))


@pytest.mark.slow
@pytest.mark.parametrize("thin", [0.01, 0.001])
def test_a_rod_that_falls_on_a_peg(thin):
    """It sinks through between two nodes, which is told; points hold it."""

    def run(points):
        pegged = peg(0.5, thin, RADIUS, stiffness=1e6, relaxation=1e-2, points_per_element=points)
        loads = rx.Gravity((0, 0, -9.81)), rx.LinearDrag(20.0, 20.0), pegged
        scene = rx.Scene(rod(), rx.Slider((0, 0, 1)), loads=loads)
        return scene, rx.adaptive_rollout(scene, rx.start(scene), 0.5, throw=False)

    assert rx.Result(int(run(1)[1].result)) is rx.Result.OBSTACLE_PASSED
    scene, held = run(20)
    assert rx.Result(int(held.result)) is rx.Result.SUCCESS
    height = np.asarray(held.final.position[:, 2])
    assert abs(np.mean(height[2:4])) < 0.2 * RADIUS  # between them, at the peg
    force = np.sum(measures.obstacle_contact(scene, held, 2).normal_force[-1])
    np.testing.assert_allclose(force, WEIGHT, rtol=0.02)


@pytest.mark.slow
def test_stability_and_vibration_between_nodes():
    """Modes by elimination are those of the matrices, damping is that of the velocities."""
    scene = resting(6, relaxation=1e-3)
    state, _ = rx.equilibrium(scene, rx.placing(scene), load_steps=2)
    allowed = admissible.admissible(scene, state)
    damping = np.asarray(admissible.damping_matrix(scene, state, allowed))
    # of what is pressed without a soft beginning, as much as of its stiffness
    bare = dataclasses.replace(scene, loads=scene.loads[:1])
    stiffness = np.asarray(allowed.stiffness - admissible.admissible(bare, state).stiffness)
    rate = float(admissible.rate_of(scene))
    up = np.asarray(jnp.einsum("mni,ni->m", allowed.basis, jnp.eye(6)[2][None] * jnp.ones((6, 6))))
    found, small = damping @ up, 1e-4 * np.max(np.abs(damping @ up))
    np.testing.assert_allclose(found, 1e-3 * rate * (stiffness @ up), atol=small)
    np.testing.assert_allclose(damping, damping.T, atol=1e-9 * np.max(np.abs(damping)))
    told = rx.stability(scene, state)
    assert bool(told.symmetric) and bool(told.stable) and float(told.eigenvalues[0]) > 0


@pytest.mark.slow
def test_a_heavy_rod_on_a_drum_converges():
    """Clamped at its top it hangs over it; where its end is, to second order in the elements."""

    def end(elements, points):
        section = rx.circular_section(2 * RADIUS, 1e6, 4e5, density=1500.0)
        one = rx.straight_rod(1.0, elements, section, direction=(1, 0, 0))
        drum = rx.Cylinder((0, 0, -0.4 - RADIUS), (0, 1, 0), 0.4)
        obstacle = rx.Obstacle(drum, 1e5, points_per_element=points)
        scene = rx.Scene(one, rx.Clamped(), loads=(rx.Gravity((0, 0, -9.81)), obstacle))
        return np.asarray(rx.equilibrium(scene, rx.placing(scene))[0].position[-1])

    best = end(96, 2)
    errors = [np.linalg.norm(end(elements, 4) - best) for elements in (12, 24)]
    print(errors, [np.linalg.norm(end(elements, 1) - best) for elements in (12, 24)])
    assert errors[1] < 0.35 * errors[0] and errors[1] < 2e-3


@pytest.mark.slow
def test_derivatives_through_a_run():
    """By place, friction and radius, against differences, forwards and backwards."""
    times = 2e-3 * np.arange(1, 13)

    def end(p):
        shape = rx.Cylinder((0.5 + p[0], 0, -0.1095), (0.1, 1, 0), 0.1 + p[1])
        friction = rx.Friction(0.3 + p[2], 1e5)
        obstacle = rx.Obstacle(shape, 1e4, friction, relaxation=1e-3, points_per_element=5)
        scene = rx.Scene(rod(), loads=(rx.Gravity((2, 1, -9.81)), obstacle))
        final = rx.rollout(scene, rx.start(scene), times, throw=False).final
        return final.position[0, 0] + final.position[1, 2] + 0.1 * final.angular_velocity[2, 2]

    at, small = jnp.zeros(3), np.array([1e-6, 1e-7, 1e-4])
    forward, backward = jax.jacfwd(end)(at), jax.grad(end)(at)
    np.testing.assert_allclose(backward, forward, rtol=1e-8, atol=1e-12)
    steps = [(end(at.at[i].add(s)) - end(at.at[i].add(-s))) / (2 * s) for i, s in enumerate(small)]
    np.testing.assert_allclose(forward, steps, rtol=1e-4, atol=1e-9)


@pytest.mark.slow
def test_it_goes_on_from_a_file(tmp_path):
    """Bit for bit, with what sticks between nodes; a file without the field has the nodes alone."""
    friction = rx.Friction(0.4, 1e5)
    shape = rx.Cylinder((0.5, 0, -0.1097), (0.1, 1, 0), 0.1)
    obstacle = rx.Obstacle(shape, 1e4, friction, relaxation=1e-3, points_per_element=5)
    scene = rx.Scene(rod(), loads=(rx.Gravity((2, 1, -9.81)), obstacle))
    start, control = rx.start(scene), rx.StepControl(max_step=2e-3, min_step=1e-12)
    whole = rx.adaptive_rollout(scene, start, 0.04, control=control)
    half = rx.adaptive_rollout(scene, start, 0.02, control=control)
    rx.storage.save(tmp_path / "half.h5", scene, half, control=control)
    loaded = rx.storage.load(tmp_path / "half.h5")
    assert loaded.scene.loads[1].points_per_element == 5
    rest = loaded.resume(0.04)
    assert rest.final.memory.loads[1].stretch.shape == (6 + 5 * 4, 3)
    assert float(jnp.max(jnp.abs(whole.final.memory.loads[1].stretch))) > 1e-7
    for one, other in zip(jax.tree.leaves(rest.final), jax.tree.leaves(whole.final), strict=True):
        np.testing.assert_array_equal(one, other)
