"""Steps from one point of a path to the next, and to where something is met."""

from typing import NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np

from rodjax.continuation.arc_step import Aim, ArcStep, Tangent, arc_step, cosine
from rodjax.continuation.family import Family, Place
from rodjax.continuation.looking import Look, look
from rodjax.continuation.near_modes import Motions
from rodjax.numerics.results import Result

# Error left by the last increment of a step, in rotations and displacements [rad].
TOLERANCE = 1e-9

# How far a step's correction may go, over its length, and how little its tangents may agree.
_CORRECTED, _ALONG = 0.5, 0.8

# The angle between tangents that a step is made for [rad], the iterations, and how much longer the
# next may be.
_ANGLE, _ITERATIONS, _LONGER = 0.2, 4, 1.6


class Point(NamedTuple):
    """A point of a path."""

    parameter: jax.Array
    place: Place
    tangent: Tangent
    look: Look


@runtime_checkable
class Made(Protocol):
    """What a step of any kind says of how it went."""

    @property
    def result(self) -> jax.Array: ...
    @property
    def corrected(self) -> jax.Array: ...
    @property
    def along(self) -> jax.Array: ...
    @property
    def iterations(self) -> jax.Array: ...


class Walker(NamedTuple):
    """What all steps of a path are made by."""

    family: Family
    unit: jax.Array  # of the parameter
    measures: dict
    still: Motions  # as many as are looked for, zero

    def number(self, value) -> jax.Array:
        """In the precision of the rod."""
        return jnp.asarray(value, self.unit.dtype)

    def along_parameter(self, like: Tangent, sign: float) -> Tangent:
        """The row of steps to a value of the parameter."""
        return Tangent(jnp.zeros_like(like.x), self.number(sign))

    def begin(self, point: Point) -> ArcStep:
        """The equilibrium at a point's value of the parameter, its tangent along that."""
        row = point.tangent
        return self._step(point.parameter, point.place, 0.0, row, row, self.free(point))

    def _step(self, parameter, place, length: float, row, predicted, free) -> ArcStep:
        aim = Aim(self.number(length), self.unit, row, predicted, free)
        return arc_step(self.family, parameter, place, aim, self.number(TOLERANCE))

    def free(self, point: Point) -> Motions:
        """Those found at a point that cost nothing."""
        near, level = point.look.near, point.look.level
        return jnp.where((jnp.abs(near.values) <= level)[:, None, None], near.modes, self.still)

    def from_point(self, point: Point, length: float) -> ArcStep:
        """The equilibrium at this distance along the path."""
        row = point.tangent
        return self._step(point.parameter, point.place, length, row, row, self.free(point))

    def to_parameter(self, point: Point, length: float, value: float) -> ArcStep:
        """The equilibrium at a value of the parameter, about so far along the path."""
        distance = (value - float(point.parameter)) / float(self.unit)
        sign = 1.0 if float(point.tangent.parameter) >= 0 else -1.0
        row = self.along_parameter(point.tangent, sign)
        free = self.free(point)
        if distance == 0:
            return self._step(point.parameter, point.place, 0.0, row, row, free)
        way = jax.tree.map(lambda t: t * (length / abs(distance)), point.tangent)
        predicted = way._replace(parameter=self.number(np.sign(distance)))
        found = self._step(point.parameter, point.place, abs(distance), row, predicted, free)
        # the angle between the tangents, not that to the row
        along = cosine(self.family, point.parameter, point.place, point.tangent, found.tangent)
        return found._replace(along=along)

    def looked(self, step: ArcStep, first: Motions) -> Point:
        """The point that a step came to; `first` is what modes are looked for from."""
        return self.point(step.parameter, step.place, step.tangent, first)

    def point(self, parameter, place: Place, tangent: Tangent, first: Motions) -> Point:
        """A point with what is found there."""
        found = look(self.family, parameter, place, first, self.measures)
        return Point(parameter, place, tangent, found)


def fits(step: Made, length: float, gently: bool) -> bool:
    """Whether a step found the path's next point, and not one of another path.

    Args:
        gently: whether the step is so short that a corner of the path explains what is rough.
    """
    if int(step.result) != Result.SUCCESS:
        return False
    if float(step.corrected) > _CORRECTED * abs(length):
        return False
    return float(step.along) > (0.0 if gently else _ALONG)


def next_length(step: Made, length: float) -> float:
    """How long the next step may be."""
    angle = np.arccos(np.clip(float(step.along), -1.0, 1.0))
    wanted = min(_ANGLE / max(angle, 1e-9), (_ITERATIONS + 1) / (float(step.iterations) + 1))
    return length * float(np.clip(wanted, 0.4, _LONGER))
