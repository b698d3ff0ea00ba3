"""Fits of parameters to observations.

`least_squares` is Levenberg and Marquardt's method with derivatives in forward mode, for few
parameters; it tells how well the data determine them. It searches in the unknowns of `bounds`, and
takes back a trial at which the prediction fails (is not finite). For many parameters or any other
loss see `minimize`.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from rodjax.fitting.bounds import Unknowns, unknowns_of
from rodjax.fitting.fit_problem import Point, Problem, covariance_of, linearize
from rodjax.fitting.fit_results import (
    PART,
    Combination,
    Fit,
    FitError,
    FitResult,
    Progress,
    Starts,
    check_settings,
    reporting,
)
from rodjax.fitting.marquardt import advance_all, advance_one, begin_all, begin_one
from rodjax.fitting.observations import Observations
from rodjax.fitting.robust import AbstractRobust
from rodjax.inputs.validation import as_float
from rodjax.numerics.compilation import compiled
from rodjax.numerics.results import STEP_FAILED


def least_squares(
    predict: Callable[[PyTree], Array],
    guess: PyTree,
    observations: Observations,
    *,
    bounds: PyTree = None,
    priors: PyTree = None,
    robust: AbstractRobust | None = None,
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
        observations: missing samples (NaN) take no part.
        bounds: see `bounds.unknowns_of`; `Fixed` takes a parameter out of the fit.
        priors: what is known of parameters beforehand, see `priors.priors_of`. It counts as data,
            in chi squared, in the degrees of freedom and in the deviations.
        robust: a loss for data with outliers, such as `Huber()`; None means least squares. Chi
            squared is then the sum of this loss, and the covariance that of an M-estimator, from
            the scatter of the residuals.
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
        ValueError: guess, bounds, priors or the prediction's shape do not fit, or priors or a
            robust loss are to weigh data whose deviation is not stated.

    Example:
        >>> t = np.linspace(0.0, 2.0, 9)
        >>> data = rx.Observations(t, 3.0 * np.exp(-1.5 * t), deviation=0.01)
        >>> decay = lambda p: p["height"] * jnp.exp(-p["rate"] * t)
        >>> fit = rx.least_squares(decay, {"height": 1.0, "rate": 1.0}, data)
        >>> round(float(fit.parameters["rate"]), 6)
        1.5
    """
    check_settings(max_steps, tolerance, threshold, progress)
    problem = Problem.of(predict, unknowns_of(guess, bounds), observations, priors, robust)
    start = problem.unknowns.vector(problem.unknowns.like)
    return _fit(problem, start, max_steps, tolerance, threshold, progress)


def _fit(problem, start, max_steps, tolerance, threshold, progress) -> Fit:
    best = trial = _evaluate(problem, start)
    problem.check_start(best)
    linear, history, trials = linearize(problem, best, threshold), [best.cost], 0
    solver, result = begin_one(*problem.shrunk(*best[1:3]), start), FitResult.CONVERGED
    with reporting(progress, problem.unknowns, max_steps) as report:
        try:
            report(0, best.cost, start)
            while not linear.converged(tolerance):
                if trials == max_steps:
                    result = FitResult.MAX_STEPS
                    break
                solver, at, move = advance_one(*problem.shrunk(*trial[1:3]), solver)
                idle = len(history) > 3 and history[-4] <= (1 + tolerance) * history[-1]
                if idle or not move > tolerance:
                    result = FitResult.SETTLED
                    break
                try:
                    trial = _evaluate(problem, at)
                except STEP_FAILED:
                    trial = Point(at, jnp.nan * best.residual, best.jacobian, np.inf)
                trials += 1
                if trial.cost < best.cost:
                    best, linear = trial, linearize(problem, trial, threshold)
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
    priors: PyTree = None,
    robust: AbstractRobust | None = None,
    max_steps: int = 50,
    tolerance: float = 1e-8,
    threshold: float | None = None,
    progress: Progress = None,
) -> Starts:
    """`least_squares` from several guesses at once, by `vmap`; the best of them is then finished.

    All starts step together until three trials have lowered none of their costs by a thousandth.
    Args:
        guesses: pytree like a guess, with the starts along the leading axis of every array.
        predict, observations, bounds, priors, robust: as in `least_squares`.
        max_steps, tolerance, threshold, progress: as in `least_squares`.

    A start may fail where another does not. (Where one fails by a check, which does not say whose,
    the starts are evaluated one by one.)

    Raises:
        FitError: as `least_squares` does for the best of the starts; all of them fail.
        ValueError: as `least_squares`, or the guesses are not of one number.

    Example:
        >>> t = np.linspace(0.0, 2.0, 9)
        >>> data = rx.Observations(t, np.sin(3.0 * t), deviation=0.01)
        >>> fits = rx.several_starts(lambda w: jnp.sin(w * t), np.array([1.0, 2.8, 4.0]), data)
        >>> best = fits[0]
    """
    check_settings(max_steps, tolerance, threshold, progress)
    counts = {np.shape(leaf)[:1] for leaf in jax.tree.leaves(guesses)}
    if len(counts) != 1 or counts & {(), (0,)}:
        raise ValueError("guesses: every array needs the same number of starts as leading axis")
    unknowns, guesses = unknowns_of(guesses, bounds), jax.tree.map(as_float, guesses)
    unknowns = Unknowns(unknowns.bounds, jax.tree.map(lambda leaf: leaf[0], guesses))
    for bound, leaf in zip(unknowns.bounds, jax.tree.leaves(guesses), strict=True):
        if not bound.free and np.any(leaf != leaf[:1]):
            raise ValueError("guesses: what is fixed must be the same in all of them")
    problem = Problem.of(predict, unknowns, observations, priors, robust)
    best = at = jax.vmap(unknowns.vector)(guesses)
    residual, jacobian = _evaluate_all(problem, at)
    costs = problem.costs(residual, jacobian)
    if not np.any(np.isfinite(costs)):
        raise FitError("guesses: the prediction or its derivative is not finite at any of them")
    solvers, history, stopped = begin_all(*problem.shrunk(residual, jacobian), at), [costs], False
    with reporting(progress, unknowns, max_steps) as report:
        try:
            for trial in range(max_steps + 1):
                report(trial, np.min(costs), best[np.argmin(costs)])
                idle = len(history) > 3 and np.all(history[-4] <= 1.001 * costs)
                if idle or trial == max_steps:
                    break
                solvers, at, _ = advance_all(*problem.shrunk(residual, jacobian), solvers)
                residual, jacobian = _evaluate_all(problem, at)
                found = problem.costs(residual, jacobian)
                best = jnp.where((found < costs)[:, None], at, best)
                costs = np.minimum(found, costs)
                history.append(costs)
        except KeyboardInterrupt:
            stopped = True
    steps = 0 if stopped else max_steps
    fit = _fit(problem, best[np.argmin(costs)], steps, tolerance, threshold, None)
    fit = fit._replace(result=FitResult.INTERRUPTED) if stopped else fit
    return Starts(fit, costs, jax.vmap(unknowns.parameters)(best))


def _linearized(problem, vector):
    """Weighted residuals and their Jacobian in the unknowns, in one forward pass."""
    push = lambda tangent: jax.jvp(problem.residuals, (vector,), (tangent,))
    return jax.vmap(push, out_axes=(None, 1))(jnp.eye(vector.size, dtype=vector.dtype))


_linearized_one = compiled(_linearized)
_linearized_all = compiled(lambda problem, u: jax.vmap(lambda one: _linearized(problem, one))(u))


def _evaluate(problem, vector) -> Point:
    residual, jacobian = _linearized_one(problem, vector)
    return Point(vector, residual, jacobian, float(problem.costs(residual, jacobian)))


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
            size = problem.data.stop + problem.prior_count
            found.append((jnp.full(size, jnp.nan), jnp.full((size, vector.size), jnp.nan)))
    return tuple(jnp.asarray(np.stack(parts)) for parts in zip(*found, strict=True))


def _report(problem, best, linear, trials, history, result) -> Fit:
    unknowns, observations = problem.unknowns, problem.observations
    known = linear.determined
    freedom = problem.count - int(np.sum(known))
    slopes = np.asarray(unknowns.slopes(best.unknowns), float)
    covariance = covariance_of(problem, best, linear) * slopes * slopes[:, None]
    if observations.deviation is None:
        covariance = covariance * (best.cost / freedom if freedom else np.nan)
    free = np.max(np.abs(linear.directions[~known]), 0, initial=0) > PART
    covariance[free, :] = covariance[:, free] = np.nan
    covariance[free, free] = np.inf
    strengths = linear.singular / (linear.singular[0] or 1.0)
    pairs = list(map(Combination, linear.directions, strengths.tolist()))
    shrunk, leverage = map(np.asarray, problem.shrunk(best.residual, best.jacobian))
    leverage = leverage[problem.data] @ (linear.directions[known] / linear.singular[known, None]).T
    pull = best.residual[problem.data]
    weights = np.ones(pull.shape) if problem.robust is None else problem.robust.weights(pull)
    shape, here = observations.values.shape, np.asarray(observations.here)
    deviation = 1.0 if observations.deviation is None else observations.deviation
    residuals = np.reshape(np.asarray(pull), shape) * np.asarray(deviation)
    return Fit(
        parameters=unknowns.parameters(best.unknowns),
        deviations=unknowns.unflatten(jnp.asarray(np.sqrt(np.diag(covariance)))),
        covariance=covariance,
        names=unknowns.names,
        labels=unknowns.labels,
        at_bound=unknowns.at_bound(best.unknowns),
        residuals=np.where(here, residuals, np.nan),
        chi_squared=best.cost,
        freedom=freedom,
        determined=tuple(pairs[: int(np.sum(known))]),
        undetermined=tuple(pairs[int(np.sum(known)) :]),
        steps=len(history) - 1,
        evaluations=trials + 1,
        history=history,
        result=result,
        fixed=unknowns.fixed,
        data_freedom=observations.count - float(np.sum(leverage**2)),
        prior_chi_squared=float(np.sum(shrunk[problem.data.stop :] ** 2)),
        weights=np.where(here, np.reshape(weights, shape), 0.0),
    )
