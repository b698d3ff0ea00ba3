"""Self-contact: its parameters, and how the rod is divided for it.

For contact the rod is a chain of equal segments of its own, whatever the grid: their joints move
with the nodes beside them, and each segment carries a few quadrature points. `screening` finds
the segments near each other, `contact_forces` sums the law over the points of such pairs.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from rodjax.contact_laws import AbstractLaw
from rodjax.rod import Rod
from rodjax.validation import as_float, as_float_or_none


class Contact(eqx.Module):
    """Which parts of the rod interact, and by what law.

    Args:
        law: the pair interaction.
        segments: number of equal segments the rod is divided into for contact. They set the cost,
            which does not grow with the grid; chords of the grid's own length are a good choice.
        cutoff: no force beyond this distance of the centrelines [m].
        points_per_segment: quadrature points of a segment. Their spacing h must resolve the law:
            for a force ripple under 2 %, h <= d/3 and h <= sqrt(2 d w)/2, with d the settled
            distance and w = |psi/psi'| there.
        aperture: screening aperture theta [rad] (Fig. 4): a pair acts if the line between the
            points lies within theta/2 of either cross-section plane. 0 is the plane, pi all
            space. The force fades smoothly from the plane to the aperture's edge, and to the
            cut-off over the last `edge` of the distance.
        exclusion: points closer than this along the rod never interact [m]; default 1.5 cutoff.
            Must not be less than the cut-off, or a straight rod would repel itself.
        capacities: numbers of joints in contact for which a solver is compiled, increasing; the
            smallest that fits is used at each step, and a run that outgrows the largest says so.
            Default: 64, 128 and on by doubling up to all joints. Under `vmap` give one.
        pairs_per_segment: capacity of the list of near pairs, per joint of `capacities`.
    """

    law: AbstractLaw
    segments: int = eqx.field(static=True)
    cutoff: Float[Array, ""] = eqx.field(converter=as_float)
    points_per_segment: int = eqx.field(static=True, default=4)
    aperture: Float[Array, ""] = eqx.field(converter=as_float, default=np.pi / 2)
    edge: Float[Array, ""] = eqx.field(converter=as_float, default=0.25)
    exclusion: Float[Array, ""] | None = eqx.field(converter=as_float_or_none, default=None)
    capacities: tuple[int, ...] | None = eqx.field(static=True, default=None)
    pairs_per_segment: int = eqx.field(static=True, default=4)

    def __check_init__(self):
        least = {"segments": 2, "points_per_segment": 1, "pairs_per_segment": 1}
        for name, low in least.items():
            value = getattr(self, name)
            if not isinstance(value, int) or value < low:
                raise ValueError(f"{name}: must be an integer of at least {low}, got {value}")
        ranges = {
            "cutoff": (self.cutoff, 0, np.inf),
            "aperture": (self.aperture, 0, np.pi),
            "edge": (self.edge, 0, 1),
        }
        for name, (value, low, high) in ranges.items():
            if isinstance(value, jax.core.Tracer) or not hasattr(value, "shape"):
                continue
            if not np.all((np.asarray(value) > low) & (np.asarray(value) <= high)):
                raise ValueError(f"{name}: must be in ({low:g}, {high:g}], got {value}")
        traced = any(isinstance(x, jax.core.Tracer) for x in (self.exclusion, self.cutoff))
        concrete = self.exclusion is not None and not traced and hasattr(self.exclusion, "shape")
        if concrete and np.any(np.asarray(self.exclusion) < np.asarray(self.cutoff)):
            raise ValueError(
                f"cutoff: {self.cutoff} exceeds the excluded neighbour distance"
                f" {self.exclusion}; a straight rod would repel itself: raise `exclusion`"
            )
        sizes = self.capacities
        if sizes is not None and (list(sizes) != sorted(set(sizes)) or not sizes or sizes[0] < 2):
            raise ValueError(f"capacities: must increase from 2 at least, got {sizes}")

    def check(self, rod: Rod) -> None:
        """Raise ValueError where the rod lacks what contact needs."""
        if rod.diameter is None:
            raise ValueError("diameter: contact needs the rod's diameter; give it to the section")
        if self.law.uses_mass() and rod.mass is None:
            raise ValueError("mass: this contact law scales with the rod's mass per length")
        length = jnp.sum(rod.length)
        reach = self.excluded
        if any(isinstance(x, jax.core.Tracer) for x in (length, reach)):
            return
        if np.any(np.asarray(reach) >= np.asarray(length)):
            raise ValueError("exclusion: as long as the rod; no two points could interact")
        # partners of a joint on one strand beside it, at the worst distance, each pair once
        needed = contact_reach(self) / (length / self.segments) + 1
        if isinstance(needed, jax.core.Tracer):
            return
        if np.any(np.asarray(needed) > self.pairs_per_segment):
            raise ValueError(
                f"pairs_per_segment: {self.pairs_per_segment} cannot hold the pairs within the"
                f" cut-off; raise it to {int(np.ceil(np.max(np.asarray(needed))))}, or use fewer"
                " segments or a smaller cut-off"
            )

    @property
    def excluded(self) -> Float[Array, ""]:
        """Arc distance below which points never interact."""
        return 1.5 * self.cutoff if self.exclusion is None else self.exclusion

    @property
    def sizes(self) -> tuple[int, ...]:
        """Numbers of joints for which a solver is compiled."""
        joints = self.segments + 1
        if self.capacities is not None:
            return tuple(sorted({min(size, joints) for size in self.capacities}))
        sizes = [64]
        while sizes[-1] < joints:
            sizes.append(2 * sizes[-1])
        # each size costs compile time: none that nearly is all joints
        return (*[size for size in sizes if size < 0.7 * joints], joints)


class Level(NamedTuple):
    """What a solver of Newton's system is compiled for. Static numbers."""

    joints: int  # in contact, at most
    pairs: int  # of segments in the list
    nodes: int | None  # between which the joints lie; None: of no use, joints are fewer


def levels(contact: Contact, elements: int) -> tuple[Level, ...]:
    """The sizes of `Contact` on a grid.

    Contact couples the joints that it touches, or the nodes between which these lie, whichever
    are fewer. Of nodes a stretch of joints has its share of the grid and up to four more.
    """
    finer = contact.segments > elements

    def level(joints):
        share = -(-joints * elements // contact.segments) + 16
        nodes = min(elements + 1, share) if finer else None
        return Level(joints, contact.pairs_per_segment * joints, nodes)

    return tuple(map(level, contact.sizes))


def contact_reach(contact: Contact) -> Float[Array, ""]:
    """How far along a parallel strand a point can have partners [m]."""
    return contact.cutoff * jnp.sin(0.5 * contact.aperture)


class Sites(NamedTuple):
    """Where joints and points lie on the grid."""

    nodes: Int[Array, "j k"]  # between which a joint is interpolated, k = 4 or all of them
    weight: Float[Array, "j k"]  # of each
    arc_length: Float[Array, "g p"]  # of the points of every segment
    spacing: Float[Array, ""]  # of the points
    diameter: Float[Array, "g p"]
    mass: Float[Array, "g p"] | None


def sites(contact: Contact, rod: Rod) -> Sites:
    """Joints at equal arcs, points at the middles of equal parts of every segment.

    Joints lie on the cubic through the four nodes nearest to them: on the elements' chords they
    would be off by kappa l^2/8, which in a tight loop is as much as a strand gives way.
    """
    total = jnp.sum(rod.length)
    spacing = total / (contact.segments * contact.points_per_segment)
    nodes = rod.arc_length

    def element(s):
        # comparing with all nodes compiles far faster than a binary search, and is done once a step
        place = jnp.searchsorted(nodes, s, side="right", method="compare_all")
        return jnp.clip(place - 1, 0, rod.elements - 1)

    joints = total / contact.segments * jnp.arange(contact.segments + 1, dtype=total.dtype)
    stencil = min(4, rod.elements + 1)
    first = jnp.clip(element(joints) - 1, 0, rod.elements + 1 - stencil)
    chosen = first[:, None] + jnp.arange(stencil, dtype=first.dtype)[None]
    index = jnp.arange(contact.segments * contact.points_per_segment, dtype=total.dtype)
    s = ((index + 0.5) * spacing).reshape(contact.segments, contact.points_per_segment)
    at = element(s)
    mass = None if rod.mass is None else rod.mass[at]
    assert rod.diameter is not None
    weight = _lagrange(nodes[chosen], joints[:, None])
    return Sites(chosen, weight, s, spacing, rod.diameter[at], mass)


def _lagrange(nodes: Float[Array, "j k"], s: Float[Array, "j 1"]) -> Float[Array, "j k"]:
    """Weights at s of the values at the nodes, for the polynomial through them."""
    own = jnp.eye(nodes.shape[1], dtype=bool)
    apart = jnp.where(own, 1.0, nodes[:, :, None] - nodes[:, None, :])
    return jnp.prod(jnp.where(own, 1.0, (s - nodes)[:, None, :] / apart), 2)


def interpolate(where: Sites, nodal: Float[Array, "nodes c"]) -> Float[Array, "j c"]:
    """Values at the joints."""
    return jnp.sum(where.weight[:, :, None] * nodal[where.nodes], 1)


def spread(where: Sites, values: Float[Array, "j c"], nodes: int) -> Float[Array, "nodes c"]:
    """The transpose of `interpolate`: forces on joints to forces on nodes."""
    out = jnp.zeros((nodes, values.shape[1]), values.dtype)
    return out.at[where.nodes].add(where.weight[:, :, None] * values[:, None, :])
