"""Writhe, twist and linking number of a rod, each exact on the polygon of its nodes.

The element frames of a rod make its polygon a ribbon. Twist (Tw) measures the rotation of the
ribbon about its own axis, writhe (Wr) the coiling of the axis in space, and their sum, the linking
number Lk = Tw + Wr, equals the number of turns applied at the ends as long as no strand passes
through another; every passage changes it by 2.

Signs: right-handed coiling and right-handed twist are positive, so a rod whose end s = 0 is turned
by -turns about its tangent while the other end is held has Lk = +turns.
"""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from rodjax.inputs.argument_types import AnyArray
from rodjax.numerics import rotations
from rodjax.rods.mutual_linking import mutual_linking  # noqa: F401 (public here)
from rodjax.rods.solid_angles import PAIRS, difference, half_solid_angle, triple


def writhe(
    positions: Float[AnyArray, "nodes 3"],
    *,
    closed: bool = False,
    extension: Float[Array, ""] | float | None = None,
    start_direction: Float[AnyArray, "3"] | None = None,
    end_direction: Float[AnyArray, "3"] | None = None,
) -> Float[Array, ""]:
    """Writhe of a polygon: the signed number of crossings averaged over all views.

    The Gauss double integral Wr = 1/(4 pi) int int (r1 - r2) . (t1 x t2) / |r1 - r2|^3 ds1 ds2 is
    evaluated in closed form for each pair of straight segments, where it is the signed solid angle
    under which one sees the other (Klenin & Langowski 2000, Biopolymers 54, 307), here in the
    arctan2 form of Van Oosterom & Strackee (1983), which keeps its digits for nearly collinear
    segments. Work grows as nodes^2, memory as nodes; the derivatives cost only O(nodes).

    An open curve is extended straight at both ends, by default to infinity. Extensions of finite
    length change the result by about (polygon length / extension), or by its square if the two
    lie on one line.

    Args:
        positions: vertices [m], consecutive ones distinct.
        closed: join the last vertex to the first, which is not repeated. Then there is no
            extension, and the three arguments below have no effect.
        extension: length of each extension [m]; None is the limit of infinite length.
        start_direction: unit vector of the extension before the first vertex, pointing towards
            increasing arc length; by default the direction of the first segment.
        end_direction: unit vector of the extension after the last vertex, pointing towards
            increasing arc length; by default the direction of the last segment.

    Returns:
        Writhe [-]; a right-handed helix is positive, a planar curve has 0. Where strands cross, the
        writhe jumps by 2 and its derivative is that on either side. Infinite extensions that run
        side by side the same way (opposite `start_direction` and `end_direction`) have no writhe
        in the limit: give them a length.
    """
    positions = jnp.asarray(positions)
    edges = positions[1:] - positions[:-1]
    length = jnp.sum(jnp.linalg.norm(edges, axis=1))
    # pairs without an angle count as zero: where vertices are no numbers, neither is the writhe
    unknown = 0 * lax.stop_gradient(length)
    vertices = positions / length  # so that products stay in range
    if closed:
        edges = jnp.concatenate([edges, positions[:1] - positions[-1:]])
        pairs = _sum_over_pairs(vertices, jnp.roll(vertices, -1, axis=0), closed)
        pairs = pairs + unknown
        return _with_local_derivative(pairs, jnp.concatenate([edges, edges[:1]])) / jnp.pi
    along = lambda edge, given: (
        edge / jnp.linalg.norm(edge) if given is None else jnp.asarray(given)
    )
    start, end = along(edges[0], start_direction), along(edges[-1], end_direction)
    pairs = _sum_over_pairs(vertices[:-1], vertices[1:], closed) + unknown
    there = jnp.concatenate([start[None, :], edges, end[None, :]])
    if extension is None:
        angles = _extension_angles(vertices, start, end, jnp.zeros_like(length))
        round_trip = jnp.concatenate([there, start[None, :]])
        return _with_local_derivative(pairs + jnp.sum(angles), round_trip) / jnp.pi
    # the pair of the two extensions apart: its infinite limit may not exist
    inverse = jnp.stack([jnp.zeros_like(length), length / extension])
    by_inverse = jax.vmap(_extension_angles, (None, None, None, 0))
    infinite, finite = by_inverse(vertices, start, end, inverse)
    others = jnp.sum(infinite[:-1])
    round_trip = jnp.concatenate([there, vertices[-1:] - vertices[:1], start[None, :]])
    total = _with_local_derivative(pairs + others, round_trip)
    return (total - others + jnp.sum(finite)) / jnp.pi


def twist(
    positions: Float[AnyArray, "nodes 3"],
    element_frames: Float[AnyArray, "nodes-1 4"],
    *,
    start_frame: Float[AnyArray, "4"] | None = None,
    end_frame: Float[AnyArray, "4"] | None = None,
    signed: bool = False,
) -> Float[Array, ""]:
    """Twist of the framed polygon, such that twist + writhe is its linking number to round-off.

    At every vertex the frame of one element is carried to the next edge by parallel transport (the
    smallest rotation between the two edges); the angle that remains about the next edge, between
    -pi and pi (`signed`: -2 pi and 2 pi), is the twist of that vertex. A frame whose third axis is
    off its edge, as in a shearable rod, is first put on the edge by the smallest rotation.

    Args:
        positions: nodes [m], consecutive ones distinct.
        element_frames: unit quaternions, scalar first, body to inertial, of the elements; their
            third axes lie along the edges of the polygon (less than 180 degrees off).
        start_frame: quaternion of the first node's cross-section; its third axis is the tangent
            there. With it the twist between that frame and the first element is included.
        end_frame: the same at the last node.
        signed: the quaternions follow each other continuously along the rod, as those of a state
            do, so that q and -q are a turn apart; else their signs do not matter.

    Returns:
        Twist [turns], right-handed positive.
    """
    frames, directions = [element_frames], [positions[1:] - positions[:-1]]
    if start_frame is not None:
        frames.insert(0, start_frame[None, :])
        directions.insert(0, rotations.tangent_director(jnp.asarray(start_frame))[None, :])
    if end_frame is not None:
        frames.append(end_frame[None, :])
        directions.append(rotations.tangent_director(jnp.asarray(end_frame))[None, :])
    return _ribbon_twist(jnp.concatenate(directions), jnp.concatenate(frames), signed)


def twist_integral(
    curvature: Float[AnyArray, "elements 3"], lengths: Float[AnyArray, "elements"]
) -> Float[Array, ""]:
    """Twist as the integral Tw = 1/(2 pi) int kappa . t ds, Eq. (15) of Goyal, Perkins & Lee.

    Args:
        curvature: curvature and twist vector in the body frame [rad/m], third component the twist.
        lengths: lengths of the elements [m].

    Returns:
        Twist [turns]. It agrees with `twist` to second order in the element length only: it is the
        quantity of the paper, but strand passage is to be judged by `twist`.
    """
    return jnp.sum(curvature[:, 2] * lengths) / (2 * jnp.pi)


def linking_number(
    positions: Float[AnyArray, "nodes 3"],
    element_frames: Float[AnyArray, "nodes-1 4"],
    *,
    start_frame: Float[AnyArray, "4"] | None = None,
    end_frame: Float[AnyArray, "4"] | None = None,
    extension: Float[Array, ""] | float | None = None,
) -> Float[Array, ""]:
    """Linking number Lk = Tw + Wr of an open rod extended straight along its end tangents.

    With `start_frame` and `end_frame` given, the extensions follow their third axes, and Lk changes
    only when these frames turn or when a strand passes through another (Fuller 1971, White 1969).
    For infinite extensions this holds to round-off at any number of nodes.

    Arguments (positions, element_frames, and so on) as in `twist` and `writhe`; without an end
    frame the extension at that end follows the first or last segment. Returns the linking
    number [turns].
    """
    tangent = lambda frame: (
        None if frame is None else rotations.tangent_director(jnp.asarray(frame))
    )
    coiling = writhe(
        positions,
        extension=extension,
        start_direction=tangent(start_frame),
        end_direction=tangent(end_frame),
    )
    return twist(positions, element_frames, start_frame=start_frame, end_frame=end_frame) + coiling


def linking_error(
    turns: Float[Array, "*saved"], twist: Float[Array, "*saved"], writhe: Float[Array, "*saved"]
) -> Float[Array, "*saved"]:
    """Excess of the linking number over the turns applied at the ends, Tw + Wr - turns.

    Args:
        turns: turns applied since the rod was straight and untwisted: the end s = 0 turned by
            -turns about its tangent.
        twist: exact twist, from `twist` with the end frames [turns].
        writhe: writhe, from `writhe` with the end tangents [-].

    Returns:
        Zero to round-off as long as no strand has passed through another; every passage adds or
        takes 2 [turns]. A size beyond 1 therefore marks the motion as unphysical.
    """
    return twist + writhe - turns


def _sum_over_pairs(
    starts: Float[Array, "segments 3"], ends: Float[Array, "segments 3"], closed: bool
) -> Float[Array, ""]:
    """Sum over all pairs of segments of half their signed solid angle, a constant under derivation.

    Pair (i, i + shift modulo segments) runs over every unordered pair once as the shift runs from 1
    to half the number of segments (twice at exactly half); shifts are taken in blocks. Segments
    that share a vertex are left out by index: their solid angle is zero, but round-off makes it
    any angle.
    """
    starts, ends = lax.stop_gradient((starts, ends))
    segments = starts.shape[0]
    shifts = max(1, segments // 2)
    blocks = -(-shifts // max(1, PAIRS // segments))
    block_size = -(-shifts // blocks)
    first = [*starts.T, *ends.T]  # x, y, z apart: contiguous vectors
    doubled = [jnp.concatenate([component, component]) for component in first]
    # at shift 1 segments are neighbours, but for the two ends of an open curve
    unshared = jnp.arange(segments)[None, :] == (-1 if closed or segments < 3 else segments - 1)
    start_1, end_1 = [c[None, :] for c in first[:3]], [c[None, :] for c in first[3:]]

    def add_block(total, block_start):
        shift = block_start + jnp.arange(block_size)
        second = [
            jax.vmap(lambda k, c=component: lax.dynamic_slice_in_dim(c, k, segments))(shift)
            for component in doubled
        ]
        start_2, end_2 = second[:3], second[3:]
        a, b = difference(start_2, start_1), difference(end_2, start_1)
        c, d = difference(end_2, end_1), difference(start_2, end_1)
        volume = triple(a, difference(end_2, start_2), difference(end_1, start_1))
        angles = half_solid_angle(a, b, c, d, volume, volume)
        angles = jnp.where((shift > 1)[:, None] | unshared, angles, 0.0)
        weight = jnp.where(2 * shift < segments, 1.0, jnp.where(2 * shift == segments, 0.5, 0.0))
        return total + jnp.sum(weight.astype(angles.dtype) * jnp.sum(angles, axis=1)), None

    block_starts = 1 + block_size * jnp.arange(blocks)
    return lax.scan(add_block, jnp.zeros((), starts.dtype), block_starts)[0]


def _extension_angles(
    vertices: Float[Array, "nodes 3"],
    start: Float[Array, "3"],
    end: Float[Array, "3"],
    inverse: Float[Array, ""],
) -> Float[Array, "pairs"]:
    """The same angles for the pairs with an extension, last the pair of the two extensions.

    `inverse` is 1 / length of the extensions, or 0. Vectors from a far end are divided by the
    length of the extension, so that none is large. Neighbours are left out.
    """

    def rays(vertices, direction):
        d = vertices[1:] - vertices[:1]
        a = direction[None, :] + inverse * d
        directions = jnp.broadcast_to(direction[None, :], d[1:].shape)
        return [a[:-1], a[1:], d[1:], d[:-1], d[1:] - d[:-1], directions]

    chord = vertices[-1] - vertices[0]
    a, c = start + inverse * chord, end + inverse * chord
    both = [vector[None, :] for vector in (a, start + c, c, chord, end, start)]
    parts = [rays(vertices, start), rays(vertices[::-1], -end), both]  # reversal keeps the writhe
    a, b, c, d, segment, direction = (
        tuple(jnp.concatenate(part).T) for part in zip(*parts, strict=True)
    )
    volume = triple(d, segment, direction)
    return half_solid_angle(a, b, c, d, inverse * volume, volume)


@jax.custom_jvp
def _with_local_derivative(
    value: Float[Array, ""], directions: Float[Array, "n 3"]
) -> Float[Array, ""]:
    """pi times the writhe, with its derivative taken from a round trip of directions alone.

    For frames carried along with the curve Tw + Wr does not change, so that dWr = -dTw, a sum over
    the vertices (compare Fuller 1978, PNAS 75, 3557). As this holds for finite changes too, higher
    derivatives are right as well. The round trip visits the directions of the segments and comes
    back to the first one; for an open curve with infinite extensions it is start, segments, end,
    start, and with the chord before the last if the pair of the two extensions is left out.
    """
    del directions
    return value


@_with_local_derivative.defjvp
def _(primals, tangents):
    value, directions = primals
    identity, half_turn = jnp.eye(4, dtype=directions.dtype)[:2]  # third axes e3 and -e3
    nearer = jnp.where(directions[:, 2:] >= 0, identity[None, :], half_turn[None, :])
    frames = lax.stop_gradient(_align(nearer, directions))
    twist_change = jax.jvp(lambda d: _ribbon_twist(d, frames), (directions,), (tangents[1],))[1]
    return value, -jnp.pi * twist_change


def _ribbon_twist(
    directions: Float[Array, "n 3"], frames: Float[Array, "n 4"], signed: bool = False
) -> Float[Array, ""]:
    """Twist [turns] of frames, each first put on its direction, between consecutive directions.

    The relative rotation (w, x, y, z) of two frames is the smallest rotation that aligns their
    third axes times a rotation about the third axis by 2 arctan2(z, w), whose branch tells a turn
    where the signs of the frames count.
    """
    frames = _align(frames, directions)
    w, _, _, z = rotations.multiply(rotations.conjugate(frames[:-1]), frames[1:]).T
    regular = (w != 0) | (z != 0)
    flip = jnp.zeros_like(regular) if signed else w < 0  # either sign is the same rotation
    angles = jnp.arctan2(jnp.where(flip, -z, z), jnp.where(regular, jnp.where(flip, -w, w), 1.0))
    return jnp.sum(angles) / jnp.pi


def _align(frames: Float[Array, "n 4"], directions: Float[Array, "n 3"]) -> Float[Array, "n 4"]:
    """Frames turned by the smallest rotation that puts their third axes along the directions."""
    axes = rotations.tangent_director(frames)
    targets = directions / jnp.linalg.norm(directions, axis=1, keepdims=True)
    cosine = jnp.sum(axes * targets, axis=1, keepdims=True)
    smallest = jnp.concatenate([1 + cosine, jnp.cross(axes, targets)], axis=1)
    return rotations.multiply(rotations.normalize(smallest), frames)
