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
    # a scaling leaves the signs, and keeps small ones out of the rounding of large ones: of each
    # row the largest entry becomes one (Ruiz 2001)
    for _ in range(6):
        scale = jnp.sqrt(jnp.max(jnp.abs(matrices), 2))
        scale = jnp.where(scale > 0, scale, 1.0)
        matrices = matrices / scale[:, :, None] / scale[:, None, :]
    return lax.map(_negative, matrices)


def negative_in_all(matrices: Float[Array, "m k k"]) -> Int[Array, ""]:
    """Number of negative eigenvalues of all, which are symmetric but for rounding."""
    symmetric = 0.5 * (matrices + jnp.swapaxes(matrices, 1, 2))
    return jnp.sum(negative_eigenvalues(symmetric), dtype=jnp.int32)


def determinant_signs(matrices: Float[Array, "m k k"]) -> Float[Array, " m"]:
    """Signs of the determinants."""
    return lax.map(_sign, matrices)


@jax.custom_batching.sequential_vmap
def _negative(matrix):
    return jnp.sum(jnp.linalg.eigvalsh(matrix) < 0, dtype=jnp.int32)


@jax.custom_batching.sequential_vmap
def _sign(matrix):
    return jnp.linalg.slogdet(matrix)[0]
