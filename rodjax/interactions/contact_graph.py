"""Which nodes contact couples, and the order in which they can be eliminated."""

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from rodjax.interactions.sites import Sites
from rodjax.numerics.chunks import CHUNK, chunks, part, whole_chunks
from rodjax.numerics.front_order import FrontSize, Order, arrange
from rodjax.numerics.frontal import Distant, Stencils

# two vertices coupled by strands side by side, per near pair of their segments, and to spare
_COUPLED = 6
_SEATS = 24  # that an order is tried with
_BETWEEN = 4  # nodes between vertices; of more than these no front is wide enough


class Graph(NamedTuple):
    """The vertices that near pairs couple, each two of them once, and an order of the nodes."""

    order: Order
    first: Int[Array, " u"]  # vertex; beyond `count` meaningless but valid
    second: Int[Array, " u"]
    count: Int[Array, ""]
    entry: Int[Array, "q 4 4"]  # where in this list two vertices of a pair stand
    complete: Bool[Array, ""]  # whether the list holds all

    def fits(self, size: FrontSize) -> Bool[Array, ""]:
        """Whether a front of this size eliminates the nodes."""
        return self.complete & self.order.fits(size)


def couplings(
    vertices: tuple[Array, ...], count: Int[Array, ""], sites: Sites, nodes: int
) -> Graph:
    """The graph of so many pairs, of which these are the four vertices."""
    index = jnp.stack(vertices, 1)
    number, capacity = sites.weight.shape[0], _COUPLED * index.shape[0]
    used = jnp.arange(index.shape[0], dtype=jnp.int32) < count
    row, column = jnp.broadcast_arrays(index[:, :, None], index[:, None, :])
    coupled = jnp.zeros((number, number), bool)
    coupled = coupled.at[jnp.where(used[:, None, None], row, number), column].set(True, mode="drop")
    flat = coupled.reshape(-1)
    place = jnp.cumsum(flat.astype(jnp.int32), dtype=jnp.int32)
    total, place = place[-1], (place - 1).reshape(number, number)
    entry = jnp.where(used[:, None, None], place[row, column], capacity)
    unlisted = jnp.zeros((capacity,), jnp.int32)
    first, second = (unlisted.at[entry].set(vertex, mode="drop") for vertex in (row, column))
    touching = _touching(_stencils(sites), nodes, first, second, total)
    # nodes between vertices do not touch, but should be eliminated with those that do
    between = min(-(-(nodes - 1) // sites.arc_length.shape[0]) - 1, _BETWEEN)
    order = arrange(touching, _SEATS, between)
    return Graph(order, first, second, total, entry, total <= capacity)


def nothing(pairs: int, nodes: int) -> Graph:
    """The graph of no pairs."""
    zero, unlisted = jnp.asarray(0, jnp.int32), jnp.zeros((_COUPLED * pairs,), jnp.int32)
    every = jnp.arange(nodes, dtype=jnp.int32)
    order = Order(every, every, every, zero, zero)
    entry = jnp.full((pairs, 4, 4), _COUPLED * pairs, jnp.int32)
    return Graph(order, unlisted, unlisted, zero, entry, jnp.asarray(False))


def distant(
    graph: Graph,
    sites: Sites,
    count: Int[Array, ""],
    derivative: Float[Array, "q 4 4 w w"],
    factor: Float[Array, "nodes w w"],
    by_column: Float[Array, "nodes w w"] | None = None,
) -> Distant:
    """The derivative of so many pairs by vertices as one by nodes, times factors of the nodes."""

    # beyond the list's end zeros are added to its first entry
    listed = whole_chunks(graph.entry), whole_chunks(derivative)

    def added(chunk, block):
        entry, values = (part(x, chunk) for x in listed)
        return block.at[entry].add(values, mode="drop")

    block = jnp.zeros((graph.first.shape[0], *derivative.shape[3:]), derivative.dtype)
    block = lax.fori_loop(0, chunks(count), added, block)
    stencils = _stencils(sites)
    return Distant(graph.first, graph.second, block, graph.count, stencils, factor, by_column)


def _stencils(sites: Sites) -> Stencils:
    """Nodes of the vertices and their weights, the heaviest first: one where they lie on nodes."""
    order = jnp.argsort(-jnp.abs(sites.weight), axis=1)
    take = lambda values: jnp.take_along_axis(values, order, axis=1)
    node, weight = take(sites.nodes), take(sites.weight)
    slack = 100 * jnp.finfo(weight.dtype).eps
    on_nodes = jnp.all(jnp.abs(weight[:, 1:]) < slack) & jnp.all(jnp.abs(weight[:, 0] - 1) < slack)
    return Stencils(node, weight, jnp.where(on_nodes, 1, weight.shape[1]).astype(jnp.int32))


def _touching(stencils, nodes, first, second, count) -> Bool[Array, "n n"]:
    """Which nodes the vertices of these pairs lie between."""
    weighs = jnp.arange(stencils.node.shape[1], dtype=jnp.int32) < stencils.used
    weighty = weighs[:, None] & weighs[None, :]

    listed = whole_chunks(first), whole_chunks(second)

    def added(chunk, touching):
        used = chunk * CHUNK + jnp.arange(CHUNK, dtype=jnp.int32) < count
        one, other = (stencils.node[part(vertex, chunk)] for vertex in listed)
        row = jnp.where(used[:, None, None] & weighty[None], one[:, :, None], nodes)
        return touching.at[row, other[:, None, :]].set(True, mode="drop")

    return lax.fori_loop(0, chunks(count), added, jnp.zeros((nodes, nodes), bool))
