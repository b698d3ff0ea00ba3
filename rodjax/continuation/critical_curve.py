"""Curves of critical points in two parameters, through their cusps."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from rodjax.continuation.arc_step import Tangent
from rodjax.continuation.curve_step import CurvePoint, CurveStep, curve_step, with_free
from rodjax.continuation.diagram import CriticalPoint, PathEnd
from rodjax.continuation.family import Family, Place
from rodjax.continuation.near_modes import first_motions
from rodjax.continuation.path_arguments import check_bounds, check_settings, checked_family
from rodjax.continuation.path_steps import fits, next_length
from rodjax.inputs.user_functions import check_function
from rodjax.inputs.validation import check_instance
from rodjax.numerics import results
from rodjax.numerics.results import Result

# The shortest step, over the longest allowed, and below what of that corners are expected.
_SHORTEST, _GENTLE = 1e-4, 1e-2

# Steps by which a cusp is found, and what of the slope before it is left there.
_SECANTS, _RESTS = 8, 1e-6

# Among how many modes what costs nothing is looked for.
_MODES = 5


class CriticalCurve(eqx.Module):
    """Critical points of two parameters, in the order in which the curve passes them.

    Attributes:
        parameters: the critical loads, of each point.
        others: the second parameter, of each point.
        points: the critical points themselves.
        cusps: both parameters where both turn back at once, each.
        end: why the curve ended.
        result: a `Result` as a number: 0 unless `end` is FAILED.

    Example:
        >>> print(rx.critical_curve(turned, point, 0.0, 0.3))  # doctest: +SKIP
        curve of 8 critical points, second parameter 0 to 0.3: the parameter reached the value asked
    """

    parameters: np.ndarray
    others: np.ndarray
    points: tuple[CriticalPoint, ...]
    cusps: np.ndarray
    end: PathEnd
    result: int

    def __len__(self) -> int:
        return len(self.parameters)

    def __str__(self) -> str:
        lines = [
            f"curve of {len(self)} critical points, second parameter {self.others[0]:g} to"
            f" {self.others[-1]:g}: {self.end.value}"
        ]
        if self.result:
            lines.append(f"  {Result(self.result)}")
        lines += [f"  cusp at ({one[0]:.9g}, {one[1]:.9g})" for one in self.cusps]
        return "\n".join(lines)


def critical_curve(
    scene_of: Callable[[Any, Any], Any],
    point: CriticalPoint,
    start: float,
    stop: float,
    *,
    points: int = 100,
    first_step: float = 0.02,
    longest_step: float = 0.2,
    throw: bool = True,
) -> CriticalCurve:
    """Follow a fold or branch point along a second parameter.

    Continuation by arc length of the extended equations of `critical`, in x and both parameters:
    the curve may turn in either of them, and folds pass cusps, where two folds meet and end. What
    lies between the two folds of a cusp has three equilibria, what lies outside has one.

    Args:
        scene_of: gives for both parameters, arrays without dimensions, a scene, or a scene and the
            time at which its schedules are evaluated. The first is the parameter of `point`.
        point: where to begin, of `EquilibriumPath.critical` or of `critical`: a critical point at
            `start` of the second parameter.
        start, stop: values of the second parameter, which bound the curve.
        points: at most so many.
        first_step, longest_step: lengths along the curve, in radians that sections turn by (root
            mean square), and of the parameters over their units: `point.unit` and |stop - start|.
        throw: raise where no next point was found; the error's `partial` holds the curve so far.
            Otherwise its `end` and `result` tell.

    Returns:
        The curve, see `CriticalCurve`.

    Raises:
        ValueError: arguments do not fit.
        SimulationError: the point is not critical at `start`, or the curve could not be followed:
            STEP_TOO_SMALL, or what made steps fail.

    Example:
        >>> turn = rx.Turn((1, 0, 0), rx.PiecewiseLinear([0.0, 3.0], [0.0, 6 * np.pi]))
        >>> middle = np.exp(-(((np.arange(20) - 9.5) / 4.0) ** 2))[:, None]
        >>> def turned(turns, softer):  # the middle of the rod has another stiffness
        ...     own = dataclasses.replace(rod, stiffness=rod.stiffness * (1.0 - softer * middle))
        ...     return rx.Scene(own, rx.Clamped(), rx.Slider((1, 0, 0), rotation=turn)), turns
        >>> uniform = jax.tree_util.Partial(lambda turns: turned(turns, jnp.zeros(())))
        >>> path = rx.path(uniform, rx.placing(turned(0.0, jnp.zeros(()))[0]), 0.0, 3.0)
        >>> curve = rx.critical_curve(turned, path.critical[0], 0.0, 0.3)
        >>> bool(curve.parameters[-1] < curve.parameters[0]), round(float(curve.others[-1]), 9)
        (True, 0.3)
    """
    check_instance(CriticalPoint, "give one of those that `path(...).critical` holds", point=point)
    check_function(scene_of=scene_of)
    bounds = check_bounds(start, stop, None)
    settings = check_settings(points, first_step, longest_step, 4, None, None)
    pair = jax.tree_util.Partial(_of_pair, _bound(scene_of))
    at = jnp.stack([point.parameter, jnp.asarray(bounds.start, point.parameter.dtype)])
    family = checked_family(pair, point.origin, at)
    units = jnp.stack([point.unit, jnp.asarray(bounds.unit, point.unit.dtype)])
    walk = _Walk(family, point, units, (bounds.start, bounds.stop))
    found = walk.onward(settings.points, settings.first_step, settings.longest_step)
    if throw:
        where = f"critical_curve, at {found.others[-1]:g} after {len(found)} points"
        results.raise_if_failed(found.result, where, found)
    return found


def _bound(scene_of) -> Any:
    return scene_of if isinstance(scene_of, jax.tree_util.Partial) else eqx.Partial(scene_of)


def _of_pair(scene_of, parameters):
    return scene_of(parameters[0], parameters[1])


class _Walk(NamedTuple):
    """A walk along a curve between bounds of the second parameter."""

    family: Family
    given: CriticalPoint
    units: Array
    bounds: tuple[float, float]

    def onward(self, points: int, first_step: float, longest_step: float) -> CriticalCurve:
        """All points from the first."""
        step = self._begin()
        seen = first_motions(self.given.modes.shape[1], _MODES, self.units.dtype)
        point, seen = with_free(self.family, step.point, seen)
        passed, cusps, length = [point], [], first_step
        why, code = PathEnd.POINTS, Result(int(step.result))
        while code is Result.SUCCESS and len(passed) < points:
            before = passed[-1]
            step, bound = self._ahead(before, length)
            if not fits(step, length, length < _GENTLE * longest_step):
                length *= 0.5
                if length < _SHORTEST * longest_step:
                    code = Result(int(step.result)) or Result.STEP_TOO_SMALL
                continue
            point, seen = with_free(self.family, step.point, seen)
            if float(point.tangent.parameter @ before.tangent.parameter) < 0:
                cusps.append(self._cusp(before, length, point))
            passed.append(point)
            if bound is not None:
                why = PathEnd.STOP if bound == self.bounds[1] else PathEnd.START
                break
            length = min(next_length(step, length), longest_step)
        return self._given_out(passed, cusps, why, code)

    def _begin(self) -> CurveStep:
        """The point itself, found anew, with the curve's direction."""
        given = self.given
        start = jnp.asarray(self.bounds[0], self.units.dtype)
        parameters, place = jnp.stack([given.parameter, start]), Place.of(given.state)
        x = jnp.zeros_like(self.family.guess(parameters, place))
        row = Tangent(x, self._along_second(np.sign(self.bounds[1] - self.bounds[0])))
        # other modes of the point are held, as what costs nothing wherever the curve goes
        free = jnp.concatenate([given.modes[1:], given.free])[: len(given.free)]
        point = CurvePoint(parameters, place, given.modes[0], free, row)
        return self._step(point, row, 0.0)

    def _along_second(self, sign) -> Array:
        return jnp.asarray([0.0, float(sign)], self.units.dtype)

    def _step(self, point: CurvePoint, row: Tangent, length: float) -> CurveStep:
        branches = jnp.asarray(self.given.kind == "branch")
        far = jnp.asarray(length, self.units.dtype)
        return curve_step(self.family, point, row, far, self.units, branches)

    def _ahead(self, before: CurvePoint, length: float) -> tuple[CurveStep, float | None]:
        """The next step, and the bound to which it came, if it did."""
        slope = float(before.tangent.parameter[1] * self.units[1])
        at, low, high = float(before.parameters[1]), min(self.bounds), max(self.bounds)
        expected = at + length * slope
        if low <= expected <= high:
            return self._step(before, before.tangent, length), None
        bound = low if expected < low else high
        row = Tangent(jnp.zeros_like(before.tangent.x), self._along_second(np.sign(slope)))
        step = self._step(before, row, abs(bound - at) / float(self.units[1]))
        return step._replace(along=jnp.ones_like(step.along)), bound

    def _cusp(self, before: CurvePoint, length: float, after: CurvePoint) -> np.ndarray:
        """Both parameters where neither changes along the curve, by the secant rule."""
        way = np.asarray(before.tangent.parameter)
        (a, of_a), (b, of_b) = (
            (at, float(way @ np.asarray(one.tangent.parameter)))
            for at, one in ((0.0, before), (length, after))
        )
        best = after
        for _ in range(_SECANTS):
            at = a - of_a * (b - a) / (of_b - of_a)
            step = self._step(before, before.tangent, at)
            if int(step.result) != Result.SUCCESS:
                break
            best, value = step.point, float(way @ np.asarray(step.point.tangent.parameter))
            if abs(value) < _RESTS * abs(float(way @ way)) or value == of_b:
                break
            (a, of_a), (b, of_b) = (b, of_b), (at, value)
        return np.asarray(best.parameters)

    def _given_out(self, passed, cusps, why, code) -> CriticalCurve:
        both = np.stack([np.asarray(one.parameters) for one in passed])
        if code is not Result.SUCCESS:
            why = PathEnd.FAILED
        points = tuple(map(self._point, passed))
        cusps = np.reshape(np.array(cusps), (-1, 2))
        return CriticalCurve(both[:, 0], both[:, 1], points, cusps, why, int(code))

    def _point(self, found: CurvePoint) -> CriticalPoint:
        given = self.given
        beside = jnp.zeros_like(given.free).at[: len(found.free)].set(found.free)
        return dataclasses.replace(
            given,
            parameter=found.parameters[0],
            state=self.family.state(found.parameters, found.place),
            modes=found.mode[None],
            free=beside,
        )
