"""What a fit minimizes: weighted residuals of the data and of priors, and what their size tells."""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rodjax.fitting.bounds import Unknowns
from rodjax.fitting.fit_results import FitError
from rodjax.fitting.observations import Observations
from rodjax.fitting.priors import Priors, priors_of
from rodjax.fitting.robust import AbstractRobust


class Point(NamedTuple):
    """Where a fit has evaluated the prediction."""

    unknowns: Array
    residual: Array  # of data and priors, each over its deviation
    jacobian: Array
    cost: float  # chi squared; inf unless residual and Jacobian are finite


class Problem(eqx.Module):
    """The data, the prediction of them, and all else that chi squared is made of."""

    predict: Callable
    unknowns: Unknowns
    observations: Observations
    priors: Priors
    robust: AbstractRobust | None

    @classmethod
    def of(cls, predict, unknowns: Unknowns, observations, priors, robust) -> "Problem":
        """Of the arguments of a fit, checked."""
        if not callable(predict):
            raise ValueError(f"predict: give a function of the parameters, got {predict!r}")
        if not isinstance(observations, Observations):
            raise ValueError(
                "observations: give rx.Observations(times, values, deviation), got"
                f" {type(observations).__name__}"
            )
        if robust is not None and not isinstance(robust, AbstractRobust):
            raise ValueError(f"robust: give None, or rx.Huber() or rx.SoftL1(), got {robust!r}")
        problem = cls(predict, unknowns, observations, priors_of(priors, unknowns), robust)
        for name, given in (("priors", problem.prior_count), ("robust", robust is not None)):
            if given and observations.deviation is None:
                raise ValueError(
                    f"{name}: only with the `deviation` of the observations, which weighs the data"
                )
        names, count = unknowns.names, problem.count
        if count < len(names):
            raise FitError(
                f"observations: {count} data cannot determine the {len(names)} unknowns"
                f" {', '.join(names)}"
            )
        return problem

    @property
    def prior_count(self) -> int:
        """Number of data that the priors make."""
        return self.priors.count(self.unknowns.like)

    @property
    def count(self) -> int:
        """Number of data, missing ones not counted and those of the priors included."""
        return self.observations.count + self.prior_count

    @property
    def data(self) -> slice:
        """Where the residuals of the data are among all."""
        return slice(0, self.observations.values.size)

    def residuals(self, vector: Float[Array, " p"]) -> Float[Array, " n"]:
        """Weighted residuals: of the data, zero for those missing, then of the priors."""
        return self.residuals_of(self.unknowns.parameters(vector))

    def residuals_of(self, parameters):
        data = self.observations.residuals(jnp.asarray(self.predict(parameters)))
        return jnp.concatenate([data, self.priors.residuals(parameters).astype(data.dtype)])

    def shrunk(self, residual, jacobian):
        """Those of numbers whose squares are the loss; along leading axes of both, if any."""
        if self.robust is None:
            return residual, jacobian
        ours = residual[..., self.data]
        smaller, slope = jax.jvp(self.robust.shrunk, (ours,), (jnp.ones_like(ours),))
        return (
            residual.at[..., self.data].set(smaller),
            jacobian.at[..., self.data, :].multiply(slope[..., None]),
        )

    def costs(self, residual, jacobian):
        """Chi squared; infinite unless residual and Jacobian are finite."""
        finite = np.isfinite(residual).all(-1) & np.isfinite(jacobian).all((-2, -1))
        smaller = np.asarray(self.shrunk(residual, jacobian)[0], float)
        with np.errstate(all="ignore"):
            return np.where(finite, np.sum(smaller**2, -1), np.inf)

    def derivatives_alone(self, vector):
        """Derivatives with respect to one array of parameters at a time.

        What is not finite stays with its cause; with all of them 0 * inf gives NaN for the others.
        """
        leaves, structure = jax.tree.flatten(self.unknowns.parameters(vector))
        instead = lambda j, leaf: structure.unflatten([*leaves[:j], leaf, *leaves[j + 1 :]])
        one = lambda j: jax.jit(jax.jacfwd(lambda leaf: self.residuals_of(instead(j, leaf))))
        free = [j for j, bound in enumerate(self.unknowns.bounds) if bound.free]
        return np.concatenate([one(j)(leaves[j]).reshape(-1, leaves[j].size) for j in free], 1)

    def check_start(self, point: Point):
        """Name the parameter at fault, and the time."""
        residual, jacobian = (np.asarray(x)[self.data] for x in (point.residual, point.jacobian))
        names, first = np.array(self.unknowns.names), self.observations.first_time
        if np.any(bad := ~np.isfinite(residual)):
            raise FitError(
                f"guess: the prediction is not finite at time {first(bad):g}; did the simulation"
                " fail, or end before it?"
            )
        if np.any(bad := ~np.isfinite(jacobian)):
            alone = ~np.isfinite(self.derivatives_alone(point.unknowns)[self.data])
            bad = alone if np.any(alone) else bad
            raise FitError(
                "guess: the derivative of the prediction with respect to"
                f" {', '.join(names[bad.any(0)])} is not finite at time {first(bad):g}"
            )
        columns = np.linalg.norm(point.jacobian, axis=0)
        bad = columns <= np.finfo(columns.dtype).eps * np.max(columns)
        bad &= ~np.isin(names, self.unknowns.at_bound(point.unknowns))
        if np.any(bad):
            raise FitError(f"guess: the prediction does not depend on {', '.join(names[bad])}")


class Linear(NamedTuple):
    """The problem linear about a point, in its singular directions."""

    singular: np.ndarray  # (p,), descending
    directions: np.ndarray  # (p, p), in rows
    determined: np.ndarray  # (p,)
    step: np.ndarray  # Gauss-Newton step in the determined directions
    cosine: float  # between the residuals and what the step takes from them

    def converged(self, tolerance):
        """Whether nothing is left to gain."""
        return np.max(np.abs(self.step)) <= tolerance or self.cosine <= tolerance


def linearize(problem: Problem, point: Point, threshold) -> Linear:
    """The singular directions of the Jacobian at a point."""
    if threshold is None:
        threshold = max(1e-6, 10 * float(np.sqrt(np.finfo(point.jacobian.dtype).eps)))
    both = problem.shrunk(point.residual, point.jacobian)
    residual, jacobian = (np.asarray(x, float) for x in both)
    left, singular, directions = np.linalg.svd(jacobian, full_matrices=False)
    determined = singular > threshold * singular[0]
    along = np.where(determined, residual @ left, 0.0)
    step = -(along / np.where(determined, singular, 1.0)) @ directions
    cosine = np.linalg.norm(along) / (np.linalg.norm(residual) or 1.0)
    return Linear(singular, directions, determined, step, float(cosine))


def covariance_of(problem: Problem, point: Point, linear: Linear) -> np.ndarray:
    """Covariance of the unknowns in the directions determined, for data of deviation 1.

    (J^T J)^-1; with a robust loss A^-1 B A^-1 of A = <psi'> J^T J and B = <psi^2> J^T J, psi the
    influence and the means over the data, corrected for their number (Huber 1973); priors enter
    both as the data that they are.
    """
    known = linear.determined
    rows = linear.directions[known]
    if problem.robust is None:
        root = rows / linear.singular[known, None]
        return root.T @ root
    jacobian = np.asarray(point.jacobian, float) @ rows.T
    ours, prior = jacobian[problem.data], jacobian[problem.data.stop :]
    here = np.ravel(problem.observations.here)
    residual = jnp.asarray(point.residual)[problem.data]
    pull, slope = jax.jvp(problem.robust.influence, (residual,), (jnp.ones_like(residual),))
    pull, slope = np.asarray(pull, float)[here], np.asarray(slope, float)[here]
    count, unknown = pull.size, len(rows)
    mean = np.mean(slope)
    spread = np.sum(pull**2) / max(count - unknown, 1)
    spread *= (1 + unknown / count * np.var(slope) / mean**2) ** 2
    inverse = np.linalg.inv(mean * ours.T @ ours + prior.T @ prior)
    middle = spread * ours.T @ ours + prior.T @ prior
    return rows.T @ inverse @ middle @ inverse @ rows
