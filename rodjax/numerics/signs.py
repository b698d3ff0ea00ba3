"""Signs of eigenvalues and determinants, of one small matrix after the other.

Of a batch of matrices jaxlib's kernels for CPUs hand parts to the pool of threads that runs the
program itself, and wait for them on one of its threads. Where as many such kernels as there are
threads wait at once, which two do on two cores, none ever ends (jaxlib 0.10). One matrix at a time
nothing is handed on, whatever the caller maps over.
"""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int


def negative_eigenvalues(matrices: Float[Array, "m k k"]) -> Int[Array, " m"]:
    """Numbers of negative eigenvalues of symmetric matrices."""
    return lax.map(_negative, matrices)


def determinant_signs(matrices: Float[Array, "m k k"]) -> Float[Array, " m"]:
    """Signs of the determinants."""
    return lax.map(_sign, matrices)


@jax.custom_batching.sequential_vmap
def _negative(matrix):
    # a scaling leaves the signs, and keeps small ones out of the rounding of large ones
    scale = jnp.sqrt(jnp.max(jnp.abs(matrix), -1))
    scale = jnp.where(scale > 0, scale, 1.0)
    scaled = matrix / scale[:, None] / scale[None]
    return jnp.sum(jnp.linalg.eigvalsh(scaled) < 0, dtype=jnp.int32)


@jax.custom_batching.sequential_vmap
def _sign(matrix):
    return jnp.linalg.slogdet(matrix)[0]
