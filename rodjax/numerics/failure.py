"""What comes after a failure is not a number, and neither is its derivative."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool


def not_a_number(tree, failed: Bool[Array, "*k"]):
    """The tree with NaN for its floating point numbers where `failed` (along leading axes) holds.

    A loss built on what failed is NaN with a derivative that is NaN, in forward and reverse mode,
    where `jnp.where` would give it the derivative 0. What a loss does not ask of gets 0 in the
    reverse pass.
    """

    def mark(leaf):
        if not eqx.is_inexact_array(leaf):
            return leaf
        bad = failed.reshape(failed.shape + (1,) * (leaf.ndim - failed.ndim))
        # linear, with a transpose of its own
        return lax.custom_linear_solve(
            lambda x: x,
            leaf,
            solve=lambda _, x: jnp.where(bad, jnp.nan, x),
            transpose_solve=lambda _, x: jnp.where(bad & (x != 0), jnp.nan, x),
        )

    return jax.tree.map(mark, tree)
