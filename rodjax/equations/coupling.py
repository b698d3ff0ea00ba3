"""The derivative of the contact forces in a Newton system, pair by pair.

In the matrix it is L K R^T: K the sum of the pairs' derivatives over the vertices in contact, R^T
reads the displacements of those vertices, L puts forces on them into the force balances.
"""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.equations.assembly import Scales
from rodjax.interactions.contact import Contact
from rodjax.interactions.contact_capacities import Capacity, capacities
from rodjax.interactions.contact_forces import forces_and_derivative, gather, vertices_of
from rodjax.interactions.screening import NearPairs
from rodjax.interactions.self_contact import FoundContact, on_nodes
from rodjax.interactions.sites import Sites, interpolate, spread
from rodjax.rods.state import NodeMotion
from rodjax.scenes.holds import Node, with_row


class Coupling(eqx.Module):
    """Derivative of the contact forces, pair by pair, and where it stands in the matrix."""

    sites: Sites
    pairs: NearPairs
    derivative: Float[Array, "q 4 4 3 3"]  # of minus the force by the vertices, scaled
    left: Float[Array, "nodes 9 3"]  # where a force on a node enters its block row
    right: Float[Array, "nodes 9 3"]  # where a node's displacement stands in its block column
    capacities: tuple[Capacity, ...] = eqx.field(static=True)  # sizes with a solver

    def held(self, projectors: Float[Array, "h 6 6"], nodes: tuple[Node, ...]) -> "Coupling":
        """The same contact of a rod that is held so."""
        return dataclasses.replace(self, left=_balances(projectors, nodes, len(self.left)))

    def transpose(self) -> "Coupling":
        """The coupling of the transposed matrix."""
        swapped = jnp.transpose(self.derivative, (0, 2, 1, 4, 3))
        return Coupling(self.sites, self.pairs, swapped, self.right, self.left, self.capacities)

    def symmetric(self) -> "Coupling":
        """The symmetric part, of a rod that nothing holds."""
        turned = jnp.transpose(self.derivative, (0, 2, 1, 4, 3))
        return dataclasses.replace(self, derivative=0.5 * (self.derivative + turned))

    def multiply(self, b: Float[Array, "nodes 9"]) -> Float[Array, "nodes 9"]:
        """L K R^T b, pair by pair."""
        return self.push(interpolate(self.sites, jnp.einsum("jrk,jr->jk", self.right, b)))

    def push(self, moved: Float[Array, "j 3"]) -> Float[Array, "nodes 9"]:
        """L K times displacements of the vertices, pair by pair."""
        index = jnp.stack(vertices_of(self.pairs), 1)
        force = jnp.einsum("qijkl,qjl->qik", self.derivative, moved[index])
        force = gather(self.pairs, force, moved.shape[0])
        return jnp.einsum("jrk,jk->jr", self.left, spread(self.sites, force, len(self.left)))


def _balances(
    projectors: Float[Array, "h 6 6"], nodes: tuple[Node, ...], count: int
) -> Float[Array, "nodes 9 3"]:
    """Where a force enters the block rows of the nodes: nowhere in directions that are held."""
    eye = jnp.eye(9, 3, k=-3, dtype=projectors.dtype)
    left = jnp.broadcast_to(eye[None], (count, 9, 3))
    for node, projector in zip(nodes, projectors, strict=True):
        left = with_row(left, node, eye - jnp.pad(projector[:, :3], ((3, 0), (0, 0))))
    return left


def couple(
    contact: Contact,
    found: FoundContact,
    motion: NodeMotion,
    by_velocity: Float[Array, ""],
    projectors: Float[Array, "h 6 6"],
    nodes: tuple[Node, ...],
    scales: Scales,
) -> tuple[Float[Array, "nodes 6"], Coupling]:
    """What contact exerts on the nodes, and its derivative in a system as `assembly.assemble`'s.

    Velocities follow positions by the factor `by_velocity`.
    """
    sites, pairs = found
    vertices, velocities = (interpolate(sites, x) for x in (motion.position, motion.velocity))
    between = forces_and_derivative(contact, sites, pairs, vertices, velocities, by_velocity)
    assert between.derivative is not None
    count = len(motion.position)
    left = _balances(projectors, nodes, count)
    coupling = Coupling(
        sites,
        pairs,
        scales.length / scales.force * between.derivative,
        left,
        jnp.broadcast_to(jnp.eye(9, 3, dtype=left.dtype)[None], left.shape),
        capacities(contact, count - 1),
    )
    return on_nodes(spread(sites, between.force, count)), coupling
