"""The vertices and nodes that pairs of segments involve, and which sizes of contact hold them."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from rodjax.interactions.contact_capacities import Capacity
from rodjax.interactions.sites import Sites


class Involved(NamedTuple):
    """What some pairs involve."""

    order: Int[Array, " j"]  # all vertices, those involved first
    rank: Int[Array, " j"]  # place of each vertex in `order`
    nodes: Int[Array, " nodes"] | None  # all, first those of such vertices; if needed
    count: Int[Array, ""]  # of these nodes, without them of the vertices
    fits: Bool[Array, " c"]  # which of the sizes hold all, if not eliminated by a front


def involve(
    first: Int[Array, " q"],
    second: Int[Array, " q"],
    count: Int[Array, ""],
    sites: Sites,
    nodes: int,
    sizes: tuple[Capacity, ...],
) -> Involved:
    """What so many pairs of segments involve, those that come first in the list."""
    vertices = sites.weight.shape[0]
    listed = jnp.arange(first.shape[0], dtype=jnp.int32) < count
    involved = jnp.zeros((vertices,), bool)
    for segment in (first, second):
        vertex = jnp.where(listed, segment, vertices)
        for at in (vertex, vertex + 1):
            involved = involved.at[at].set(True, mode="drop")
    order, rank, involving = chosen_first(involved)
    holds = lambda numbers: jnp.asarray(numbers, jnp.int32)
    fits = (involving <= holds([size.vertices for size in sizes])) & (
        count <= holds([size.pairs for size in sizes])
    )
    node, points = None, involving
    if sizes[-1].nodes is not None:
        between = jnp.zeros((nodes,), jnp.int32).at[sites.nodes]
        touched = involved[:, None] & (sites.weight != 0)
        between = between.add(touched.astype(jnp.int32)) > 0
        node, _, points = chosen_first(between)
        fits = fits & (points <= holds([size.nodes for size in sizes]))
    return Involved(order, rank, node, points, fits)


def chosen_first(
    chosen: Bool[Array, " k"],
) -> tuple[Int[Array, " k"], Int[Array, " k"], Int[Array, ""]]:
    """All indices, the chosen ones first; the place of each; how many are chosen."""
    ones = chosen.astype(jnp.int32)
    count = jnp.sum(ones, dtype=jnp.int32)
    index = jnp.arange(chosen.shape[0], dtype=jnp.int32)
    before = jnp.cumsum(ones, dtype=jnp.int32) - ones
    place = jnp.where(chosen, before, count + index - before)
    return jnp.zeros_like(place).at[place].set(index), place, count
