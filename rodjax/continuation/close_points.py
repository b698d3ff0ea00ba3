"""Several modes that lose stability in one step of a path: at one point, or at points close by.

The modes of a symmetric rod come in pairs, which one point has; those of a rod that is nearly
symmetric have points of their own, as near to each other as it is to symmetry.
"""

import dataclasses

import numpy as np

from rodjax.continuation.crossings import neutral_modes
from rodjax.continuation.diagram import CriticalPoint
from rodjax.continuation.events import Event, events, locate
from rodjax.continuation.family import Place
from rodjax.continuation.near_modes import near_modes
from rodjax.continuation.path_steps import Point, Walker
from rodjax.numerics.results import Result

# Eigenvalues at a critical point, over those of the same modes at the ends of the step, below
# which it has these modes too; and the secant steps to where points are told apart.
_ALIKE, _SECANTS = 1e-5, 8


def located(
    walker: Walker, before: Point, after: Point, length: float, event: Event
) -> list[CriticalPoint]:
    """The critical points between two points, as far as they are found.

    Args:
        length: of the step between them.
    """
    found = locate(walker, before, after, length, event)
    if found is None:
        return []
    if event.kind == "fold" or abs(event.change) < 2:
        return [found]
    values = _values_at(walker, before, found, abs(event.change))
    scale = max(_largest(before, len(values)), _largest(after, len(values)))
    # what costs nothing besides is known to its own level
    others = values[np.abs(values) > max(_ALIKE * scale, float(before.look.level))]
    if not len(others):
        return [found]
    alone = dataclasses.replace(found, modes=found.modes[: len(values) - len(others)])
    parted = _between(walker, before, after, length, alone, float(others[0]))
    if parted is None:
        return [alone]
    far, middle = parted
    ways = (before, middle, far), (middle, after, length - far)
    return [
        point
        for first, second, way in ways
        for one in events(first, second)
        for point in located(walker, first, second, way, one)
    ]


def modes_of(points: list[CriticalPoint]) -> int:
    """How many modes become critical at these."""
    return sum(len(point.modes) for point in points)


def _values_at(walker: Walker, before: Point, found: CriticalPoint, count: int) -> np.ndarray:
    """Eigenvalues at a critical point of as many modes, nearest to zero but what costs nothing."""
    family, place = walker.family, Place.of(found.state)
    near = near_modes(family, found.parameter, place, before.look.near.modes)
    free = neutral_modes(before)
    return np.asarray(near.values)[free : free + count]


def _largest(point: Point, count: int) -> float:
    """The largest eigenvalue at a point of as many modes nearest to zero."""
    free = neutral_modes(point)
    return float(np.max(np.abs(np.asarray(point.look.near.values)[free : free + count])))


def _between(
    walker: Walker, before: Point, after: Point, length: float, found: CriticalPoint, value: float
) -> tuple[float, Point] | None:
    """A point with some modes critical before it and some behind, and how far along it is.

    Args:
        value: eigenvalue, at the critical point that was found, of a mode that has another.
    """
    ends = float(before.parameter), float(after.parameter)
    counts = int(before.look.unstable), int(after.look.unstable)
    # as stable as before the step: its point is still to come
    later = (value > 0) == (counts[1] > counts[0])
    end = after if later else before
    far_value = _largest(end, len(found.modes) + 1)
    here = float(found.parameter)
    share = 0.5 * abs(value) / (abs(value) + far_value)
    wanted = here + share * (float(end.parameter) - here)
    low, high = (0.0, ends[0]), (length, ends[1])
    for _ in range(_SECANTS):
        part = (wanted - low[1]) / (high[1] - low[1])
        far = low[0] + float(np.clip(part, 0.0, 1.0)) * (high[0] - low[0])
        step = walker.from_point(before, far)
        if int(step.result) != Result.SUCCESS:
            return None
        middle = walker.looked(step, before.look.near.modes)
        if min(counts) < int(middle.look.unstable) < max(counts):
            return far, middle
        reached = float(step.parameter)
        if (reached < wanted) == (ends[0] < ends[1]):
            low = far, reached
        else:
            high = far, reached
        if low[1] == high[1]:
            return None
    return None
