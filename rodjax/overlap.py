"""Strands nearer to each other than their contact law can hold them.

Long strands that cross at the angle alpha at a distance x push each other apart by the double
integral of the law over both,

    F(x) = 2 pi x phi(x) / sin(alpha),

phi the law's potential counted from the cut-off. Solids that give way, as a penalty does, have a
largest F, and so has every law that is continued below its smallest distance. Nearer than where it
is, the strands are held the less the deeper they are in each other: they pass, or have passed.

This is looked at outside traced code, in the states of a run, and costs its steps nothing.
"""

from typing import NamedTuple

import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.spatial import KDTree

from rodjax.compilation import compiled
from rodjax.contact import Contact, Sites, sites
from rodjax.contact_energy import pair_energy
from rodjax.contact_laws import PairProperties
from rodjax.scene import Scene
from rodjax.state import State

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
    parts = jnp.linspace(0.0, 1.0, _TRIED).reshape(-1, *[1] * pair.diameter.ndim)
    low = _LEAST * pair.diameter[None]
    tried = low * (contact.cutoff / low) ** parts
    force = crossing_force(contact, tried, jax.tree.map(lambda v: v[None], pair))
    place = jnp.take_along_axis(tried, jnp.argmax(force, 0)[None], 0)[0]
    return jnp.where(jnp.max(force, 0) > 0, place, 0.0)


class _Limits(NamedTuple):
    where: Sites
    held: Float[Array, " g"]  # of each segment
    excluded: Float[Array, ""]


@compiled
def _limits(scene: Scene) -> _Limits:
    contact = scene.contact
    assert contact is not None
    where = sites(contact, scene.rod, scene.closed)
    middle = lambda v: v[:, v.shape[1] // 2]
    mass = None if where.mass is None else middle(where.mass)
    held = least_held(contact, PairProperties(middle(where.diameter), mass))
    return _Limits(where, held, contact.excluded)


def first_overlap(scene: Scene, positions) -> tuple[int, Overlap] | None:
    """The first of some configurations (k, nodes, 3) with strands too near, and where; or None."""
    contact = scene.contact
    if contact is None:
        return None
    limits = jax.tree.map(np.asarray, _limits(scene))
    where = limits.where
    for k, position in enumerate(np.asarray(positions)):
        if not np.all(np.isfinite(position)):
            continue
        joints = np.einsum("jk,jkc->jc", where.weight, position[where.nodes])
        found = _nearest(contact, limits, joints)
        if found is not None:
            return k, found
    return None


def _nearest(contact: Contact, limits: _Limits, joints) -> Overlap | None:
    """The two segments deepest in each other, of those that are too near."""
    held, where = limits.held, limits.where
    chords = joints[1:] - joints[:-1]
    reach = np.max(held) + np.sqrt(np.max(np.sum(chords**2, 1)))
    middles = 0.5 * (joints[1:] + joints[:-1])
    pairs = KDTree(middles).query_pairs(reach, output_type="ndarray")
    length = float(where.spacing) * contact.points_per_segment
    around = np.inf if where.around is None else float(where.around)
    apart = np.abs(pairs[:, 1] - pairs[:, 0])
    apart = np.minimum(apart, around / length - apart)
    pairs = pairs[(apart + 1) * length >= limits.excluded]
    if not len(pairs):
        return None
    a, b = pairs.T
    u, v, distance = _closest(joints[a], chords[a], joints[b], chords[b])
    first, second = (a + u) * length, (b + v) * length
    along = np.abs(second - first)
    along = np.minimum(along, around - along)
    limit = 0.5 * (held[a] + held[b])
    near = (distance < limit) & (along >= limits.excluded)
    if not np.any(near):
        return None
    i = np.argmin(np.where(near, distance / np.where(limit > 0, limit, 1.0), np.inf))
    diameter = np.mean(where.diameter[[a[i], b[i]]])
    return Overlap(*map(float, (first[i], second[i], distance[i], limit[i], diameter)))


def _closest(p, d, q, e):
    """Where the segments p + u d and q + v e are nearest, 0 <= u, v <= 1, and their distance."""
    dot = lambda x, y: np.sum(x * y, 1)
    dd, de, ee, r = dot(d, d), dot(d, e), dot(e, e), p - q
    determinant = dd * ee - de**2
    skew = determinant > 1e-12 * dd * ee
    u = np.where(skew, de * dot(e, r) - ee * dot(d, r), 0.0) / np.where(skew, determinant, 1.0)
    v = (de * np.clip(u, 0, 1) + dot(e, r)) / ee
    v = np.clip(v, 0, 1)
    u = np.clip((de * v - dot(d, r)) / dd, 0, 1)
    return u, v, np.sqrt(np.sum((r + u[:, None] * d - v[:, None] * e) ** 2, 1))


def _known(scene: Scene, state: State) -> bool:
    leaves = jax.tree.leaves((scene.contact, scene.rod, state.position))
    return not any(isinstance(leaf, jax.core.Tracer) for leaf in leaves)


def overcome(scene: Scene, state: State) -> bool:
    """Whether strands are nearer than the contact can hold them; no in traced code."""
    if scene.contact is None or not _known(scene, state):
        return False
    return first_overlap(scene, np.asarray(state.position)[None]) is not None


def check_apart(scene: Scene, state: State) -> None:
    """Raise ValueError if strands start nearer than the contact can hold them, unless traced."""
    if scene.contact is None or not _known(scene, state):
        return
    scene.contact.check(scene.rod)
    found = first_overlap(scene, np.asarray(state.position)[None])
    if found is None:
        return
    _, where = found
    raise ValueError(
        f"position: the strands at s = {where.first:.4g} and {where.second:.4g} are"
        f" {where.distance:.3g} apart ({where.distance / where.diameter:.2g} diameters), and the"
        f" contact law holds strands that cross no nearer than {where.held:.3g}; start them apart,"
        " or do without contact"
    )
