"""What holds the two ends of the rod: constrained directions and their prescribed motion.

An end tells which directions of translation (inertial axes) and of rotation (body axes) it takes
away, as two orthogonal projectors, and by how much it moves over a step. Motion is prescribed as
the difference of a schedule over the step, so an end stays wherever it is while its schedule
rests, and a constraint may begin at any time.
"""

import abc

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rodjax import rotations
from rodjax.schedules import AbstractSchedule


def _unit(vector):
    vector = jnp.asarray(vector, jnp.result_type(float))
    if not isinstance(vector, jax.core.Tracer):
        norm = np.linalg.norm(vector)
        if vector.shape != (3,) or not norm > 0 or not np.isfinite(norm):
            raise ValueError(f"axis: give three finite components, not all zero; got {vector}")
    return vector / jnp.linalg.norm(vector)


class Turn(eqx.Module):
    """Rotation about a fixed inertial axis by a scheduled angle [rad]."""

    axis: Float[Array, "3"] = eqx.field(converter=_unit)
    angle: AbstractSchedule

    def __check_init__(self):
        shape = jnp.shape(self.angle(jnp.zeros(())))
        if shape != ():
            raise ValueError(f"angle: the schedule must give one number, got shape {shape}")

    def __call__(self, time):
        return self.angle(time) * self.axis

    @property
    def until(self):
        return self.angle.until

    @property
    def corners(self):
        """Times at which a derivative of the angle jumps [s]."""
        return self.angle.corners


class AbstractEnd(eqx.Module):
    """One end of a rod."""

    displacement: eqx.AbstractVar[AbstractSchedule | None]
    rotation: eqx.AbstractVar[Turn | None]

    @abc.abstractmethod
    def projector(self, time: Float[Array, ""]) -> Float[Array, "6 6"]:
        """Projector on the constrained directions for a step that starts at `time`."""

    @property
    def switch_times(self) -> tuple:
        """Times at which the projector changes."""
        return ()


def _translation(directions):
    return jnp.zeros((6, 6)).at[:3, :3].set(directions)


def _check_motion(displacement):
    if displacement is not None:
        shape = jnp.shape(displacement(jnp.zeros(())))
        if shape != (3,):
            raise ValueError(f"displacement: the schedule must give three components, got {shape}")


class Free(AbstractEnd):
    """No constraint."""

    displacement: None = None
    rotation: None = None

    def projector(self, time):
        return jnp.zeros((6, 6))


class Clamped(AbstractEnd):
    """Position and frame prescribed (held where they are without schedules).

    `displacement` [m] is a vector schedule in inertial axes, `rotation` a `Turn`; only their
    changes count.
    """

    displacement: AbstractSchedule | None = None
    rotation: Turn | None = None

    def __check_init__(self):
        _check_motion(self.displacement)

    def projector(self, time):
        return jnp.eye(6)


class Pinned(AbstractEnd):
    """Position prescribed, free to rotate."""

    displacement: AbstractSchedule | None = None
    rotation: None = None

    def __check_init__(self):
        _check_motion(self.displacement)

    def projector(self, time):
        return _translation(jnp.eye(3))


class Slider(AbstractEnd):
    """No rotation (or a prescribed one) and no motion across `axis`; free to slide along it."""

    axis: Float[Array, "3"] = eqx.field(converter=_unit)
    displacement: AbstractSchedule | None = None
    rotation: Turn | None = None

    def __check_init__(self):
        _check_motion(self.displacement)

    def projector(self, time):
        return jnp.eye(6) - _translation(jnp.outer(self.axis, self.axis))


class Switched(AbstractEnd):
    """One end until a time, another from then on: a slider that is held, a clamp that lets go.

    Motion schedules are those of whichever end is in force; displacement and rotation given here
    (not in the parts) drive both.
    """

    before: AbstractEnd
    after: AbstractEnd
    at: Float[Array, ""] = eqx.field(converter=lambda t: jnp.asarray(t, jnp.result_type(float)))
    displacement: AbstractSchedule | None = None
    rotation: Turn | None = None

    def __check_init__(self):
        parts = (self.before, self.after)
        if any(p.displacement is not None or p.rotation is not None for p in parts):
            raise ValueError(
                "before, after: give the schedules to Switched itself, not to its parts"
            )
        known = hasattr(self.at, "shape") and not isinstance(self.at, jax.core.Tracer)
        if known and not np.all(np.isfinite(np.asarray(self.at))):
            raise ValueError(f"at: must be finite, got {self.at}")
        if any(isinstance(p, Switched) for p in parts[:1]):
            raise ValueError("before: nest a further switch in `after`")

    def projector(self, time):
        return jnp.where(time >= self.at, self.after.projector(time), self.before.projector(time))

    @property
    def switch_times(self):
        return (self.at, *self.after.switch_times)


def impose(
    rows: Float[Array, "nodes k"], aims: Float[Array, "2 k"], projectors: Float[Array, "2 k k"]
) -> Float[Array, "nodes k"]:
    """The nodes' rows, at both ends replaced in constrained directions: r + P (a - r)."""
    both = jnp.stack([rows[0], rows[-1]])
    both = both + jnp.einsum("eij,ej->ei", projectors, aims - both)
    return jnp.concatenate([both[:1], rows[1:-1], both[1:]])


def increments(
    end: AbstractEnd, start: Float[Array, ""], stop: Float[Array, ""], quaternion: Float[Array, "4"]
) -> Float[Array, "6"]:
    """Prescribed increments over a step: displacement [m], body rotation vector [rad]."""
    shift = turn = jnp.zeros((3,), quaternion.dtype)
    if end.displacement is not None:
        shift = end.displacement(stop) - end.displacement(start)
    if end.rotation is not None:
        # a fixed axis: the two rotations commute
        angle = end.rotation.angle(stop) - end.rotation.angle(start)
        turn = rotations.rotate_inverse(quaternion, angle * end.rotation.axis)
    return jnp.concatenate([shift, turn]).astype(quaternion.dtype)


def rates(
    end: AbstractEnd, time: Float[Array, ""], quaternion: Float[Array, "4"]
) -> tuple[Float[Array, "6"], Float[Array, "6"]]:
    """Prescribed velocity and acceleration: inertial translation, body rotation."""

    def motion(schedule):
        if schedule is None:
            zero = jnp.zeros((3,), quaternion.dtype)
            return zero, zero
        rate = lambda t: jax.jvp(schedule, (t,), (jnp.ones_like(t),))[1]
        return jax.jvp(rate, (time,), (jnp.ones_like(time),))

    velocity, acceleration = motion(end.displacement)
    spin, spin_rate = (rotations.rotate_inverse(quaternion, x) for x in motion(end.rotation))
    return jnp.concatenate([velocity, spin]), jnp.concatenate([acceleration, spin_rate])


def jerk(
    end: AbstractEnd, time: Float[Array, ""], quaternion: Float[Array, "4"]
) -> Float[Array, "6"]:
    """Derivative of the prescribed acceleration: inertial translation, body rotation."""
    # the axis of a turn is fixed, so its body components rest while the end turns about it
    acceleration = lambda t: rates(end, t, quaternion)[1]
    return jax.jvp(acceleration, (time,), (jnp.ones_like(time),))[1]
