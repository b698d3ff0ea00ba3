"""Motors and actuators: hinges and slides that schedules drive, and rings driven in Lk."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_joints import ENDS, STIFF

import rodjax as rx
from rodjax.dynamics import passages
from rodjax.equations import joint_terms
from rodjax.rods.state import node_motion
from rodjax.scenes import drives

RATE, GAIN = 3.0, 8.0  # of a motor at the start [rad/s], and what it gains [rad/s^2]


def sped_up(time):
    return RATE * time + 0.5 * GAIN * time**2


def moved_on(time):
    return 0.2 * time + 0.5 * 4.0 * time**2


LINE = (
    rx.straight_rod(0.5, 2, STIFF, direction=(1, 0, 0)),
    rx.straight_rod(1.0, 4, STIFF, direction=(1, 0, 0), origin=(0.5, 0, 0)),
)


def driven(joint, *loads):
    """A clamped rod and a stiff one in line with it, joined so."""
    return rx.Scene(rods=LINE, first_end=(rx.Clamped(), rx.Free()), loads=loads, joints=(joint,))


@pytest.mark.slow
def test_a_motor_swings_a_rod():
    """At its rate and by the work of a rigid rod, and that is in the ledger."""
    up = jnp.asarray([0.0, 0.0, 1.0])
    axis = rx.rotations.rotate_inverse(LINE[0].quaternion[-1], up)
    scene = driven(rx.Hinge(*ENDS, axis=axis, angle=rx.Function(sped_up)))
    moves = np.arange(8) > 2  # the nodes of the second rod
    arm = np.asarray(scene.rod.position)[:, 0] - 0.5
    velocity = np.outer(np.where(moves, RATE * arm, 0.0), [0.0, 1.0, 0.0])
    spin = np.outer(np.where(moves, RATE, 0.0), axis)
    state = rx.start(scene, velocity=velocity, angular_velocity=spin)
    np.testing.assert_allclose(state.velocity, velocity, atol=1e-9)
    # the spin of the node that the joint drives follows from its schedule
    slower = rx.start(scene, velocity=velocity)
    turning = (slower.angular_velocity[3] - slower.angular_velocity[2]) @ axis
    np.testing.assert_allclose(turning, RATE, rtol=1e-9)
    # lumped as the nodes are
    masses = 0.25 * np.array([0.5, 1.0, 1.0, 1.0, 0.5])
    inertia = np.sum(masses * np.linspace(0, 1, 5) ** 2) + 1e-6
    run = rx.rollout(scene, state, np.linspace(0, 0.5, 101)[1:])
    angle = sped_up(0.5)
    tip = np.asarray(run.final.position[-1]) - [0.5, 0.0, 0.0]
    np.testing.assert_allclose(tip, [np.cos(angle), np.sin(angle), 0.0], atol=1e-3)
    # its torque over the angle (about which the rod, which is not rigid, makes it vibrate)
    torque = -np.asarray(run.states.joints)[:, 0, 3:] @ np.asarray(axis)
    turned = np.diff(sped_up(np.asarray(run.times)))
    work = np.sum(0.5 * (torque[1:] + torque[:-1]) * turned)
    ledger = rx.energy.ledger(scene, run)
    gained = 0.5 * inertia * ((RATE + 0.5 * GAIN) ** 2 - RATE**2)
    np.testing.assert_allclose([work, ledger.drive_work[-1]], gained, rtol=1e-2)
    np.testing.assert_allclose(ledger.residual, 0.0, atol=1e-2 * gained)


@pytest.mark.slow
def test_an_actuator_pushes_a_rod():
    """A slide driven along its axis exerts mass times acceleration, and holds its way."""
    along = rx.rotations.rotate_inverse(LINE[0].quaternion[-1], jnp.asarray([1.0, 0.0, 0.0]))
    scene = driven(rx.Slide(*ENDS, axis=along, displacement=rx.Function(moved_on)))
    state = rx.start(scene)
    np.testing.assert_allclose(state.velocity[3:], [[0.2, 0.0, 0.0]] * 5, atol=1e-9)
    np.testing.assert_allclose(state.joints[0, :3], -4.0 * np.asarray(along), atol=1e-9)
    run = rx.rollout(scene, state, np.linspace(0, 0.5, 11)[1:])
    np.testing.assert_allclose(run.final.position[-1], [1.5 + moved_on(0.5), 0, 0], atol=1e-9)
    ledger = rx.energy.ledger(scene, run)
    np.testing.assert_allclose(ledger.drive_work[-1], 0.5 * (2.2**2 - 0.2**2), rtol=1e-6)
    np.testing.assert_allclose(ledger.residual, 0.0, atol=1e-6)


SECTION = rx.circular_section(0.02, 1e6, 0.4e6, density=1500.0)
RING = rx.ring(1.0, 16, SECTION, turns=0.25)


def wound(sense, turns, **given):
    """A ring of which a motor where its ends meet drives the linking number."""
    drive = rx.Smooth([0.0, 1.0], [0.0, 2 * np.pi * turns])
    points = (rx.Point(0), rx.Point(-1))[::sense]
    motor = rx.Hinge(*points, axis=(0, 0, sense), angle=drive)
    return rx.Scene(RING, joints=(motor,), **given)


@pytest.mark.slow
@pytest.mark.parametrize("sense", [1, -1])
def test_a_ring_is_wound_up_where_its_ends_meet(sense):
    """Whichever end comes first: Lk is what was applied, no passage, and the work is booked."""
    scene = wound(sense, 2.5, loads=(rx.LinearDrag(5.0, 5.0, 1e-3),))
    assert scene.closed
    run = rx.rollout(scene, rx.start(scene), np.linspace(0, 1.0, 61)[1:])
    found = rx.measures.linking(scene, run)
    np.testing.assert_allclose(found.turns[-1], 2.5, rtol=1e-12)
    np.testing.assert_allclose(found.error, 0.0, atol=1e-7)
    np.testing.assert_allclose(found.twist[-1] + found.writhe[-1], 2.75, atol=1e-7)
    gap = joint_terms.gaps(scene, node_motion(run.final))
    np.testing.assert_allclose(gap, 0.0, atol=1e-12)
    assert abs(float(passages.unexplained(scene, run.state(0), run.final))) < 1e-6
    ledger = rx.energy.ledger(scene, run)
    np.testing.assert_allclose(ledger.residual, 0.0, atol=1e-3 * ledger.drive_work[-1])
    # between the twist's energy at rest and that with the drag of the whole way
    rest = 0.5 * RING.stiffness[0, 2] * (2 * np.pi) ** 2 * (2.75**2 - 0.25**2)
    assert rest < float(ledger.drive_work[-1]) < 1.2 * rest


@pytest.mark.slow
def test_a_ring_at_rest_has_the_torque_of_its_twist():
    """Below Michell's threshold C 2 pi Lk / L, after more turns than a frame tells; its slope.

    To second order in the element length.
    """
    stiff, errors = float(RING.stiffness[0, 2]), []
    for elements in (16, 32):
        ring = rx.ring(1.0, elements, SECTION, turns=0.25)

        @jax.jit
        def torque(turns, ring=ring):
            drive = rx.Smooth(jnp.asarray([0.0, 1.0]), jnp.stack([0.0 * turns, 2 * jnp.pi * turns]))
            motor = rx.Hinge(rx.Point(0), rx.Point(-1), axis=(0, 0, 1), angle=drive)
            scene = rx.Scene(ring, first_end=rx.Clamped(), joints=(motor,))
            state, _ = rx.equilibrium(scene, rx.placing(scene), time=1.0, throw=False)
            return -state.joints[0, 5]

        one = stiff * 2 * np.pi
        found = torque(jnp.asarray(1.5)) / (1.75 * one), torque(jnp.asarray(-1.25)) / (-1.0 * one)
        slope = jax.grad(torque)(jnp.asarray(1.5))
        small = 1e-4
        either = [torque(jnp.asarray(1.5 + way)) for way in (-small, small)]
        np.testing.assert_allclose(slope, (either[1] - either[0]) / (2 * small), rtol=1e-6)
        errors.append(np.abs(np.array([*found, slope / one]) - 1))
    assert np.all(errors[1] < 0.01)
    np.testing.assert_allclose(errors[0] / errors[1], 4.0, rtol=0.15)


# What is refused


def test_refusals():
    scene = lambda **given: rx.Scene(RING, joints=(rx.Hinge(rx.Point(0), rx.Point(-1), **given),))
    with pytest.raises(ValueError, match="displacement: the schedule must give one number"):
        rx.Slide(*ENDS, axis=(0, 0, 1), displacement=rx.Constant((0.0, 0.0, 1.0)))
    elsewhere = scene(axis=(0, 0, 1), angle=rx.Constant(0.3))
    with pytest.raises(ValueError, match=r"joints\[0\].angle: its schedule says 0.3 at t = 0"):
        rx.start(elsewhere)
    drive = rx.Smooth([0.0, 1.0], [0.0, 1.0])
    with pytest.raises(ValueError, match=r"joints\[0\].angle: its schedule ends at 1, before"):
        rx.rollout(wound(1, 1.0), rx.placing(wound(1, 1.0)), [0.5, 2.0])
    with pytest.raises(ValueError, match=r"joints\[0\]: turns are counted for a drive about"):
        rx.measures.turns(scene(axis=(0, 1, 1), angle=drive), 1.0)


def test_a_step_of_half_a_turn_is_too_fast():
    """Which frames would not tell from none."""
    scene = wound(1, 2.5)
    drive, frames = scene.joints[0].angle, scene.rod.quaternion
    for stop in (0.2, 0.4):
        within = bool(drive(jnp.asarray(stop)) < np.pi)
        too_fast = drives.too_fast(scene, jnp.asarray(0.0), jnp.asarray(stop), frames)
        assert bool(too_fast) is not within
    assert not within
