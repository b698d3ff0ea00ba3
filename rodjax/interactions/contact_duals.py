"""Duals of the friction between strands, block by block of the near pairs of segments."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import lax

from rodjax.interactions import strand_friction
from rodjax.interactions.contact import Contact
from rodjax.interactions.contact_forces import rates_of
from rodjax.interactions.friction import Dual, continued
from rodjax.interactions.pair_points import blocks_of, points_of
from rodjax.interactions.screening import BLOCK, NearPairs
from rodjax.interactions.sites import Sites, interpolate
from rodjax.rods.state import NodeMotion


def first_duals(
    contact: Contact,
    sites: Sites,
    pairs: NearPairs,
    motion: NodeMotion,
    before: NodeMotion | None,
) -> Dual:
    """The duals that Newton's iterations begin with, block by block of the pairs.

    With the motion that a step begins from, `friction.continued`.
    """
    friction = contact.friction
    assert friction is not None
    motions = [one for one in (before, motion) if one is not None]
    loads = [_loads(contact, sites, pairs, one) for one in motions]

    def of(row, _):
        found = [strand_friction.first_dual(friction, *load(row)) for load in loads]
        return found[0] if len(found) == 1 else continued(*found)

    blocks = -(-len(pairs.first) // BLOCK)
    count, dtype = contact.points_per_segment, motion.position.dtype
    zeros = lambda *shape: jnp.zeros((blocks, BLOCK * count**2, *shape), dtype)
    return _of_blocks(pairs, of, Dual(zeros(3), zeros(3), zeros(1)))


def next_duals(contact: Contact, sites: Sites, pairs: NearPairs, motion: NodeMotion) -> Dual:
    """Those that follow the duals of the contact."""
    friction, load = contact.friction, _loads(contact, sites, pairs, motion)
    assert friction is not None and contact.dual is not None
    of = lambda row, before: strand_friction.next_dual(friction, before, *load(row))
    return _of_blocks(pairs, of, contact.dual)


def _of_blocks(pairs: NearPairs, of: Callable, begun: Dual) -> Dual:
    """The duals of the blocks in use, of each from what it is and its duals so far.

    In their place, as room for all takes long to clear; what is not in use stays zero.
    """
    rows = blocks_of(pairs)

    def body(i, found):
        row, before = (jax.tree.map(lambda leaf: leaf[i], x) for x in (rows, found))
        return jax.tree.map(lambda buffer, value: buffer.at[i].set(value), found, of(row, before))

    return lax.fori_loop(0, (pairs.count + BLOCK - 1) // BLOCK, body, begun)


def _loads(contact: Contact, sites: Sites, pairs: NearPairs, motion: NodeMotion) -> Callable:
    """What presses on each other in a block, and how it passes."""
    vertices, rates = (interpolate(sites, x) for x in (motion.position, rates_of(contact, motion)))

    def load(row):
        points = points_of(contact, sites, pairs, vertices, rates, row)
        p = jnp.where(points.acts, points.magnitude(contact, *points.inputs), 0.0)
        return p, points.passing

    return load
