"""Paths of equilibria along a parameter, by pseudo-arclength continuation."""

from collections.abc import Callable, Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np

from rodjax.continuation.arc_step import Tangent
from rodjax.continuation.diagram import CriticalPoint, EquilibriumPath
from rodjax.continuation.family import Place, motion_weight, of_motion
from rodjax.continuation.near_modes import first_motions
from rodjax.continuation.path_arguments import check_bounds, check_settings, checked_family
from rodjax.continuation.path_steps import Walker
from rodjax.continuation.walk import Walk
from rodjax.inputs.validation import check_instance
from rodjax.numerics import results
from rodjax.numerics.results import Result
from rodjax.rods.state import State
from rodjax.scenes.scene import Scene

# How far a start may be from its equilibrium [rad].
_NEAR = 1e-3


def path(
    scene_of: Scene | Callable[[Any], Any],
    state: State,
    start: float,
    stop: float,
    *,
    points: int = 200,
    first_step: float = 0.02,
    longest_step: float = 0.2,
    modes: int = 4,
    measures: Mapping[str, Callable] | None = None,
    targets: Mapping[str, float] | None = None,
    unit: float | None = None,
    throw: bool = True,
) -> EquilibriumPath:
    """The path of equilibria through `state`, from one value of a parameter towards another.

    Continuation in the length along the path, so that it goes round folds, where the parameter
    turns; through unstable equilibria; with contact. Length is measured by the root of
    mean(|displacement|^2/L^2 + |spin|^2) + (p/unit)^2, in radians.

    The path ends where the parameter reaches `stop` or comes back to `start`, where a measure
    reaches its target, at a point passed before, after `points`. Steps adapt to the path's
    curvature; one whose tangents disagree, or whose correction goes far, is halved, so that none
    jumps to another path.

    Between points in which the number of unstable modes or the sense of the parameter differs,
    folds and branch points are found (see `critical`). An even number of crossings within one step
    that cancel each other is not seen: `longest_step` bounds what may be missed.

    Args:
        scene_of: a `Scene`, whose schedules' time is the parameter; or a function that gives for a
            parameter p (an array, traced) a scene, or a scene and the time at which its schedules
            are evaluated. Schedules count from `state`. What a function closes over is compiled
            in: for many paths bind it, `jax.tree_util.Partial(function, arrays)`.
        state: the equilibrium of `scene_of(start)`, of `equilibrium` or of `placing`.
        start, stop: values of the parameter. Both bound the path.
        points: at most so many.
        first_step, longest_step: lengths along the path [rad].
        modes: how many eigenvalues nearest to zero are found, three at least.
        measures: functions of (scene, state) by name, values of which are kept at every point;
            compiled, so written with jax.numpy. A function made anew is compiled anew.
        targets: values of measures (numbers) at which the path ends, by name.
        unit: of the parameter in lengths; |stop - start| by default.
        throw: raise where no next point was found; the error's `partial` holds the path so far.
            Otherwise its `end` and `result` tell.

    Runs in Python, one compiled step after the other: not to be called in traced code (`critical`
    is). Memory of materials and friction has no equilibria of its own, and is refused.

    Raises:
        ValueError: `state` is no equilibrium of `scene_of(start)`; nothing in the scene depends on
            the parameter; the scene remembers (plastic, friction); arguments do not fit.
        SimulationError: the path could not be followed: STEP_TOO_SMALL, or what made steps fail.

    Example:
        >>> turn = rx.Turn((1, 0, 0), rx.PiecewiseLinear([0.0, 3.0], [0.0, 6 * np.pi]))
        >>> scene = rx.Scene(rod, rx.Clamped(), rx.Slider((1, 0, 0), rotation=turn))
        >>> path = rx.path(scene, rx.placing(scene), 0.0, 3.0)
        >>> print(path)  # doctest: +SKIP
        path of 60 equilibria, parameter 0 to 3: the parameter reached the value asked
          unstable modes: 0, 2
          branch at 2.15655
    """
    begun = check_bounds(start, stop, unit)
    settings = check_settings(points, first_step, longest_step, modes, measures, targets)
    family = checked_family(scene_of, state, begun.start)
    number = lambda value: jnp.asarray(value, state.position.dtype)
    first = first_motions(len(state.position), settings.modes + 1, state.position.dtype)
    walker = Walker(family, number(begun.unit), dict(measures or {}), jnp.zeros_like(first))
    parameter = number(begun.start)
    place = family.first(parameter)
    still = jnp.zeros_like(family.guess(parameter, place))
    row = Tangent(still, number(np.sign(begun.stop - begun.start)))
    # where what costs nothing (a ring everts) is known, the first increments do not go along it
    given = walker.point(parameter, place, row, first)
    step = walker.begin(given)
    if int(step.result) != Result.SUCCESS or float(step.corrected) > _NEAR:
        raise ValueError(
            "state: is no equilibrium of scene_of(start); find that first by"
            " rx.equilibrium(scene, state)"
        )
    if float(step.pull) < 1e3 * float(jnp.finfo(still.dtype).eps):
        raise ValueError(
            "scene_of: nothing in the scene changes with the parameter at its start; use p in what"
            " holds, loads or makes the rod (as an array, float(p) is a constant)"
        )
    point = walker.looked(step, given.look.near.modes)
    found = Walk(walker, settings, (begun.start, begun.stop)).onward(point)
    if throw:
        results.raise_if_failed(found.result, _where(found), found)
    return found


def branch(
    scene_of: Scene | Callable[[Any], Any],
    point: CriticalPoint,
    bounds: tuple[float, float],
    *,
    way: int = 1,
    mode: int | tuple[float, ...] = 0,
    points: int = 200,
    first_step: float = 0.02,
    longest_step: float = 0.2,
    modes: int = 4,
    measures: Mapping[str, Callable] | None = None,
    targets: Mapping[str, float] | None = None,
    throw: bool = True,
) -> EquilibriumPath:
    """The path of equilibria that leaves another at a branch point, along a null vector.

    Its first point is the branch point. Where all rods are alike in all directions about their
    axis, modes come in pairs, and each of them stands for a whole circle of paths.

    Args:
        scene_of: as of `path`.
        point: one of `EquilibriumPath.critical` whose kind is "branch".
        bounds: lowest and highest value of the parameter, which end the path.
        way: 1 or -1, which way along the null vector.
        mode: which of `point.modes`, or how much of each.
        points, first_step, longest_step, modes, measures, targets, throw: as of `path`.

    Raises:
        ValueError: the point is a fold, where nothing branches, or lies outside the bounds.
        SimulationError: as of `path`.

    Example:
        >>> turn = rx.Turn((1, 0, 0), rx.PiecewiseLinear([0.0, 3.0], [0.0, 6 * np.pi]))
        >>> scene = rx.Scene(rod, rx.Clamped(), rx.Slider((1, 0, 0), rotation=turn))
        >>> path = rx.path(scene, rx.placing(scene), 0.0, 3.0)
        >>> point = path.critical[0]  # from which the rod buckles, back to fewer turns
        >>> buckled = rx.branch(scene, point, (1.5, 3.0))
        >>> bool(buckled.parameters[-1] == 1.5), int(buckled.unstable[1])
        (True, 1)
    """
    check_instance(CriticalPoint, "give one of those that `path(...).critical` holds", point=point)
    if point.kind != "branch":
        raise ValueError(
            "point: is a fold, at which the path turns and no other leaves it; take one whose"
            " kind is 'branch'"
        )
    if way not in (1, -1):
        raise ValueError(f"way: must be 1 or -1, got {way}")
    settings = check_settings(points, first_step, longest_step, modes, measures, targets)
    low, high = (float(value) for value in bounds)
    at = float(point.parameter)
    if not low <= at <= high:
        raise ValueError(f"bounds: {bounds} do not hold the branch point at {at:g}")
    count = len(point.modes)
    share = np.asarray(np.arange(count) == mode if isinstance(mode, int) else mode, float)
    if share.shape != (count,) or not np.any(share):
        raise ValueError(f"mode: the point has {count} mode(s), got {mode}")
    family = checked_family(scene_of, point.origin, at)
    place = Place.of(point.state)
    first = first_motions(len(place.position), settings.modes + 1, place.position.dtype)
    walker = Walker(family, point.unit, dict(measures or {}), jnp.zeros_like(first))
    x = family.guess(point.parameter, place)
    equations = family.equations(point.parameter, place)
    motion = way * jnp.einsum("k,kni->ni", jnp.asarray(share, x.dtype), point.modes)
    rows = of_motion(motion / equations.scales.motion[None], x)
    length = jnp.sqrt(jnp.sum(motion_weight(equations, x) * rows**2))
    row = Tangent(rows / length, jnp.zeros_like(point.parameter))
    known = jnp.asarray(point.modes, x.dtype)[: settings.modes]
    first = first.at[: len(known)].set(known)
    at_point = walker.point(point.parameter, place, row, first)
    walk = Walk(walker, settings, (low, high), leaves=True)
    found = walk.onward(at_point)
    if throw:
        results.raise_if_failed(found.result, _where(found), found)
    return found


def _where(found: EquilibriumPath) -> str:
    return f"path, at {found.parameters[-1]:g} after {len(found)} points"
