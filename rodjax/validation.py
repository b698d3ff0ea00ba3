"""What constructors share: conversion of numbers, and checks of those that are known.

Values that are traced, or put in place of arrays by a transformation, are not checked. A check must
not use an operation of jax: in traced code even known arrays become traced by one.
"""

import jax
import jax.core
import jax.numpy as jnp
import numpy as np


def as_float(value):
    """The value as an array of floating point numbers."""
    return jnp.asarray(value, jnp.result_type(float, jnp.asarray(value).dtype))


def as_float_or_none(value):
    """`as_float` of what may be left out."""
    return None if value is None else as_float(value)


def as_traced(tree):
    """The pytree with its numbers as arrays of full type, which are traced, not compiled in.

    Truth values, texts and functions stay what they are.
    """

    def convert(leaf):
        number = isinstance(leaf, int | float | complex | np.number) and not isinstance(leaf, bool)
        if number or isinstance(leaf, np.ndarray) or getattr(leaf, "weak_type", False):
            return jnp.asarray(leaf, jnp.asarray(leaf).dtype)
        return leaf

    return jax.tree.map(convert, tree)


def known(value) -> bool:
    """Whether a field holds numbers (not a tracer, nor what a transformation puts there)."""
    return hasattr(value, "shape") and not isinstance(value, jax.core.Tracer)


def check_finite(**values) -> None:
    """Raise ValueError unless the known values are finite."""
    for name, value in values.items():
        if known(value) and not np.all(np.isfinite(value)):
            raise ValueError(f"{name}: must be finite, got {value}")


def check_positive(**values) -> None:
    """Raise ValueError unless the known values are positive and finite."""
    for name, value in values.items():
        if known(value) and not np.all(np.isfinite(value) & (np.asarray(value) > 0)):
            raise ValueError(f"{name}: must be positive and finite, got {value}")


def check_not_negative(**values) -> None:
    """Raise ValueError unless the known values are finite and not negative."""
    for name, value in values.items():
        if known(value) and not np.all(np.isfinite(value) & (np.asarray(value) >= 0)):
            raise ValueError(f"{name}: must be finite and not negative, got {value}")
