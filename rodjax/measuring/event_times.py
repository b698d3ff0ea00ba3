"""Rates of sampled values, and times at which they reach a level or are largest."""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from rodjax.inputs.argument_types import AnyArray
from rodjax.numerics.compilation import compiled


def slopes(times: Float[AnyArray, " k"], values: Float[AnyArray, " k"]) -> Float[Array, " k"]:
    """Rate of values sampled at times, from the parabola through three consecutive samples."""
    dt = jnp.diff(times)
    secant = jnp.diff(values) / dt
    inner = (dt[1:] * secant[:-1] + dt[:-1] * secant[1:]) / (dt[1:] + dt[:-1])
    first, last = 2 * secant[:1] - inner[:1], 2 * secant[-1:] - inner[-1:]
    return jnp.concatenate([first, inner, last])


def first_crossing(
    times: Float[AnyArray, " k"],
    values: Float[AnyArray, " k"],
    level: Float[Array, ""] | float,
    rates: Float[AnyArray, " k"] | None = None,
) -> Float[Array, ""]:
    """Time at which a sampled quantity first reaches a level from below.

    Linear between samples, or the cubic through values and `rates` at both (`slopes` gives rates
    for a smooth quantity). The first time if it starts at or above the level, inf if it never
    reaches it; NaN if it is not known whether it would have (a run that failed before).
    Differentiable in all arguments; the sample interval is held.

    Args:
        times: of the samples, increasing [s].
        values: of the quantity at the times.
        level: in the unit of the values.
        rates: derivatives of the values by time.
    """
    level = level if isinstance(level, jax.Array) else jnp.asarray(level, values.dtype)
    return _first_crossing(times, values, level, rates)


@compiled
def _first_crossing(times, values, level, rates):
    reached = values >= level
    j = jnp.argmax(reached)  # first true
    i = jnp.maximum(j - 1, 0)
    inside = reached[j] & (j > 0)
    t0, t1, v0, v1 = times[i], times[i + 1], values[i], values[i + 1]
    if rates is None:
        x = (level - v0) / jnp.where(inside, v1 - v0, 1.0)
    else:
        # a harmless line where nothing is crossed
        line = (level - 0.5, level + 0.5, 1.0, 1.0)
        cubic = (v0, v1, (t1 - t0) * rates[i], (t1 - t0) * rates[i + 1])
        cubic = tuple(jnp.where(inside, a, b) for a, b in zip(cubic, line, strict=True))
        x = _hermite_root(cubic, jnp.asarray(level, values.dtype))
    time = jnp.where(inside, t0 + x * (t1 - t0), times[0])
    return jnp.where(jnp.any(reached), time, _unless_unknown(values, jnp.inf))


def _unless_unknown(values, otherwise):
    """NaN if a value is, with a derivative that is NaN as well, else what is given."""
    return jnp.where(jnp.any(jnp.isnan(values)), jnp.sum(values), otherwise)


def _hermite_root(cubic, level):
    """Root in [0, 1] of the cubic with these end values and slopes, by bisection and Newton."""
    v0, v1, m0, m1 = cubic

    def gap(x):
        rise = v1 - v0
        value = v0 + x * (m0 + x * ((3 * rise - 2 * m0 - m1) + x * (m0 + m1 - 2 * rise)))
        return value - level

    def solve(function, x):
        def halve(_, bracket):
            low, high = bracket
            middle = 0.5 * (low + high)
            below = function(middle) < 0
            return jnp.where(below, middle, low), jnp.where(below, high, middle)

        return 0.5 * sum(lax.fori_loop(0, 60, halve, (jnp.zeros_like(x), jnp.ones_like(x))))

    return lax.custom_root(
        gap, 0.5 * jnp.ones_like(level), solve, lambda g, y: y / g(jnp.ones_like(y))
    )


@compiled
def time_of_maximum(
    times: Float[AnyArray, " k"], values: Float[AnyArray, " k"]
) -> Float[Array, ""]:
    """Time of the largest of values sampled at times.

    The vertex of the parabola through it and its two neighbours.

    The sample's own time if it is the first or the last; NaN if a value is. Differentiable; the
    samples are held.
    """
    largest = jnp.argmax(values)
    k = jnp.clip(largest, 1, values.shape[0] - 2)
    t, v = lax.dynamic_slice_in_dim(times, k - 1, 3), lax.dynamic_slice_in_dim(values, k - 1, 3)
    before, after = t[1] - t[0], t[2] - t[1]
    distinct = (before > 0) & (after > 0)
    before, after = jnp.where(distinct, before, 1.0), jnp.where(distinct, after, 1.0)
    left, right = (v[1] - v[0]) / before, (v[2] - v[1]) / after
    bend = right - left
    inside = (largest == k) & distinct & (bend < 0)
    bend = jnp.where(inside, bend, 1.0)
    # the slope of the parabola falls linearly from `left` to `right` between the interval centres
    vertex = 0.5 * (t[0] + t[1]) - left / bend * 0.5 * (before + after)
    return _unless_unknown(values, jnp.where(inside, vertex, times[largest]))
