"""Lists of which only the first entries are in use, worked through in parts of one length."""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Int

CHUNK = 256  # entries of a part


def chunks(count: Int[Array, ""]) -> Int[Array, ""]:
    """Parts that hold so many entries."""
    return (count + CHUNK - 1) // CHUNK


def whole_chunks(values: Array) -> Array:
    """A list filled up with zeros to whole parts."""
    return jnp.pad(values, ((0, -len(values) % CHUNK), *[(0, 0)] * (values.ndim - 1)))


def part(values: Array, chunk) -> Array:
    """One of the parts."""
    return lax.dynamic_slice_in_dim(values, chunk * CHUNK, CHUNK)
