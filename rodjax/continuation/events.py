"""Folds and branch points between two points of a path."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from rodjax.continuation.arc_step import along
from rodjax.continuation.critical import critical
from rodjax.continuation.crossings import interpolated, met_across, neutral_modes
from rodjax.continuation.diagram import CriticalPoint, Kind
from rodjax.continuation.path_steps import Point, Walker
from rodjax.numerics.results import Result

# How often an interval with a critical point is halved until Newton's method finds that from it.
# A crossing is looked for by steps of its own.
_HALVINGS, _OF_CROSSINGS = 24, 3


class Event(NamedTuple):
    """Something critical between two points."""

    kind: Kind
    change: int  # of the number of unstable modes


_SIDEWAYS = Event("branch", 0)


def events(before: Point, after: Point) -> list[Event]:
    """What the tangents and the numbers of unstable modes tell.

    A path that turns and is as stable as before came to another at right angles, and leaves it on
    the other side: a branch point seen from the branch (Event("branch", 0)).
    """
    ahead = float(before.tangent.parameter), float(after.tangent.parameter)
    change = int(after.look.unstable) - int(before.look.unstable)
    folds = ahead[0] * ahead[1] < 0
    if not folds:
        return [Event("branch", change)] if change else []
    if not change:
        # a fold so near to a point that its mode counts as free there is one all the same
        return [_SIDEWAYS if neutral_modes(before) == neutral_modes(after) else Event("fold", 0)]
    found = [Event("fold", int(np.sign(change)))]
    rest = change - found[0].change
    return [*found, Event("branch", rest)] if rest else found


def locate(
    walker: Walker, before: Point, after: Point, length: float, event: Event
) -> CriticalPoint | None:
    """The critical point between two points, or None where it was not found.

    Args:
        length: of the step between them.
    """
    low, high = (0.0, before), (length, after)
    for _ in range(_OF_CROSSINGS if event == _SIDEWAYS else _HALVINGS):
        guess = _guess(walker, before, low, high, event)
        if guess is not None:
            found = critical(walker.family.scene_of, guess, throw=False)
            if int(found.result) == Result.SUCCESS and _between(walker, low[1], high[1], found):
                return found
        middle = 0.5 * (low[0] + high[0])
        step = walker.from_point(before, middle)
        if int(step.result) != Result.SUCCESS:
            return None
        point = walker.looked(step, before.look.near.modes)
        if _holds(low[1], point, event):
            high = (middle, point)
        else:
            low = (middle, point)
    return None


def _turns(event: Event) -> bool:
    return event.kind == "fold" or event.change == 0


def _holds(first: Point, second: Point, event: Event) -> bool:
    """Whether what is sought lies between these."""
    between = events(first, second)
    if _turns(event):
        return any(map(_turns, between))
    return any(not _turns(one) for one in between)


def _guess(walker: Walker, before: Point, low, high, event: Event) -> CriticalPoint | None:
    """Where interpolation has the critical point."""
    (a, first), (b, second) = low, high
    modes = None
    if _turns(event):
        of_first, of_second = float(first.tangent.parameter), float(second.tangent.parameter)
    else:
        modes, of_first, of_second = _crossing(first, second, event.change)
        if modes is None:
            return None
    ends = (a, of_first), (b, of_second)
    if event == _SIDEWAYS:
        seen = met_across(walker, before, *ends)
        return None if seen is None else _given(walker, event.kind, *seen)
    step = walker.from_point(before, interpolated(*ends))
    if int(step.result) != Result.SUCCESS:
        return None
    if modes is None:
        modes = along(walker.family, step.parameter, step.place, step.tangent.x)[None]
    return _given(walker, event.kind, step.parameter, step.place, modes, walker.free(first))


def _given(walker: Walker, kind: Kind, parameter, place, modes, free) -> CriticalPoint:
    state = walker.family.state(parameter, place)
    none = jnp.zeros((), jnp.int32)
    return CriticalPoint(
        kind, parameter, state, modes, free, walker.unit, walker.family.origin, none
    )


def _crossing(first: Point, second: Point, change: int):
    """Modes whose eigenvalues pass zero, with the nearest of them before and behind."""
    sides = [(first, _softest(first, change > 0, abs(change)))]
    sides.append((second, _softest(second, change < 0, abs(change))))
    if not all(len(chosen) for _, chosen in sides):
        return None, 1.0, -1.0
    at = [float(point.look.near.values[chosen[0]]) for point, chosen in sides]
    point, chosen = max(sides, key=lambda side: len(side[1]))
    return point.look.near.modes[chosen], *at


def _softest(point: Point, stable: bool, count: int) -> np.ndarray:
    """The numbers of modes nearest to losing stability, or to gaining it."""
    values = np.asarray(point.look.near.values)
    # further from motions that cost no energy
    apart = np.abs(values) > 3 * float(point.look.level)
    return np.flatnonzero(apart & ((values > 0) == stable))[:count]


def _between(walker: Walker, first: Point, second: Point, found: CriticalPoint) -> bool:
    """Whether a point lies between two of the path, and not far beside them."""
    ends = [distance(walker, found.parameter, found.state.position, one) for one in (first, second)]
    apart = distance(walker, first.parameter, first.place.position, second)
    return max(ends) <= 1.5 * apart + 1e-9


def distance(walker: Walker, parameter, position, point: Point) -> float:
    """Of an equilibrium from a point, by displacements over L and the parameter."""
    return float(distances(walker, parameter, position, [point])[0])


def distances(walker: Walker, parameter, position, points: list[Point]) -> np.ndarray:
    """Of an equilibrium from points, by displacements over L and the parameter."""
    positions = np.stack([np.asarray(one.place.position) for one in points])
    parameters = np.array([float(one.parameter) for one in points])
    lengths = np.sum(np.linalg.norm(np.diff(positions, axis=1), axis=2), 1)
    moved = np.sum((np.asarray(position) - positions) ** 2, 2)
    gaps = (float(parameter) - parameters) / float(walker.unit)
    return np.sqrt(np.mean(moved, 1) / lengths**2 + gaps**2)
