"""Joints between two points of rods or bodies: what they take away of the motion of one against
the other.

The two points come together in a joint, and its second frame is where the placing of the rods has
it from the first. With t the vector from the first point to the second (inertial axes, those of the
first frame in a `Slide`) and r the rotation of the second frame from where it was placed (axes of
the first), a joint holds P (t, r) = 0, P its projector. It exerts a force and a moment, P of six
multipliers, on the first point and the opposite on the second; they do no work.

A `Hinge` and a `Slide` may be driven along what they leave free, by a schedule: then they hold that
direction too, where the schedule has it, and what they exert there does the drive's work.
"""

import abc

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.constraints.axes import check_axis, unit_vector
from rodjax.inputs.schedules import AbstractSchedule, check_schedule
from rodjax.inputs.validation import (
    as_float,
    check_instance,
    check_integer,
    check_numbers,
    given,
    shown,
)
from rodjax.numerics import rotations

Frame = tuple[Float[Array, "3"], Float[Array, "4"]]  # position [m], unit quaternion


class Point(eqx.Module):
    """A point that moves with a node of a rod, or with a body.

    Attributes:
        node: its number, from 0 at s = 0 of its rod; negative from s = L (-1 is the last).
        rod: which of the rods of the scene, from 0.
        offset: from the node, or from the body's centre of mass, in the body frame there [m].
        body: which of the scene's bodies, from 0; None for a rod. Node and rod then say nothing.

    Example:
        >>> tip, rim = rx.Point(-1), rx.Point(0, rod=1, offset=(0.005, 0, 0))
    """

    node: int = eqx.field(static=True, default=0)
    rod: int = eqx.field(static=True, default=0)
    offset: Float[Array, "3"] = eqx.field(converter=as_float, default=(0.0, 0.0, 0.0))
    body: int | None = eqx.field(static=True, default=None)

    def __check_init__(self):
        check_integer(-100_000, 100_000, node=self.node)
        check_integer(0, 10_000, rod=self.rod)
        check_integer(0, 10_000, **given(body=self.body))
        if self.body is not None and (self.node, self.rod) != (0, 0):
            raise ValueError("body: a point is on a body or at a node of a rod; give one of them")
        check_numbers(offset=self.offset)
        if jnp.shape(self.offset) != (3,):
            raise ValueError(f"offset: give three components, got {shown(self.offset)}")

    def place(self, parts) -> int:
        """The node among those of the scene, of rods and bodies that stand in these parts."""
        if self.body is not None:
            return [part.first for part in parts if part.first == part.last][self.body]
        part = parts[self.rod]
        return self.node + (part.last + 1 if self.node < 0 else part.first)

    def at(self, frame: Frame) -> Float[Array, "3"]:
        """Where it is for a position and a frame of its node."""
        position, quaternion = frame
        return position + rotations.rotate(quaternion, self.offset.astype(position.dtype))


class AbstractJoint(eqx.Module):
    """What two points cannot do against each other.

    Attributes:
        first, second: the points, of rods or bodies.
    """

    first: eqx.AbstractVar[Point]
    second: eqx.AbstractVar[Point]

    @abc.abstractmethod
    def projector(self) -> Float[Array, "6 6"]:
        """Projector on the directions (t, r) that it takes away."""

    @property
    def turning(self) -> bool:
        """Whether its directions turn with the first frame, or it holds rotations."""
        return True

    @property
    def rejoins(self) -> bool:
        """Whether its kind makes one piece of what it joins."""
        return False

    @property
    def schedules(self) -> dict[str, AbstractSchedule]:
        """What drives it, by argument."""
        return {}

    def driven(self) -> Float[Array, "6"] | None:
        """The direction (t, r) along which its schedule drives the second point; None: none."""
        return None

    def coordinate(self, time: Float[Array, ""]) -> Float[Array, ""]:
        """How far its schedule has driven it along that direction [m or rad]."""
        (schedule,) = self.schedules.values()
        return schedule(time)

    def translation(self, first: Frame, second: Frame) -> Float[Array, "3"]:
        """t [m]."""
        return self.second.at(second) - self.first.at(first)

    def rotation(self, first: Frame, second: Frame, placed: Float[Array, "4"]) -> Float[Array, "3"]:
        """r, zero where the second frame is `placed` against the first [rad, to first order]."""
        return _turn(first, second, placed)

    def gap(
        self, first: Frame, second: Frame, placed: Float[Array, "4"], time: Float[Array, ""]
    ) -> Float[Array, "6"]:
        """(t, r), from where its schedule has it at the time."""
        both = self.translation(first, second), self.rotation(first, second, placed)
        return jnp.concatenate(both)


def _turn(first: Frame, second: Frame, placed) -> Float[Array, "3"]:
    """Twice the vector part of the rotation since the placing, in axes of the first frame."""
    return 2 * _since(first, second, placed)[1:]


def _since(first: Frame, second: Frame, placed) -> Float[Array, "4"]:
    """That rotation, by at most half a turn."""
    now = rotations.multiply(rotations.conjugate(first[1]), second[1])
    turned = rotations.multiply(now, rotations.conjugate(placed))
    # q and -q are one rotation
    return jnp.where(turned[0] < 0, -1.0, 1.0) * turned


def _check_points(first: Point, second: Point) -> None:
    mend = "give a point such as Point(-1), the last node of the scene's first rod"
    check_instance(Point, mend, first=first, second=second)


class Weld(AbstractJoint):
    """Both points and frames stay together: a rod's last node welded to its first makes a ring.

    Attributes:
        first, second: the points, of rods or bodies.

    Example:
        >>> other = rx.straight_rod(0.5, 10, section, direction=(1, 0, 0), origin=(1, 0, 0))
        >>> joint = rx.Weld(rx.Point(-1), rx.Point(0, rod=1))
        >>> ends = (rx.Clamped(), rx.Free())
        >>> scene = rx.Scene(rods=(rod, other), first_end=ends, joints=(joint,))
    """

    first: Point
    second: Point

    def __check_init__(self):
        _check_points(self.first, self.second)

    @property
    def rejoins(self):
        return True

    def projector(self):
        return jnp.eye(6)


class Ball(AbstractJoint):
    """Both points stay together, and their frames turn freely.

    Attributes:
        first, second: the points, of rods or bodies.

    Example:
        >>> other = rx.straight_rod(0.5, 10, section, direction=(1, 0, 0), origin=(1, 0, 0))
        >>> joint = rx.Ball(rx.Point(-1), rx.Point(0, rod=1))
        >>> ends = (rx.Clamped(), rx.Free())
        >>> scene = rx.Scene(rods=(rod, other), first_end=ends, joints=(joint,))
    """

    first: Point
    second: Point

    def __check_init__(self):
        _check_points(self.first, self.second)

    def projector(self):
        return jnp.diag(jnp.asarray([1.0, 1.0, 1.0, 0.0, 0.0, 0.0]))

    @property
    def turning(self):
        return False


class Hinge(AbstractJoint):
    """Both points stay together, and their frames turn against each other about an axis alone.

    Attributes:
        first, second: the points, of rods or bodies.
        axis: in the first point's body frame, of any length.
        angle: schedule by which the second frame turns about the axis against the first,
            right-handed from where the rods are placed [rad]: a motor, of any number of turns;
            None: it turns freely. Of a ring that it closes, about the tangent, it drives the
            linking number.

    Example:
        >>> other = rx.straight_rod(0.5, 10, section, direction=(1, 0, 0), origin=(1, 0, 0))
        >>> joint = rx.Hinge(rx.Point(-1), rx.Point(0, rod=1), axis=(1, 0, 0))
        >>> ends = (rx.Clamped(), rx.Free())
        >>> scene = rx.Scene(rods=(rod, other), first_end=ends, joints=(joint,))
    """

    first: Point
    second: Point
    axis: Float[Array, "3"] = eqx.field(converter=unit_vector)
    angle: AbstractSchedule | None = None

    def __check_init__(self):
        _check_points(self.first, self.second)
        check_axis(self.axis)
        mend = "give a schedule of one number, such as Smooth([0.0, 1.0], [0.0, 6.28])"
        check_schedule((), mend, **self.schedules)

    @property
    def schedules(self):
        return given(angle=self.angle)

    @property
    def rejoins(self):
        return self.angle is not None

    def projector(self):
        if self.angle is not None:
            return jnp.eye(6)
        return jnp.eye(6).at[3:, 3:].add(-jnp.outer(self.axis, self.axis))

    def driven(self):
        return None if self.angle is None else jnp.concatenate([0 * self.axis, self.axis])

    def gap(self, first, second, placed, time):
        if self.angle is None:
            return super().gap(first, second, placed, time)
        turn = (self.angle(time) * self.axis).astype(placed.dtype)
        wanted = rotations.multiply(rotations.exponential(turn), placed)
        # linear in what it turns by, so that Newton's method leaves nothing of a step's turn
        turn = rotations.logarithm(_since(first, second, wanted))
        return jnp.concatenate([self.translation(first, second), turn])

    def rotation(self, first, second, placed):
        """axis x (the second's axis), which is zero however far it has turned about it."""
        axis = self.axis.astype(placed.dtype)
        now = rotations.multiply(rotations.conjugate(first[1]), second[1])
        turned = rotations.multiply(now, rotations.conjugate(placed))
        return rotations.cross(axis, rotations.rotate(turned, axis))


class Slide(AbstractJoint):
    """The second point slides along an axis through the first, and does not turn.

    Attributes:
        first, second: the points, of rods or bodies.
        axis: in the first point's body frame, of any length.
        displacement: schedule of the way along the axis from the first point to the second [m]: an
            actuator. None: it slides freely.

    Example:
        >>> other = rx.straight_rod(0.5, 10, section, direction=(1, 0, 0), origin=(1, 0, 0))
        >>> joint = rx.Slide(rx.Point(-1), rx.Point(0, rod=1), axis=(0, 0, 1))
        >>> ends = (rx.Clamped(), rx.Free())
        >>> scene = rx.Scene(rods=(rod, other), first_end=ends, joints=(joint,))
    """

    first: Point
    second: Point
    axis: Float[Array, "3"] = eqx.field(converter=unit_vector)
    displacement: AbstractSchedule | None = None

    def __check_init__(self):
        _check_points(self.first, self.second)
        check_axis(self.axis)
        mend = "give a schedule of one number, such as Smooth([0.0, 1.0], [0.0, 0.1])"
        check_schedule((), mend, **self.schedules)

    @property
    def schedules(self):
        return given(displacement=self.displacement)

    def projector(self):
        if self.displacement is not None:
            return jnp.eye(6)
        return jnp.eye(6).at[:3, :3].add(-jnp.outer(self.axis, self.axis))

    def driven(self):
        return None if self.displacement is None else jnp.concatenate([self.axis, 0 * self.axis])

    def gap(self, first, second, placed, time):
        found = super().gap(first, second, placed, time)
        if self.displacement is None:
            return found
        return found.at[:3].add(-(self.displacement(time) * self.axis).astype(found.dtype))

    def translation(self, first, second):
        return rotations.rotate_inverse(first[1], super().translation(first, second))
