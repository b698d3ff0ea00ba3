"""Where the vertices and points of contact lie on the grid of a rod, or of several."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from rodjax.interactions.contact import Contact
from rodjax.rods.rod import Part, Rod


class Sites(NamedTuple):
    """Where vertices and points lie on the grid."""

    nodes: Int[Array, "j k"]  # between which a vertex is interpolated, k = 4 or all of them
    weight: Float[Array, "j k"]  # of each
    arc_length: Float[Array, "g p"]  # of the points of every segment
    spacing: Float[Array, "*g"]  # of the points; of each segment where there are several rods
    diameter: Float[Array, "g p"]
    mass: Float[Array, "g p"] | None
    around: Float[Array, " *r"] | None = None  # lengths of closed rods, infinite of open ones
    stride: Float[Array, ""] | None = None  # of several rods, between their arc lengths' zeros

    def weigh(self, at_a: Callable, at_b: Callable) -> Float[Array, "*q"]:
        """Product of the spacings of the points of two segments, which are taken from rows so."""
        if self.spacing.ndim == 0:
            return self.spacing**2
        return at_a(self.spacing[:, None]) * at_b(self.spacing[:, None])

    @property
    def widest(self) -> Float[Array, ""]:
        """Largest spacing."""
        return self.spacing if self.spacing.ndim == 0 else jnp.max(self.spacing)


def sites_of(contact: Contact, rod: Rod, closed: bool | Bool[Array, ""] = False) -> Sites:
    """Vertices at equal arcs, points at the middles of equal parts of every segment.

    Of a `closed` rod, whose ends are at one place, the shorter way counts (`Scene.closed`).
    Vertices lie on the cubic through the four nodes nearest to them: on the elements' chords they
    would be off by kappa l^2/8, which in a tight loop is as much as a strand gives way.

    Of several rods each has segments of its own, and between two of them stands one that is none.
    Their arc lengths are so far from each other that no exclusion reaches from one to the next.
    Which of them are closed the contact knows (`Contact.rings`).
    """
    shares = contact.shared
    if len(shares) != len(rod.strands):
        raise ValueError("contact: it was set up for another number of rods; give it to the scene")
    total = jnp.sum(rod.length)
    if not rod.breaks:
        around = None
        if closed is not False:
            around = lax.stop_gradient(jnp.where(closed, total, jnp.inf))
        return _sites_of_one(contact, rod, rod.parts[0], shares[0])._replace(around=around)
    found = []
    for i, (part, segments) in enumerate(zip(rod.strands, shares, strict=True)):
        own = _sites_of_one(contact, rod, part, segments)
        far = 3 * i * total
        if found:
            found.append(_between_rods(own, far - total))
        spacing = jnp.broadcast_to(own.spacing, (segments,))
        found.append(own._replace(arc_length=own.arc_length + far, spacing=spacing))
    width = min(one.nodes.shape[1] for one in found)
    assert all(one.nodes.shape[1] == width for one in found)
    whole = jax.tree.map(lambda *rows: jnp.concatenate(rows), *found)
    if not contact.rings:
        return whole
    lengths = (jnp.sum(rod.length[part.elements]) for part in rod.strands)
    around = [x if ring else x + jnp.inf for x, ring in zip(lengths, contact.rings, strict=True)]
    return whole._replace(around=lax.stop_gradient(jnp.stack(around)), stride=3 * total)


def _sites_of_one(contact: Contact, rod: Rod, part: Part, segments: int) -> Sites:
    """Those of one of the rods, arc lengths from its own beginning."""
    length = rod.length[part.elements]
    total, points = jnp.sum(length), contact.points_per_segment
    spacing = total / (segments * points)
    nodes = rod.arc_length
    if rod.breaks:
        nodes = nodes[part.nodes]
    count = part.last - part.first

    def element(s):
        # comparing with all nodes compiles far faster than a binary search, and is done once a step
        place = jnp.searchsorted(nodes, s, side="right", method="compare_all")
        return jnp.clip(place - 1, 0, count - 1)

    vertices = total / segments * jnp.arange(segments + 1, dtype=total.dtype)
    stencil = min(4, *(one.last - one.first + 1 for one in rod.strands))
    first = jnp.clip(element(vertices) - 1, 0, count + 1 - stencil)
    chosen = first[:, None] + jnp.arange(stencil, dtype=first.dtype)[None]
    index = jnp.arange(segments * points, dtype=total.dtype)
    s = ((index + 0.5) * spacing).reshape(segments, points)
    weight = _lagrange(nodes[chosen], vertices[:, None])
    at = element(s)
    if rod.breaks:
        at, chosen = at + part.first, chosen + part.first
    mass = None if rod.mass is None else rod.mass[at]
    assert rod.diameter is not None
    return Sites(chosen, weight, s, spacing, rod.diameter[at], mass)


def _between_rods(after: Sites, place: Float[Array, ""]) -> Sites:
    """The segment between the last vertex of a rod and the first of the next, which never acts."""
    first = lambda rows: None if rows is None else rows[:1]
    s = jnp.full_like(after.arc_length[:1], 0.0) + place
    spacing = jnp.broadcast_to(after.spacing, (1,))
    none = after.nodes[:0], after.weight[:0]
    return Sites(*none, s, spacing, after.diameter[:1], first(after.mass))


def along(sites: Sites, a, b, xp=jnp):
    """Distance along the rod between places on it [m], by numpy or jax.numpy."""
    direct = xp.abs(b - a)
    if sites.around is None:
        return direct
    if sites.stride is None:
        return xp.minimum(direct, sites.around - direct)
    shorter = xp.minimum(direct, around_of(sites, a, xp) - direct)
    return xp.where(direct < 0.5 * sites.stride, shorter, direct)


def around_of(sites: Sites, s, xp=jnp):
    """Length of the closed rod that a place is on, infinite where it is open."""
    around = xp.asarray(sites.around)
    if sites.stride is None:
        return xp.broadcast_to(around, s.shape)
    return around[xp.floor(s / sites.stride).astype("int32")]


def _lagrange(nodes: Float[Array, "j k"], s: Float[Array, "j 1"]) -> Float[Array, "j k"]:
    """Weights at s of the values at the nodes, for the polynomial through them."""
    own = jnp.eye(nodes.shape[1], dtype=bool)
    apart = jnp.where(own, 1.0, nodes[:, :, None] - nodes[:, None, :])
    return jnp.prod(jnp.where(own, 1.0, (s - nodes)[:, None, :] / apart), 2)


def interpolate(sites: Sites, nodal: Float[Array, "nodes c"]) -> Float[Array, "j c"]:
    """Values at the vertices."""
    return jnp.sum(sites.weight[:, :, None] * nodal[sites.nodes], 1)


def spread(sites: Sites, values: Float[Array, "j c"], nodes: int) -> Float[Array, "nodes c"]:
    """The transpose of `interpolate`: forces on vertices to forces on nodes."""
    out = jnp.zeros((nodes, values.shape[1]), values.dtype)
    return out.at[sites.nodes].add(sites.weight[:, :, None] * values[:, None, :])
