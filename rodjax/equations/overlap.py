"""Strands nearer to each other than their contact law can hold them.

Long strands that cross at the angle alpha at a distance x push each other apart by the double
integral of the law over both,

    F(x) = 2 pi x phi(x) / sin(alpha),

phi the law's potential counted from the cut-off. Solids that give way, as a penalty does, have a
largest F, and so has every law that is continued below its smallest distance. Nearer than where it
is, the strands are held the less the deeper they are in each other: they pass, or have passed.

Steps look at it in the pairs of segments that are near (`too_near`); starts, and equilibria outside
traced code, are looked at whole, and told where (`deepest`).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from rodjax.inputs.validation import all_known
from rodjax.interactions.contact import Contact
from rodjax.interactions.contact_energy import pair_energy
from rodjax.interactions.contact_law import PairProperties
from rodjax.interactions.self_contact import FoundContact
from rodjax.interactions.sites import Sites, along, interpolate, sites_of
from rodjax.numerics import newton
from rodjax.numerics.batching import only_where
from rodjax.numerics.closest import closest
from rodjax.numerics.compilation import compiled
from rodjax.rods.state import State
from rodjax.scenes.scene import Scene

# Distances that are tried, and the least of them in diameters.
_TRIED, _LEAST = 300, 1e-3


class Overlap(NamedTuple):
    """Two places of the rod that are too near to each other."""

    first: float  # arc length [m]
    second: float
    distance: float  # of the centrelines [m]
    held: float  # least distance at which the law holds them [m]
    diameter: float


def crossing_force(contact: Contact, distance, pair: PairProperties):
    """F of strands that cross at right angles [N], positive when they repel."""
    return 2 * jnp.pi * distance * pair_energy(contact, distance, pair)


def least_held(contact: Contact, pair: PairProperties) -> Float[Array, "..."]:
    """Where `crossing_force` is largest [m]; zero for a law that does not repel."""
    dtype = pair.diameter.dtype
    parts = jnp.linspace(0.0, 1.0, _TRIED, dtype=dtype).reshape(-1, *[1] * pair.diameter.ndim)
    low = _LEAST * pair.diameter[None]
    tried = low * (contact.cutoff.astype(dtype) / low) ** parts
    force = crossing_force(contact, tried, jax.tree.map(lambda v: v[None], pair))
    place = jnp.take_along_axis(tried, jnp.argmax(force, 0)[None], 0)[0]
    return jnp.where(jnp.max(force, 0) > 0, place, 0.0)


def distances_held(scene: Scene) -> Float[Array, " g"] | None:
    """`least_held` of each segment of the contact [m], without derivative; None without contact.

    It looks for a largest force in hundreds of distances: once a run, not once a step.
    """
    return None if scene.contact is None else _limits(newton.constant(scene)).held


def too_near(
    contact: Contact,
    found: FoundContact,
    held: Float[Array, " g"],
    position: Float[Array, "nodes 3"],
) -> Bool[Array, ""]:
    """Whether strands, of the pairs found near, are nearer than the contact can hold them."""
    contact, found, position = newton.constant((contact, found, position))
    sites, pairs = found

    def some(position):
        vertices = interpolate(sites, position)
        places = _between(jnp, vertices, pairs.first, pairs.second, sites, contact)
        valid = jnp.arange(pairs.first.shape[0], dtype=jnp.int32) < pairs.count
        limit = 0.5 * (held[pairs.first] + held[pairs.second])
        near_by = valid & (places.along >= contact.excluded) & (places.distance < limit)
        return jnp.any(near_by)

    return only_where(pairs.count > 0, some, lambda _: jnp.asarray(False), position)


class _Between(NamedTuple):
    """Where pairs of segments are nearest to each other."""

    first: Array  # arc length [m]
    second: Array
    along: Array  # distance along the rod [m]
    distance: Array  # of the centrelines [m]


def _between(xp, vertices, a, b, sites: Sites, contact: Contact) -> _Between:
    """Of the segments a and b, by numpy or jax.numpy."""
    spacing = xp.broadcast_to(sites.spacing, sites.arc_length.shape[:1])
    begin, length = sites.arc_length[:, 0] - 0.5 * spacing, spacing * contact.points_per_segment
    u, v, distance = closest(xp, *(x for i in (a, b) for x in (vertices[i], vertices[i + 1])))
    first, second = begin[a] + u * length[a], begin[b] + v * length[b]
    return _Between(first, second, along(sites, first, second, xp), distance)


class _Limits(NamedTuple):
    sites: Sites
    held: Float[Array, " g"]  # of each segment
    excluded: Float[Array, ""]


@compiled
def _limits(scene: Scene) -> _Limits:
    contact = scene.contact
    assert contact is not None
    sites = sites_of(contact, scene.rod, scene.closed)
    middle = lambda v: v[:, v.shape[1] // 2]
    mass = None if sites.mass is None else middle(sites.mass)
    held = least_held(contact, PairProperties(middle(sites.diameter), mass))
    return _Limits(sites, held, contact.excluded)


def deepest(scene: Scene, position) -> Overlap | None:
    """Where strands of a configuration are too near, most of all; None if nowhere (not traced)."""
    from scipy.spatial import KDTree  # it takes long to import

    contact = scene.contact
    if contact is None or not np.all(np.isfinite(np.asarray(position))):
        return None
    sites, held, excluded = jax.tree.map(np.asarray, _limits(scene))
    vertices = np.einsum("jk,jkc->jc", sites.weight, np.asarray(position)[sites.nodes])
    middles = 0.5 * (vertices[1:] + vertices[:-1])
    chords = np.diff(vertices, axis=0)
    if contact.idle is not None:
        chords = chords[~contact.idle]
    reach = np.max(held) + np.sqrt(np.max(np.sum(chords**2, 1)))
    a, b = KDTree(middles).query_pairs(reach, output_type="ndarray").T
    found = _between(np, vertices, a, b, sites, contact)
    limit = 0.5 * (held[a] + held[b])
    near = (found.distance < limit) & (found.along >= excluded)
    if contact.idle is not None:
        near = near & ~contact.idle[a] & ~contact.idle[b]
    if not np.any(near):
        return None
    i = np.argmin(np.where(near, found.distance / np.where(limit > 0, limit, 1.0), np.inf))
    diameter = np.mean(sites.diameter[[a[i], b[i]]])
    return Overlap(*map(float, (found.first[i], found.second[i], found.distance[i], limit[i],
                                diameter)))  # fmt: skip


def _known(scene: Scene, state: State) -> bool:
    leaves = jax.tree.leaves((scene.contact, scene.rod, state.position))
    return all_known(leaves)


def overcome(scene: Scene, state: State) -> bool:
    """Whether strands are nearer than the contact can hold them; no in traced code."""
    if scene.contact is None or not _known(scene, state):
        return False
    return deepest(scene, state.position) is not None


def check_apart(scene: Scene, state: State) -> None:
    """Raise ValueError if strands start nearer than the contact can hold them, unless traced."""
    if scene.contact is None or not _known(scene, state):
        return
    scene.contact.check(scene.rod)
    place = deepest(scene, state.position)
    if place is None:
        return
    raise ValueError(
        f"position: the strands at s = {place.first:.4g} and {place.second:.4g} are"
        f" {place.distance:.3g} apart ({place.distance / place.diameter:.2g} diameters), and the"
        f" contact law holds strands that cross no nearer than {place.held:.3g}; start them apart,"
        " or do without contact"
    )
