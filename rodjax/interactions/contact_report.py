"""Contact of one configuration: forces on the nodes, the smallest gap, what friction does."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from rodjax.interactions.contact import Contact
from rodjax.interactions.contact_forces import Rubbed, pair_forces
from rodjax.interactions.screening import search
from rodjax.interactions.sites import interpolate, sites_of, spread
from rodjax.rods.rod import Rod


class ContactReport(NamedTuple):
    """Contact of one configuration.

    Attributes:
        force: on the nodes, inertial components, friction among them [N].
        total: sum of the magnitudes of all forces between points, without friction [N].
        smallest: least d/D, distance over diameter, of the points that act; infinite without one.
        overflow: pairs were left out; raise the contact's `capacities` or `pairs_per_segment`.
        friction: sum of its magnitudes between points [N].
        mobilised: that over the sum of its limits, mu times `total`; 0 where nothing touches.
        power: that it takes away [W].
    """

    force: Float[Array, "nodes 3"]
    total: Float[Array, ""]
    smallest: Float[Array, ""]
    overflow: Bool[Array, ""]
    friction: Float[Array, ""]
    mobilised: Float[Array, ""]
    power: Float[Array, ""]


def report(
    contact: Contact,
    rod: Rod,
    position: Float[Array, "nodes 3"],
    velocity: Float[Array, "nodes 3"],
    closed: bool | Bool[Array, ""] = False,
    spin: Float[Array, "nodes 3"] | None = None,
) -> ContactReport:
    """Contact forces and the smallest gap of a configuration, by a search of its own.

    Args:
        closed: whether the rod's ends are at one place, see `Scene.closed`.
        spin: angular velocities, inertial axes, which friction asks for [rad/s].
    """
    contact = contact.fitted(rod)
    sites = sites_of(contact, rod, closed)
    pairs = search(contact, sites, position)
    rates = velocity
    if contact.friction is not None:
        if spin is None:
            raise ValueError("spin: contact with friction asks for the nodes' angular velocities")
        rates = jnp.concatenate([velocity, spin], 1)
    vertices = interpolate(sites, position)
    found = pair_forces(contact, sites, pairs, vertices, interpolate(sites, rates))
    nodal = spread(sites, found.force, rod.elements + 1)[:, :3]
    zero = jnp.zeros_like(found.total)
    rubbed = Rubbed(zero, zero, zero) if found.rubbed is None else found.rubbed
    touches = rubbed.limit > 0
    mobilised = jnp.where(touches, rubbed.force / jnp.where(touches, rubbed.limit, 1.0), 0.0)
    own = rubbed.force, mobilised, rubbed.power
    return ContactReport(nodal, found.total, found.smallest, pairs.overflow, *own)
