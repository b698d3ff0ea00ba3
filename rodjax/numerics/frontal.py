"""Frontal elimination of a chain whose nodes also touch far nodes, in an order found at run time.

A chain folded back on itself, or wound up with itself, is a narrow strip: with the nodes taken in
the order in which a search along all connections meets them (Cuthill & McKee 1969), each is
connected to a few of those before it. The nodes are eliminated in that order, one at a time, from a
small dense matrix of the unknowns that eliminated nodes are connected to, the front (Irons 1970),
so that the cost is linear in the nodes. Of the nine unknowns of a node only the first three touch
far nodes. So a node has a place for these in a window that moves along the order, and a seat for the
other six only while it is the neighbour of an eliminated node.

Pivots are chosen inside the block of a node and not across blocks, as in `block_tridiagonal`.
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from rodjax.numerics.block_tridiagonal import BlockTridiagonal

REACHING, OWN = 3, 6  # unknowns of a node that touch far nodes, and that do not


class FrontSize(NamedTuple):
    """Room of a front. Static numbers."""

    window: int  # nodes whose first unknowns it holds
    seats: int  # nodes whose other unknowns it holds

    @property
    def unknowns(self) -> int:
        """Rows and columns of the front."""
        return REACHING * self.window + OWN * self.seats


class Order(NamedTuple):
    """The order of elimination, and the front that it needs."""

    node: Int[Array, " n"]  # in the order
    place: Int[Array, " n"]  # of every node in the order
    seat: Int[Array, " n"]  # of every node
    window: Int[Array, ""]
    seats: Int[Array, ""]

    def fits(self, size: FrontSize) -> Bool[Array, ""]:
        """Whether a front of this size will do."""
        return (self.window <= size.window) & (self.seats <= size.seats)


def arrange(touching: Bool[Array, "n n"], most_seats: int) -> Order:
    """The order for nodes of which these touch each other, whatever neighbours do.

    The last node comes after its neighbour: the force in the element between them, an unknown of
    the last node, is not determined by a clamped end alone. `Order.seats` exceeds `most_seats`
    where these do not suffice.
    """
    nodes = touching.shape[0]
    number = jnp.arange(nodes, dtype=jnp.int32)
    beside = jnp.abs(number[:, None] - number[None, :]) == 1
    touching = touching | touching.T | beside

    def seated(seat, busy, at, wanted):
        free = jnp.argmin(busy).astype(jnp.int32)
        taken = wanted & (seat[at] < 0)
        place = jnp.where(busy[free], most_seats, free)
        seat = seat.at[at].set(jnp.where(taken, place, seat[at]))
        return seat, busy.at[free].set(busy[free] | taken)

    def visit(turn, found):
        place, count, seat, busy = found
        node = jnp.argmax(place == turn).astype(jnp.int32)
        new = touching[node] & (place < 0)
        new = new.at[-2].set(new[-2] | (new[-1] & (place[-2] < 0)))
        ones = new.astype(jnp.int32)
        place = jnp.where(new, count + jnp.cumsum(ones, dtype=jnp.int32) - 1, place)
        for at in (node - 1, node + 1, node):
            inside = jnp.clip(at, 0, nodes - 1)
            seat, busy = seated(seat, busy, inside, (at == inside) & (place[inside] >= turn))
        busy = busy.at[jnp.minimum(seat[node], most_seats - 1)].set(False)
        return place, count + jnp.sum(ones, dtype=jnp.int32), seat, busy

    unknown = jnp.full((nodes,), -1, jnp.int32)
    first = unknown.at[0].set(0), jnp.asarray(1, jnp.int32)
    beginning = (*first, unknown, jnp.zeros((most_seats,), bool))
    place, _, seat, _ = lax.fori_loop(0, nodes, visit, beginning)
    reach = jnp.where(touching, jnp.abs(place[:, None] - place[None, :]), 0)
    node = jnp.zeros_like(place).at[place].set(number)
    return Order(node, place, seat, jnp.max(reach) + 1, jnp.max(seat) + 1)


class Distant(NamedTuple):
    """Blocks of the matrix between the first unknowns of nodes anywhere; added where repeated."""

    row: Int[Array, " k"]  # node; as many as there are nodes: none
    column: Int[Array, " k"]
    block: Float[Array, "k 3 3"]


class FrontalFactors(eqx.Module):
    """The elimination, stored for repeated solves, in the order of elimination.

    With P the block of a node when it is eliminated, and R, C what then stands right of it and
    below it in the front.
    """

    order: Order
    slots: Int[Array, "n 9"]  # of the unknowns in the front
    inverse: Float[Array, "n 9 9"]  # of P
    right: Float[Array, "n 9 s"]  # P^-1 R
    below: Float[Array, "n 9 s"]  # C^T

    def solve(self, b: Float[Array, "nodes 9"]) -> Float[Array, "nodes 9"]:
        """Solution for one right side."""

        def forward(front, row):
            slots, inverse, below, b = row
            y = inverse @ (b + front[slots])
            return front.at[slots].set(0.0) - y @ below, y

        def backward(front, row):
            slots, right, y = row
            x = y - right @ front
            return front.at[slots].set(x), x

        nothing = jnp.zeros((self.right.shape[2],), b.dtype)
        given = (self.slots, self.inverse, self.below, b[self.order.node])
        _, y = lax.scan(forward, nothing, given)
        _, x = lax.scan(backward, nothing, (self.slots, self.right, y), reverse=True)
        return x[self.order.place]

    def solve_transpose(self, b: Float[Array, "nodes 9"]) -> Float[Array, "nodes 9"]:
        """Solution of the transposed system for one right side."""

        def forward(front, row):
            slots, right, b = row
            v = b + front[slots]
            return front.at[slots].set(0.0) - v @ right, v

        def backward(front, row):
            slots, inverse, below, v = row
            x = (v - below @ front) @ inverse
            return front.at[slots].set(x), x

        nothing = jnp.zeros((self.right.shape[2],), b.dtype)
        _, v = lax.scan(forward, nothing, (self.slots, self.right, b[self.order.node]))
        given = (self.slots, self.inverse, self.below, v)
        _, x = lax.scan(backward, nothing, given, reverse=True)
        return x[self.order.place]


def factorize(
    blocks: BlockTridiagonal, distant: Distant, order: Order, size: FrontSize
) -> FrontalFactors:
    """Eliminate the nodes of blocks + distant in this order, which must fit into the front."""
    nodes, dtype = blocks.diagonal.shape[0], blocks.diagonal.dtype
    width = size.unknowns
    count = lambda number: jnp.arange(number, dtype=jnp.int32)[None]
    window = REACHING * (order.place % size.window)[:, None] + count(REACHING)
    seat = OWN * order.seat[:, None] + count(OWN) + REACHING * size.window
    slots = jnp.concatenate([window, seat], 1)
    rows = _entries(blocks, distant, order, slots, size)
    in_order = slots[order.node]

    def eliminate(front, row):
        entries, slots = row
        kept = jnp.ones((width,), dtype).at[slots].set(0.0)
        right = front[slots] + entries[0]
        below = front[:, slots].T + entries[1]
        pivot = right[:, slots]
        eye = jnp.eye(REACHING + OWN, dtype=dtype)
        solved = jnp.linalg.solve(pivot, jnp.concatenate([right * kept[None], eye], 1))
        right, below = solved[:, :width], below * kept[None]
        front = (front - below.T @ right) * (kept[:, None] * kept[None, :])
        return front, (solved[:, width:], right, below)

    nothing = jnp.zeros((width, width), dtype)
    _, (inverse, right, below) = lax.scan(eliminate, nothing, (rows, in_order))
    return FrontalFactors(order, in_order, inverse, right, below)


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
    at = turn[:, None, None], side[:, None, None], jnp.arange(REACHING + OWN)[None, :, None]
    out = jnp.zeros((nodes, 2, REACHING + OWN, size.unknowns), dtype)
    out = out.at[(*at, slots[other][:, None, :])].add(block)
    present = distant.row < nodes
    inside = lambda node: jnp.where(present, node, 0)
    turn, side, other, block = dealt(inside(distant.row), inside(distant.column), distant.block)
    far = jnp.zeros((nodes, 2, size.window, REACHING, REACHING), dtype)
    turn = jnp.where(present, turn, nodes)
    far = far.at[turn, side, order.place[other] % size.window].add(block, mode="drop")
    far = jnp.swapaxes(far, 2, 3).reshape(nodes, 2, REACHING, REACHING * size.window)
    return out.at[:, :, :REACHING, : REACHING * size.window].add(far)
