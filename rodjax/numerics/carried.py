"""Loops of which the derivative is traced once."""

from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import PyTree

T = TypeVar("T")


def with_tangents(carry: T, given: PyTree) -> T:
    """A loop's first carry, with a tangent, of zeros if need be, where anything `given` has one.

    JAX traces the derivative of a scan with the tangents that its first carry has, and anew if more
    parts of the carry have one after a step: of a state, all have one then.
    """
    moving, rest = eqx.partition(carry, eqx.is_inexact_array)
    return eqx.combine(_beside(moving, eqx.filter(given, eqx.is_inexact_array)), rest)


@jax.custom_jvp
def _beside(carry, given):
    return carry


@_beside.defjvp
def _beside_jvp(primals, tangents):
    own, given = tangents
    kind = jax.tree.leaves(own)[0].dtype
    # zeros alone would count as no tangent: what is known has none in reverse mode
    none = [jnp.where(False, leaf.reshape(-1)[:1], 0.0) for leaf in jax.tree.leaves(given)]
    none = sum((jnp.sum(one).astype(kind) for one in none), jnp.zeros((), kind))
    return primals[0], jax.tree.map(lambda leaf: leaf + none.astype(leaf.dtype), own)
