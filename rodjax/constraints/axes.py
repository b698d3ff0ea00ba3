"""Axes that turns, slides and hinges are given: unit vectors of what has any length."""

import jax.numpy as jnp
import numpy as np

from rodjax.inputs.validation import all_known, as_float, check_numbers, known, shown


def unit_vector(vector):
    """The vector over its length; what has none is left for the check."""
    vector = as_float(vector)
    if not all_known(vector) and vector.shape == (3,):
        return vector / jnp.linalg.norm(vector)
    if not (known(vector) and jnp.issubdtype(vector.dtype, jnp.floating)):
        return vector
    largest = np.max(np.abs(vector), initial=0.0)
    if not (0 < largest < np.inf):
        return vector
    scaled = np.asarray(vector) / largest  # whose length neither overflows nor vanishes
    return jnp.asarray(scaled / np.linalg.norm(scaled))


def check_axis(axis) -> None:
    """Raise ValueError unless it is three finite components, not all zero."""
    check_numbers(axis=axis)
    if jnp.shape(axis) != (3,) or (known(axis) and not 0 < np.max(np.abs(axis)) < np.inf):
        given = np.asarray(axis) if known(axis) else shown(axis)
        raise ValueError(f"axis: give three finite components, not all zero; got {given}")
