"""Branch points that are met from the branch, at right angles to the path that it crosses.

On a branch that leaves another path at right angles the parameter goes as p_0 + c s^2/2, s counted
from the crossing: its slope dp/ds = c s tells how far that is. A branch of shapes that can be
turned at no cost (the buckled rod that is alike in all directions) is a bowl of such paths, and
the path that was followed may pass beside its lowest point. From where it is lowest on that path
the way to the lowest of all is at right angles to it, and c there is the same.
"""

from typing import NamedTuple

import jax
import numpy as np

from rodjax.continuation.arc_step import ArcStep, Tangent, ahead, along, unknowns
from rodjax.continuation.family import Place
from rodjax.continuation.near_modes import Motions
from rodjax.continuation.path_steps import Point, Walker, fits
from rodjax.numerics.results import Result

# How steep a path may be where the crossing is looked for from, and the steps to get there.
_LEVEL, _SECANTS = 0.02, 5

# How far the crossing may be from there [rad], and the steps to get there.
_NEAR, _STEPS = 5e-3, 4


class Crossing(NamedTuple):
    """Where another path is expected, as a critical point has it."""

    parameter: jax.Array
    place: Place
    modes: Motions
    free: Motions


def met_across(
    walker: Walker, before: Point, first: tuple[float, float], second: tuple[float, float]
) -> Crossing | None:
    """The crossing near which the slope of the parameter changes sign, or None where it is lost.

    Args:
        before: where lengths are counted from.
        first, second: lengths and slopes there, of different signs.
    """
    found = _lowest(walker, before, first, second)
    if found is None:
        return None
    step, rate = found
    point, free = _aimed(walker, before, walker.looked(step, before.look.near.modes))
    for _ in range(_STEPS):
        left = -float(point.tangent.parameter) / rate
        if abs(left) <= _NEAR:
            change = walker.number(left) * point.tangent.x
            place = ahead(walker.family, point.parameter, point.place, change)
            modes = along(walker.family, point.parameter, point.place, point.tangent.x)[None]
            return Crossing(point.parameter, place, modes, free)
        # at the crossing itself the matrix of steps is singular
        step = walker.from_point(point, 0.9 * left)
        if not fits(step, left, gently=False):
            return None
        point = walker.looked(step, point.look.near.modes)
    return None


def _lowest(walker: Walker, before: Point, first, second) -> tuple[ArcStep, float] | None:
    """A step to near where the slope is zero, and what the slope gains by length."""
    for _ in range(_SECANTS):
        length = interpolated(first, second)
        step = walker.from_point(before, length)
        if not fits(step, length, gently=False):
            return None
        slope = float(step.tangent.parameter)
        if abs(slope) <= _LEVEL:
            other = min(first, second, key=lambda end: abs(end[1]))
            return step, (other[1] - slope) / (other[0] - length)
        if slope * first[1] > 0:
            first = length, slope
        else:
            second = length, slope
    return None


def interpolated(first: tuple[float, float], second: tuple[float, float]) -> float:
    """Where the line through two points (s, value) is zero, well between them."""
    (a, of_first), (b, of_second) = first, second
    part = of_first / (of_first - of_second) if of_first != of_second else 0.5
    return a + float(np.clip(part, 0.02, 0.98)) * (b - a)


def _aimed(walker: Walker, before: Point, point: Point) -> tuple[Point, Motions]:
    """The point with the path through it that goes along its softest mode that costs something.

    And what costs nothing.
    """
    near, family = point.look.near, walker.family
    if neutral_modes(point) != neutral_modes(before):
        return point, walker.free(before)  # so near that this mode costs nothing either
    x = unknowns(family, point.parameter, point.place, near.modes[neutral_modes(point)])
    free = walker.free(point)
    step = walker.begin(point._replace(tangent=Tangent(x, walker.number(0.0))))
    if int(step.result) != Result.SUCCESS:
        return point, free
    return point._replace(place=step.place, tangent=step.tangent), free


def neutral_modes(point: Point) -> int:
    """How many modes cost nothing at a point: the first, by the size of their eigenvalues."""
    return int(np.sum(np.abs(np.asarray(point.look.near.values)) <= float(point.look.level)))
