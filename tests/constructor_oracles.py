"""Oracles of the kinds of arguments, written apart from the package.

Each says of a value in an argument's place: True if it makes sense, False if not, None if either
answer will do.
"""

import inspect
import re

import jax.numpy as jnp
import numpy as np

import rodjax as rx

N = 6  # elements of the rods

# how the package's own messages begin: with the argument's name
OURS = re.compile(r"^[a-z_0-9\[\]., ]+(\(.*\))?: ")


def real_array(value):
    """As numpy's array, if these are real numbers in a sequence or an array."""
    if isinstance(value, str | bytes | dict | bool) or value is None or callable(value):
        return None
    try:
        array = np.asarray(value)
    except (TypeError, ValueError):
        return None
    if array.dtype == object and isinstance(value, int):
        return np.asarray(float(value)) if abs(value) < 1e300 else None
    return array if array.dtype.kind in "iuf" else None


def extreme(array):
    size = np.abs(array[array != 0].astype(float))
    return bool(np.any((size > 1e20) | (size < 1e-20)))


def array_of(shape, low=-np.inf, high=np.inf, *, strict=False, optional=False, infinite=False):
    """Real numbers of a shape in a range (`strict`: without its bounds)."""

    def oracle(value):
        if value is None:
            return optional
        array = real_array(value)
        if array is None or array.shape != shape or np.any(np.isnan(array)):
            return False
        if not infinite and np.any(np.isinf(array)):
            return False
        inside = (array > low) & (array < high) if strict else (array >= low) & (array <= high)
        if not np.all(inside):
            return False
        return None if extreme(array) else True

    return oracle


positive = array_of((), 0, strict=True)
not_negative = array_of((), 0)
finite = array_of(())


def optional(oracle):
    return lambda value: True if value is None else oracle(value)


def count(low, high):
    def oracle(value):
        array = real_array(value)
        whole = array is not None and array.shape == () and float(array).is_integer()
        return whole and low <= array <= high

    return oracle


def node(value):
    array = real_array(value)
    integer = array is not None and array.shape == () and array.dtype.kind in "iu"
    return integer and -N - 1 <= array <= N


def inner_node(value):
    return node(value) and int(value) % (N + 1) not in (0, N)


def direction(value):
    array = real_array(value)
    good = array is not None and array.shape == (3,) and np.all(np.isfinite(array))
    return bool(good and np.any(array != 0))


def flag(value):
    return isinstance(value, bool | np.bool_)


def instance(kind):
    return lambda value: isinstance(value, kind)


def schedule(shape):
    return lambda value: (
        isinstance(value, rx.AbstractSchedule) and jnp.shape(value(jnp.asarray(0.5))) == shape
    )


def numbers(value):
    array = real_array(value)
    return array is not None and bool(np.all(np.isfinite(array)))


def perhaps_a_function(value):
    return None if callable(value) and not inspect.isclass(value) else False


def original(*good):
    """Only these very objects make sense."""
    return lambda value: any(value is one for one in good)


def rising(value):
    array = real_array(value)
    good = array is not None and array.shape == (3,) and np.all(np.isfinite(array))
    return bool(good and np.all(np.diff(array) > 0))


def rows(value):
    array = real_array(value)
    good = array is not None and array.ndim >= 1 and array.shape[0] == 3
    return bool(good and np.all(np.isfinite(array)))


def property_of(low, strict, may_lack):
    """A number, one an element, or a function of arc length."""

    def oracle(value):
        if callable(value) and not inspect.isclass(value):
            return None
        number = array_of((), low, strict=strict, optional=may_lack)(value)
        return array_of((N,), low, strict=strict)(value) if number is False else number

    return oracle


def triple_of(low, strict, may_lack):
    def oracle(value):
        if value is None:
            return may_lack
        if isinstance(value, list | tuple) and any(callable(part) for part in value):
            return None
        if isinstance(value, range):  # a sequence of three, which may be asked for as a tuple
            return None
        three = array_of((3,), low, strict=strict)(value)
        return array_of((N, 3), low, strict=strict)(value) if three is False else three

    return oracle


def jumps(value):
    array = real_array(value)
    inside = array is not None and array.ndim == 1 and np.all((array > 0) & (array < 1))
    return bool(inside and np.all(np.diff(np.sort(array)) > 0) and len(array) < N)


def frames(value):
    return array_of((N + 1, 4))(value) is not False


def one_precision(oracle):
    """A rod in double precision may refuse single precision."""

    def judged(value):
        single = getattr(value, "dtype", None) == np.float32
        return oracle(value) and (None if single else oracle(value))

    return judged
