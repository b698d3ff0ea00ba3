"""Prescribed quantities as differentiable functions of time.

A schedule with knots rests before its first: a force or shift that shall begin at 1 s does nothing
until then. Its first knot is a corner like the others.
"""

import abc
import operator
from collections.abc import Callable

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rodjax.validation import as_float


class AbstractSchedule(eqx.Module):
    """A scalar or vector given for all times from 0 to `until`."""

    @abc.abstractmethod
    def __call__(self, time: Float[Array, ""]) -> Float[Array, "*k"]:
        """Value at a time [s]."""

    @property
    @abc.abstractmethod
    def until(self) -> float | Array:
        """Last time for which the schedule is given [s]."""

    @property
    def corners(self) -> Float[Array, " k"]:
        """Times at which a derivative jumps, where adaptive steps should end [s]."""
        return jnp.zeros((0,))

    def padded(self, knots: int) -> "AbstractSchedule":
        """The same schedule with so many knots: programs are compiled anew for another number.

        Raises:
            ValueError: it has more.
        """
        return self


def _padded(schedule, knots):
    """The first knot repeated, in every array: nothing changes, there or later."""
    more = operator.index(knots) - schedule.times.shape[0]
    if more < 0:
        raise ValueError(f"knots: must be at least the {schedule.times.shape[0]} there are")
    repeat = lambda leaf: jnp.concatenate([jnp.repeat(leaf[:1], more, 0), leaf])
    return jax.tree.map(repeat, schedule)


def _check_knots(times, values, name="values"):
    if isinstance(times, jax.core.Tracer) or not hasattr(times, "shape"):
        return
    steps = np.diff(times) if times.ndim == 1 else np.zeros(0)
    steps = np.trim_zeros(steps, "f")  # the first knot may be repeated, see `padded`
    increasing = steps.size > 0 and np.all(steps > 0)
    if not increasing or not np.all(np.isfinite(times)):
        raise ValueError("times: give at least two, finite and strictly increasing")
    if values.shape[:1] != times.shape:
        raise ValueError(
            f"{name}: expected {times.shape[0]} (one a time), got shape {values.shape}"
        )
    if not isinstance(values, jax.core.Tracer) and not np.all(np.isfinite(values)):
        raise ValueError(f"{name}: must be finite")


class Constant(AbstractSchedule):
    """One value for all times."""

    value: Float[Array, "*k"] = eqx.field(converter=as_float)

    def __call__(self, time):
        return self.value

    @property
    def until(self):
        return np.inf


class PiecewiseLinear(AbstractSchedule):
    """Linear between knots, the first value before them.

    Its rate jumps at the knots, which lowers the order of convergence.
    """

    times: Float[Array, " k"] = eqx.field(converter=as_float)
    values: Float[Array, "k *d"] = eqx.field(converter=as_float)

    def __check_init__(self):
        _check_knots(self.times, self.values)

    def __call__(self, time):
        return _interpolate(self.times, self.values, time)

    @property
    def until(self):
        return self.times[-1]

    @property
    def corners(self):
        return self.times

    def padded(self, knots):
        return _padded(self, knots)


class PiecewiseLinearRate(AbstractSchedule):
    """The integral from the first knot of a rate that is linear between knots (Fig. 6).

    Before the first knot it is zero and rests, whatever the first rate.
    """

    times: Float[Array, " k"] = eqx.field(converter=as_float)
    rates: Float[Array, "k *d"] = eqx.field(converter=as_float)

    def __check_init__(self):
        _check_knots(self.times, self.rates, "rates")

    def __call__(self, time):
        span = jnp.diff(self.times).reshape((-1,) + (1,) * (self.rates.ndim - 1))
        area = 0.5 * span * (self.rates[1:] + self.rates[:-1])
        reached = jnp.concatenate([jnp.zeros_like(self.rates[:1]), jnp.cumsum(area, 0)])
        i = _piece(self.times, time)
        rate = _interpolate(self.times, self.rates, time)
        since = _since(self.times[i], time)
        return reached[i] + 0.5 * since * (self.rates[i] + rate)

    @property
    def until(self):
        return self.times[-1]

    @property
    def corners(self):
        return self.times

    def padded(self, knots):
        return _padded(self, knots)


class Smooth(AbstractSchedule):
    """Quintic steps from knot to knot: rate and acceleration vanish at every knot (C2).

    The first value before the knots.
    """

    times: Float[Array, " k"] = eqx.field(converter=as_float)
    values: Float[Array, "k *d"] = eqx.field(converter=as_float)

    def __check_init__(self):
        _check_knots(self.times, self.values)

    def __call__(self, time):
        i = _piece(self.times, time)
        x = (time - self.times[i]) / _span(self.times, i)
        # not by clip, whose derivative at a knot is half that of the piece that begins there
        x = jnp.where(x < 0, 0.0, jnp.where(x > 1, 1.0, x))
        blend = x**3 * (10 - 15 * x + 6 * x**2)
        return self.values[i] + blend * (self.values[i + 1] - self.values[i])

    @property
    def until(self):
        return self.times[-1]

    @property
    def corners(self):
        return self.times

    def padded(self, knots):
        return _padded(self, knots)


class Function(AbstractSchedule):
    """Any differentiable function of time, valid until the time given.

    Numbers to differentiate by or to map over belong in the arrays of another schedule, not in the
    function's closure.
    """

    function: Callable = eqx.field(static=True)
    last: Float[Array, ""] = eqx.field(converter=as_float, default=float("inf"))

    def __call__(self, time):
        return self.function(time)

    @property
    def until(self):
        return self.last


def _piece(times, time):
    """Index of the interval that holds the time; the end intervals serve outside the knots."""
    return jnp.clip(jnp.searchsorted(times, time, side="right") - 1, 0, times.shape[0] - 2)


def _span(times, i):
    """Length of an interval; of those between repeated knots, which no time is in, one."""
    span = times[i + 1] - times[i]
    return jnp.where(span > 0, span, 1.0)


def _since(knot, time):
    """Time since a knot, none before it (at the knot the derivative is that of what begins)."""
    return jnp.where(time < knot, 0.0, time - knot)


def _interpolate(times, values, time):
    i = _piece(times, time)
    x = _since(times[i], time) / _span(times, i)
    return values[i] + x * (values[i + 1] - values[i])
