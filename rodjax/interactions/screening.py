"""Search for segments near each other, and what keeps strands from passing through each other.

The search runs once a step, on the motion predicted for it; its list of pairs is then held, so
that Newton's equations are smooth.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from rodjax.interactions import contact_graph
from rodjax.interactions.contact import Contact
from rodjax.interactions.contact_capacities import BLOCK, capacities
from rodjax.interactions.contact_graph import Graph
from rodjax.interactions.contact_law import PairProperties
from rodjax.interactions.involved import chosen_first, involve
from rodjax.interactions.sites import Sites, along, around_of, interpolate
from rodjax.numerics import newton
from rodjax.numerics.batching import largest, only_where
from rodjax.numerics.closest import closest


class NearPairs(NamedTuple):
    """Outcome of the search: pairs of segments, and what eliminates so many of them."""

    first: Int[Array, " q"]  # segment nearer to s = 0; beyond `count` meaningless but valid
    second: Int[Array, " q"]
    count: Int[Array, ""]  # pairs in the list
    capacity: Int[Array, ""]  # 0: no pair; k: the k-th of `contact_capacities` holds them
    overflow: Bool[Array, ""]  # pairs or vertices were left out
    graph: Graph | None = None  # of the pairs, where a capacity has use for it


def _separations(x):
    """Components of x_j - x_i for all i, j."""
    return [x[None, :, k] - x[:, None, k] for k in range(3)]


def _norm(components):
    return jnp.sqrt(sum(c**2 for c in components))


def search(
    contact: Contact,
    sites: Sites,
    position: Float[Array, "nodes 3"],
    displacement: Float[Array, "nodes 3"] | None = None,
) -> NearPairs:
    """Pairs of segments of which some points are within reach and inside both apertures.

    `displacement` is the expected motion of the step; the reach is the cut-off plus one and a
    half times a pair's relative displacement, so that no strand tunnels between two searches.
    No derivative passes through.
    """
    contact, sites, position, displacement = newton.constant(
        (contact, sites, position, displacement)
    )
    sizes = capacities(contact, position.shape[0] - 1)
    # a segment's points lie within this of its middle, so a pair's within twice of the line
    vertices = interpolate(sites, position)
    half = 0.5 * _widest(contact, sites, vertices) * (contact.points_per_segment - 1)
    middles = 0.5 * (vertices[1:] + vertices[:-1])
    moved = displaced = None
    if displacement is not None:
        displaced = interpolate(sites, displacement)
        moved = 0.5 * (displaced[1:] + displaced[:-1])
    s = jnp.mean(sites.arc_length, 1)
    segment = jnp.arange(contact.vertices - 1)
    once = (segment[:, None] < segment[None, :]) & (
        along(sites, s[:, None], s[None, :]) + 2 * half >= contact.excluded
    )

    if contact.idle is not None:
        acting = jnp.asarray(~contact.idle)
        once = once & acting[:, None] & acting[None, :]

    def reached():
        """Which pairs are near, by the reach and the apertures of each."""
        r = _separations(middles)
        distance = _norm(r)
        motion = 0.0 if moved is None else 1.5 * _norm(_separations(moved))
        near = once & (distance < contact.cutoff + motion + 2 * half)
        aperture = contact.acting_aperture
        if aperture is None:
            return near & ~_along_each_other(contact, sites, vertices, displaced)
        chord = vertices[1:] - vertices[:-1]
        chord = chord / jnp.sqrt(jnp.sum(chord**2, 1, keepdims=True))
        # inside an aperture: |r.t| cos(theta/2) <= |r - (r.t) t| sin(theta/2), within the slack
        cosine, sine = jnp.cos(0.5 * aperture), jnp.sin(0.5 * aperture)

        def inside(t):
            along = jnp.abs(sum(rk * tk for rk, tk in zip(r, t, strict=True)))
            across = jnp.sqrt(jnp.maximum(distance**2 - along**2, 0.0))
            return along * cosine <= across * sine + 2 * half + motion

        near = near & inside([chord[:, None, k] for k in range(3)])
        return near & inside([chord[None, :, k] for k in range(3)])

    def touching(first, second):
        """Which of listed pairs are near with their chords, not with their middles alone."""
        ends = [(vertices[index], vertices[index + 1]) for index in (first, second)]
        distance = closest(jnp, *ends[0], *ends[1])[2]
        if displaced is None:
            return distance < contact.cutoff
        one, other = (
            jnp.stack([displaced[index], displaced[index + 1]], 1) for index in (first, second)
        )
        apart = jnp.sum((one[:, :, None] - other[:, None, :]) ** 2, 3)
        return distance < contact.cutoff + 1.5 * jnp.sqrt(jnp.max(apart, (1, 2)))

    def some():
        return _listed(reached(), sizes, sites, position.shape[0], touching)

    def none():
        return _none_listed(sizes, position.shape[0])

    # most steps end here: nothing within the widest reach of all
    slack = jnp.zeros_like(half)
    if displaced is not None:
        slack = 3.0 * jnp.sqrt(jnp.max(jnp.sum(displaced**2, 1)))
    reach = contact.cutoff + 2 * half + slack
    squared = sum(c**2 for c in _separations(middles))
    near = once & (squared < reach**2)
    if contact.acting_aperture is None:
        near = near & ~_along_each_other(contact, sites, vertices, slack)
    maybe = jnp.any(near)
    return lax.cond(largest(maybe.astype(jnp.int32)) > 0, some, none)


def _widest(contact: Contact, sites: Sites, vertices: Float[Array, "j 3"]) -> Float[Array, ""]:
    """Largest spacing of points, of segments stretched as they are."""
    chords = jnp.sqrt(jnp.sum((vertices[1:] - vertices[:-1]) ** 2, 1))
    if contact.idle is not None:
        chords = jnp.where(jnp.asarray(contact.idle), 0.0, chords)
    return jnp.maximum(sites.widest, jnp.max(chords) / contact.points_per_segment)


def _along_each_other(
    contact: Contact,
    sites: Sites,
    vertices: Float[Array, "j 3"],
    moved: Float[Array, "j 3"] | Float[Array, ""] | None,
) -> Bool[Array, "g g"]:
    """Pairs of segments no points of which can act, since the rod between them is too straight.

    Of a piece of length A whose ends are a chord c apart, points s along it from each other are
    s - (A - c) apart at least. Those that may act are farther than `excluded` along the rod.
    `moved` is the expected motion of the vertices, or by how much a chord may shorten.
    """
    width = sites.spacing * contact.points_per_segment
    chords = jnp.sqrt(jnp.sum((vertices[1:] - vertices[:-1]) ** 2, 1))
    # a stretched segment counts as long as it is, one that is compressed as it was
    longest = jnp.cumsum(jnp.maximum(chords, width))
    places = jnp.concatenate([jnp.zeros_like(longest[:1]), longest])
    before, after = slice(None, -1), slice(1, None)

    def squared(x, one, other):
        return sum((x[None, other, k] - x[one, None, k]) ** 2 for k in range(3))

    def straight(length, one, other):
        slack = 0.0 if moved is None else moved
        if moved is not None and moved.ndim > 0:
            slack = 1.5 * jnp.sqrt(squared(moved, one, other))
        needed = length + slack - (contact.excluded - contact.cutoff)
        found = squared(vertices, one, other) > needed * jnp.abs(needed)
        return found if contact.idle is None else found & _of_one_rod(contact.idle)

    found = straight(places[None, 1:] - places[:-1, None], before, after)
    if sites.around is None:
        return found
    # of a ring the other way as well, stretched at most as any segment is
    s = jnp.mean(sites.arc_length, 1)
    begin, end = s - 0.5 * width, s + 0.5 * width
    stretch = chords / width
    if contact.idle is not None:
        stretch = jnp.where(jnp.asarray(contact.idle), 0.0, stretch)
    back = around_of(sites, s)[:, None] - (begin[None, :] - end[:, None])
    return found | straight(back * jnp.maximum(jnp.max(stretch), 1.0), after, before)


def _of_one_rod(idle: Bool[np.ndarray, " g"]) -> Bool[Array, "g g"]:
    """Which segments are of the same of several rods, between which these stand."""
    rod = np.cumsum(idle)
    return jnp.asarray(rod[:, None] == rod[None, :])


def _none_listed(sizes, nodes: int) -> NearPairs:
    """The list of no pairs."""
    no_pair, zero = jnp.zeros((sizes[-1].pairs,), jnp.int32), jnp.asarray(0, jnp.int32)
    no, graph = jnp.asarray(False), _no_graph(sizes, nodes)
    return NearPairs(no_pair, no_pair, zero, zero, no, graph)


def _no_graph(sizes, nodes: int) -> Graph | None:
    """The graph of no pairs, if a capacity has use for one."""
    fronts = any(size.front is not None for size in sizes)
    return contact_graph.nothing(sizes[-1].pairs, nodes) if fronts else None


def _listed(
    near: Bool[Array, "g g"], sizes, sites: Sites, nodes: int, touching: Callable
) -> NearPairs:
    """The list of those near pairs that are `touching`, and what they involve."""
    room = sizes[-1].pairs
    first, second = (
        index.astype(jnp.int32) for index in jnp.nonzero(near, size=room, fill_value=0)
    )
    before = jnp.sum(near).astype(jnp.int32)
    number = jnp.arange(room, dtype=jnp.int32)
    place, _, count = chosen_first(touching(first, second) & (number < before))
    first, second = first[place], second[place]
    fits = involve(first, second, count, sites, nodes, sizes).fits
    graph = no_graph = _no_graph(sizes, nodes)
    if no_graph is not None:
        fronts = [index for index, size in enumerate(sizes) if size.front is not None]
        needed = ~jnp.any(fits[: fronts[0]])
        listed = jnp.minimum(count, room)
        couplings = lambda corners: contact_graph.couplings(corners, listed, sites, nodes)
        corners = first, first + 1, second, second + 1
        graph = only_where(needed, couplings, lambda _: no_graph, corners)
        yes = jnp.asarray(True)
        wide = [yes if size.front is None else graph.fits(size.front) for size in sizes]
        fits = fits & jnp.stack(wide)
    overflow = ~jnp.any(fits) | (before > room)
    capacity = jnp.where(overflow, len(sizes), jnp.argmax(fits) + 1)
    capacity = jnp.where(count == 0, 0, capacity).astype(jnp.int32)
    count = jnp.minimum(count, room)
    return NearPairs(first, second, count, capacity, overflow, graph)


def approach_limit(
    contact: Contact,
    sites: Sites,
    pairs: NearPairs,
    position: Float[Array, "nodes 3"],
    change: Float[Array, "nodes 3"],
) -> Float[Array, ""]:
    """Largest fraction of a change of position that closes no gap by more than 70 %.

    The gap is counted from the law's smallest distance. Only the relative motion of near pairs
    is bounded, so a far part of the rod moves freely. No derivative passes through.
    """
    x, dx = (lax.stop_gradient(interpolate(sites, v)) for v in (position, change))
    contact, sites = newton.constant((contact, sites))
    diameter, excluded, arc_length = sites.diameter, contact.excluded, sites.arc_length
    count = contact.points_per_segment
    part = (jnp.arange(count, dtype=position.dtype) + 0.5) / count

    def points(values, segment):
        a, b = values[segment][:, None], values[segment + 1][:, None]
        return a + part[None, :, None] * (b - a)

    def body(i, limit):
        at = i * BLOCK + jnp.arange(BLOCK, dtype=jnp.int32)
        valid = at < pairs.count
        first, second = pairs.first[at], pairs.second[at]
        pair = lambda v: points(v, second)[:, None, :] - points(v, first)[:, :, None]
        r, w = pair(x), pair(dx)
        squared = jnp.sum(r**2, -1)
        apart = along(sites, arc_length[first][:, :, None], arc_length[second][:, None, :])
        acts = (apart >= excluded) & valid[:, None, None] & (squared > 0)
        distance = jnp.sqrt(jnp.where(squared > 0, squared, 1.0))
        closing = -jnp.sum(r * w, -1) / distance
        mean = 0.5 * (diameter[first][:, :, None] + diameter[second][:, None, :])
        floor = contact.law.smallest(PairProperties(mean, None))
        gap = jnp.maximum(distance - floor, 0.05 * mean)
        ratio = 0.7 * gap / jnp.where(closing > 0, closing, 1.0)
        return jnp.minimum(limit, jnp.min(jnp.where(acts & (closing > 0), ratio, 1.0)))

    blocks = (largest(pairs.count) + BLOCK - 1) // BLOCK
    return lax.fori_loop(0, blocks, body, jnp.ones((), position.dtype))


def passage_suspected(
    sites: Sites,
    pairs: NearPairs,
    before: Float[Array, "nodes 3"],
    after: Float[Array, "nodes 3"],
) -> Bool[Array, ""]:
    """Whether two near segments crossed each other in a step.

    Two chords cross when the volume of the tetrahedron of their four vertices changes sign, at a
    moment when the point common to their lines lies on both: that moment and point are found on
    the straight ways of the vertices. A slow passage is seen as well as a fast one.
    """

    def crossed(positions):
        return jnp.any(_crossings(pairs, *(interpolate(sites, x) for x in positions)))

    sites, positions = lax.stop_gradient((sites, (before, after)))
    return only_where(pairs.count > 0, crossed, lambda _: jnp.asarray(False), positions)


def _crossings(
    pairs: NearPairs, old: Float[Array, "j 3"], new: Float[Array, "j 3"]
) -> Bool[Array, " q"]:
    """Which pairs crossed while their vertices moved straight from old to new."""
    valid = jnp.arange(pairs.first.shape[0], dtype=jnp.int32) < pairs.count

    def chords(x):
        a, b = x[pairs.first], x[pairs.second]
        return x[pairs.first + 1] - a, x[pairs.second + 1] - b, b - a

    def volume(x):
        first, second, between = chords(x)
        return jnp.sum(jnp.cross(first, second) * between, 1)

    start, end = volume(old), volume(new)
    change = start - end
    moment = jnp.where(change == 0, 0.0, start / jnp.where(change == 0, 1.0, change))
    vertices = lambda segment: (
        old[segment] + moment[:, None] * (new[segment] - old[segment]),
        old[segment + 1] + moment[:, None] * (new[segment + 1] - old[segment + 1]),
    )
    (a0, a1), (b0, b1) = vertices(pairs.first), vertices(pairs.second)
    first, second, between = a1 - a0, b1 - b0, b0 - a0
    dot = lambda x, y: jnp.sum(x * y, 1)
    # parameters of the common point on the two lines, both times the determinant
    product = dot(first, first) * dot(second, second)
    determinant = product - dot(first, second) ** 2
    on_first = dot(second, second) * dot(first, between) - dot(first, second) * dot(second, between)
    on_second = dot(first, second) * dot(first, between) - dot(first, first) * dot(second, between)
    inside = lambda u: (u >= 0) & (u <= determinant)
    # the chords of neighbours, and those in one line as of a straight rod, have a common point by
    # rounding only
    askew = determinant > 1e4 * jnp.finfo(old.dtype).eps * product
    apart = pairs.second - pairs.first > 1
    crossed = (start * end < 0) & inside(on_first) & inside(on_second) & askew & apart
    return crossed & valid
