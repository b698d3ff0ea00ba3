"""Fits of parameters to observations.

`least_squares` is Levenberg and Marquardt's method with derivatives in forward mode, for few
parameters; it tells how well the data determine them. It searches in the unknowns of `bounds`, and
takes back a trial at which the prediction fails (is not finite). For many parameters or any other
loss see `minimize`.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from rodjax.bounds import Unknowns, unknowns_of
from rodjax.compilation import compiled
from rodjax.fit_results import (
    PART,
    Combination,
    Fit,
    FitError,
    FitResult,
    Progress,
    Starts,
    reporting,
)
from rodjax.marquardt import advance_all, advance_one, begin_all, begin_one
from rodjax.observations import Observations
from rodjax.results import STEP_FAILED
from rodjax.validation import as_float


def least_squares(
    predict: Callable[[PyTree], Array],
    guess: PyTree,
    observations: Observations,
    *,
    bounds: PyTree = None,
    max_steps: int = 50,
    tolerance: float = 1e-8,
    threshold: float | None = None,
    progress: Progress = None,
) -> Fit:
    """Fit parameters by least squares of (prediction - values) / deviation.

    Args:
        predict: from the parameters to an array like `observations.values`, differentiable in
            forward mode. A trial is taken back if it or its derivative is not finite there, or if
            a step or another check in compiled code fails; any other error (of memory, a device,
            a callback) is raised. It is compiled once for each function: pass the same to repeated
            fits.
        guess: pytree of numbers and arrays to start from.
        bounds: see `bounds.unknowns_of`.
        max_steps: largest number of trials.
        tolerance: converged when the whole Gauss-Newton step changes no unknown by more, or the
            cosine between the residuals and what it takes from them is not more.
        threshold: a combination is undetermined if its singular value is not above this part of
            the largest; None means 1e-6 (0.003 in single precision).
        progress: True for a bar, or a function of the trial's number, and chi squared and
            parameters of the best so far. A KeyboardInterrupt ends the fit with the best so far.

    Raises:
        FitError: fewer data than unknowns; a parameter that does not influence the prediction; a
            prediction or derivative that is not finite at the guess.
        ValueError: guess, bounds or the prediction's shape do not fit.
    """
    problem = _Problem(predict, unknowns_of(guess, bounds), observations)
    start = problem.unknowns.vector(problem.unknowns.like)
    return _fit(problem, start, max_steps, tolerance, threshold, progress)


def _fit(problem, start, max_steps, tolerance, threshold, progress) -> Fit:
    problem.check_size()
    best = trial = _evaluate(problem, start)
    problem.check_start(best)
    linear, history, trials = _linearize(best, threshold), [best.cost], 0
    solver, result = begin_one(best.residual, best.jacobian, start), FitResult.CONVERGED
    with reporting(progress, problem.unknowns, max_steps) as report:
        try:
            report(0, best.cost, start)
            while not linear.converged(tolerance):
                if trials == max_steps:
                    result = FitResult.MAX_STEPS
                    break
                solver, at, move = advance_one(trial.residual, trial.jacobian, solver)
                idle = len(history) > 3 and history[-4] <= (1 + tolerance) * history[-1]
                if idle or not move > tolerance:
                    result = FitResult.SETTLED
                    break
                try:
                    trial = _evaluate(problem, at)
                except STEP_FAILED:
                    trial = _Point(at, jnp.nan * best.residual, best.jacobian, np.inf)
                trials += 1
                if trial.cost < best.cost:
                    best, linear = trial, _linearize(trial, threshold)
                    history.append(best.cost)
                report(trials, best.cost, best.unknowns)
        except KeyboardInterrupt:
            result = FitResult.INTERRUPTED
    return _report(problem, best, linear, trials, tuple(history), result)


def several_starts(
    predict: Callable[[PyTree], Array],
    guesses: PyTree,
    observations: Observations,
    *,
    bounds: PyTree = None,
    max_steps: int = 50,
    tolerance: float = 1e-8,
    threshold: float | None = None,
    progress: Progress = None,
) -> Starts:
    """`least_squares` from several guesses at once, by `vmap`; the best of them is then finished.

    All starts step together until three trials have lowered none of their costs by a thousandth.
    The guesses lie along the leading axis of every array; the other arguments, and what is
    raised, are those of `least_squares`, except that a start may fail where another does not.
    (Where one fails by a check, which does not say whose, the starts are evaluated one by one.)
    """
    guesses = jax.tree.map(as_float, guesses)
    counts = {leaf.shape[:1] for leaf in jax.tree.leaves(guesses)}
    if len(counts) != 1 or counts & {(), (0,)}:
        raise ValueError("guesses: every array needs the same number of starts as leading axis")
    unknowns = unknowns_of(guesses, bounds)
    unknowns = Unknowns(unknowns.bounds, jax.tree.map(lambda leaf: leaf[0], guesses))
    problem = _Problem(predict, unknowns, observations)
    problem.check_size()
    best = at = jax.vmap(unknowns.vector)(guesses)
    residual, jacobian = _evaluate_all(problem, at)
    costs = _costs(residual, jacobian)
    if not np.any(np.isfinite(costs)):
        raise FitError("guesses: the prediction or its derivative is not finite at any of them")
    solvers, history, stopped = begin_all(residual, jacobian, at), [costs], False
    with reporting(progress, unknowns, max_steps) as report:
        try:
            for trial in range(max_steps + 1):
                report(trial, np.min(costs), best[np.argmin(costs)])
                idle = len(history) > 3 and np.all(history[-4] <= 1.001 * costs)
                if idle or trial == max_steps:
                    break
                solvers, at, _ = advance_all(residual, jacobian, solvers)
                residual, jacobian = _evaluate_all(problem, at)
                found = _costs(residual, jacobian)
                best = jnp.where((found < costs)[:, None], at, best)
                costs = np.minimum(found, costs)
                history.append(costs)
        except KeyboardInterrupt:
            stopped = True
    steps = 0 if stopped else max_steps
    fit = _fit(problem, best[np.argmin(costs)], steps, tolerance, threshold, None)
    fit = fit._replace(result=FitResult.INTERRUPTED) if stopped else fit
    return Starts(fit, costs, jax.vmap(unknowns.parameters)(best))


class _Point(NamedTuple):
    unknowns: Array
    residual: Array
    jacobian: Array
    cost: float  # chi squared; inf unless residual and Jacobian are finite


class _Problem(eqx.Module):
    predict: Callable
    unknowns: Unknowns
    observations: Observations

    def residuals(self, vector: Float[Array, " p"]) -> Float[Array, " n"]:
        """Weighted residuals."""
        return self.residuals_of(self.unknowns.parameters(vector))

    def residuals_of(self, parameters):
        return self.observations.residuals(jnp.asarray(self.predict(parameters)))

    def derivatives_alone(self, vector):
        """Derivatives with respect to one array of parameters at a time.

        What is not finite stays with its cause; with all of them 0 * inf gives NaN for the others.
        """
        leaves, structure = jax.tree.flatten(self.unknowns.parameters(vector))
        instead = lambda j, leaf: structure.unflatten([*leaves[:j], leaf, *leaves[j + 1 :]])
        one = lambda j: jax.jit(jax.jacfwd(lambda leaf: self.residuals_of(instead(j, leaf))))
        columns = [one(j)(leaf).reshape(-1, leaf.size) for j, leaf in enumerate(leaves)]
        return np.concatenate(columns, 1)

    def check_size(self):
        names, count = self.unknowns.names, self.observations.values.size
        if count < len(names):
            raise FitError(
                f"observations: {count} data cannot determine the {len(names)} unknowns"
                f" {', '.join(names)}"
            )

    def check_start(self, point: _Point):
        """Name the parameter at fault, and the time."""
        residual, jacobian = np.asarray(point.residual), np.asarray(point.jacobian)
        names, first = np.array(self.unknowns.names), self.observations.first_time
        if np.any(bad := ~np.isfinite(residual)):
            raise FitError(
                f"guess: the prediction is not finite at time {first(bad):g}; did the simulation"
                " fail, or end before it?"
            )
        if np.any(bad := ~np.isfinite(jacobian)):
            alone = ~np.isfinite(self.derivatives_alone(point.unknowns))
            bad = alone if np.any(alone) else bad
            raise FitError(
                "guess: the derivative of the prediction with respect to"
                f" {', '.join(names[bad.any(0)])} is not finite at time {first(bad):g}"
            )
        columns = np.linalg.norm(jacobian, axis=0)
        bad = columns <= np.finfo(columns.dtype).eps * np.max(columns)
        bad &= ~np.isin(names, self.unknowns.at_bound(point.unknowns))
        if np.any(bad):
            raise FitError(f"guess: the prediction does not depend on {', '.join(names[bad])}")


def _linearized(problem, vector):
    """Weighted residuals and their Jacobian in the unknowns, in one forward pass."""
    push = lambda tangent: jax.jvp(problem.residuals, (vector,), (tangent,))
    return jax.vmap(push, out_axes=(None, 1))(jnp.eye(vector.size, dtype=vector.dtype))


_linearized_one = compiled(_linearized)
_linearized_all = compiled(lambda problem, u: jax.vmap(lambda one: _linearized(problem, one))(u))


def _evaluate(problem, vector) -> _Point:
    residual, jacobian = _linearized_one(problem, vector)
    return _Point(vector, residual, jacobian, float(_costs(residual[None], jacobian[None])[0]))


def _evaluate_all(problem, vectors):
    """Residuals and Jacobians of all starts, NaN of those that fail."""
    try:
        return _linearized_all(problem, vectors)
    except STEP_FAILED:
        pass
    found = []
    for vector in vectors:
        try:
            found.append(_linearized_one(problem, vector))
        except STEP_FAILED:
            shape = problem.observations.values.size, vector.size
            found.append((jnp.full(shape[0], jnp.nan), jnp.full(shape, jnp.nan)))
    return tuple(map(jnp.stack, zip(*found, strict=True)))


def _costs(residual, jacobian):
    residual, jacobian = np.asarray(residual, float), np.asarray(jacobian)
    finite = np.isfinite(residual).all(1) & np.isfinite(jacobian).all((1, 2))
    with np.errstate(all="ignore"):
        return np.where(finite, np.sum(residual**2, 1), np.inf)


class _Linear(NamedTuple):
    """The problem linear about a point, in its singular directions."""

    singular: np.ndarray  # (p,), descending
    directions: np.ndarray  # (p, p), in rows
    determined: np.ndarray  # (p,)
    step: np.ndarray  # Gauss-Newton step in the determined directions
    cosine: float  # between the residuals and what the step takes from them

    def converged(self, tolerance):
        return np.max(np.abs(self.step)) <= tolerance or self.cosine <= tolerance


def _linearize(point: _Point, threshold) -> _Linear:
    if threshold is None:
        threshold = max(1e-6, 10 * float(np.sqrt(np.finfo(point.jacobian.dtype).eps)))
    residual, jacobian = np.asarray(point.residual, float), np.asarray(point.jacobian, float)
    left, singular, directions = np.linalg.svd(jacobian, full_matrices=False)
    determined = singular > threshold * singular[0]
    along = np.where(determined, residual @ left, 0.0)
    step = -(along / np.where(determined, singular, 1.0)) @ directions
    cosine = np.linalg.norm(along) / (np.linalg.norm(residual) or 1.0)
    return _Linear(singular, directions, determined, step, float(cosine))


def _report(problem, best, linear, trials, history, result) -> Fit:
    unknowns, deviation = problem.unknowns, problem.observations.deviation
    known = linear.determined
    freedom = best.residual.size - int(np.sum(known))
    noise = best.cost / freedom if freedom else np.nan
    slopes = np.asarray(unknowns.slopes(best.unknowns), float)
    root = linear.directions[known] * slopes / linear.singular[known, None]
    covariance = (noise if deviation is None else 1.0) * root.T @ root
    free = np.max(np.abs(linear.directions[~known]), 0, initial=0) > PART
    covariance[free, :] = covariance[:, free] = np.nan
    covariance[free, free] = np.inf
    strengths = linear.singular / (linear.singular[0] or 1.0)
    pairs = list(map(Combination, linear.directions, strengths.tolist()))
    residuals = best.residual.reshape(problem.observations.values.shape)
    return Fit(
        parameters=unknowns.parameters(best.unknowns),
        deviations=unknowns.unflatten(jnp.asarray(np.sqrt(np.diag(covariance)))),
        covariance=covariance,
        names=unknowns.names,
        labels=unknowns.labels,
        at_bound=unknowns.at_bound(best.unknowns),
        residuals=np.asarray(residuals * (1.0 if deviation is None else deviation)),
        chi_squared=best.cost,
        freedom=freedom,
        determined=tuple(pairs[: int(np.sum(known))]),
        undetermined=tuple(pairs[int(np.sum(known)) :]),
        steps=len(history) - 1,
        evaluations=trials + 1,
        history=history,
        result=result,
    )
