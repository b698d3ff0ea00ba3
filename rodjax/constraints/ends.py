"""What holds the two ends of the rod: constrained directions and their prescribed motion.

An end tells which directions of translation (inertial axes) and of rotation (body axes) it takes
away, as two orthogonal projectors, and by how much it moves over a step. Motion is prescribed as
the difference of a schedule over the step, so an end stays wherever it is while its schedule
rests, and a constraint may begin at any time.
"""

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from rodjax.constraints.axes import check_axis, unit_vector
from rodjax.inputs.schedules import AbstractSchedule, check_schedule
from rodjax.inputs.validation import (
    as_float,
    check_finite,
    check_instance,
    check_scalar,
    known,
    shown,
)
from rodjax.numerics import rotations


class Turn(eqx.Module):
    """Rotation about a fixed inertial axis by a scheduled angle.

    Attributes:
        axis: three inertial components of any length; positive angles turn by the right-hand rule.
        angle: schedule of the angle [rad] (one turn is 2 pi); only its changes count.

    Example:
        >>> two_turns = rx.Smooth([0.0, 4.0], [0.0, 4 * np.pi])
        >>> driven = rx.Clamped(rotation=rx.Turn((1, 0, 0), two_turns))
    """

    axis: Float[Array, "3"] = eqx.field(converter=unit_vector)
    angle: AbstractSchedule

    def __check_init__(self):
        check_axis(self.axis)
        check_schedule((), _ANGLE, angle=self.angle)

    def __call__(self, time):
        return self.angle(time) * self.axis

    @property
    def until(self):
        """Time until which the angle is prescribed [s]."""
        return self.angle.until

    @property
    def corners(self):
        """Times at which a derivative of the angle jumps [s]."""
        return self.angle.corners


class AbstractEnd(eqx.Module):
    """One end of a rod.

    Attributes:
        displacement: schedule of three inertial components [m], whose changes move the node in
            the directions that the end takes away; None for an end that is held.
        rotation: a `Turn`, the same for the frame.

    Example:
        >>> isinstance(rx.Clamped(), rx.AbstractEnd)
        True
    """

    displacement: eqx.AbstractVar[AbstractSchedule | None]
    rotation: eqx.AbstractVar[Turn | None]

    @abc.abstractmethod
    def projector(self, time: Float[Array, ""]) -> Float[Array, "6 6"]:
        """Projector on the constrained directions for a step that starts at `time`."""

    @property
    def switch_times(self) -> tuple:
        """Times at which the projector changes, for a `time` equal to them in its own precision.

        So compare with `jnp.asarray(at, time.dtype)`.
        """
        return ()

    @property
    def fixed(self) -> bool | Bool[Array, ""]:
        """Whether it holds its node at one place for good; True or False where its kind says it."""
        return False if self.displacement is not None else self._holds(3)

    @property
    def nothing(self) -> bool:
        """Whether its kind says that it never holds anything."""
        return False

    @property
    def clamped(self) -> bool:
        """Whether its kind says that it always holds node and frame, if perhaps moved by drives."""
        return self._holds(6) is True

    def _holds(self, directions: int) -> bool | Bool[Array, ""]:
        """Whether the first so many directions are always held.

        The library's own ends say it by themselves: to look takes a dozen small programs.
        """
        # what an end's kind makes of no numbers is known in traced code too
        with jax.ensure_compile_time_eval():
            # the first long before any change
            times = [jnp.asarray(t, float) for t in (-1e30, *self.switch_times)]
            held = [self.projector(t)[:directions, :directions] for t in times]
            held = jnp.stack(held) == jnp.eye(directions, dtype=held[0].dtype)[None]
            held = jnp.all(held)
        return bool(held) if known(held) else held


def _translation(directions):
    return jnp.zeros((6, 6), directions.dtype).at[:3, :3].set(directions)


# only changes of schedules count, so what moves an end begins at nothing
_ANGLE = "give a schedule of the angle [rad], for one turn in a second Smooth([0, 1], [0, 2 * pi])"
_SHIFT = (
    "give a schedule of the displacement [m], for 0.1 along z in a second"
    " Smooth([0, 1], [(0, 0, 0), (0, 0, 0.1)])"
)
_TURN = "give Turn(axis, angle), with a schedule of the angle [rad]"


def _check_motion(displacement, rotation):
    if displacement is not None:
        check_schedule((3,), _SHIFT, displacement=displacement)
    if rotation is not None:
        check_instance(Turn, _TURN, rotation=rotation)


def _check_absent(what, **values):
    for name, value in values.items():
        if value is not None:
            raise ValueError(f"{name}: {what}; leave it out, got {shown(value)}")


class Free(AbstractEnd):
    """No constraint: position and frame follow from the motion, force and moment are zero.

    Attributes:
        displacement, rotation: nothing; it cannot be driven.

    Example:
        >>> cantilever = rx.Scene(rod, rx.Clamped(), rx.Free())  # which is the default
    """

    displacement: None = None
    rotation: None = None

    def __check_init__(self):
        what = "a free end is not moved (a clamped or pinned one is)"
        _check_absent(what, displacement=self.displacement, rotation=self.rotation)

    @property
    def nothing(self):
        return True

    def projector(self, time):
        return jnp.zeros((6, 6))

    def _holds(self, directions):
        return False


class Clamped(AbstractEnd):
    """Position and frame prescribed: held where they are, or moved by schedules.

    Attributes:
        displacement: schedule of three inertial components [m]; only its changes count.
        rotation: a `Turn`, about an inertial axis through the end's node.

    Example:
        >>> pulled = rx.Clamped(displacement=rx.Smooth([0.0, 1.0], [(0, 0, 0), (0, 0, 0.1)]))
        >>> still = rx.Clamped()
    """

    displacement: AbstractSchedule | None = None
    rotation: Turn | None = None

    def __check_init__(self):
        _check_motion(self.displacement, self.rotation)

    def projector(self, time):
        return jnp.eye(6)

    def _holds(self, directions):
        return True


class Pinned(AbstractEnd):
    """Position prescribed, free to rotate (about its own axis as well).

    Attributes:
        displacement: schedule of three inertial components [m]; only its changes count.
        rotation: nothing; it turns as it will.

    Example:
        >>> swinging = rx.Scene(rod, rx.Pinned(), loads=(rx.Gravity((0, 0, -9.81)),))
    """

    displacement: AbstractSchedule | None = None
    rotation: None = None

    def __check_init__(self):
        _check_motion(self.displacement, None)
        _check_absent(
            "a pinned end turns freely (a clamped one can be turned)", rotation=self.rotation
        )

    def projector(self, time):
        return _translation(jnp.eye(3))

    def _holds(self, directions):
        return directions <= 3


class Slider(AbstractEnd):
    """No rotation (or a prescribed one) and no motion across `axis`; free to slide along it.

    Attributes:
        axis: direction of sliding, three inertial components of any length.
        displacement: schedule of three inertial components [m], whose changes across the axis
            count; along it the end slides as it will.
        rotation: a `Turn`, about an inertial axis through the end's node.

    Example:
        >>> twisted = rx.Scene(rod, rx.Clamped(), rx.Slider((1, 0, 0)))  # may slide along e1
    """

    axis: Float[Array, "3"] = eqx.field(converter=unit_vector)
    displacement: AbstractSchedule | None = None
    rotation: Turn | None = None

    def __check_init__(self):
        check_axis(self.axis)
        _check_motion(self.displacement, self.rotation)

    def projector(self, time):
        along = jnp.outer(self.axis, self.axis)
        return jnp.eye(6, dtype=along.dtype) - _translation(along)

    def _holds(self, directions):
        return False


class Switched(AbstractEnd):
    """One end until a time, another from then on: a slider that is held, a clamp that lets go.

    Motion schedules are those of whichever end is in force; displacement and rotation given here
    (not in the parts) drive both.

    Attributes:
        before, after: the ends, neither with schedules of its own; `after` may switch again.
        at: time of the change [s]; steps end there.
        displacement: schedule of three inertial components [m]; only its changes count.
        rotation: a `Turn`, about an inertial axis through the end's node.

    Example:
        >>> caught = rx.Switched(rx.Free(), rx.Clamped(), at=2.0)  # held where it is after 2 s
    """

    before: AbstractEnd
    after: AbstractEnd
    at: Float[Array, ""] = eqx.field(converter=as_float)
    displacement: AbstractSchedule | None = None
    rotation: Turn | None = None

    def __check_init__(self):
        check_end(before=self.before, after=self.after)
        check_scalar(at=self.at)
        check_finite(at=self.at)
        _check_motion(self.displacement, self.rotation)
        parts = (self.before, self.after)
        if any(p.displacement is not None or p.rotation is not None for p in parts):
            raise ValueError(
                "before, after: give the schedules to Switched itself, not to its parts"
            )
        if self.before.switch_times:
            raise ValueError("before: nest a further switch in `after`")

    def projector(self, time):
        # of a rod in single precision the steps end at the change as single precision has it
        dtype = jnp.result_type(time, float)
        after, before = (end.projector(time).astype(dtype) for end in (self.after, self.before))
        return jnp.where(time >= jnp.asarray(self.at, dtype), after, before)

    def _holds(self, directions):
        before, after = self.before._holds(directions), self.after._holds(directions)
        if isinstance(before, bool) and isinstance(after, bool):
            return before and after
        return super()._holds(directions)

    @property
    def switch_times(self):
        return (self.at, *self.after.switch_times)


def check_end(**ends) -> None:
    """Raise ValueError unless each is an end."""
    check_instance(AbstractEnd, "give an end: Free(), Clamped(), Pinned(), Slider(axis)", **ends)


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
