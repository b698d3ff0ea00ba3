"""Newton systems whose block-tridiagonal matrix is coupled by contact between distant nodes.

The matrix is A + L K R^T: A block tridiagonal, K the sum of the pairs' derivatives over the
joints in contact (3m x 3m), R^T reads the displacements of those joints, L puts forces on them
into the force balances. Eliminating A leaves a dense system of 3m unknowns (Woodbury's identity
in the form that needs no inverse of K). Where the grid is coarser than the contact's segments, the
nodes between which the joints lie take the joints' place: they are fewer.
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from rodjax.balance import Scales
from rodjax.batching import one_by_one
from rodjax.block_tridiagonal import BlockTridiagonal, Factors
from rodjax.contact import Contact, Level, Sites, interpolate, levels, sites, spread
from rodjax.contact_forces import forces_and_derivative, gather, joints_of
from rodjax.loads import NodeMotion
from rodjax.scene import Scene
from rodjax.screening import Near, search


class Nearby(NamedTuple):
    """Where the rod can touch itself, and the pairs found near each other."""

    where: Sites
    near: Near


def find_nearby(scene: Scene, position: Float[Array, "nodes 3"], displacement=None) -> Nearby:
    """Search for contact, before a motion of the expected displacement if one is given."""
    assert scene.contact is not None
    where = sites(scene.contact, scene.rod)
    return Nearby(where, search(scene.contact, where, position, displacement))


class Coupling(eqx.Module):
    """Derivative of the contact forces, pair by pair, and where it stands in the matrix."""

    where: Sites
    near: Near
    derivative: Float[Array, "q 4 4 3 3"]  # of minus the force by the joints, scaled
    left: Float[Array, "nodes 9 3"]  # where a force on a node enters its block row
    right: Float[Array, "nodes 9 3"]  # where a node's displacement stands in its block column
    levels: tuple[Level, ...] = eqx.field(static=True)  # sizes with a solver

    def transpose(self) -> "Coupling":
        """The coupling of the transposed matrix."""
        swapped = jnp.transpose(self.derivative, (0, 2, 1, 4, 3))
        return Coupling(self.where, self.near, swapped, self.right, self.left, self.levels)

    def matrix(self, level: Level) -> Float[Array, "k k"]:
        """K of the joints in contact, or of their nodes."""
        size = level.joints
        rank = jnp.stack(
            [self.near.rank[joint[: level.pairs]] for joint in joints_of(self.near)], 1
        )
        # scattered by whole blocks, which is faster than by numbers
        blocks = jnp.zeros((size, size, 3, 3), self.derivative.dtype)
        index = (rank[:, :, None], rank[:, None, :])
        blocks = blocks.at[index].add(self.derivative[: level.pairs], mode="drop")
        if self.near.nodes is not None:
            weight = self.weights(size)[self.near.nodes[: level.nodes]]
            blocks = jnp.einsum("na,abij,mb->nmij", weight, blocks, weight)
        return jnp.swapaxes(blocks, 1, 2).reshape(3 * blocks.shape[0], -1)

    def weights(self, size: int) -> Float[Array, "nodes m"]:
        """Interpolation weights of the first joints, those in contact among them, at the nodes."""
        chosen = self.near.order[:size]
        node = jnp.arange(self.left.shape[0])[:, None, None]
        at = node == self.where.nodes[chosen]
        return jnp.sum(jnp.where(at, self.where.weight[chosen], 0.0), 2)

    def places(self, level: Level) -> Float[Array, "nodes m"]:
        """Weights at the nodes of what K couples: joints, or the nodes themselves."""
        if self.near.nodes is None:
            return self.weights(level.joints)
        chosen = jnp.arange(self.left.shape[0])[:, None] == self.near.nodes[: level.nodes]
        return chosen.astype(self.left.dtype)

    def read(self, columns: Float[Array, "nodes 9 c"], level: Level) -> Float[Array, "k c"]:
        """R^T times columns: displacements of the joints in contact, or of their nodes."""
        nodal = jnp.einsum("nrk,nrc->nkc", self.right, columns)
        if self.near.nodes is None:
            chosen = self.near.order[: level.joints]
            at, weight = self.where.nodes[chosen], self.where.weight[chosen]
            found = jnp.einsum("mj,mjkc->mkc", weight, nodal[at])
        else:
            found = nodal[self.near.nodes[: level.nodes]]
        return found.reshape(-1, columns.shape[2])

    def multiply(self, b: Float[Array, "nodes 9"]) -> Float[Array, "nodes 9"]:
        """L K R^T b, pair by pair."""
        moved = interpolate(self.where, jnp.einsum("jrk,jr->jk", self.right, b))
        index = jnp.stack(joints_of(self.near), 1)
        force = jnp.einsum("qijkl,qjl->qik", self.derivative, moved[index])
        force = gather(self.near, force, moved.shape[0])
        return jnp.einsum("jrk,jk->jr", self.left, spread(self.where, force, b.shape[0]))


def couple(
    contact: Contact | None,
    nearby: Nearby | None,
    motion: NodeMotion,
    by_velocity: Float[Array, ""],
    projectors: Float[Array, "2 6 6"],
    scales: Scales,
) -> tuple[Float[Array, "nodes 3"] | None, Coupling | None]:
    """Contact forces on the nodes [N], and their derivative in a system as `balance.assemble`'s.

    Velocities follow positions by the factor `by_velocity`. (None, None) without contact.
    """
    if contact is None or nearby is None:
        return None, None
    where, near = nearby
    joints, velocities = (interpolate(where, x) for x in (motion.position, motion.velocity))
    found = forces_and_derivative(contact, where, near, joints, velocities, by_velocity)
    assert found.derivative is not None
    nodes, dtype = motion.position.shape[0], motion.position.dtype
    eye = jnp.zeros((9, 3), dtype).at[3:6].set(jnp.eye(3, dtype=dtype))
    left = jnp.broadcast_to(eye, (nodes, 9, 3))
    ends = jnp.stack([left[0], left[-1]]).at[:, 3:].add(-projectors[:, :, :3])
    left = jnp.concatenate([ends[:1], left[1:-1], ends[1:]])
    coupling = Coupling(
        where,
        near,
        scales.length / scales.force * found.derivative,
        left,
        jnp.broadcast_to(jnp.roll(eye, -3, axis=0), left.shape),
        levels(contact, nodes - 1),
    )
    return spread(where, found.force, nodes), coupling


class CoupledSystem(eqx.Module):
    """A block-tridiagonal matrix with a coupling, or without (None)."""

    blocks: BlockTridiagonal
    coupling: Coupling | None = None

    def transpose(self) -> "CoupledSystem":
        """The transposed system."""
        coupling = None if self.coupling is None else self.coupling.transpose()
        return CoupledSystem(self.blocks.transpose(), coupling)

    def solve(self, b: Float[Array, "nodes 9"]) -> Float[Array, "nodes 9"]:
        """Solution of the system. Under `vmap` over b alone the matrix is eliminated once."""
        if self.coupling is None:
            return _solve_columns(self.blocks.factorize(), b)
        return _solve_shared(self, b)

    def solve_transpose(self, b: Float[Array, "nodes 9"]) -> Float[Array, "nodes 9"]:
        """Solution of the transposed system."""
        return self.transpose().solve(b)

    def multiply(self, b: Float[Array, "nodes 9"]) -> Float[Array, "nodes 9"]:
        """Matrix times vector."""
        product = self.blocks.multiply(b[:, :, None])[:, :, 0]
        return product if self.coupling is None else product + self.coupling.multiply(b)


def _solve(system: CoupledSystem, b):
    coupling = system.coupling
    assert coupling is not None
    return lax.cond(coupling.near.level > 0, _touching, _apart, system, b)


def _apart(system: CoupledSystem, b):
    return _solve_columns(system.blocks.factorize(), b)


def _touching(system: CoupledSystem, b):
    """Solution, by the smallest solver that holds the joints in contact."""
    coupling = system.coupling
    assert coupling is not None

    def some(level):
        return lambda b, factors: _solve_coupled(factors, coupling, level, b)

    branches = [some(level) for level in coupling.levels]
    return lax.switch(coupling.near.level - 1, branches, b, system.blocks.factorize())


def _not_touching(system: CoupledSystem, b):
    assert system.coupling is not None
    return system.coupling.near.level == 0


_solve_shared = one_by_one(_solve, (_not_touching, _apart))


class Touching(NamedTuple):
    """A Newton system and residual still without contact, and what contact adds to them."""

    blocks: BlockTridiagonal
    residual: Float[Array, "nodes 9"]
    contact: Contact
    nearby: Nearby
    motion: NodeMotion
    by_velocity: Float[Array, ""]
    projectors: Float[Array, "2 6 6"]
    scales: Scales
    needed: Bool[Array, ""]  # otherwise any finite increment will do


def increment(given: Touching) -> Float[Array, "nodes 9"]:
    """Newton's increment with contact: forces and their derivative in time that follows the pairs.

    Where nothing is near, nothing of contact is evaluated. Without derivative.
    """
    return _increment(given)


def _increment_of_one(given: Touching):
    near = given.nearby.near
    case = jnp.where(given.needed, jnp.where(near.level > 0, 2, 1), 0)
    nothing = lambda given: jnp.zeros_like(given.residual)
    return lax.switch(case, [nothing, _increment_apart, _increment_touching], given)


def _increment_apart(given: Touching):
    return given.blocks.solve(-given.residual)


def _increment_touching(given: Touching):
    contact, nearby, scales = given.contact, given.nearby, given.scales
    push, coupling = couple(
        contact, nearby, given.motion, given.by_velocity, given.projectors, scales
    )
    assert push is not None and coupling is not None
    right = jnp.einsum("jrk,jk->jr", coupling.left, push / scales.force) - given.residual
    return _touching(CoupledSystem(given.blocks, coupling), right)


def _increment_easy(given: Touching):
    return (given.nearby.near.level == 0) | ~given.needed


_increment = one_by_one(_increment_of_one, (_increment_easy, _increment_apart))


def _solve_columns(factors: Factors, b: Float[Array, "nodes 9"]) -> Float[Array, "nodes 9"]:
    return factors.solve(b[:, :, None])[:, :, 0]


def _solve_coupled(factors: Factors, coupling: Coupling, level: Level, b):
    """Solve with m joints or nodes in contact: 3m columns through A, then a dense system."""
    places = coupling.places(level)
    m = 3 * places.shape[1]

    def forward(previous, row):
        lower, entry, place = row
        columns = (entry[:, None, :] * place[None, :, None]).reshape(9, m)
        current = columns - lower @ previous
        return current, current

    def backward(following, row):
        upper, middle = row
        current = middle - upper @ following
        return current, current

    zero = jnp.zeros((9, m), b.dtype)
    entries = factors.inverse @ coupling.left
    _, middle = lax.scan(forward, zero, (factors.lower, entries, places))
    _, columns = lax.scan(backward, zero, (factors.upper, middle), reverse=True)
    matrix = coupling.matrix(level)
    system = jnp.eye(m, dtype=b.dtype) + coupling.read(columns, level) @ matrix
    # b by itself, so that vmap over b leaves the columns alone
    free = _solve_columns(factors, b)
    displacement = jnp.linalg.solve(system, coupling.read(free[:, :, None], level)[:, 0])
    return free - columns @ (matrix @ displacement)
