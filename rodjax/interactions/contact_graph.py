"""Which nodes contact couples, and the order in which they can be eliminated."""

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from rodjax.interactions.contact import Sites
from rodjax.numerics.frontal import Distant, FrontSize, Order, arrange

# joints that are coupled by two strands side by side, per near pair of their segments, and to spare
_COUPLED = 6
_SEATS = 16  # that an order is tried with
_BETWEEN = 4  # nodes between joints; of more than these no front is wide enough


class Graph(NamedTuple):
    """The joints that near pairs couple, each two of them once, and an order of the nodes."""

    order: Order
    first: Int[Array, " u"]  # joint; beyond `count` meaningless but valid
    second: Int[Array, " u"]
    count: Int[Array, ""]
    entry: Int[Array, "q 4 4"]  # where in this list two joints of a pair stand
    layers: Int[Array, ""]  # of pairs of nodes for two joints: 1 where joints lie on nodes
    complete: Bool[Array, ""]  # whether the list holds all

    def fits(self, size: FrontSize) -> Bool[Array, ""]:
        """Whether a front of this size eliminates the nodes."""
        return self.complete & self.order.fits(size)


def couplings(joints: tuple[Array, ...], count: Int[Array, ""], where: Sites, nodes: int) -> Graph:
    """The graph of so many pairs, of which these are the four joints."""
    index = jnp.stack(joints, 1)
    number, capacity = where.weight.shape[0], _COUPLED * index.shape[0]
    used = jnp.arange(index.shape[0], dtype=jnp.int32) < count
    row, column = jnp.broadcast_arrays(index[:, :, None], index[:, None, :])
    coupled = jnp.zeros((number, number), bool)
    coupled = coupled.at[jnp.where(used[:, None, None], row, number), column].set(True, mode="drop")
    flat = coupled.reshape(-1)
    place = jnp.cumsum(flat.astype(jnp.int32), dtype=jnp.int32)
    total, place = place[-1], (place - 1).reshape(number, number)
    entry = jnp.where(used[:, None, None], place[row, column], capacity)
    every = jnp.nonzero(flat, size=capacity, fill_value=0)[0].astype(jnp.int32)
    first, second = every // number, every % number
    weight = _stencils(where)[1]
    slack = 100 * jnp.finfo(weight.dtype).eps
    on_nodes = jnp.all(jnp.abs(weight[:, 1:]) < slack) & jnp.all(jnp.abs(weight[:, 0] - 1) < slack)
    layers = jnp.where(on_nodes, 1, weight.shape[1] ** 2).astype(jnp.int32)
    touching = _touching(where, nodes, first, second, total, layers)
    # nodes between joints do not touch, but should be eliminated with those that do
    between = min(-(-(nodes - 1) // where.arc_length.shape[0]) - 1, _BETWEEN)
    order = arrange(touching, _SEATS, between)
    return Graph(order, first, second, total, entry, layers, total <= capacity)


def nothing(pairs: int, nodes: int) -> Graph:
    """The graph of no pairs."""
    zero, unlisted = jnp.asarray(0, jnp.int32), jnp.zeros((_COUPLED * pairs,), jnp.int32)
    every = jnp.arange(nodes, dtype=jnp.int32)
    order = Order(every, every, every, zero, zero)
    entry = jnp.full((pairs, 4, 4), _COUPLED * pairs, jnp.int32)
    return Graph(order, unlisted, unlisted, zero, entry, zero + 1, jnp.asarray(False))


def distant(
    graph: Graph,
    where: Sites,
    derivative: Float[Array, "q 4 4 3 3"],
    factor: Float[Array, "nodes 3 3"],
) -> Distant:
    """The derivative of pairs by their joints as one by nodes, the factor of a node its left."""
    nodes = factor.shape[0]
    size = graph.first.shape[0]
    block = jnp.zeros((size, 3, 3), derivative.dtype)
    block = block.at[graph.entry].add(derivative, mode="drop")
    node, weight = _stencils(where)
    given = jnp.arange(size, dtype=jnp.int32) < graph.count
    row, column, product = [], [], []
    for i in range(node.shape[1]):
        for j in range(node.shape[1]):
            row.append(jnp.where(given, node[graph.first, i], nodes))
            column.append(node[graph.second, j])
            product.append(weight[graph.first, i] * weight[graph.second, j])
    stacked = (jnp.stack(part) for part in (row, column, product))
    return Distant(*stacked, block, factor, graph.layers)


def _stencils(where: Sites) -> tuple[Int[Array, "j k"], Float[Array, "j k"]]:
    """Nodes of every joint and their weights, the heaviest first."""
    order = jnp.argsort(-jnp.abs(where.weight), axis=1)
    take = lambda values: jnp.take_along_axis(values, order, axis=1)
    return take(where.nodes), take(where.weight)


def _touching(where, nodes, first, second, count, layers) -> Bool[Array, "n n"]:
    """Which nodes the joints of these pairs lie between."""
    node, _ = _stencils(where)
    stencil = node.shape[1]
    used = jnp.arange(first.shape[0], dtype=jnp.int32) < count

    def layer(i, touching):
        row = jnp.where(used, node[first, i // stencil], nodes)
        return touching.at[row, node[second, i % stencil]].set(True, mode="drop")

    return lax.fori_loop(0, layers, layer, jnp.zeros((nodes, nodes), bool))
