"""Prescribed quantities as differentiable functions of time.

A schedule with knots rests before its first: a force or shift that shall begin at 1 s does nothing
until then. Its first knot is a corner like the others.
"""

import abc
import operator
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rodjax.inputs.user_functions import check_function, named, returned
from rodjax.inputs.validation import (
    as_float,
    check_finite,
    check_instance,
    check_numbers,
    check_scalar,
    known,
    shown,
)


class AbstractSchedule(eqx.Module):
    """A scalar or vector given for all times from 0 to `until`.

    Example:
        >>> class Decay(rx.AbstractSchedule):
        ...     rate: jax.Array
        ...     def __call__(self, time):
        ...         return jnp.exp(-self.rate * time)
        ...     @property
        ...     def until(self):
        ...         return jnp.inf
        >>> float(Decay(jnp.asarray(2.0))(jnp.asarray(0.0)))
        1.0
    """

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


def check_schedule(shape: tuple[int, ...], mend: str, **schedules) -> None:
    """Raise ValueError unless each is a schedule whose values have this shape.

    `mend` says what to give where a number, a sequence or something else was given.
    """
    for name, schedule in schedules.items():
        if callable(schedule) and not isinstance(schedule, type | eqx.Module):
            raise ValueError(f"{name}: wrap {named(schedule)} in a schedule: Function(function)")
        check_instance(AbstractSchedule, mend, **{name: schedule})
        values: Any = schedule
        found = returned(name, values, _time()).shape
        if found != shape:
            expected = "one number" if shape == () else f"{shape[0]} components"
            raise ValueError(f"{name}: the schedule must give {expected}, got shape {found}")


def _time():
    """Shape and type of a time."""
    return jax.ShapeDtypeStruct((), jnp.result_type(float))


def _check_knots(times, **values):
    check_numbers(times=times, **values)
    shape = jnp.shape(times)
    if len(shape) != 1 or shape[0] < 2:
        raise ValueError(
            f"times: give at least two knots, finite and increasing, got {shown(times)}"
        )
    if known(times):
        steps = np.trim_zeros(np.diff(times), "f")  # the first may be repeated, see `padded`
        if not (np.all(np.isfinite(times)) and steps.size > 0 and np.all(steps > 0)):
            raise ValueError(
                f"times: must be finite and strictly increasing, got {np.asarray(times)}"
            )
    for name, value in values.items():
        if jnp.shape(value)[:1] != shape:
            raise ValueError(
                f"{name}: expected {shape[0]} (one for each of the times), got shape"
                f" {jnp.shape(value)}"
            )
    check_finite(**values)


class Constant(AbstractSchedule):
    """One value for all times (of a drive, whose changes alone count: no motion).

    Attributes:
        value: a number or an array, in the unit of what it prescribes.

    Example:
        >>> hanging_weight = rx.PointLoad(-1, force=rx.Constant((0.0, 0.0, -2.0)))
    """

    value: Float[Array, "*k"] = eqx.field(converter=as_float)

    def __check_init__(self):
        check_finite(value=self.value)

    def __call__(self, time):
        return self.value

    @property
    def until(self):
        return np.inf


class PiecewiseLinear(AbstractSchedule):
    """Linear between knots, the first value before them.

    Its rate jumps at the knots, which lowers the order of convergence.

    Attributes:
        times: of the knots, at least two, increasing [s]. A run may last until the last.
        values: at the knots, one row a time: numbers or vectors, in the unit of what it prescribes.

    Example:
        >>> ramp = rx.PiecewiseLinear([0.0, 2.0, 3.0], [0.0, 4.0, 4.0])
        >>> float(ramp(jnp.asarray(1.0)))
        2.0
    """

    times: Float[Array, " k"] = eqx.field(converter=as_float)
    values: Float[Array, "k *d"] = eqx.field(converter=as_float)

    def __check_init__(self):
        _check_knots(self.times, values=self.values)

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

    Attributes:
        times: of the knots, at least two, increasing [s]. A run may last until the last.
        rates: at the knots, one row a time: numbers or vectors, in the unit of what it prescribes
            per second.

    Example:
        >>> speed_up = rx.PiecewiseLinearRate([0.0, 1.0, 5.0], [0.0, 2.0, 2.0])  # [rad/s]
        >>> float(speed_up(jnp.asarray(2.0)))  # the angle [rad]
        3.0
    """

    times: Float[Array, " k"] = eqx.field(converter=as_float)
    rates: Float[Array, "k *d"] = eqx.field(converter=as_float)

    def __check_init__(self):
        _check_knots(self.times, rates=self.rates)

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

    Attributes:
        times: of the knots, at least two, increasing [s]. A run may last until the last.
        values: at the knots, one row a time: numbers or vectors, in the unit of what it prescribes.

    Example:
        >>> soft = rx.Smooth([0.0, 2.0], [0.0, 1.0])
        >>> float(soft(jnp.asarray(1.0)))
        0.5
    """

    times: Float[Array, " k"] = eqx.field(converter=as_float)
    values: Float[Array, "k *d"] = eqx.field(converter=as_float)

    def __check_init__(self):
        _check_knots(self.times, values=self.values)

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

    Attributes:
        function: of the time [s], a scalar, written with jax.numpy; returns a number or a vector.
        last: time until which it holds [s]; a run cannot last longer.

    Example:
        >>> wave = rx.Function(lambda t: jnp.stack([0.0 * t, 0.0 * t, 0.1 * jnp.sin(t)]))
        >>> heaving = rx.Scene(rod, rx.Clamped(displacement=wave))
    """

    function: Callable = eqx.field(static=True)
    last: Float[Array, ""] = eqx.field(converter=as_float, default=float("inf"))

    def __check_init__(self):
        check_function(function=self.function)
        check_scalar(last=self.last)
        if known(self.last) and not self.last > -np.inf:
            raise ValueError(f"last: must be finite, or infinite for all times, got {self.last}")
        returned("function", self.function, _time())

    def __call__(self, time):
        return as_float(self.function(time))

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
