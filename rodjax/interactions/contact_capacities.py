"""The sizes of contact for which solvers of Newton's system are compiled."""

from typing import NamedTuple

import jax

from rodjax.interactions.contact import Contact
from rodjax.numerics.front_order import FrontSize

BLOCK = 32  # pairs that are evaluated together


class Capacity(NamedTuple):
    """What a solver of Newton's system is compiled for. Static numbers."""

    vertices: int  # in contact, at most
    pairs: int  # of segments in the list
    nodes: int | None  # between which the vertices lie; None: of no use, vertices are fewer
    front: FrontSize | None = None  # None: what touches is eliminated as a dense system
    kept: bool = True  # whether the factors are, or are made for every right side anew

    @property
    def points(self) -> int:
        """What the dense system is of: vertices, or the nodes between which they lie."""
        return self.vertices if self.nodes is None else self.nodes


# dense systems up to so many unknowns are cheaper than a front; a second pays beyond the other
_DENSE, _WIDE = 350, 750
_FEW = 64  # vertices for which a dense system is tried before a front
_MOST = 3100  # unknowns of the largest dense system: more take many seconds an iteration
# a smaller dense system is compiled if it is so much smaller than the largest, and that is large
_WORTH, _SMALL = 0.6, 200
_FRONTS = (FrontSize(16, 6), FrontSize(24, 8))
_TANGLED = FrontSize(40, 24)  # takes ten rods that all cross each other


def capacities(contact: Contact, elements: int) -> tuple[Capacity, ...]:
    """The sizes of `Contact` on a grid, in the order in which they are tried.

    Contact couples the vertices that it touches, or the nodes between which these lie, whichever
    are fewer. Of nodes a stretch of vertices has its share of the grid and up to four more. More
    than a few are eliminated by a front, if one is wide enough, as it is for strands side by side
    and not for a tangle; on accelerators, whose threads a front leaves idle, never.
    """
    finer = contact.vertices - 1 > elements

    def capacity(vertices):
        share = -(-vertices * elements // (contact.vertices - 1)) + 16
        nodes = min(elements + 1, share) if finer else None
        # whole blocks: of a list cut off inside one everything that goes with it would be copied
        pairs = -(-contact.room * vertices // BLOCK) * BLOCK
        return Capacity(vertices, pairs, nodes)

    dense = tuple(map(capacity, contact.sizes))
    largest = contact.width * dense[-1].points
    if not contact.capacities:  # each costs compile time: none that saves little of the largest
        most = _WORTH * largest if largest > _SMALL else 0
        dense = (*[one for one in dense if contact.width * one.points < most], dense[-1])
    if contact.capacities or largest <= _DENSE or jax.default_backend() != "cpu":
        return dense
    fronts = _FRONTS if largest > _WIDE else _FRONTS[:1]
    few = sum(one.vertices <= _FEW for one in dense[:-1])
    of_all = lambda sizes: tuple(dense[-1]._replace(front=size) for size in sizes)
    more = tuple(one for one in dense[few:] if contact.width * one.points <= _MOST)
    # so large that keeping room for its factors would cost the others more than they take
    last = tuple(one._replace(kept=False) for one in of_all((_TANGLED,)) if largest > _MOST)
    return (*dense[:few], *of_all(fronts), *more, *last)
