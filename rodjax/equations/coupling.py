"""The derivative of the contact forces in a Newton system, pair by pair.

In the matrix it is L K R^T: K the sum of the pairs' derivatives over the vertices in contact, R^T
reads the displacements of those vertices, L puts forces on them into the force balances.
"""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from rodjax.equations.assembly import Scales
from rodjax.interactions.contact import Contact
from rodjax.interactions.contact_capacities import Capacity, capacities
from rodjax.interactions.contact_forces import forces_and_derivative, rates_of
from rodjax.interactions.involved import Involved, chosen_first, involve
from rodjax.interactions.pair_points import vertices_of
from rodjax.interactions.screening import NearPairs
from rodjax.interactions.self_contact import FoundContact, on_nodes
from rodjax.interactions.sites import Sites, interpolate, spread
from rodjax.numerics import rotations
from rodjax.rods.rod import Rod
from rodjax.rods.state import NodeMotion
from rodjax.scenes.holds import Node, with_row


class Acting(NamedTuple):
    """Which of the near pairs act, with a derivative that is not zero, and what they involve.

    Strands near each other are many more than touch, where they cross and where they part.
    """

    place: Int[Array, " q"]  # all places of the list, those of pairs that act first
    count: Int[Array, ""]
    capacity: Int[Array, ""]  # 0: no pair; k: the k-th size holds them, see `NearPairs.capacity`
    involved: Involved

    @classmethod
    def of(
        cls,
        acts: Bool[Array, " q"],
        pairs: NearPairs,
        sites: Sites,
        nodes: int,
        sizes: tuple[Capacity, ...],
    ) -> "Acting":
        """Of the pairs so marked.

        A smaller dense system than that for what is near may hold them; a front is of what is near.
        """
        listed = jnp.arange(len(acts), dtype=jnp.int32) < pairs.count
        place, _, count = chosen_first(acts & listed)
        first, second = pairs.first[place], pairs.second[place]
        involved = involve(first, second, count, sites, nodes, sizes)
        fits = involved.fits & jnp.asarray([size.front is None for size in sizes])
        smaller = jnp.minimum(pairs.capacity, jnp.argmax(fits).astype(jnp.int32) + 1)
        capacity = jnp.where(jnp.any(fits), smaller, pairs.capacity)
        return cls(place, count, jnp.where(count == 0, 0, capacity), involved)


class Strand(NamedTuple):
    """How many vertices and nodes one of several rods has."""

    vertices: int
    nodes: int


class Coupling(eqx.Module):
    """Derivative of the contact forces, pair by pair, and where it stands in the matrix."""

    sites: Sites
    pairs: NearPairs
    acting: Acting
    derivative: Float[Array, "q 4 4 w w"]  # of minus the force by the vertices
    # its scales, of the components of a force and of a displacement: applied to sums and not to the
    # list, which is as long as all that might touch
    units: tuple[Float[Array, " w"], Float[Array, " w"]]
    left: Float[Array, "nodes 9 w"]  # where a force on a node enters its block row
    right: Float[Array, "nodes 9 w"]  # where a node's displacement stands in its block column
    capacities: tuple[Capacity, ...] = eqx.field(static=True)  # sizes with a solver
    strands: tuple[Strand, ...] = eqx.field(static=True, default=())  # of several rods

    @property
    def width(self) -> int:
        """Components of what acts on a vertex: 3, or 6 with the moments of friction."""
        return self.left.shape[2]

    @property
    def level(self) -> Int[Array, ""]:
        """Which of the capacities holds the pairs that act; of none the first."""
        return jnp.maximum(self.acting.capacity - 1, 0)

    @property
    def acts(self) -> Bool[Array, ""]:
        """Whether it is not zero."""
        return self.acting.capacity > 0

    def held(self, projectors: Float[Array, "h 6 6"], nodes: tuple[Node, ...]) -> "Coupling":
        """The same contact, without friction, of a rod that is held so."""
        assert self.width == 3
        return dataclasses.replace(self, left=_balances(projectors, nodes, len(self.left)))

    def transpose(self) -> "Coupling":
        """The coupling of the transposed matrix."""
        swapped = jnp.transpose(self.derivative, (0, 2, 1, 4, 3))
        return dataclasses.replace(
            self, derivative=swapped, units=self.units[::-1], left=self.right, right=self.left
        )

    def symmetric(self) -> "Coupling":
        """The symmetric part, of a rod that nothing holds."""
        turned = jnp.transpose(self.derivative, (0, 2, 1, 4, 3))
        return dataclasses.replace(self, derivative=0.5 * (self.derivative + turned))

    def multiply(self, b: Float[Array, "nodes 9"]) -> Float[Array, "nodes 9"]:
        """L K R^T b, pair by pair."""
        return self.push(interpolate(self.sites, jnp.einsum("jrk,jr->jk", self.right, b)))

    def push(
        self, moved: Float[Array, "j w"], capacity: Capacity | None = None
    ) -> Float[Array, "nodes 9"]:
        """L K times displacements of the vertices, pair by pair, of those that a capacity holds."""
        index, derivative = jnp.stack(vertices_of(self.pairs), 1), self.derivative
        if capacity is not None:
            index, derivative = self.first_acting(capacity)
        of_force, of_motion = self.units
        force = jnp.einsum("qijkl,qjl->qik", derivative, (moved * of_motion[None])[index])
        force = jnp.zeros_like(moved).at[index].add(force) * of_force[None]
        return jnp.einsum("jrk,jk->jr", self.left, spread(self.sites, force, len(self.left)))

    def first_acting(
        self, capacity: Capacity
    ) -> tuple[Int[Array, "q 4"], Float[Array, "q 4 4 w w"]]:
        """Vertices and derivative of as many pairs as a capacity holds, those that act first."""
        place = self.acting.place[: capacity.pairs]
        return jnp.stack(vertices_of(self.pairs), 1)[place], self.derivative[place]


def _balances(
    projectors: Float[Array, "h 6 6"],
    nodes: tuple[Node, ...],
    count: int,
    moments: Float[Array, "nodes 3 3"] | None = None,
) -> Float[Array, "nodes 9 w"]:
    """Where a force enters the block rows of the nodes: nowhere in directions that are held.

    Then moments, of these axes, if there are any.
    """
    eye = jnp.eye(9, 3, k=-3, dtype=projectors.dtype)
    left = jnp.broadcast_to(eye[None], (count, 9, 3))
    if moments is not None:
        left = jnp.concatenate([left, jnp.pad(moments, ((0, 0), (6, 0), (0, 0)))], 2)
    for node, projector in zip(nodes, projectors, strict=True):
        taken, whole = projector[:, :3], eye
        if moments is not None:
            taken = jnp.concatenate([taken, projector[:, 3:] @ moments[node]], 1)
            whole = left[node]
        left = with_row(left, node, whole - jnp.pad(taken, ((3, 0), (0, 0))))
    return left


class Following(NamedTuple):
    """How the nodes' rates follow from their increments in a step."""

    by_velocity: Float[Array, ""]  # [1/s]
    increment: Float[Array, "nodes 6"]  # displacements and rotation vectors


def couple(
    contact: Contact,
    rod: Rod,
    found: FoundContact,
    motion: NodeMotion,
    following: Following | None,
    projectors: Float[Array, "h 6 6"],
    nodes: tuple[Node, ...],
    scales: Scales,
) -> tuple[Float[Array, "nodes 6"], Coupling]:
    """What contact exerts on the nodes, and its derivative in a system as `assembly.assemble`'s.

    The moments of friction, of inertial axes in the coupling, also turn with the frames of the
    nodes: see `turned_moments`. At rest (None follows) there is no friction.
    """
    sites, pairs = found
    still = jnp.zeros_like(scales.force)
    by_velocity = still if following is None else following.by_velocity
    rates = rates_of(contact, motion)
    vertices, rates = (interpolate(sites, x) for x in (motion.position, rates))
    between = forces_and_derivative(contact, sites, pairs, vertices, rates, by_velocity)
    assert between.derivative is not None
    count = len(motion.position)
    units = jnp.ones((contact.width,), still.dtype)
    axes, spins = None, None
    if contact.friction is not None:
        assert following is not None
        units = jnp.repeat(jnp.stack([jnp.ones_like(scales.length), 1 / scales.length]), 3)
        axes, spins = _turned(motion, following)
    left = _balances(projectors, nodes, count, axes)
    right = jnp.broadcast_to(jnp.eye(9, 3, dtype=left.dtype)[None], (count, 9, 3))
    if spins is not None:
        right = jnp.concatenate([right, spins], 2)
    at = capacities(contact, count - 1)
    units = scales.length / scales.force * units, units
    assert between.acts is not None
    acting = Acting.of(between.acts, pairs, sites, count, at)
    coupling = Coupling(
        sites, pairs, acting, between.derivative, units, left, right, at, _strands(contact, rod)
    )
    return on_nodes(spread(sites, between.force, count), motion), coupling


def _strands(contact: Contact, rod: Rod) -> tuple[Strand, ...]:
    """How many vertices and nodes each of several rods has."""
    if not rod.breaks:
        return ()
    nodes = (part.last - part.first + 1 for part in rod.strands)
    return tuple(Strand(g + 1, n) for g, n in zip(contact.shared, nodes, strict=True))


def _turned(motion: NodeMotion, following: Following):
    """Where moments enter the rows of the body's, and which columns turn by what spins follow.

    Both are of inertial axes; spins follow rotations by the factor `by_velocity`.
    """
    frames = rotations.matrix(motion.quaternion)
    # of the spin R w, w the body's own, that follows the rotation vector
    carried = rotations.hat(motion.angular_velocity) / following.by_velocity
    followed = frames @ (rotations.tangent_inverse(following.increment[:, 3:]) - carried)
    spins = jnp.pad(jnp.swapaxes(followed, 1, 2), ((0, 0), (6, 0), (0, 0)))
    return jnp.swapaxes(frames, 1, 2), spins


def turned_moments(
    contact: Contact, wrench: Float[Array, "nodes 6"]
) -> Float[Array, "nodes 6 6"] | None:
    """Derivative of minus what contact exerts by the nodes' spins, of moments that keep inertial.

    None without friction, whose moments they are.
    """
    if contact.friction is None:
        return None
    return jnp.pad(-rotations.hat(wrench[:, 3:]), ((0, 0), (3, 0), (3, 0)))
