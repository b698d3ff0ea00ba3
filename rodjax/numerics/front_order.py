"""An order for the elimination of a chain whose nodes also touch far nodes, found at run time.

A chain folded back on itself, or wound up with itself, is a narrow strip: with the nodes taken
about in the order in which a search along all connections meets them (Cuthill & McKee 1969), each
is connected to a few of those before it. Of the nine unknowns of a node three alone touch far
nodes, or six where strands rub. So a node has a place for these in a window that moves along the
order, and a seat for the others only while it is the neighbour of an eliminated node.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Int

BLOCK = 9  # unknowns of a node


class FrontSize(NamedTuple):
    """Room of a front. Static numbers."""

    window: int  # nodes whose first unknowns it holds, besides the last node's
    seats: int  # nodes whose other unknowns it holds
    reaching: int = 3  # unknowns of a node that touch far nodes, its first

    @property
    def own(self) -> int:
        """Unknowns of a node that touch its neighbours alone."""
        return BLOCK - self.reaching

    @property
    def seated_from(self) -> int:
        """Where the seats begin."""
        return self.reaching * (self.window + 1)

    @property
    def unknowns(self) -> int:
        """Rows and columns of the front."""
        return self.seated_from + self.own * self.seats


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
