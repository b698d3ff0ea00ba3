"""The pairs of points of near pairs of segments, a block of pairs at a time."""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from rodjax.interactions import strand_friction
from rodjax.interactions.contact import Contact
from rodjax.interactions.contact_law import PairProperties, continued
from rodjax.interactions.screening import BLOCK, NearPairs
from rodjax.interactions.sites import Sites, along
from rodjax.interactions.strand_friction import Passing


def smooth_step(x):
    """0 below 0, 1 above 1, C2 between."""
    x = jnp.clip(x, 0.0, 1.0)
    return x**3 * (10 - 15 * x + 6 * x**2)


def window(contact: Contact, distance, pair: PairProperties, cosines=()):
    """Smooth gate of a pair of points: near enough, and inside both apertures.

    A law that vanishes by itself is not touched by the cut-off. `cosines` are n.t, n the unit
    vector between the points, t the chord at either; inside means |n.t| <= sin(theta/2). It fades
    over the whole aperture: an edge would have to be resolved by the points, at several times
    their number for the same ripple of the force.
    """
    close = jnp.ones_like(distance)
    if contact.law.extent(pair) is None:
        close = smooth_step((1 - distance / contact.cutoff) / contact.edge)
    if contact.acting_aperture is None:
        return close
    limit = jnp.sin(0.5 * contact.acting_aperture) ** 2
    cosine_a, cosine_b = cosines
    inside = lambda c: smooth_step(1 - c**2 / limit)
    # theta = pi is all space: no gate
    gate = jnp.where(
        limit > 1 - 10 * jnp.finfo(limit.dtype).eps, 1.0, inside(cosine_a) * inside(cosine_b)
    )
    return close * gate


def vertices_of(pairs: NearPairs) -> tuple[Array, Array, Array, Array]:
    """Indices of the four vertices of every pair."""
    return pairs.first, pairs.first + 1, pairs.second, pairs.second + 1


def blocks_of(pairs: NearPairs) -> tuple[Int[Array, " k"], Int[Array, "k block 4"]]:
    """The blocks of the list: their first places, and the vertices of their pairs."""
    index = jnp.stack(vertices_of(pairs), 1)
    room = index.shape[0]
    padded = -(-room // BLOCK) * BLOCK
    # filled up with a segment and itself, which does not act but has a length
    filling = jnp.broadcast_to(jnp.asarray([0, 1, 0, 1], index.dtype), (padded - room, 4))
    index = jnp.concatenate([index, filling])
    return jnp.arange(0, padded, BLOCK, dtype=jnp.int32), index.reshape(-1, BLOCK, 4)


class Points(NamedTuple):
    """The pairs of points of a block of pairs of segments; components of vectors lead.

    Points a of the first segments and b of the second, at x_b - x_a = sum_i mix[a, b, i] X_i over
    the four vertices.
    """

    mix: Float[Array, "a b 4"]
    pair: PairProperties
    weight: Callable[[], Float[Array, "*q"]]  # of a pair of points, by their spacings
    acts: Bool[Array, "q a b"]
    distance: Float[Array, "q a b"]
    passing: Passing  # without friction spins are of no account and zero
    opening: Float[Array, "q a b"]  # rate of the distance
    tangents: tuple[Float[Array, "3 q 1 1"], ...]  # unit vectors of both chords, where they count
    lengths: Float[Array, "q 2"] | None
    cosines: tuple[Float[Array, "q a b"], ...]
    share: Float[Array, "q a b 4"] | None  # of the spins of the vertices in the mean one

    def magnitude(self, contact: Contact, distance, closing, *cosines) -> Float[Array, "q a b"]:
        """Force between points, repulsive positive, whether they act or not [N]."""
        psi = continued(contact.law, distance, closing, self.pair)
        return psi * window(contact, distance, self.pair, cosines) * self.weight()

    @property
    def inputs(self) -> tuple[Float[Array, "q a b"], ...]:
        """What `magnitude` takes."""
        return self.distance, -self.opening, *self.cosines


def points_of(
    contact: Contact,
    sites: Sites,
    pairs: NearPairs,
    vertices: Float[Array, "j 3"],
    rates: Float[Array, "j w"],
    row: tuple[Int[Array, ""], Int[Array, "block 4"]],
) -> Points:
    """The pairs of points of one block (its first place, the vertices of its pairs)."""
    first, index = row
    count = contact.points_per_segment
    part = (jnp.arange(count, dtype=vertices.dtype) + 0.5) / count
    one, other = jnp.broadcast_arrays(part[:, None], part[None, :])
    mix = jnp.stack([one - 1, -one, 1 - other, other], -1)
    at_a = lambda v: v[index[:, 0]][:, :, None]
    at_b = lambda v: v[index[:, 2]][:, None, :]
    valid = first + jnp.arange(BLOCK, dtype=jnp.int32) < pairs.count
    s, mean = sites.arc_length, lambda v: 0.5 * (at_a(v) + at_b(v))
    pair = PairProperties(mean(sites.diameter), None if sites.mass is None else mean(sites.mass))
    acts = along(sites, at_a(s), at_b(s)) >= contact.excluded
    between = lambda v: jnp.einsum("abi,qik->kqab", mix, v[index])
    r, w = between(vertices), between(rates[:, :3])
    squared = jnp.sum(r**2, 0)
    acts = acts & valid[:, None, None] & (squared > 0)
    # pairs that do not act are put at the cut-off, where everything is zero and smooth
    distance = jnp.where(acts, jnp.sqrt(jnp.where(acts, squared, 1.0)), contact.cutoff)
    n = jnp.where(acts[None], r / distance[None], 0.0)
    opening = jnp.sum(n * w, 0)
    tangents, lengths, cosines = (), None, ()
    if contact.acting_aperture is not None:
        corner = vertices[index]  # (q, 4, 3)
        chords = corner[:, 1::2] - corner[:, ::2]
        lengths = jnp.sqrt(jnp.sum(chords**2, -1))
        t = jnp.moveaxis(chords / lengths[..., None], 2, 0)[..., None, None]
        tangents = t[:, :, 0], t[:, :, 1]
        cosines = tuple(jnp.sum(n * t, 0) for t in tangents)
    spin, share = jnp.zeros_like(n), None
    if contact.friction is not None:
        both = jnp.broadcast_arrays(at_a(sites.diameter), at_b(sites.diameter))
        share = strand_friction.shares(mix, *both)
        spin = jnp.einsum("qabi,qik->kqab", share, rates[:, 3:][index])
    weight = lambda: sites.weigh(at_a, at_b)
    passing = Passing(r, n, w, spin)
    return Points(
        mix, pair, weight, acts, distance, passing, opening, tangents, lengths, cosines, share
    )
