"""Observed values at given times, and what a run predicts for them."""

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rodjax.run import Run
from rodjax.validation import as_float, as_float_or_none


class Observations(eqx.Module):
    """Values measured at increasing times.

    `deviation` is the standard deviation of the values' noise, one for all or in a shape that
    broadcasts to that of the values; None leaves it to be estimated from a fit's residuals.
    """

    times: Float[Array, " k"] = eqx.field(converter=as_float)
    values: Float[Array, "k *d"] = eqx.field(converter=as_float)
    deviation: Float[Array, "..."] | None = eqx.field(converter=as_float_or_none, default=None)

    def __check_init__(self):
        leaves = (self.times, self.values, self.deviation)
        if not hasattr(self.times, "shape") or any(isinstance(x, jax.core.Tracer) for x in leaves):
            return
        times, values = np.asarray(self.times), np.asarray(self.values)
        if times.ndim != 1 or not np.all(np.isfinite(times)) or np.any(np.diff(times) <= 0):
            raise ValueError("times: must be finite and strictly increasing")
        if values.shape[:1] != times.shape:
            raise ValueError(
                f"values: expected {times.size} (one a time), got shape {values.shape}"
            )
        finite = np.isfinite(values).reshape(times.size, -1).all(1)
        if not np.all(finite):
            raise ValueError(f"values: not finite at time {times[np.argmin(finite)]:g}")
        if self.deviation is None:
            return
        deviation = np.asarray(self.deviation)
        try:
            fits = np.broadcast_shapes(deviation.shape, values.shape) == values.shape
        except ValueError:
            fits = False
        if not fits:
            raise ValueError(
                f"deviation: shape {deviation.shape} does not broadcast to that of the values,"
                f" {values.shape}"
            )
        if not np.all(np.isfinite(deviation) & (deviation > 0)):
            raise ValueError("deviation: must be positive and finite")

    def residuals(self, prediction: Array) -> Float[Array, " n"]:
        """(prediction - values) / deviation, ravelled; not divided where none is stated.

        Raises:
            ValueError: the prediction does not have the shape of the values.
        """
        if prediction.shape != self.values.shape:
            raise ValueError(
                f"predict: expected shape {self.values.shape}, that of the observed values, got"
                f" {prediction.shape}"
            )
        deviation = 1.0 if self.deviation is None else self.deviation
        return ((prediction - self.values) / deviation).ravel()

    def first_time(self, marked: np.ndarray) -> float:
        """Time of the first of the (ravelled) values that are marked."""
        each = np.reshape(marked, (self.times.size, -1)).any(1)
        return float(self.times[int(np.argmax(each))])


def positions_at(run: Run, times: Float[Array, " k"]) -> Float[Array, "k nodes 3"]:
    """Centreline at given times [m], by the cubic through the positions and velocities saved.

    Fourth order in the interval between saved states. Differentiable in the run and the times.
    In traced code a time outside the run, or after the failure of one made with `throw=False`,
    gives NaN, which a fit takes as a failed trial.

    Raises:
        ValueError: a time lies outside the run (checked outside traced code).
    """
    known = run.times
    times = jnp.asarray(times, known.dtype)
    # a run that failed repeats its last good state
    first, last = known[0], jnp.max(known)
    slack = 8 * jnp.finfo(known.dtype).eps * (jnp.abs(first) + jnp.abs(last))
    inside = (times >= first - slack) & (times <= last + slack)
    traced = any(isinstance(x, jax.core.Tracer) for x in (known, times, inside))
    if not traced and not np.all(inside):
        outside = float(times[int(np.argmin(inside))])
        raise ValueError(
            f"times: {outside:g} lies outside the run, from {float(first):g} to {float(last):g}"
        )
    i = jnp.clip(jnp.searchsorted(known, times, side="left") - 1, 0, known.shape[0] - 2)
    step = known[i + 1] - known[i]
    step = jnp.where(step > 0, step, 1.0)
    x = ((times - known[i]) / step)[:, None, None]
    step = step[:, None, None]
    begin, end = run.states.position[i], run.states.position[i + 1]
    start, stop = step * run.states.velocity[i], step * run.states.velocity[i + 1]
    rise = end - begin
    cubic = start + x * ((3 * rise - 2 * start - stop) + x * (start + stop - 2 * rise))
    return jnp.where(inside[:, None, None], begin + x * cubic, jnp.nan)
