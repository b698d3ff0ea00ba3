"""Search for segments near each other, and what keeps strands from passing through each other.

The search runs once a step, on the motion predicted for it; its list of pairs is then held, so
that Newton's equations are smooth.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from rodjax.batching import largest
from rodjax.contact import Contact, Sites, interpolate, levels
from rodjax.contact_laws import PairProperties

BLOCK = 32  # pairs that are evaluated together


class Near(NamedTuple):
    """Outcome of the search: pairs of segments, the joints they involve and these joints' nodes."""

    first: Int[Array, " q"]  # segment nearer to s = 0; beyond `count` meaningless but valid
    second: Int[Array, " q"]
    count: Int[Array, ""]  # pairs in the list
    order: Int[Array, " j"]  # all joints, those involved first
    rank: Int[Array, " j"]  # place of each joint in `order`
    nodes: Int[Array, " nodes"] | None  # all, those between which such joints lie first; if needed
    level: Int[Array, ""]  # 0: no pair; k: the k-th of `contact.levels` holds them
    overflow: Bool[Array, ""]  # pairs or joints were left out


def _separations(x):
    """Components of x_j - x_i for all i, j."""
    return [x[None, :, k] - x[:, None, k] for k in range(3)]


def _norm(components):
    return jnp.sqrt(sum(c**2 for c in components))


def _middles(where: Sites, nodal) -> Float[Array, "g 3"]:
    joints = lax.stop_gradient(interpolate(where, nodal))
    return 0.5 * (joints[1:] + joints[:-1])


def search(
    contact: Contact,
    where: Sites,
    position: Float[Array, "nodes 3"],
    displacement: Float[Array, "nodes 3"] | None = None,
) -> Near:
    """Pairs of segments of which some points are within reach and inside both apertures.

    `displacement` is the expected motion of the step; the reach is the cut-off plus one and a
    half times a pair's relative displacement, so that no strand tunnels between two searches.
    No derivative passes through.
    """
    contact, where = lax.stop_gradient((contact, where))
    # a segment's points lie within this of its middle, so a pair's within twice of the line
    half = 0.5 * where.spacing * (contact.points_per_segment - 1)
    joints = lax.stop_gradient(interpolate(where, position))
    chord = joints[1:] - joints[:-1]
    chord = chord / jnp.sqrt(jnp.sum(chord**2, 1, keepdims=True))
    r = _separations(0.5 * (joints[1:] + joints[:-1]))
    distance = _norm(r)
    motion = jnp.zeros((), distance.dtype)
    if displacement is not None:
        motion = 1.5 * _norm(_separations(_middles(where, displacement)))
    # inside an aperture: |r.t| cos(theta/2) <= |r - (r.t) t| sin(theta/2), each within the slack
    cosine, sine = jnp.cos(0.5 * contact.aperture), jnp.sin(0.5 * contact.aperture)

    def inside(t):
        along = jnp.abs(sum(rk * tk for rk, tk in zip(r, t, strict=True)))
        across = jnp.sqrt(jnp.maximum(distance**2 - along**2, 0.0))
        return along * cosine <= across * sine + 2 * half + motion

    s = jnp.mean(where.arc_length, 1)
    segment = jnp.arange(contact.segments)
    near = (distance < contact.cutoff + motion + 2 * half) & (segment[:, None] < segment[None, :])
    near = near & (jnp.abs(s[:, None] - s[None, :]) + 2 * half >= contact.excluded)
    near = near & inside([chord[:, None, k] for k in range(3)])
    near = near & inside([chord[None, :, k] for k in range(3)])
    sizes = levels(contact, position.shape[0] - 1)
    capacity = sizes[-1].pairs

    def pick(near):
        first, second = jnp.nonzero(near, size=capacity, fill_value=0)
        return first.astype(jnp.int32), second.astype(jnp.int32), jnp.sum(near).astype(jnp.int32)

    none = jnp.zeros((capacity,), jnp.int32)
    nothing = (none, none, jnp.asarray(0, jnp.int32))
    some = largest(jnp.any(near).astype(jnp.int32)) > 0
    first, second, count = lax.cond(some, pick, lambda _: nothing, near)
    segments = jnp.any(near, 0) | jnp.any(near, 1)
    involved = jnp.zeros((contact.segments + 1,), bool).at[:-1].set(segments)
    involved = involved | jnp.roll(involved, 1)
    order, rank, joints = _first(involved)
    fits = (joints <= jnp.asarray([size.joints for size in sizes])) & (
        count <= jnp.asarray([size.pairs for size in sizes])
    )
    nodes = None
    if sizes[-1].nodes is not None:
        between = jnp.zeros(position.shape[:1], jnp.int32).at[where.nodes]
        between = between.add(involved[:, None] & (where.weight != 0)) > 0
        nodes, _, count_nodes = _first(between)
        fits = fits & (count_nodes <= jnp.asarray([size.nodes for size in sizes]))
    overflow = ~fits[-1]
    level = jnp.where(overflow, len(sizes), jnp.argmax(fits) + 1)
    level = jnp.where(count == 0, 0, level).astype(jnp.int32)
    return Near(first, second, jnp.minimum(count, capacity), order, rank, nodes, level, overflow)


def _first(chosen: Bool[Array, " k"]) -> tuple[Int[Array, " k"], Int[Array, " k"], Int[Array, ""]]:
    """All indices, the chosen ones first; the place of each; how many are chosen."""
    count = jnp.sum(chosen)
    index = jnp.arange(chosen.shape[0])
    before = jnp.cumsum(chosen) - chosen
    place = jnp.where(chosen, before, count + index - before).astype(jnp.int32)
    return jnp.zeros_like(place).at[place].set(index.astype(jnp.int32)), place, count


def approach_limit(
    contact: Contact,
    where: Sites,
    near: Near,
    position: Float[Array, "nodes 3"],
    change: Float[Array, "nodes 3"],
) -> Float[Array, ""]:
    """Largest fraction of a change of position that closes no gap by more than 70 %.

    The gap is counted from the law's smallest distance. Only the relative motion of near pairs
    is bounded, so a far part of the rod moves freely. No derivative passes through.
    """
    x, dx = (lax.stop_gradient(interpolate(where, v)) for v in (position, change))
    diameter, excluded, law = lax.stop_gradient((where.diameter, contact.excluded, contact.law))
    arc_length = lax.stop_gradient(where.arc_length)
    part = (jnp.arange(contact.points_per_segment) + 0.5) / contact.points_per_segment
    part = part.astype(position.dtype)

    def points(values, segment):
        a, b = values[segment][:, None], values[segment + 1][:, None]
        return a + part[None, :, None] * (b - a)

    def body(i, limit):
        at = i * BLOCK + jnp.arange(BLOCK)
        valid = at < near.count
        first, second = near.first[at], near.second[at]
        pair = lambda v: points(v, second)[:, None, :] - points(v, first)[:, :, None]
        r, w = pair(x), pair(dx)
        squared = jnp.sum(r**2, -1)
        acts = jnp.abs(arc_length[second][:, None, :] - arc_length[first][:, :, None]) >= excluded
        acts = acts & valid[:, None, None] & (squared > 0)
        distance = jnp.sqrt(jnp.where(squared > 0, squared, 1.0))
        closing = -jnp.sum(r * w, -1) / distance
        mean = 0.5 * (diameter[first][:, :, None] + diameter[second][:, None, :])
        floor = law.smallest(PairProperties(mean, None))
        gap = jnp.maximum(distance - floor, 0.05 * mean)
        ratio = 0.7 * gap / jnp.where(closing > 0, closing, 1.0)
        return jnp.minimum(limit, jnp.min(jnp.where(acts & (closing > 0), ratio, 1.0)))

    blocks = (largest(near.count) + BLOCK - 1) // BLOCK
    return lax.fori_loop(0, blocks, body, jnp.ones((), position.dtype))


def passage_suspected(
    where: Sites,
    near: Near,
    before: Float[Array, "nodes 3"],
    after: Float[Array, "nodes 3"],
) -> Bool[Array, ""]:
    """Whether two near segments crossed each other in a step.

    Two chords cross when the volume of the tetrahedron of their four joints changes sign, at a
    moment when the point common to their lines lies on both: that moment and point are found on
    the straight ways of the joints. A slow passage is seen as well as a fast one.
    """
    old, new = (lax.stop_gradient(interpolate(where, x)) for x in (before, after))
    valid = jnp.arange(near.first.shape[0]) < near.count

    def chords(x):
        a, b = x[near.first], x[near.second]
        return x[near.first + 1] - a, x[near.second + 1] - b, b - a

    def volume(x):
        first, second, between = chords(x)
        return jnp.sum(jnp.cross(first, second) * between, 1)

    start, end = volume(old), volume(new)
    change = start - end
    moment = jnp.where(change == 0, 0.0, start / jnp.where(change == 0, 1.0, change))
    joints = lambda segment: (
        old[segment] + moment[:, None] * (new[segment] - old[segment]),
        old[segment + 1] + moment[:, None] * (new[segment + 1] - old[segment + 1]),
    )
    (a0, a1), (b0, b1) = joints(near.first), joints(near.second)
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
    apart = near.second - near.first > 1
    crossed = (start * end < 0) & inside(on_first) & inside(on_second) & askew & apart
    return jnp.any(crossed & valid)
