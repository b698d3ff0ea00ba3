"""The walks along curves of critical points: folds by arc length, branch points by steps."""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from rodjax.continuation.arc_step import Tangent
from rodjax.continuation.critical import critical
from rodjax.continuation.curve_diagram import CriticalCurve
from rodjax.continuation.curve_step import CurvePoint, CurveStep, curve_step, with_free
from rodjax.continuation.diagram import CriticalPoint, PathEnd
from rodjax.continuation.family import Family, Place
from rodjax.continuation.near_modes import first_motions
from rodjax.continuation.path_steps import fits, next_length
from rodjax.numerics.results import Result

# The shortest step, over the longest allowed, and below what of that corners are expected.
_SHORTEST, _GENTLE = 1e-4, 1e-2

# Steps by which a cusp is found, and what of the slope before it is left there.
_SECANTS, _RESTS = 8, 1e-6

# How much longer the next step may be.
_LONGER = 1.6


class Folds(NamedTuple):
    """A walk along a curve between bounds of the second parameter."""

    family: Family
    given: CriticalPoint
    units: Array
    bounds: tuple[float, float]

    def onward(self, points: int, first_step: float, longest_step: float) -> CriticalCurve:
        """All points from the first."""
        step = self._begin()
        if int(step.result) != Result.SUCCESS:
            lost = jax.tree.map(lambda leaf: jnp.nan * leaf, step.point)
            return self._given_out([lost], [], PathEnd.FAILED, Result(int(step.result)))
        seen = first_motions(self.given.free.shape[1], len(self.given.free), self.units.dtype)
        point, seen = with_free(self.family, step.point, seen)
        passed, cusps, length = [point], [], first_step
        why, code = PathEnd.POINTS, Result.SUCCESS
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
        far = jnp.asarray(length, self.units.dtype)
        return curve_step(self.family, point, row, far, self.units)

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
        return dataclasses.replace(
            given,
            parameter=found.parameters[0],
            state=self.family.state(found.parameters, found.place),
            modes=found.mode[None],
            free=found.free,
        )


def branch_points(
    scene_of,
    point: CriticalPoint,
    bounds: tuple[float, float],
    points: int,
    first_step: float,
    longest_step: float,
) -> CriticalCurve:
    """A curve of branch points, by steps of the second parameter; lengths over |stop - start|."""
    (start, stop), length = bounds, first_step
    number = lambda value: jnp.asarray(value, point.parameter.dtype)
    given = critical(jax.tree_util.Partial(_at, scene_of, number(start)), point, throw=False)
    passed, others, code = [given], [start], Result(int(given.result))
    while code is Result.SUCCESS and others[-1] != stop and len(passed) < points:
        part = (others[-1] - start) / (stop - start) + length
        other = stop if part >= 1 else start + part * (stop - start)
        guess = passed[-1]
        if len(passed) > 1:
            slope = (guess.parameter - passed[-2].parameter) / (others[-1] - others[-2])
            ahead = guess.parameter + slope * (other - others[-1])
            guess = dataclasses.replace(guess, parameter=ahead)
        found = critical(jax.tree_util.Partial(_at, scene_of, number(other)), guess, throw=False)
        if int(found.result) == Result.NO_BRANCH_POINT:
            code = Result.NO_BRANCH_POINT
        elif int(found.result) != Result.SUCCESS:
            length *= 0.5
            if length < _SHORTEST * longest_step:
                code = Result.STEP_TOO_SMALL
        else:
            passed.append(found)
            others.append(other)
            length = min(_LONGER * length, longest_step)
    why = PathEnd.STOP if others[-1] == stop else PathEnd.POINTS
    parameters = np.array([float(one.parameter) for one in passed])
    why = why if code is Result.SUCCESS else PathEnd.FAILED
    return CriticalCurve(
        parameters, np.array(others), tuple(passed), np.zeros((0, 2)), why, int(code)
    )


def _at(scene_of, other, parameter):
    return scene_of(parameter, other)
