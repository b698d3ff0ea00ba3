"""What constructors share: conversion of numbers, and checks of those that are known.

Values that are traced, or put in place of arrays by a transformation, are not checked. A check must
not use an operation of jax: in traced code even known arrays become traced by one.
"""

import jax.core
import jax.numpy as jnp
import numpy as np


def as_float(value):
    """The value as an array of floating point numbers."""
    return jnp.asarray(value, jnp.result_type(float, jnp.asarray(value).dtype))


def as_float_or_none(value):
    """`as_float` of what may be left out."""
    return None if value is None else as_float(value)


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
