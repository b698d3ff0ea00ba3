"""Control flow that a batch shares.

Under `vmap` a `cond` whose predicate differs from lane to lane runs both branches, and a loop whose
length differs copies what it carries in every pass. Lanes that share the largest of their counts
keep one branch and one length; what a lane has no need of adds nothing to its result.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int


@jax.custom_batching.custom_vmap
def largest(count: Int[Array, ""]) -> Int[Array, ""]:
    """The count; under `vmap` the largest of the batch, the same for all lanes."""
    return count


@largest.def_vmap
def _largest_of_batch(axis_size, in_batched, count):
    return (jnp.max(count), False) if in_batched[0] else (count, False)
