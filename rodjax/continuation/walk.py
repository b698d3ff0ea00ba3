"""The walk along a path: steps that adapt to it, what is met between them, and where it ends."""

import warnings
from typing import NamedTuple

import jax
import numpy as np

from rodjax.continuation.arc_step import ArcStep
from rodjax.continuation.close_points import located, modes_of
from rodjax.continuation.diagram import EquilibriumPath, PathEnd
from rodjax.continuation.events import Event, distances, events
from rodjax.continuation.path_arguments import Settings
from rodjax.continuation.path_steps import Point, Walker, fits, next_length
from rodjax.numerics.results import ModelWarning, Result

# The shortest step, over the longest allowed, and below what of that corners are expected.
_SHORTEST, _GENTLE = 1e-5, 1e-2

# How near the path must come to a point that it has passed, over the step, to be there again.
_AGAIN = 0.05


class Walk(NamedTuple):
    """A walk between bounds."""

    walker: Walker
    settings: Settings
    bounds: tuple[float, float]  # where it begins, or the low one; where it is to end
    leaves: bool = False  # whether it begins at a branch point

    def onward(self, point: Point) -> EquilibriumPath:
        """All points from the first."""
        walker, settings = self.walker, self.settings
        passed, arcs, critical = [point], [0.0], []
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
                found = located(walker, before, after, far, event)
                critical.extend(found)
                if modes_of(found) < max(abs(event.change), 1):
                    _warn_of_missed(event, before, after)
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
        gaps = distances(walker, last.parameter, last.place.position, passed)
        near = _AGAIN * gaps[-2]
        for i in np.flatnonzero(gaps[:-4] < near):
            if _turned(last, passed[i]) < near:
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
