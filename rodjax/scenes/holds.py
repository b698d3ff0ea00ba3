"""What holds a rod: both ends, then its supports, each at one node.

Arrays of what they hold have a row for each in this order.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from rodjax.constraints.ends import AbstractEnd

Node = int | Int[Array, ""]


class Held(NamedTuple):
    """A node that is held."""

    name: str  # of the scene's argument
    node: Node  # a number of Python's where it is that of an end
    end: AbstractEnd  # what it takes away there


def rows_at(rows: Float[Array, "nodes *k"], nodes: tuple[Node, ...]) -> Float[Array, "h *k"]:
    """The rows of these nodes."""
    return jnp.stack([rows[node] for node in nodes])


def with_row(rows: Float[Array, "nodes *k"], node: Node, row) -> Float[Array, "nodes *k"]:
    """The rows with that of one node replaced."""
    return lax.dynamic_update_index_in_dim(rows, row, node, 0)


def with_part(array, part, place: tuple[Node, ...]):
    """The array with a part of it replaced, from a place on."""
    return lax.dynamic_update_slice(array, part, [jnp.asarray(i, jnp.int32) for i in place])


def impose(
    rows: Float[Array, "nodes k"],
    aims: Float[Array, "h k"],
    projectors: Float[Array, "h k k"],
    nodes: tuple[Node, ...],
) -> Float[Array, "nodes k"]:
    """The nodes' rows, of those held replaced in constrained directions: r + P (a - r)."""
    held = rows_at(rows, nodes)
    held = held + jnp.einsum("eij,ej->ei", projectors, aims - held)
    for node, row in zip(nodes, held, strict=True):
        rows = with_row(rows, node, row)
    return rows
