"""Roots and triangular solves of many small matrices, entry by entry.

Written out over their few rows, so that all matrices go through each operation together: a call of
LAPACK for each of them costs many times that, on accelerators too.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float


def root(matrix: Float[Array, "*k m m"]) -> Float[Array, "*k m m"]:
    """The lower triangular L of L L^T = matrix (Cholesky), of its lower triangle."""
    size = matrix.shape[-1]
    zero = jnp.zeros_like(matrix[..., 0, 0])
    rows: list[list] = []
    for i in range(size):
        row = []
        for j in range(i + 1):
            left = matrix[..., i, j]
            for k in range(j):
                left = left - row[k] * (row if i == j else rows[j])[k]
            row.append(jnp.sqrt(left) if i == j else left / rows[j][j])
        rows.append(row)
    padded = [jnp.stack([*row, *[zero] * (size - len(row))], -1) for row in rows]
    return jnp.stack(padded, -2)


def solve(lower: Float[Array, "*k m m"], right: Float[Array, "*k m"]) -> Float[Array, "*k m"]:
    """L^-1 b."""
    found: list = []
    for i in range(lower.shape[-1]):
        left = right[..., i]
        for k in range(i):
            left = left - lower[..., i, k] * found[k]
        found.append(left / lower[..., i, i])
    return jnp.stack(found, -1)


def solve_transpose(
    lower: Float[Array, "*k m m"], right: Float[Array, "*k m"]
) -> Float[Array, "*k m"]:
    """L^-T b."""
    size = lower.shape[-1]
    found: list = [None] * size
    for i in reversed(range(size)):
        left = right[..., i]
        for k in range(i + 1, size):
            left = left - lower[..., k, i] * found[k]
        found[i] = left / lower[..., i, i]
    return jnp.stack(found, -1)
