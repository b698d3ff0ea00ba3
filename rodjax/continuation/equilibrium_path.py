"""Paths of equilibria along a parameter, by pseudo-arclength continuation."""

import warnings
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rodjax.continuation.arc_step import ArcStep, Tangent
from rodjax.continuation.diagram import CriticalPoint, EquilibriumPath, PathEnd
from rodjax.continuation.events import Event, distance, events, locate
from rodjax.continuation.family import Place, motion_weight
from rodjax.continuation.near_modes import first_motions
from rodjax.continuation.path_arguments import check_bounds, check_settings, checked_family
from rodjax.continuation.walking import Point, Walker, fits, next_length
from rodjax.inputs.validation import check_instance
from rodjax.numerics import results
from rodjax.numerics.results import ModelWarning, Result
from rodjax.rods.state import State
from rodjax.scenes.scene import Scene

# The shortest step, over the longest allowed, and below what of that corners are expected.
_SHORTEST, _GENTLE = 1e-5, 1e-2

# How far a start may be from its equilibrium [rad].
_NEAR = 1e-3

# How near the path must come to a point that it has passed, over the step, to be there again.
_AGAIN = 0.05


class Settings(NamedTuple):
    """How a path is walked."""

    points: int
    first_step: float
    longest_step: float
    modes: int
    targets: dict[str, float]


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
        measures: functions of (scene, state) by name, values of which are kept at every point.
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
    walker = Walker(family, number(begun.unit), dict(measures or {}))
    place, parameter = Place.of(state), number(begun.start)
    still = jnp.zeros_like(family.guess(parameter, place))
    row = Tangent(still, number(np.sign(begun.stop - begun.start)))
    step = walker.step(parameter, place, 0.0, row)
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
    first = first_motions(len(state.position), settings.modes + 1, still.dtype)
    point = walker.looked(step, first)
    found = _Walk(walker, settings, (begun.start, begun.stop)).onward(point, 0.0)
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
    walker = Walker(family, point.unit, dict(measures or {}))
    place = Place.of(point.state)
    x = family.guess(point.parameter, place)
    equations = family.equations(point.parameter, place)
    motion = way * jnp.einsum("k,kni->ni", jnp.asarray(share, x.dtype), point.modes)
    along = motion / equations.scales.motion[None]
    rows = jnp.concatenate([along[:, :3], jnp.zeros_like(along[:, :3]), along[:, 3:]], 1)
    rows = jnp.pad(rows, ((0, x.shape[0] - rows.shape[0]), (0, 0)))
    length = jnp.sqrt(jnp.sum(motion_weight(equations, x) * rows**2))
    row = Tangent(rows / length, jnp.zeros_like(point.parameter))
    first = first_motions(len(place.position), settings.modes + 1, x.dtype)
    known = jnp.asarray(point.modes, x.dtype)[: settings.modes]
    first = first.at[: len(known)].set(known)
    at_point = walker.point(point.parameter, place, row, first)
    walk = _Walk(walker, settings, (low, high), leaves=True)
    found = walk.onward(at_point, 0.0)
    if throw:
        results.raise_if_failed(found.result, _where(found), found)
    return found


def _where(found: EquilibriumPath) -> str:
    return f"path, at {found.parameters[-1]:g} after {len(found)} points"


class _Walk(NamedTuple):
    """A walk between bounds."""

    walker: Walker
    settings: Settings
    bounds: tuple[float, float]  # where it begins, or the low one; where it is to end
    leaves: bool = False  # whether it begins at a branch point

    def onward(self, point: Point, arc: float) -> EquilibriumPath:
        """All points from the first."""
        walker, settings = self.walker, self.settings
        passed, arcs, critical = [point], [arc], []
        length, why, code = settings.first_step, PathEnd.POINTS, Result.SUCCESS
        while len(passed) < settings.points:
            before = passed[-1]
            leaving = self.leaves and len(passed) == 1
            gently = length < _GENTLE * settings.longest_step
            step, bound, far = self._ahead(before, length)
            # a branch leaves its point at right angles to the path, and may do so curved
            if not fits(step, far, gently or leaving):
                length *= 0.5
                if length < _SHORTEST * settings.longest_step:
                    why, code = PathEnd.FAILED, _why(step)
                    break
                continue
            ended = None if bound is None else self._end(bound)
            after = walker.looked(step, before.look.near.modes)
            target = self._target(before, after)
            if target is not None:
                after, far = self._at_target(before, after, far, target)
                ended = PathEnd.TARGET
            met = [] if leaving else events(before, after)
            if len(met) > 1 and not gently:
                length *= 0.5
                continue
            for event in met:
                located = locate(walker, before, after, far, event)
                if located is None:
                    _warn_of_missed(event, before, after)
                else:
                    critical.append(located)
            passed.append(after)
            arcs.append(arcs[-1] + far)
            ended = ended or self._again(passed)
            if ended is not None:
                why = ended
                break
            length = min(next_length(step, length), settings.longest_step)
        return _given(self.walker, passed, arcs, critical, why, code)

    def _ahead(self, before: Point, length: float) -> tuple[ArcStep, float | None, float]:
        """The next step, the bound to which it came, if it did, and its length."""
        walker = self.walker
        slope = float(before.tangent.parameter) * float(walker.unit)
        expected = self._beyond(float(before.parameter) + length * slope)
        if expected is not None:
            # what a schedule says beyond the bound may be nothing
            part = (expected - float(before.parameter)) / slope
            return walker.to_parameter(before, part, expected), expected, part
        step = walker.from_point(before, length)
        bound = self._beyond(float(step.parameter))
        if bound is None or int(step.result) != Result.SUCCESS:
            return step, None, length
        far = float(step.parameter - before.parameter)
        part = length * (bound - float(before.parameter)) / far
        return walker.to_parameter(before, part, bound), bound, part

    def _beyond(self, value: float) -> float | None:
        """The bound that lies before a value of the parameter."""
        low, high = min(self.bounds), max(self.bounds)
        if value < low:
            return low
        return high if value > high else None

    def _end(self, bound: float) -> PathEnd:
        return PathEnd.STOP if self.leaves or bound == self.bounds[1] else PathEnd.START

    def _target(self, before: Point, after: Point) -> str | None:
        """The measure that passes its target between two points."""
        for name, value in self.settings.targets.items():
            sides = [float(point.look.measures[name]) - value for point in (before, after)]
            if sides[0] * sides[1] <= 0 and sides[0] != 0:
                return name
        return None

    def _at_target(self, before: Point, after: Point, length: float, name: str):
        """The point at which a measure has its target, by the secant rule, and how far it is."""
        value, walker = self.settings.targets[name], self.walker
        lacking = lambda point: float(point.look.measures[name]) - value
        (a, at_a), (b, at_b) = (0.0, lacking(before)), (length, lacking(after))
        best, far = after, length
        for _ in range(20):
            if at_b == at_a or abs(at_b) <= 1e-10 * max(abs(value), 1.0):
                break
            a, b = b, b - at_b * (b - a) / (at_b - at_a)
            step = walker.from_point(before, b)
            if int(step.result) != Result.SUCCESS:
                break
            best, far = walker.looked(step, before.look.near.modes), b
            at_a, at_b = at_b, lacking(best)
        return best, far

    def _again(self, passed: list[Point]) -> PathEnd | None:
        """Whether the last point lies on the path before."""
        last, walker = passed[-1], self.walker
        if len(passed) < 8:
            return None
        length = distance(walker, last.parameter, last.place.position, passed[-2])
        for i, one in enumerate(passed[:-4]):
            gap = distance(walker, last.parameter, last.place.position, one)
            if gap < _AGAIN * length and _turned(last, one) < _AGAIN * length:
                return PathEnd.CLOSED if i == 0 else PathEnd.VISITED
        return None


def _warn_of_missed(event: Event, before: Point, after: Point) -> None:
    """Say that something critical was seen and not found."""
    between = sorted(float(point.parameter) for point in (before, after))
    warnings.warn(
        f"path: between {between[0]:.6g} and {between[1]:.6g} lies a {event.kind} point that was"
        " not found (`critical` lacks it); walk that part again with a smaller longest_step",
        ModelWarning,
        stacklevel=4,
    )


def _turned(first: Point, second: Point) -> float:
    """Root mean square of the angles between the frames of two points [rad]."""
    a, b = np.asarray(first.place.quaternion), np.asarray(second.place.quaternion)
    cosine = np.clip(np.abs(np.sum(a * b, 1)), 0.0, 1.0)
    return float(np.sqrt(np.mean((2 * np.arccos(cosine)) ** 2)))


def _why(step: ArcStep) -> Result:
    code = Result(int(step.result))
    return Result.STEP_TOO_SMALL if code is Result.SUCCESS else code


def _given(walker: Walker, passed, arcs, critical, why, code) -> EquilibriumPath:
    """The path as it is given out."""
    looks = [point.look for point in passed]
    stack = lambda *leaves: np.stack([np.asarray(leaf) for leaf in leaves])
    together = lambda trees: jax.tree.map(stack, *trees)
    return EquilibriumPath(
        parameters=np.array([float(point.parameter) for point in passed]),
        states=together([one.state for one in looks]),
        arc=np.array(arcs),
        unstable=np.array([int(one.unstable) for one in looks]),
        eigenvalues=np.stack([np.asarray(one.near.values)[:-1] for one in looks]),
        antisymmetry=np.array([float(one.near.odd) for one in looks]),
        energy=np.array([float(one.energy) for one in looks]),
        reactions=together([one.reactions for one in looks]),
        measures=together([one.measures for one in looks]),
        critical=tuple(critical),
        unit=float(walker.unit),
        end=why,
        result=int(code),
    )
