"""What fits tell: how they ended, what the data determine, and progress on the way."""

import contextlib
import enum
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import PyTree
from tqdm import tqdm

Progress = Callable[[int, float, Any], None] | bool | None


class FitError(ValueError):
    """Data, parameters or a prediction with which a fit cannot begin."""


class FitResult(enum.IntEnum):
    """Why a fit ended."""

    CONVERGED = 0
    SETTLED = 1
    MAX_STEPS = 2
    INTERRUPTED = 3
    NON_FINITE = 4


MESSAGES = {
    FitResult.CONVERGED: "converged",
    FitResult.SETTLED: "the cost no longer falls (rounding, a bound, or a prediction that fails)",
    FitResult.MAX_STEPS: "max_steps was reached",
    FitResult.INTERRUPTED: "interrupted, the best so far",
    FitResult.NON_FINITE: "the loss or its gradient is not finite further on",
}


class Combination(NamedTuple):
    """A direction in the unknowns, of unit length."""

    weights: np.ndarray  # for each unknown
    strength: float  # singular value of the weighted Jacobian, over the largest


class Fit(NamedTuple):
    """Parameters fitted to observations, and how well the data determine them.

    The right singular vectors of the weighted residuals' Jacobian in the unknowns are the
    combinations that the data determine; those with too small a singular value they do not. A
    parameter that takes part in an undetermined combination has an infinite deviation. The other
    deviations hold to first order (through the slopes of the bounds), for noise as stated by the
    observations, or as estimated from the residuals where it is not (NaN without more data than
    determined combinations).
    """

    parameters: PyTree
    deviations: PyTree  # standard deviations, in the structure and units of the parameters
    covariance: np.ndarray  # (p, p); NaN beside the infinite variances
    names: tuple[str, ...]  # of the parameters
    labels: tuple[str, ...]  # of the unknowns
    at_bound: tuple[str, ...]  # names of parameters that went to the end of their interval
    residuals: np.ndarray  # prediction - values
    chi_squared: float  # sum of the squares of the residuals, over their deviations if stated
    freedom: int  # number of data less that of determined combinations
    determined: tuple[Combination, ...]
    undetermined: tuple[Combination, ...]
    steps: int  # trials that lowered chi squared
    evaluations: int
    history: tuple[float, ...]  # chi squared at the guess and after each step
    result: FitResult

    @property
    def reduced(self) -> float:
        """Chi squared for each degree of freedom: near 1 if model and stated noise are right."""
        return self.chi_squared / self.freedom if self.freedom else np.nan

    @property
    def residual_deviation(self) -> float:
        """Standard deviation of the noise, estimated from the residuals."""
        return float(np.sqrt(np.sum(self.residuals**2) / self.freedom)) if self.freedom else np.nan

    def combinations(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Of the parameters not determined alone: what is determined, and what is not."""
        rows = np.array([c.weights for c in self.undetermined]).reshape(-1, len(self.labels))
        part = np.max(np.abs(rows), 0, initial=0) > PART
        rows, labels = rows[:, part], np.array(self.labels)[part]
        others = np.linalg.svd(rows)[2][len(rows) :]
        say = lambda rows: tuple(_formula(row, labels) for row in _echelon(rows))
        return say(others), say(rows)

    def summary(self) -> str:
        """A table of the parameters, and what the data do not determine."""
        width = max(map(len, self.names))
        lines = [
            f"{MESSAGES[self.result]}: {self.steps} steps, {self.evaluations} evaluations",
            f"chi squared {self.chi_squared:.6g}, degrees of freedom {self.freedom}, deviation of"
            f" the residuals {self.residual_deviation:.3g}",
        ]
        at_bound = [name in self.at_bound for name in self.names]
        deviations = _flat(self.deviations)
        rows = zip(self.names, _flat(self.parameters), deviations, at_bound, strict=True)
        for name, value, deviation, near in rows:
            spread = "not determined" if np.isinf(deviation) else f"+- {deviation:.2g}"
            lines.append(f"  {name:<{width}}  {value:<12.6g}  {'at its bound' if near else spread}")
        if np.any(np.isinf(deviations) & ~np.array(at_bound)):
            known, unknown = self.combinations()
            say = f"the data determine {', '.join(known)} but not" if known else "not determined:"
            lines.append(f"{say} {', '.join(unknown)}")
        return "\n".join(lines)

    __str__ = summary


PART = 1e-3  # least weight with which an unknown takes part in a combination


class Starts(NamedTuple):
    """Fits from several starts."""

    best: Fit
    costs: np.ndarray  # chi squared reached from each start, inf where the prediction failed
    parameters: PyTree  # reached from each start, along the leading axis


def _flat(tree):
    return np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(tree)])


def _echelon(rows):
    """Rows that span the same, each with a one where all others are zero."""
    rows = np.array(rows)
    for i in range(len(rows)):
        below = np.abs(rows[i:])
        largest = below > (1 - PART) * np.max(below)  # the first of those as good as equal
        k, j = np.unravel_index(np.argmax(largest), below.shape)
        rows[[i, i + k]] = rows[[i + k, i]]
        rows[i] /= rows[i, j]
        rows -= np.where(np.arange(len(rows)) == i, 0.0, rows[:, j])[:, None] * rows[i]
    return rows


def _formula(weights, labels):
    """The weighted sum, as 'log a - 0.5 log b'."""
    size = lambda w: "" if abs(abs(w) - 1) < PART else f"{abs(w):.3g} "
    terms = [
        f"{'-' if weight < 0 else '+'} {size(weight)}{label}"
        for weight, label in sorted(zip(weights, labels, strict=True), key=lambda term: term[0] < 0)
        if abs(weight) > PART
    ]
    return " ".join(terms).removeprefix("+ ")


@contextlib.contextmanager
def reporting(progress: Progress, unknowns, total):
    """A function (trial, cost, unknowns) that reports in the way asked for."""
    if callable(progress):
        yield lambda trial, cost, u: progress(trial, float(cost), unknowns.parameters(u))
    elif not progress:
        yield lambda *_: None
    else:
        with tqdm(total=total, desc="fit") as bar:

            def report(trial, cost, _):
                bar.set_postfix(cost=f"{cost:.6g}", refresh=False)
                bar.update(trial - bar.n)

            yield report
