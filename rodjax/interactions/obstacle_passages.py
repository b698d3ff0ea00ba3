"""What of an obstacle a rod passed or has between the points at which it feels it.

Points see an obstacle where they are. One that is thinner than their distance may be between two
of them, and a rod then sinks through it unnoticed. So the chords between neighbouring points are
looked at, on their way from one configuration to another, for the place that is deepest.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from rodjax.interactions.element_points import ElementPoints
from rodjax.interactions.shapes import AbstractShape
from rodjax.numerics.batching import only_where
from rodjax.numerics.compilation import compiled

# How deep an increment of Newton's method may bring a centreline into an obstacle, or deeper than
# it is, in radii of the rod. (Not less than nothing: a soft soil may be pressed in so far.)
_DEEPER = 0.5

# Places between two positions of a point that are looked at for an obstacle in the way: at least
# and at most, and how close to each other where it is near, in radii of the rod.
_LOOKS, _MOST_LOOKS, _CLOSE = 8, 256, 0.25

# Places along an element's chord that are looked at where it begins and ends its way; then, where
# something may be between them, places and times closer by the deepest, so often. The distance from
# a convex obstacle is convex along a chord: so its deepest place is found to 1/128, wherever it is.
_PLACES, _CLOSE_PLACES, _TIMES, _CLOSER = 17, 5, 9, 3

# Cosine of the angle between the normals at both ends of a chord, or of a way, up to which they see
# one rounding.
_SEEN = 0.5

Distance = Callable[[Float[Array, "3"]], tuple[Float[Array, ""], Float[Array, "3"]]]
Positions = Float[Array, "points 3"]


def safe_fraction(
    apart: Callable[[Positions], Float[Array, " points"]],
    position: Positions,
    change: Positions,
    radius: Float[Array, " points"],
) -> Float[Array, ""]:
    """How much of a change of points brings none too deep into an obstacle, by its distances."""
    # of a convex obstacle the linear change is the most that a node comes nearer, of a hollow
    # that from end to end
    before, linear = jax.jvp(apart, (position,), (change,))
    closing = jnp.maximum(-linear, before - apart(position + change))
    most = jnp.maximum(before, 0.0) + _DEEPER * radius
    fraction = most / jnp.where(closing > most, closing, most)
    return jnp.min(fraction, initial=1.0)


class Ways(NamedTuple):
    """Straight ways of the points of a rod, as the obstacle sees them.

    Attributes:
        before, after: where they begin and end.
        radius: of the rod.
    """

    before: Positions
    after: Positions
    radius: Float[Array, " points"]


class _Ends(NamedTuple):
    """Distances from the obstacle where ways begin and end, and the cosine of the normals' turn."""

    first: Float[Array, " points"]
    last: Float[Array, " points"]
    cosine: Float[Array, " points"]


def _ends(distance: Distance, ways: Ways) -> _Ends:
    (first, out), (last, there) = (jax.vmap(distance)(at) for at in (ways.before, ways.after))
    return _Ends(first, last, jnp.sum(out * there, 1))


def passed(shape: AbstractShape, ways: Ways) -> Bool[Array, ""]:
    """Whether a point went through an obstacle, or half a diameter into it at once."""
    apart = jax.vmap(shape.distance)
    # the way out of a convex room is deepest at its end
    deepest = apart(ways.after) if shape.convex_room else _deepest_on_way(apart, ways)
    return jnp.any((apart(ways.before) >= 0) & (deepest < -ways.radius))


def jumped(shape: AbstractShape, ways: Ways) -> Bool[Array, ""]:
    """Whether an obstacle is between two positions of a point outside it, or the centreline is in
    it where its normal is another than where it came from.

    Of equilibria, which may press far into a soft one at once.
    """
    ends = _ends(shape.distance_and_normal, ways)
    deepest = _deepest_on_way(jax.vmap(shape.distance), ways)
    over = (jnp.minimum(ends.first, ends.last) >= 0) & (deepest < -ways.radius)
    return jnp.any(over | ((ends.first >= 0) & (ends.last < 0) & (ends.cosine < _SEEN)))


def came_through(distance: Distance, ways: Ways) -> Bool[Array, ""]:
    """Whether a point that touches an obstacle is now on another side of it.

    Its normal has turned by more than a right angle: what is thinner than the rod is no deeper than
    its own radius where the centreline is in its middle, and then pushes on to the other side.
    """
    ends = _ends(distance, ways)
    touch = (ends.first < ways.radius) & (ends.last < ways.radius)
    return jnp.any((ends.cosine < 0) & touch)


def _deepest_on_way(
    apart: Callable[[Positions], Float[Array, " points"]], ways: Ways
) -> Float[Array, " points"]:
    """The least distance of points on their ways, found where it is below -radius.

    Where a point is as far as d from the obstacle it is not looked at before it has gone d + radius
    on: only then can it be so deep.
    """
    before, after, radius = ways
    length = jnp.sqrt(jnp.sum((after - before) ** 2, 1))

    def on(parts, distance):
        free = jnp.maximum(distance + radius, _CLOSE * radius)
        ahead = jnp.where(free < length, free / jnp.where(length > 0, length, 1.0), 1.0)
        return parts + jnp.clip(ahead, 1 / _MOST_LOOKS, 1 / _LOOKS)

    def look(found):
        parts, deepest = found
        at = jnp.minimum(parts, 1.0)[:, None]
        distance = apart(before + at * (after - before))
        return on(parts, distance), jnp.minimum(deepest, distance)

    first = apart(before)
    found = on(jnp.zeros_like(first), first), jnp.minimum(first, apart(after))
    return lax.while_loop(lambda found: jnp.any(found[0] < 1.0), look, found)[1]


class Deepest(NamedTuple):
    """The deepest place of a chord between two points, on its way.

    Attributes:
        lacking: below zero where the points beside it do not see what it is in: where it is inside
            the obstacle with its centreline, and more than twice as deep, from where surfaces
            touch, as either of them [m]; and below them by more than twice what the chord of a
            circle would be by which the normals turn (a drum, of which a rod is a polygon).
        distance: of the centreline from the obstacle [m].
    """

    lacking: Float[Array, " chords"]
    distance: Float[Array, " chords"]


class _Window(NamedTuple):
    """Part of a chord and of its way that is looked at, and what was deepest in it."""

    along: Float[Array, "2"]
    way: Float[Array, "2"]
    found: Deepest


class _Chord(NamedTuple):
    """A chord on its way.

    Attributes:
        before, after: its ends.
        radius: of the rod.
    """

    before: Float[Array, "2 3"]
    after: Float[Array, "2 3"]
    radius: Float[Array, ""]


def between_points(
    distance: Distance,
    points: ElementPoints,
    before: Float[Array, "nodes 3"],
    after: Float[Array, "nodes 3"],
) -> Deepest:
    """The deepest places of all chords between points of a rod's elements, in their order.

    Args:
        distance: of one point from the obstacle, and the normal there.
        before, after: positions of the nodes between which they move.
    """
    nodes = points.radius[: points.rod.elements + 1, None]
    radius = jnp.mean(_chords(points, nodes), (1, 2))
    chords = _Chord(_chords(points, before), _chords(points, after), radius)
    places = max(1 + (_PLACES - 1) // points.per_element, _CLOSE_PLACES)
    look = lambda chord: _look(distance, chord, _whole(chord), places, 2)
    windows = jax.vmap(look)(chords)
    # a place is nearer to the obstacle than what was looked at by no more than the way to it
    half = lambda rows: 0.5 * jnp.sqrt(jnp.sum(rows**2, -1))
    aside = half(chords.before[:, 1] - chords.before[:, 0]) / (places - 1)
    moved = jnp.max(half(chords.after - chords.before), 1)
    near = windows.found.lacking < aside + 3 * moved

    def closer(windows: _Window) -> _Window:
        look = lambda chord, window: _look(distance, chord, window, _CLOSE_PLACES, _TIMES)
        every = jax.vmap(look)
        return lax.fori_loop(0, _CLOSER, lambda _, windows: every(chords, windows), windows)

    return only_where(jnp.any(near), closer, lambda windows: windows, windows).found


def _chords(points: ElementPoints, rows: Float[Array, "nodes k"]) -> Float[Array, "chords 2 k"]:
    """What the nodes have, at both ends of the chords between points."""
    rod, count = points.rod, points.per_element
    ends = rod.solid(jnp.stack([rows[:-1], rows[1:]], 1))
    first = np.arange(count) / count
    parts = jnp.asarray(np.stack([first, first + 1 / count], 1), rows.dtype)[None, :, :, None]
    divided = (1 - parts) * ends[:, None, :1] + parts * ends[:, None, 1:]
    return divided.reshape(-1, 2, rows.shape[1])


def _whole(chord: _Chord) -> _Window:
    """All of a chord and of its way."""
    ends = jnp.asarray([0.0, 1.0], chord.radius.dtype)
    none = jnp.full_like(chord.radius, jnp.inf)
    return _Window(ends, ends, Deepest(none, none))


def _look(distance: Distance, chord: _Chord, window: _Window, places: int, times: int) -> _Window:
    """A window after a look at so many places at so many times: round what is deepest there."""
    many, dtype = jax.vmap(jax.vmap(lambda at: distance(at)[0])), chord.radius.dtype
    spread = lambda part, count: (
        part[0] + (part[1] - part[0]) * jnp.linspace(0, 1, count, dtype=dtype)
    )
    along, when = spread(window.along, places), spread(window.way, times)
    ends = chord.before[None] + when[:, None, None] * (chord.after - chord.before)[None]
    edge = ends[:, 1] - ends[:, 0]
    there = many(ends[:, :1] + along[None, :, None] * edge[:, None])
    distances, normals = jax.vmap(jax.vmap(distance))(ends)
    nearest = jnp.min(distances, 1)
    beside = jnp.minimum(nearest, chord.radius)
    lacking = there + jnp.maximum(chord.radius - 2 * beside, 0.0)[:, None]
    cosine, sagging = _sagging(normals, edge)
    rounded = there - (nearest - 2 * sagging)[:, None]
    lacking = jnp.where(cosine[:, None] > _SEEN, jnp.maximum(lacking, rounded), lacking)
    i, j = jnp.divmod(jnp.argmin(lacking), places)
    better = lacking[i, j] < window.found.lacking
    pick = lambda new, old: jnp.where(better, new[i, j], old)
    found = Deepest(pick(lacking, window.found.lacking), pick(there, window.found.distance))
    near = lambda at, part, count: jnp.clip(
        at + jnp.asarray([-1.0, 1.0], dtype) * (part[1] - part[0]) / (count - 1), 0.0, 1.0
    )
    around = near(along[j], window.along, places), near(when[i], window.way, times)
    return _Window(*around, found)


def _sagging(
    normals: Float[Array, "t 2 3"], edge: Float[Array, "t 3"]
) -> tuple[Float[Array, " t"], Float[Array, " t"]]:
    """Cosine of the angle between the normals at the ends of a chord, and how far its middle is
    below them if it is that of a circle: l/2 tan(angle/4).
    """
    product = jnp.sum(normals[:, 0] * normals[:, 1], 1)
    size = jnp.sqrt(jnp.sum(normals[:, 0] ** 2, 1) * jnp.sum(normals[:, 1] ** 2, 1))
    cosine = jnp.clip(product / jnp.where(size > 0, size, 1.0), -1.0, 1.0)
    half = jnp.sqrt(0.5 * (1 + cosine))
    return cosine, 0.5 * jnp.sqrt(jnp.sum(edge**2, 1) * (1 - half) / (1 + half))


@compiled
def _between(shape: AbstractShape, points: ElementPoints) -> Deepest:
    position = points.rod.position
    return between_points(shape.distance_and_normal, points, position, position)


def check_outside(shape: AbstractShape, points: ElementPoints) -> None:
    """Raise ValueError where a rod as placed is inside an obstacle (not in traced code)."""
    rod = points.rod
    count = rod.elements + 1 + points.parts.size
    numbers = np.asarray(points.of_rods(jnp.arange(count)))
    distance = np.asarray(jax.vmap(shape.distance)(points.of_rods(points.at(rod.position))))
    if not np.all(np.isfinite(distance)):
        place = points.name(int(numbers[np.argmin(np.isfinite(distance))]))
        raise ValueError(
            f"shape: its distance from {place} is no number; give a signed distance that is finite"
            " everywhere"
        )
    starts = "shape: the rod starts inside the obstacle, "
    if np.any(distance < 0):
        point = int(np.argmin(distance))
        raise ValueError(
            f"{starts}{points.name(int(numbers[point]))} by {-float(distance[point]):.3g} m; place"
            " the rod or the obstacle elsewhere (the signed distance is positive where a rod may"
            " be: turn a plane's normal round, or give `inside`)"
        )
    if shape.convex_room:
        return
    between = _between(shape, points)
    lacking = np.asarray(between.lacking)
    if np.any(lacking < 0):
        chord = int(np.argmin(lacking))
        solid = np.delete(np.arange(rod.elements), list(rod.breaks))
        element, depth = solid[chord // points.per_element], -float(between.distance[chord])
        raise ValueError(
            f"{starts}between nodes {element} and {element + 1} by {depth:.3g} m, where no point"
            " feels it; place the rod or the obstacle elsewhere, or bring points nearer to each"
            " other by points_per_element or more elements"
        )
