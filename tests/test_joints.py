"""Joints between points of rods: their equations, motions and equilibria."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import random_arrays
from scipy.integrate import solve_ivp

import rodjax as rx
from rodjax import rotations
from rodjax.equations.equations import Equations, step_equations
from rodjax.equations.imbalance import lacking
from rodjax.equations.schemes import rest_on_path
from rodjax.rods.state import State

SECTION = rx.Section(
    stiffness=(1.0, 1.3, 0.7), mass=1.0, rotary_inertia=(1e-3, 1e-3, 2e-3), diameter=0.02
)
ENDS = rx.Point(-1), rx.Point(0, rod=1)
DRIVE = rx.Smooth([0.0, 1.0], [0.0, 0.4])
KINDS = {
    "weld": rx.Weld(*ENDS),
    "ball": rx.Ball(*ENDS),
    "hinge": rx.Hinge(*ENDS, axis=(0.3, 1.0, 0.2)),
    "slide": rx.Slide(*ENDS, axis=(0.0, 0.6, 0.8)),
    "motor": rx.Hinge(*ENDS, axis=(0.3, 1.0, 0.2), angle=rx.Smooth([0.0, 1.0], [0.0, 0.4])),
    "actuator": rx.Slide(
        *ENDS, axis=(0.0, 0.6, 0.8), displacement=rx.Smooth([0.0, 1.0], [0.0, 0.4])
    ),
    "offset": rx.Hinge(
        rx.Point(-1, offset=(0.1, 0.0, 0.2)),
        rx.Point(0, rod=1, offset=(0.1, 0.0, 0.2)),
        axis=(0.0, 1.0, 0.0),
    ),
}


def two(joint, **given):
    """Two rods of 3 and 2 elements in one line, joined."""
    rods = (
        rx.straight_rod(1.0, 3, SECTION),
        rx.straight_rod(0.6, 2, SECTION, origin=(0.0, 0.0, 1.0)),
    )
    given = dict(first_end=(rx.Clamped(), rx.Free()), joints=(joint,)) | given
    return rx.Scene(rods=rods, **given)


BOTH = [(kind, moving) for kind in KINDS for moving in (True, False)]
QUICK = [("motor", True)]


@pytest.mark.parametrize(
    ("kind", "moving"),
    [both if both in QUICK else pytest.param(*both, marks=pytest.mark.slow) for both in BOTH],
)
def test_the_newton_system_is_the_derivative(kind, moving):
    """Of the residual at a state that solves nothing; and what solves it, both ways."""
    scene = two(KINDS[kind])
    rod = scene.rod
    count = rod.elements + 1
    shift, turn, rates, force, joints, b = random_arrays(
        7, (count, 3), (count, 3), (count, 6), (rod.elements, 3), (1, 6), (count + 1, 9)
    )
    rates, b = rates.at[0].set(0.0), b.at[0].set(0.0)  # the held node is where it is held
    quaternion = rotations.multiply(rod.quaternion, rotations.exponential(0.1 * turn))
    state = rx.placing(scene)
    state = dataclasses.replace(
        state,
        position=rod.position + 0.05 * shift,
        quaternion=quaternion,
        rate=rates,
        force=force,
        joints=joints,
    )

    @jax.jit
    def systems(scene, state, b):
        if moving:
            equations = step_equations(scene, state, jnp.asarray(0.05), jnp.asarray(0.8))
        else:
            one = jnp.asarray(1.0)
            reference = state.position, state.quaternion
            path = rest_on_path(reference, one, 0.7 * one, lacking(scene, state))
            equations = Equations.of(scene, path, state, state.time)
        x = equations.guess(state.force, state.joints) + 0.01 * b
        lifted = lambda dx: equations.residual(x + equations.lift(x, dx))
        exact = jax.jacfwd(lifted)(jnp.zeros_like(x)).reshape(x.size, x.size)
        system = equations.linearize(x)
        columns = jnp.eye(x.size).reshape(x.size, *x.shape)
        matrix = jax.vmap(system.multiply)(columns).reshape(x.size, x.size).T
        return exact, matrix, system.solve(b).ravel(), system.solve_transpose(b).ravel()

    # rows of what does not exist say that it is zero
    exact, matrix, solved, transposed = systems(scene, state, b)
    dummies = [9 * count + 3 + i for i in range(3)]
    exact = np.array(exact)
    exact[dummies, dummies] = 1.0
    np.testing.assert_allclose(matrix, exact, atol=1e-10 * np.max(np.abs(exact)))
    if not (moving or kind == "weld"):  # at rest nothing holds what the joint leaves free
        return
    right = np.asarray(b).ravel()
    np.testing.assert_allclose(exact @ solved, right, atol=1e-9 * np.max(np.abs(exact)))
    np.testing.assert_allclose(exact.T @ transposed, right, atol=1e-9 * np.max(np.abs(exact)))


STIFF = rx.Section(stiffness=(1e4, 1e4, 1e4), mass=1.0, rotary_inertia=(1e-6, 1e-6, 1e-6))


def pendulum(angles, times):
    """Tip of two rigid rods, lumped as the nodes are, by their equations of motion."""
    count, inertia, gravity = 4, 1e-6, 9.81
    sums = []
    for length in (1.0, 0.7):
        s = np.linspace(0.0, length, count + 1)
        m = np.full(count + 1, length / count)
        m[[0, -1]] *= 0.5
        sums.append((m.sum(), m @ s, m @ s**2 + inertia * length))
    (_, s1, i1), (m2, s2, i2) = sums

    def slope(_, y):
        p, q, dp, dq = y
        c, s = np.cos(p - q), np.sin(p - q)
        matrix = np.array([[i1 + m2, s2 * c], [s2 * c, i2]])
        right = [
            -s2 * s * dq**2 - gravity * (s1 + m2) * np.sin(p),
            s2 * s * dp**2 - gravity * s2 * np.sin(q),
        ]
        return [dp, dq, *np.linalg.solve(matrix, right)]

    span = (0.0, times[-1])
    p, q = solve_ivp(slope, span, [*angles, 0, 0], t_eval=times, rtol=1e-10, atol=1e-12).y[:2]
    return np.stack([np.sin(p) + 0.7 * np.sin(q), -np.cos(p) - 0.7 * np.cos(q)], 1)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["ball", "hinge"])
def test_double_pendulum(kind):
    angles = 0.5, 0.9
    down = lambda angle: (np.sin(angle), 0.0, -np.cos(angle))
    one = rx.straight_rod(1.0, 4, STIFF, direction=down(angles[0]))
    other = rx.straight_rod(0.7, 4, STIFF, direction=down(angles[1]), origin=down(angles[0]))
    across = rotations.rotate_inverse(one.quaternion[0], jnp.asarray([0.0, 1.0, 0.0]))
    joint = rx.Ball(*ENDS) if kind == "ball" else rx.Hinge(*ENDS, axis=across)
    gravity = (rx.Gravity((0.0, 0.0, -9.81)),)
    ends = (rx.Pinned(), rx.Free())
    scene = rx.Scene(rods=(one, other), first_end=ends, loads=gravity, joints=(joint,))
    times = np.linspace(0.0, 0.4, 101)
    run = rx.rollout(scene, rx.start(scene), jnp.asarray(times[1:]))
    position = np.asarray(run.states.position)
    np.testing.assert_allclose(position[:, -1, [0, 2]], pendulum(angles, times), atol=1e-4)
    np.testing.assert_allclose(position[:, 4], position[:, 5], atol=1e-12)
    assert int(np.max(run.infos.iterations)) <= 3
    # no joint does work
    ledger = rx.energy.ledger(scene, run)
    np.testing.assert_allclose(ledger.residual, 0.0, atol=1e-3 * np.max(ledger.kinetic))


@pytest.mark.slow
def test_a_joint_carries_what_hangs_from_it():
    """Two rods that hang: its force on the first is the weight of the second."""
    gravity = (rx.Gravity((0.0, 0.0, 2.0)),)
    scene = two(rx.Hinge(*ENDS, axis=(1.0, 0.0, 0.0)), loads=gravity)
    state, info = rx.equilibrium(scene, rx.start(scene))
    np.testing.assert_allclose(state.joints[0, :3], [0.0, 0.0, 0.6 * 2.0], atol=1e-9)
    np.testing.assert_allclose(state.joints[0, 3:], 0.0, atol=1e-9)
    np.testing.assert_allclose(state.position[3], state.position[4], atol=1e-12)
    reaction = rx.energy.reactions(scene, state).force[0]
    np.testing.assert_allclose(reaction, [0.0, 0.0, -1.6 * 2.0], atol=1e-9)
    assert info.unstable == 0


@pytest.mark.slow
def test_a_weld_makes_one_rod():
    """Of two: the cantilever's own deflection, and the moment inside it."""
    load = (rx.PointLoad(-1, rx.Constant((0.05, 0.0, 0.0))),)
    scene = two(KINDS["weld"], loads=load)
    state, _ = rx.equilibrium(scene, rx.start(scene))
    lengths = [1.0 / 3] * 3 + [0.3] * 2
    whole = rx.straight_rod(1.6, 5, SECTION)
    position = np.zeros((6, 3))
    position[1:, 2] = np.cumsum(lengths)
    whole = dataclasses.replace(whole, length=jnp.asarray(lengths), position=jnp.asarray(position))
    one = rx.Scene(whole, rx.Clamped(), rx.Free(), load)
    same, _ = rx.equilibrium(one, rx.start(one))
    np.testing.assert_allclose(state.position[:4], same.position[:4], atol=1e-10)
    np.testing.assert_allclose(state.position[4:], same.position[3:], atol=1e-10)
    moment = 0.05 * (same.position[-1, 2] - same.position[3, 2])
    frame = state.quaternion[3]
    torque = rotations.rotate(frame, state.joints[0, 3:])
    np.testing.assert_allclose(torque, [0.0, moment, 0.0], atol=1e-8)


@pytest.mark.slow
def test_gradients_through_a_joint():
    """Reverse and forward, and differences: by a stiffness and by where a hinge sits."""
    times = jnp.linspace(0.0, 0.2, 9)[1:]
    base = two(KINDS["offset"], loads=(rx.Gravity((3.0, 0.0, 1.0)),))

    @jax.jit
    def tip(p):
        stiffness = base.rod.stiffness.at[:3].multiply(1 + p[0])
        offset = jnp.asarray([0.1, 0.0, 0.2]) + p[1] * jnp.asarray([0.0, 0.0, 1.0])
        first, second = (
            dataclasses.replace(point, offset=offset)
            for point in (base.joints[0].first, base.joints[0].second)
        )
        joint = dataclasses.replace(base.joints[0], first=first, second=second)
        rod = dataclasses.replace(base.rod, stiffness=stiffness)
        scene = dataclasses.replace(base, rod=rod, joints=(joint,))
        return rx.rollout(scene, rx.start(scene), times).final.position[-1, 0]

    p = jnp.zeros(2)
    reverse, forward = jax.grad(tip)(p), jax.jacfwd(tip)(p)
    np.testing.assert_allclose(reverse, forward, rtol=1e-9)
    h = 1e-5
    differences = [(tip(h * e) - tip(-h * e)) / (2 * h) for e in jnp.eye(2)]
    np.testing.assert_allclose(reverse, differences, rtol=1e-5)


# What is refused


@pytest.mark.parametrize(
    ("joint", "message"),
    [
        (rx.Ball(rx.Point(0), rx.Point(0, rod=1)), r"joints\[0\]: its points are 1 apart"),
        (rx.Ball(rx.Point(7), rx.Point(0, rod=1)), r"first: node: a rod of 3 elements"),
        (rx.Ball(rx.Point(0), rx.Point(0, rod=2)), r"second: rod: the scene's rods are 0 to 1"),
        (rx.Ball(rx.Point(3), rx.Point(-1)), r"both points are at node 3"),
    ],
)
def test_refusals(joint, message):
    with pytest.raises(ValueError, match=message):
        two(joint)


def test_an_axis_has_a_direction():
    with pytest.raises(ValueError, match="axis: give three finite components"):
        rx.Hinge(*ENDS, axis=(0.0, 0.0, 0.0))


@pytest.mark.slow
def test_a_free_rod_on_a_ball_spins():
    """Statics says what nothing holds: the second rod's spin about itself."""
    scene = two(KINDS["ball"], loads=(rx.Gravity((0.0, 0.0, 2.0)),))
    with pytest.raises(ValueError, match="leave 1 rigid motion"):
        rx.equilibrium(scene, rx.start(scene))


@pytest.mark.slow
def test_states_have_the_joints():
    scene = two(KINDS["weld"])
    state = rx.start(scene)
    assert isinstance(state, State)
    assert state.joints.shape == (1, 6)
    np.testing.assert_allclose(state.joints, 0.0, atol=1e-12)
