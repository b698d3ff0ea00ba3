"""Folds and branch points between two points of a path."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rodjax.continuation.arc_step import ArcStep
from rodjax.continuation.critical import critical
from rodjax.continuation.diagram import CriticalPoint, Kind
from rodjax.continuation.path_steps import Point, Walker
from rodjax.equilibria.motion_norms import moving_weight
from rodjax.numerics.results import Result

# How often an interval with a critical point is halved until Newton's method finds that from it.
_HALVINGS = 24


class Event(NamedTuple):
    """Something critical between two points."""

    kind: Kind
    change: int  # of the number of unstable modes


def events(before: Point, after: Point) -> list[Event]:
    """What the tangents and the numbers of unstable modes tell."""
    ahead = float(before.tangent.parameter), float(after.tangent.parameter)
    change = int(after.look.unstable) - int(before.look.unstable)
    folds = ahead[0] * ahead[1] < 0
    if not folds:
        return [Event("branch", change)] if change else []
    found = [Event("fold", int(np.sign(change)) if change else 0)]
    rest = change - found[0].change
    if change and rest:
        found.append(Event("branch", rest))
    return found


def locate(
    walker: Walker, before: Point, after: Point, length: float, event: Event
) -> CriticalPoint | None:
    """The critical point between two points, or None where it was not found.

    Args:
        length: of the step between them.
    """
    low, high = (0.0, before), (length, after)
    for _ in range(_HALVINGS):
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
        if any(one.kind == event.kind for one in events(low[1], point)):
            high = (middle, point)
        else:
            low = (middle, point)
    return None


def _guess(walker: Walker, before: Point, low, high, event: Event) -> CriticalPoint | None:
    """Where interpolation has the critical point."""
    (a, first), (b, second) = low, high
    modes = None
    if event.kind == "fold":
        of_first, of_second = float(first.tangent.parameter), float(second.tangent.parameter)
    else:
        modes, of_first, of_second = _crossing(first, second, abs(event.change))
        if modes is None:
            return None
    part = of_first / (of_first - of_second) if of_first != of_second else 0.5
    step = walker.from_point(before, a + float(np.clip(part, 0.02, 0.98)) * (b - a))
    if int(step.result) != Result.SUCCESS:
        return None
    if modes is None:
        modes = _along(walker, step)[None]
    state = walker.family.state(step.parameter, step.place)
    none = jnp.zeros((), jnp.int32)
    origin = walker.family.origin
    free = walker.free(low[1])
    return CriticalPoint(event.kind, step.parameter, state, modes, free, walker.unit, origin, none)


def _along(walker: Walker, step: ArcStep) -> Float[Array, "nodes 6"]:
    """The motion along the path, which is the mode of a fold, of unit norm."""
    equations = walker.family.equations(step.parameter, step.place)
    motion = equations.change(step.tangent.x)
    return motion / jnp.sqrt(jnp.sum(moving_weight(equations.scene) * motion**2))


def _crossing(first: Point, second: Point, count: int):
    """Modes whose eigenvalues pass zero, with the nearest of them before and behind."""
    # those lowest in size on the side where they are further from motions that cost no energy
    sides = []
    for point in (first, second):
        values = np.asarray(point.look.near.values)
        apart = np.abs(values) > 3 * float(point.look.level)
        sides.append((values, np.flatnonzero(apart), point))
    gained = int(second.look.unstable) >= int(first.look.unstable)
    wanted = [sides[0][0] > 0, sides[1][0] < 0] if gained else [sides[0][0] < 0, sides[1][0] > 0]
    found = []
    for (values, apart, point), right in zip(sides, wanted, strict=True):
        chosen = [i for i in apart if right[i]][:count]
        found.append((values, chosen, point))
    if not all(chosen for _, chosen, _ in found):
        return None, 1.0, -1.0
    at = [float(values[chosen[0]]) for values, chosen, _ in found]
    _, chosen, point = max(found, key=lambda one: len(one[1]))
    return point.look.near.modes[np.array(chosen)], *at


def _between(walker: Walker, first: Point, second: Point, found: CriticalPoint) -> bool:
    """Whether a point lies between two of the path, and not far beside them."""
    ends = [distance(walker, found.parameter, found.state.position, one) for one in (first, second)]
    apart = distance(walker, first.parameter, first.place.position, second)
    return max(ends) <= 1.5 * apart + 1e-9


def distance(walker: Walker, parameter, position, point: Point) -> float:
    """Of an equilibrium from a point, by displacements over L and the parameter."""
    length = float(jnp.sum(jnp.linalg.norm(jnp.diff(point.place.position, axis=0), axis=1)))
    moved = np.asarray(position) - np.asarray(point.place.position)
    gap = float(parameter - point.parameter) / float(walker.unit)
    return float(np.sqrt(np.mean(np.sum(moved**2, 1)) / length**2 + gap**2))
