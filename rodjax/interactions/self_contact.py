"""Contact of a rod with itself as one of what acts on it."""

from typing import NamedTuple

import jax.numpy as jnp
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, Float

from rodjax.interactions import contact_duals, contact_energy, contact_forces, screening
from rodjax.interactions.contact import Contact
from rodjax.interactions.contact_law import PairProperties, ignores_approach
from rodjax.interactions.interaction import AbstractInteraction
from rodjax.interactions.roles import Role
from rodjax.interactions.screening import NearPairs
from rodjax.interactions.sites import Sites, sites_of
from rodjax.numerics import newton, rotations
from rodjax.numerics.results import Result, join
from rodjax.rods.state import NodeMotion, at_rest


class FoundContact(NamedTuple):
    """Where the rod can touch itself, and the pairs found near each other."""

    sites: Sites
    pairs: NearPairs


class SelfContact(AbstractInteraction):
    """Contact of the strands of a rod with each other."""

    contact: Contact

    @property
    def role(self):
        return Role.CONTACT

    @property
    def conservative(self):
        return contact_energy.has_potential(self.contact)

    def check(self, rod):
        self.contact.check(rod)

    def find(self, rod, position, displacement=None, closed=False) -> FoundContact:
        sites = sites_of(self.contact, rod, closed)
        pairs = screening.search(self.contact, sites, position, displacement)
        # a reverse pass need not search again
        return FoundContact(sites, checkpoint_name(pairs, newton.SOLUTION))

    def exerted(self, rod, motion, found: FoundContact):
        return on_nodes(contact_forces.forces(self.contact, *found, motion), motion)

    def stored(self, rod, motion, found: FoundContact) -> Float[Array, ""]:
        energy = contact_energy.stored(self.contact, *found, motion.position)
        return jnp.where(self.conservative, energy, 0.0)

    def lost(self, rod, motion, found: FoundContact, exerted):
        resting = exerted
        pair = PairProperties(found.sites.diameter, found.sites.mass)
        rubs = self.contact.friction is not None
        if rubs or not ignores_approach(self.contact.law, pair):
            still = at_rest(*motion[:3])
            resting = self.exerted(rod, still, found)
        return exerted - jnp.where(self.conservative, resting, 0.0)

    def safe_fraction(self, rod, position, change, found: FoundContact):
        return screening.approach_limit(self.contact, *found, position, change)

    @property
    def rubs(self):
        return self.contact.friction is not None

    def first_dual(self, rod, motion, found: FoundContact, before):
        if self.contact.friction is None:
            return None
        return contact_duals.first_duals(self.contact, *found, motion, before)

    def next_dual(self, rod, motion, found: FoundContact):
        if self.contact.friction is None:
            return None
        return contact_duals.next_duals(self.contact, *found, motion)

    def verdict(self, rod, before, after, found: FoundContact):
        passed = screening.passage_suspected(*found, before, after)
        return join(
            jnp.where(passed, Result.STRAND_PASSAGE, Result.SUCCESS),
            jnp.where(found.pairs.overflow, Result.CAPACITY_OVERFLOW, Result.SUCCESS),
        )


def on_nodes(acting: Float[Array, "nodes w"], motion: NodeMotion) -> Float[Array, "nodes 6"]:
    """Wrenches of forces, and of moments in inertial axes if there are any."""
    force = acting[:, :3]
    if acting.shape[1] == 3:
        return jnp.concatenate([force, jnp.zeros_like(force)], 1)
    moment = rotations.rotate_inverse(motion.quaternion, acting[:, 3:])
    return jnp.concatenate([force, moment], 1)
