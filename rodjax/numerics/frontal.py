"""Frontal elimination of a chain whose nodes also touch far nodes, in an order found at run time.

A chain folded back on itself, or wound up with itself, is a narrow strip: with the nodes taken
about in the order in which a search along all connections meets them (Cuthill & McKee 1969), each
is connected to a few of those before it. The nodes are eliminated in that order, one at a time,
from a small dense matrix of the unknowns that eliminated nodes are connected to, the front (Irons
1970), so that the cost is linear in the nodes. Of the nine unknowns of a node three alone touch
far nodes. So a node has a place for these in a window that moves along the order, and a seat for
the other six only while it is the neighbour of an eliminated node.

Pivots are chosen inside the block of a node and not across blocks, as in `block_tridiagonal`.
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from rodjax.numerics.block_tridiagonal import BlockTridiagonal

REACHING, OWN = 3, 6  # unknowns of a node that touch far nodes, and that do not
BLOCK = REACHING + OWN


class FrontSize(NamedTuple):
    """Room of a front. Static numbers."""

    window: int  # nodes whose first unknowns it holds, besides the last node's
    seats: int  # nodes whose other unknowns it holds

    @property
    def seated_from(self) -> int:
        """Where the seats begin."""
        return REACHING * (self.window + 1)

    @property
    def unknowns(self) -> int:
        """Rows and columns of the front."""
        return self.seated_from + OWN * self.seats


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


def arrange(touching: Bool[Array, "n n"], most_seats: int, between: int = 0) -> Order:
    """The order for nodes of which these touch each other, whatever neighbours do.

    Where only some nodes of a stretch touch, with so many `between` them, those are taken with
    their neighbours. The last node comes last: what hangs on its neighbours alone is determined,
    but if it were also held by the last node it might be held twice, as a straight inextensible
    piece is. `Order.seats` exceeds `most_seats` where these do not suffice.
    """
    nodes = touching.shape[0]
    number = jnp.arange(nodes, dtype=jnp.int32)
    beside = jnp.abs(number[:, None] - number[None, :]) == 1
    touching = touching | touching.T | beside
    others = touching[:-1, :-1]
    place = _centred(others, _met(_widened(others, between)))
    reach = jnp.where(others, jnp.abs(place[:, None] - place[None, :]), 0)
    place = jnp.append(place, number[-1])
    node = jnp.zeros_like(place).at[place].set(number)
    seat = _seated(node, place, most_seats)
    return Order(node, place, seat, jnp.max(reach) + 1, jnp.max(seat) + 1)


def _met(connected: Bool[Array, "n n"]) -> Int[Array, " n"]:
    """When a search along the connections, from the first node, meets every node."""

    def visit(turn, found):
        place, count = found
        new = connected[jnp.argmax(place == turn)] & (place < 0)
        ones = new.astype(jnp.int32)
        place = jnp.where(new, count + jnp.cumsum(ones, dtype=jnp.int32) - 1, place)
        return place, count + jnp.sum(ones, dtype=jnp.int32)

    nodes = connected.shape[0]
    beginning = jnp.full((nodes,), -1, jnp.int32).at[0].set(0), jnp.asarray(1, jnp.int32)
    return lax.fori_loop(0, nodes, visit, beginning)[0]


def _centred(touching: Bool[Array, "n n"], place: Int[Array, " n"]) -> Int[Array, " n"]:
    """Places by the middle between the first and the last node that each touches.

    Which makes the window narrower by a quarter: a search meets one strand ahead of the other.
    """
    nodes = place.shape[0]
    last = jnp.max(jnp.where(touching, place[None, :], place[:, None]), 1)
    first = jnp.min(jnp.where(touching, place[None, :], place[:, None]), 1)
    node = jnp.lexsort((place, first + last))
    return jnp.zeros_like(place).at[node].set(jnp.arange(nodes, dtype=jnp.int32))


def _seated(node: Int[Array, " n"], place: Int[Array, " n"], most_seats: int) -> Int[Array, " n"]:
    """Seats of the nodes, `most_seats` for those that find none."""
    nodes = place.shape[0]

    def visit(turn, found):
        seat, busy = found
        for beside in (-1, 1, 0):
            at = jnp.clip(node[turn] + beside, 0, nodes - 1)
            free = jnp.argmin(busy).astype(jnp.int32)
            taken = (place[at] >= turn) & (seat[at] < 0)
            seat = seat.at[at].set(
                jnp.where(taken, jnp.where(busy[free], most_seats, free), seat[at])
            )
            busy = busy.at[free].set(busy[free] | taken)
        return seat, busy.at[jnp.minimum(seat[node[turn]], most_seats - 1)].set(False)

    beginning = jnp.full((nodes,), -1, jnp.int32), jnp.zeros((most_seats,), bool)
    return lax.fori_loop(0, nodes, visit, beginning)[0]


def _widened(touching: Bool[Array, "n n"], by: int) -> Bool[Array, "n n"]:
    """Also the nodes within so many of those that touch."""
    for axis in (0, 1):
        edges = [(by, by) if k == axis else (0, 0) for k in (0, 1)]
        padded = jnp.pad(touching, edges)
        shifted = [
            lax.slice_in_dim(padded, k, k + len(touching), axis=axis) for k in range(2 * by + 1)
        ]
        touching = jnp.any(jnp.stack(shifted), 0)
    return touching


# Lists of which only the first entries are in use are worked through in parts of this length.
CHUNK = 256


def chunks(count: Int[Array, ""]) -> Int[Array, ""]:
    """Parts that hold so many entries."""
    return (count + CHUNK - 1) // CHUNK


def whole_chunks(values: Array) -> Array:
    """A list filled up with zeros to whole parts."""
    return jnp.pad(values, ((0, -len(values) % CHUNK), *[(0, 0)] * (values.ndim - 1)))


def part(values: Array, chunk) -> Array:
    """One of the parts."""
    return lax.dynamic_slice_in_dim(values, chunk * CHUNK, CHUNK)


class Stencils(NamedTuple):
    """The nodes between which points lie, and their weights."""

    node: Int[Array, "m k"]
    weight: Float[Array, "m k"]
    used: Int[Array, ""]  # so many of the k have weight


class Distant(NamedTuple):
    """What the matrix has between the first unknowns of nodes anywhere.

    Blocks between two points each, put on the nodes of both by their weights, times the factor of
    the row's node; entries for the same two nodes are added.
    """

    first: Int[Array, " k"]  # point whose rows; beyond `count` meaningless but valid, as the second
    second: Int[Array, " k"]
    block: Float[Array, "k 3 3"]
    count: Int[Array, ""]
    stencils: Stencils
    factor: Float[Array, "n 3 3"]


class FrontalFactors(eqx.Module):
    """The elimination, stored for repeated solves, a row for every node in the order.

    With P the block of a node when it is eliminated, and R, C what then stands right of it and
    below it in the front, a row begins with P^-1, P^-1 R and the transpose of C.
    """

    order: Order
    rows: Float[Array, "n r"]
    size: FrontSize = eqx.field(static=True)

    def solve(self, b: Float[Array, "nodes 9"]) -> Float[Array, "nodes 9"]:
        """Solution for one right side."""

        def forward(front, row):
            slots, row, b = row
            inverse, _, below = self._parts(row)
            y = inverse @ (b + front[slots])
            return front.at[slots].set(0.0) - y @ below, y

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
            x = (v - below @ front) @ inverse
            return front.at[slots].set(x), x

        return self._swept(forward, backward, b)

    def _parts(self, row):
        first, second, third = (BLOCK * (BLOCK + k * self.size.unknowns) for k in range(3))
        parts = row[:first], row[first:second], row[second:third]
        return tuple(part.reshape(BLOCK, -1) for part in parts)

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
    window = REACHING * _windows(order, size)[:, None] + count(REACHING)
    seat = OWN * order.seat[:, None] + count(OWN) + size.seated_from
    return jnp.concatenate([window, seat], 1)


def factorize(
    blocks: BlockTridiagonal, distant: Distant, order: Order, size: FrontSize
) -> FrontalFactors:
    """Eliminate the nodes of blocks + distant in this order, which must fit into the front."""
    dtype, width = blocks.diagonal.dtype, size.unknowns
    slots = _slots(order, size)
    entries = _entries(blocks, distant, order, slots, size)

    def eliminate(front, row):
        entries, slots = row
        kept = jnp.ones((width,), dtype).at[slots].set(0.0)
        right = front[slots] + entries[0]
        below = (front[:, slots].T + entries[1]) * kept[None]
        # not solved for all columns, which takes longer
        inverse = jnp.linalg.solve(right[:, slots], jnp.eye(BLOCK, dtype=dtype))
        right = inverse @ (right * kept[None])
        front = (front - below.T @ right) * (kept[:, None] * kept[None, :])
        return front, jnp.concatenate([part.reshape(-1) for part in (inverse, right, below)])

    nothing = jnp.zeros((width, width), dtype)
    _, rows = lax.scan(eliminate, nothing, (entries, slots[order.node]))
    return FrontalFactors(order, rows, size)


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
            turn, side, later, block = dealt(row, column, block)
            turn = jnp.where(used, turn, nodes)
            return far.at[turn, side, windows[later]].add(block, mode="drop")

        return lax.fori_loop(0, stencil**2, layer, far)

    windows = _windows(order, size)
    far = jnp.zeros((nodes, 2, size.window + 1, REACHING, REACHING), dtype)
    far = lax.fori_loop(0, chunks(distant.count), added, far)
    far = jnp.swapaxes(far, 2, 3).reshape(nodes, 2, REACHING, size.seated_from)
    return out.at[:, :, :REACHING, : size.seated_from].add(far)
