"""Observed values at given times, and what a run predicts for them."""

import warnings
from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from rodjax.dynamics.run import Run
from rodjax.inputs.argument_types import AnyArray
from rodjax.inputs.validation import (
    all_known,
    as_float,
    as_float_or_none,
    broadcasts,
    check_numbers,
    given,
    known,
)
from rodjax.numerics.results import ModelWarning


def _as_array(value):
    """Truth values as an array; what cannot be one is left to the check."""
    try:
        return None if value is None else jnp.asarray(value)
    except TypeError:
        return value


class Observations(eqx.Module):
    """Values measured at increasing times; some may be missing.

    Args:
        times: one for each entry of the first axis of the values; or, where every marker has its
            own, an array of the shape of the values' leading axes, increasing along the first.
        values: what was measured. NaN marks a missing sample.
        deviation: standard deviation of the values' noise, one for all or in a shape that
            broadcasts to that of the values; None leaves it to be estimated from a fit's
            residuals. That of missing samples does not matter.
        present: True where there is a value, in a shape that broadcasts to that of the values;
            None: wherever it is not NaN.

    Missing samples take no part in a fit, nor in its degrees of freedom.

    Example:
        >>> data = rx.Observations([0.1, 0.2, 0.3], [1.0, np.nan, 0.8], deviation=0.05)
    """

    times: Float[Array, "k *m"] = eqx.field(converter=as_float)
    values: Float[Array, "k *d"] = eqx.field(converter=as_float)
    deviation: Float[Array, "..."] | None = eqx.field(converter=as_float_or_none, default=None)
    present: Bool[Array, "..."] | None = eqx.field(converter=_as_array, default=None)

    def __check_init__(self):
        check_numbers(times=self.times, values=self.values, **given(deviation=self.deviation))
        kind = getattr(self.present, "dtype", None)
        if self.present is not None and (kind is None or not jnp.issubdtype(kind, jnp.bool_)):
            raise ValueError("present: give truth values, True where there is a value")
        leaves = (self.times, self.values, self.deviation, self.present)
        if not all_known(leaves) or not known(self.times):
            return
        times, values = np.asarray(self.times), np.asarray(self.values)
        if not (times.ndim >= 1 and times.size and times.shape == values.shape[: times.ndim]):
            raise ValueError(
                f"values: expected {times.shape[0] if times.ndim else 'at least one time'}"
                f" (one a time), got shape {values.shape} for times of shape {times.shape}"
            )
        if not np.all(np.isfinite(times)) or np.any(np.diff(times, axis=0) <= 0):
            raise ValueError("times: must be finite and strictly increasing")
        for name, array in given(deviation=self.deviation, present=self.present).items():
            if not broadcasts(np.shape(array), values.shape):
                raise ValueError(
                    f"{name}: shape {np.shape(array)} does not broadcast to that of the values,"
                    f" {values.shape}"
                )
        here = np.asarray(self.here)
        if not np.any(here):
            raise ValueError("values: every sample is missing")
        if np.any(bad := here & ~np.isfinite(values)):
            raise ValueError(f"values: not finite at time {self.first_time(bad):g}")
        if self.deviation is None:
            return
        deviation = np.broadcast_to(self.deviation, values.shape)
        if np.any(bad := here & ~(np.isfinite(deviation) & (deviation > 0))):
            raise ValueError(
                f"deviation: must be positive and finite, but is not at time"
                f" {self.first_time(bad):g}; mark a missing sample by NaN among the values"
            )
        size = 1e3 * np.max(np.abs(values[here]))
        if np.any(void := here & (deviation > size)) and not np.all(void[here]):
            warnings.warn(
                f"deviation: {np.sum(void)} are over 1000 times the largest value; such values"
                " say nothing, but count among the degrees of freedom; mark missing samples by"
                " NaN among the values",
                ModelWarning,
                stacklevel=2,
            )

    @property
    def here(self) -> Bool[Array, "k *d"]:
        """Where there is a value."""
        measured = ~jnp.isnan(self.values)
        if self.present is None:
            return measured
        return measured & jnp.broadcast_to(self.present, measured.shape)

    @property
    def count(self) -> int:
        """Number of values."""
        return int(np.sum(self.here))

    def residuals(self, prediction: Array) -> Float[Array, " n"]:
        """(prediction - values) / deviation, ravelled; not divided where none is stated.

        Zero where there is no value, whatever the prediction. In the higher precision of
        prediction and values.

        Raises:
            ValueError: the prediction does not have the shape of the values.
        """
        if prediction.shape != self.values.shape:
            raise ValueError(
                f"predict: expected shape {self.values.shape}, that of the observed values, got"
                f" {prediction.shape}"
            )
        here = self.here
        # replaced before they are divided: what is no number would be one in no derivative either
        widest = np.result_type(prediction.dtype, self.values.dtype)
        there = lambda array, other: jnp.where(here, array.astype(widest), other)
        difference = there(prediction, 0.0) - there(self.values, 0.0)
        if self.deviation is not None:
            deviation = jnp.broadcast_to(self.deviation, here.shape)
            difference = difference / there(deviation, 1.0)
        return difference.ravel()

    def first_time(self, marked: np.ndarray) -> float:
        """Time of the first of the (ravelled) values that are marked."""
        times = np.asarray(self.times)
        each = np.reshape(marked, (*times.shape, -1)).any(-1)
        return float(np.min(times[each]))


def positions_at(
    run: Run,
    times: Float[AnyArray, "k *columns"],
    nodes: Int[Array, " m"] | Sequence[int] | None = None,
) -> Float[Array, "k m 3"]:
    """Centreline at given times [m], by the cubic through the positions and velocities saved.

    Args:
        times: (k,) for all, or (k, m) with a column of its own for each node.
        nodes: numbers of the nodes wanted, negative from the end s = L; all by default.

    Fourth order in the interval between saved states. Differentiable in the run and the times.
    In traced code a time outside the run gives NaN, and so does one after the failure of a run
    made with `throw=False`, which a fit takes as a failed trial.

    Raises:
        ValueError: a time lies outside the run (checked outside traced code), or the nodes are
            not those of the rod, or not one for each column of times.

    Example:
        >>> rx.positions_at(run, np.array([0.05, 0.15]), nodes=[10, -1]).shape
        (2, 2, 3)
    """
    check_numbers(times=times)
    saved = run.times
    times = jnp.asarray(times, saved.dtype)
    count = run.states.position.shape[1]
    which = _node_numbers(nodes, count)
    if times.ndim not in (1, 2) or times.ndim == 2 and times.shape[1:] != which.shape:
        raise ValueError(
            f"times: must have shape (k,), or (k, {which.size}) with a column for each node, got"
            f" {times.shape}"
        )
    first, last = saved[0], saved[-1]
    slack = 8 * jnp.finfo(saved.dtype).eps * (jnp.abs(first) + jnp.abs(last))
    inside = (times >= first - slack) & (times <= last + slack)
    traced = not all_known((saved, times, inside))
    if not traced and not np.all(inside):
        outside = float(np.asarray(times)[~np.asarray(inside)][0])
        raise ValueError(
            f"times: {outside:g} lies outside the run, from {float(first):g} to {float(last):g}"
        )
    i = jnp.clip(jnp.searchsorted(saved, times, side="left") - 1, 0, saved.shape[0] - 2)
    step = saved[i + 1] - saved[i]
    step = jnp.where(step > 0, step, 1.0)
    x = (times - saved[i]) / step
    if times.ndim == 1:
        i, step, x, inside = (array[:, None] for array in (i, step, x, inside))
    step, x, inside = step[..., None], x[..., None], inside[..., None]
    position, velocity = run.states.position, run.states.velocity
    begin, end = position[i, which], position[i + 1, which]
    start, stop = step * velocity[i, which], step * velocity[i + 1, which]
    rise = end - begin
    cubic = start + x * ((3 * rise - 2 * start - stop) + x * (start + stop - 2 * rise))
    return jnp.where(inside, begin + x * cubic, jnp.nan)


def _node_numbers(nodes, count) -> Int[Array, " m"] | np.ndarray:
    if nodes is None:
        return np.arange(count)
    nodes = nodes if hasattr(nodes, "dtype") else np.asarray(nodes)
    if nodes.ndim != 1 or not jnp.issubdtype(nodes.dtype, jnp.integer):
        raise ValueError("nodes: give the numbers of nodes, one axis of integers")
    if known(nodes) and not np.all((np.asarray(nodes) >= -count) & (np.asarray(nodes) < count)):
        raise ValueError(f"nodes: must be among the {count} of the rod, 0 to {count - 1} or -1 on")
    return nodes
