"""What fits tell: how they ended, what the data determine, and progress on the way."""

import contextlib
import enum
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import PyTree
from tqdm import tqdm

from rodjax.fitting.bounds import names_of
from rodjax.inputs.sheets import Sheet
from rodjax.inputs.validation import given

Progress = Callable[[int, float, Any], None] | bool | None


class FitError(ValueError):
    """Data, parameters or a prediction with which a fit cannot begin.

    Example:
        >>> try:
        ...     rx.least_squares(lambda p: jnp.zeros(2), 1.0, rx.Observations([0, 1], [1.0, 1.0]))
        ... except rx.FitError as error:
        ...     print("refused")
        refused
    """


class FitResult(enum.IntEnum):
    """Why a fit ended.

    Example:
        >>> rx.FitResult(0).name
        'CONVERGED'
    """

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

    Attributes:
        parameters: the best found, a pytree like the guess.
        deviations: standard deviations, in the structure and units of the parameters; zero for
            what is fixed.
        covariance: (p, p) of the free parameters in the order of `names`; NaN beside the infinite
            variances.
        names: of the p free parameters' numbers, as 'stiffness[2]'.
        labels: of the unknowns, as 'log stiffness[2]'.
        at_bound: names of parameters that went to the end of their interval.
        residuals: prediction - values, in their units; NaN where there is no value.
        chi_squared: sum of the squares of the residuals, over their deviations if stated, or of
            the robust loss; with that of the priors.
        freedom: number of data, with those of priors, less that of determined combinations.
        determined, undetermined: combinations of the unknowns, the best determined first.
        steps: trials that lowered chi squared.
        evaluations: of the prediction and its derivatives.
        history: chi squared at the guess and after each step.
        result: why the fit ended.
        fixed: names of parameters held at the guess.
        data_freedom: of the data alone: their number less what they, not the priors, determine.
        prior_chi_squared: the priors' part of chi squared.
        weights: of the data: 1 in full, less for outliers under a robust loss, 0 if missing.

    Example:
        >>> data = rx.Observations([0.0, 1.0, 2.0], [0.0, 2.1, 3.9], deviation=0.1)
        >>> fit = rx.least_squares(lambda slope: slope * jnp.arange(3.0), 1.0, data)
        >>> round(float(fit.parameters), 2), round(float(fit.deviations), 3)
        (1.98, 0.045)
    """

    parameters: PyTree
    deviations: PyTree
    covariance: np.ndarray
    names: tuple[str, ...]
    labels: tuple[str, ...]
    at_bound: tuple[str, ...]
    residuals: np.ndarray
    chi_squared: float
    freedom: int
    determined: tuple[Combination, ...]
    undetermined: tuple[Combination, ...]
    steps: int
    evaluations: int
    history: tuple[float, ...]
    result: FitResult
    fixed: tuple[str, ...]
    data_freedom: float
    prior_chi_squared: float
    weights: np.ndarray

    @property
    def reduced(self) -> float:
        """Chi squared for each degree of freedom: near 1 if model and stated noise are right."""
        return self.chi_squared / self.freedom if self.freedom else np.nan

    @property
    def residual_deviation(self) -> float:
        """Standard deviation of the noise, estimated from the residuals."""
        squares = np.nansum(self.residuals**2)
        return float(np.sqrt(squares / self.data_freedom)) if self.freedom else np.nan

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
        names = _names(self.parameters)
        width = max(map(len, names))
        missing = int(np.sum(np.isnan(self.residuals)))
        lines = [
            f"{MESSAGES[self.result]}: {self.steps} steps, {self.evaluations} evaluations",
            f"chi squared {self.chi_squared:.6g}, degrees of freedom {self.freedom}, deviation of"
            f" the residuals {self.residual_deviation:.3g}",
        ]
        if missing:
            lines.append(f"{missing} of {self.residuals.size} samples are missing")
        for name, value, spread in zip(names, _flat(self.parameters), self._spreads(), strict=True):
            lines.append(f"  {name:<{width}}  {value:<12.6g}  {spread}")
        at_bound = np.isin(names, self.at_bound)
        deviations = _flat(self.deviations)
        if np.any(np.isinf(deviations) & ~at_bound):
            known, unknown = self.combinations()
            say = f"the data determine {', '.join(known)} but not" if known else "not determined:"
            lines.append(f"{say} {', '.join(unknown)}")
        return "\n".join(lines)

    def _spreads(self) -> list[str]:
        """How well each number among the parameters is known."""
        special = dict.fromkeys(self.at_bound, "at its bound") | dict.fromkeys(self.fixed, "fixed")
        say = lambda x: "not determined" if np.isinf(x) else f"+- {x:.2g}"
        pairs = zip(_names(self.parameters), _flat(self.deviations), strict=True)
        return [special.get(name) or say(deviation) for name, deviation in pairs]

    __str__ = summary

    def _repr_html_(self) -> str:
        first, *others = self.summary().splitlines()
        notes = [("", line) for line in others if not line.startswith("  ")]
        pairs = zip(_names(self.parameters), _flat(self.parameters), self._spreads(), strict=True)
        rows = [(name, f"{value:.6g} {spread}") for name, value, spread in pairs]
        return Sheet(first, (*rows, *notes)).html

    def __repr__(self) -> str:
        names, values = _names(self.parameters), _flat(self.parameters)
        parts = zip(names, values, self._spreads(), strict=True)
        say = _few([f"{name} = {value:.6g} {spread}" for name, value, spread in parts])
        return (
            f"Fit({self.result.name}: {say}; chi squared {self.chi_squared:.4g}, degrees of freedom"
            f" {self.freedom})"
        )


PART = 1e-3  # least weight with which an unknown takes part in a combination


class Starts(NamedTuple):
    """Fits from several starts."""

    best: Fit
    costs: np.ndarray  # chi squared reached from each start, inf where the prediction failed
    parameters: PyTree  # reached from each start, along the leading axis

    def __repr__(self) -> str:
        costs = ", ".join("failed" if np.isinf(cost) else f"{cost:.4g}" for cost in self.costs[:8])
        more = ", ..." if len(self.costs) > 8 else ""
        return f"Starts(chi squared {costs}{more} of {len(self.costs)} starts; best={self.best!r})"


def short(tree: PyTree) -> str:
    """The first numbers of a pytree by name, in a line."""
    pairs = zip(_names(tree), _flat(tree), strict=True)
    return _few([f"{name} = {value:.6g}" for name, value in pairs])


def _few(parts):
    return ", ".join(parts[:6]) + (f", ... ({len(parts)} in all)" if len(parts) > 6 else "")


def _names(tree):
    return [name for names in names_of(tree) for name in names]


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


def check_settings(max_steps, tolerance, threshold=None, progress=None) -> None:
    """Raise ValueError unless the settings of a fit make sense."""
    if not isinstance(max_steps, int | np.integer) or isinstance(max_steps, bool) or max_steps < 0:
        raise ValueError(f"max_steps: must be a whole number, 0 or more, got {max_steps!r}")
    for name, value in {"tolerance": tolerance, **given(threshold=threshold)}.items():
        number = np.shape(value) == ()
        if not number or isinstance(value, str | bool) or not 0 <= float(value) < 1:
            raise ValueError(f"{name}: must be a number from 0 to less than 1, got {value!r}")
    if not (callable(progress) or progress is None or isinstance(progress, bool)):
        raise ValueError(f"progress: give True, False or a function, got {progress!r}")
