"""Frontal elimination of a chain whose nodes also touch far nodes.

The nodes are eliminated in the order of `front_order`, one at a time, from a small dense matrix of
the unknowns that eliminated nodes are connected to, the front (Irons 1970), so that the cost is
linear in the nodes.

Pivots are chosen inside the block of a node and not across blocks, as in `block_tridiagonal`.
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from rodjax.numerics.block_tridiagonal import BlockTridiagonal
from rodjax.numerics.chunks import CHUNK, chunks, part, whole_chunks
from rodjax.numerics.front_order import BLOCK, FrontSize, Order
from rodjax.numerics.small_systems import divide


class Stencils(NamedTuple):
    """The nodes between which points lie, and their weights."""

    node: Int[Array, "m k"]
    weight: Float[Array, "m k"]
    used: Int[Array, ""]  # so many of the k have weight


class Distant(NamedTuple):
    """What the matrix has between the first unknowns of nodes anywhere.

    Blocks between two points each, put on the nodes of both by their weights, times the factors of
    the row's and the column's node; entries for the same two nodes are added.
    """

    first: Int[Array, " k"]  # point whose rows; beyond `count` meaningless but valid, as the second
    second: Int[Array, " k"]
    block: Float[Array, "k w w"]
    count: Int[Array, ""]
    stencils: Stencils
    factor: Float[Array, "n w w"]
    by_column: Float[Array, "n w w"] | None = None  # from the right; None: none is needed


class FrontalFactors(eqx.Module):
    """The elimination, stored for repeated solves, a row for every node in the order.

    With P the block of a node when it is eliminated, and R, C what then stands right of it and
    below it in the front, a row begins with P^-1, P^-1 R and C.
    """

    order: Order
    rows: Float[Array, "n r"]
    size: FrontSize = eqx.field(static=True)

    @property
    def pivots(self) -> Float[Array, "n 9 9"]:
        """The inverses P^-1."""
        return self.rows[:, : BLOCK**2].reshape(-1, BLOCK, BLOCK)

    def solve(self, b: Float[Array, "nodes 9"]) -> Float[Array, "nodes 9"]:
        """Solution for one right side."""

        def forward(front, row):
            slots, row, b = row
            inverse, _, below = self._parts(row)
            y = inverse @ (b + front[slots])
            return front.at[slots].set(0.0) - below @ y, y

        def backward(front, row):
            slots, row, y = row
            x = y - self._parts(row)[1] @ front
            return front.at[slots].set(x), x

        return self._swept(forward, backward, b)

    def solve_transpose(self, b: Float[Array, "nodes 9"]) -> Float[Array, "nodes 9"]:
        """Solution of the transposed system for one right side."""

        def forward(front, row):
            slots, row, b = row
            v = b + front[slots]
            return front.at[slots].set(0.0) - v @ self._parts(row)[1], v

        def backward(front, row):
            slots, row, v = row
            inverse, _, below = self._parts(row)
            x = (v - front @ below) @ inverse
            return front.at[slots].set(x), x

        return self._swept(forward, backward, b)

    def _parts(self, row):
        first, second, third = (BLOCK * (BLOCK + k * self.size.unknowns) for k in range(3))
        inverse, right, below = row[:first], row[first:second], row[second:third]
        return inverse.reshape(BLOCK, BLOCK), right.reshape(BLOCK, -1), below.reshape(-1, BLOCK)

    def _swept(self, forward, backward, b):
        order = self.order
        given = _slots(order, self.size)[order.node], self.rows
        nothing = jnp.zeros((self.size.unknowns,), b.dtype)
        _, y = lax.scan(forward, nothing, (*given, b[order.node]))
        _, x = lax.scan(backward, nothing, (*given, y), reverse=True)
        return x[order.place]


def _windows(order: Order, size: FrontSize) -> Int[Array, " n"]:
    """Places in the window, behind which the last node has one of its own."""
    return (order.place % size.window).at[-1].set(size.window)


def _slots(order: Order, size: FrontSize) -> Int[Array, "n 9"]:
    """Where the unknowns of every node stand in the front."""
    count = lambda number: jnp.arange(number, dtype=jnp.int32)[None]
    window = size.reaching * _windows(order, size)[:, None] + count(size.reaching)
    seat = size.own * order.seat[:, None] + count(size.own) + size.seated_from
    return jnp.concatenate([window, seat], 1)


def factorize(
    blocks: BlockTridiagonal,
    distant: Distant,
    order: Order,
    size: FrontSize,
    paired: tuple[int, ...] = tuple(range(BLOCK)),
) -> FrontalFactors:
    """Eliminate the nodes of blocks + distant in this order, which must fit into the front.

    Inside a block rows are `paired` with its columns for `divide`: numbers of rows.
    """
    dtype, width = blocks.diagonal.dtype, size.unknowns
    slots, rows = _slots(order, size), jnp.asarray(paired, jnp.int32)
    eye = jnp.eye(BLOCK, dtype=dtype)[rows]
    entries = _entries(blocks, distant, order, slots, size)

    def eliminate(front, row):
        entries, slots = row
        kept = jnp.ones((width,), dtype).at[slots].set(0.0)
        right = front[slots] + entries[0]
        # a column for each row of the block: transposed their product would take twice the time
        below = (front[:, slots] + entries[1].T) * kept[:, None]
        # not solved for all columns, which takes longer
        inverse = divide(right[:, slots][rows], eye)
        right = inverse @ (right * kept[None])
        front = (front - below @ right) * (kept[:, None] * kept[None, :])
        return front, (inverse, right, below)

    nothing = jnp.zeros((width, width), dtype)
    _, parts = lax.scan(eliminate, nothing, (entries, slots[order.node]))
    flat = [part.reshape(len(part), -1) for part in parts]
    return FrontalFactors(order, jnp.concatenate(flat, 1), size)


def _entries(blocks, distant, order, slots, size) -> Float[Array, "n 2 9 s"]:
    """What the matrix adds to the rows of every node and (transposed) to its columns.

    In the order of elimination. An entry between two nodes goes to the one eliminated first.
    """
    nodes, dtype = slots.shape[0], blocks.diagonal.dtype
    number = jnp.arange(nodes, dtype=jnp.int32)

    def dealt(row, column, block):
        transposed = order.place[row] > order.place[column]
        turned = jnp.where(transposed[:, None, None], jnp.swapaxes(block, 1, 2), block)
        turn = jnp.minimum(order.place[row], order.place[column])
        return turn, transposed.astype(jnp.int32), jnp.where(transposed, row, column), turned

    row = jnp.concatenate([number, number[:-1], number[1:]])
    column = jnp.concatenate([number, number[1:], number[:-1]])
    block = jnp.concatenate([blocks.diagonal, blocks.upper[:-1], blocks.lower[1:]])
    turn, side, other, block = dealt(row, column, block)
    at = turn[:, None, None], side[:, None, None], jnp.arange(BLOCK)[None, :, None]
    out = jnp.zeros((nodes, 2, BLOCK, size.unknowns), dtype)
    out = out.at[(*at, slots[other][:, None, :])].add(block)

    node, weight, stencil = distant.stencils
    listed = [whole_chunks(x) for x in (distant.first, distant.second, distant.block)]

    def added(chunk, far):
        one, other, blocks = (part(x, chunk) for x in listed)
        used = chunk * CHUNK + jnp.arange(CHUNK, dtype=jnp.int32) < distant.count

        def layer(k, far):
            i, j = k // stencil, k % stencil
            row, column = node[one, i], node[other, j]
            product = (weight[one, i] * weight[other, j])[:, None, None]
            block = product * (distant.factor[row] @ blocks)
            if distant.by_column is not None:
                block = block @ distant.by_column[column]
            turn, side, later, block = dealt(row, column, block)
            turn = jnp.where(used, turn, nodes)
            return far.at[turn, side, windows[later]].add(block, mode="drop")

        return lax.fori_loop(0, stencil**2, layer, far)

    windows = _windows(order, size)
    reaching = size.reaching
    far = jnp.zeros((nodes, 2, size.window + 1, reaching, reaching), dtype)
    far = lax.fori_loop(0, chunks(distant.count), added, far)
    far = jnp.swapaxes(far, 2, 3).reshape(nodes, 2, reaching, size.seated_from)
    return out.at[:, :, :reaching, : size.seated_from].add(far)
