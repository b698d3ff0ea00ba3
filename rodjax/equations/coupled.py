"""Newton systems whose block-tridiagonal matrix is coupled by contact between distant nodes.

The matrix is A + L K R^T: A block tridiagonal, K the sum of the pairs' derivatives over the
joints in contact (3m x 3m), R^T reads the displacements of those joints, L puts forces on them
into the force balances. Eliminating A leaves a dense system of 3m unknowns (Woodbury's identity
in the form that needs no inverse of K); its factors serve for several right sides. Where the grid
is coarser than the contact's segments, the nodes between which the joints lie take the joints'
place: they are fewer.
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from rodjax.interactions.contact import Contact, Level, Sites, interpolate, levels, sites, spread
from rodjax.interactions.contact_forces import forces_and_derivative, gather, joints_of
from rodjax.interactions.screening import Near, search
from rodjax.numerics.batching import one_by_one
from rodjax.numerics.block_tridiagonal import BlockTridiagonal, Factors
from rodjax.rods.balance import Scales
from rodjax.rods.state import NodeMotion
from rodjax.scenes.scene import Scene


class Nearby(NamedTuple):
    """Where the rod can touch itself, and the pairs found near each other."""

    where: Sites
    near: Near


def find_nearby(scene: Scene, position: Float[Array, "nodes 3"], displacement=None) -> Nearby:
    """Search for contact, before a motion of the expected displacement if one is given."""
    assert scene.contact is not None
    where = sites(scene.contact, scene.rod, scene.closed)
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

    def rows(self, level: Level) -> Float[Array, "nodes 3 k"]:
        """Forces on all nodes by displacements of the joints in contact, or of their nodes."""
        size = level.joints
        rank = jnp.stack(
            [self.near.rank[joint[: level.pairs]] for joint in joints_of(self.near)], 1
        )
        # scattered by whole blocks, which is faster than by numbers
        blocks = jnp.zeros((size, size, 3, 3), self.derivative.dtype)
        index = (rank[:, :, None], rank[:, None, :])
        blocks = blocks.at[index].add(self.derivative[: level.pairs], mode="drop")
        weight = self.weights(size)
        if self.near.nodes is None:
            columns = jnp.swapaxes(blocks, 1, 2).reshape(size, 9 * size)
            return (weight @ columns).reshape(-1, 3, 3 * size)
        chosen = self.near.nodes[: level.nodes]
        weight = weight[chosen]
        rows = jnp.einsum("na,abij,mb->nmij", weight, blocks, weight)
        rows = jnp.swapaxes(rows, 1, 2).reshape(-1, 3, 3 * weight.shape[0])
        return jnp.zeros((self.left.shape[0], *rows.shape[1:]), rows.dtype).at[chosen].set(rows)

    def weights(self, size: int) -> Float[Array, "nodes m"]:
        """Interpolation weights of the first joints, those in contact among them, at the nodes."""
        chosen = self.near.order[:size]
        node = jnp.arange(self.left.shape[0], dtype=jnp.int32)[:, None, None]
        at = node == self.where.nodes[chosen][None]
        return jnp.sum(jnp.where(at, self.where.weight[chosen][None], 0.0), 2)

    def read(self, nodal: Float[Array, "nodes 3 c"], level: Level) -> Float[Array, "k c"]:
        """Displacements of the joints in contact, or of their nodes, from those of all nodes."""
        if self.near.nodes is None:
            chosen = self.near.order[: level.joints]
            at, weight = self.where.nodes[chosen], self.where.weight[chosen]
            # term by term, since XLA would store the gathered nodes of all terms
            terms = [weight[:, j, None, None] * nodal[at[:, j]] for j in range(at.shape[1])]
            found = sum(terms[1:], terms[0])
        else:
            found = nodal[self.near.nodes[: level.nodes]]
        return found.reshape(-1, nodal.shape[2])

    def joints(self, displacement: Float[Array, " k"], level: Level) -> Float[Array, "j 3"]:
        """Displacements of all joints from those of the joints in contact, or of their nodes."""
        given = displacement.reshape(-1, 3)
        if self.near.nodes is None:
            every = jnp.zeros((self.near.order.shape[0], 3), given.dtype)
            return every.at[self.near.order[: level.joints]].set(given)
        nodal = jnp.zeros((self.left.shape[0], 3), given.dtype)
        return interpolate(self.where, nodal.at[self.near.nodes[: level.nodes]].set(given))

    def multiply(self, b: Float[Array, "nodes 9"]) -> Float[Array, "nodes 9"]:
        """L K R^T b, pair by pair."""
        return self.push(interpolate(self.where, jnp.einsum("jrk,jr->jk", self.right, b)))

    def push(self, moved: Float[Array, "j 3"]) -> Float[Array, "nodes 9"]:
        """L K times displacements of the joints, pair by pair."""
        index = jnp.stack(joints_of(self.near), 1)
        force = jnp.einsum("qijkl,qjl->qik", self.derivative, moved[index])
        force = gather(self.near, force, moved.shape[0])
        return jnp.einsum("jrk,jk->jr", self.left, spread(self.where, force, len(self.left)))


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
            return _solve_apart(self, b)
        return _solve(self, b)

    def eliminate(self) -> "Eliminated":
        """The system, its pairs in contact if it has any, ready for any number of right sides."""
        factors, coupling = self.blocks.factorize(), self.coupling
        if coupling is None:
            return Eliminated(factors)
        levels = coupling.levels
        largest = _unknowns(levels[-1])

        def dense(level):
            def factorized(factors, coupling):
                k = _unknowns(level)
                response = _response(factors, coupling, level)
                lu, _, order = lax.linalg.lu(jnp.eye(k, dtype=response.dtype) + response)
                return jnp.pad(lu, (0, largest - k)), jnp.pad(order, (0, largest - k))

            return factorized

        branches = [dense(level) for level in levels]
        lu, order = lax.switch(coupling.near.level - 1, branches, factors, coupling)
        return Eliminated(factors, coupling, lu, order)

    def solve_transpose(self, b: Float[Array, "nodes 9"]) -> Float[Array, "nodes 9"]:
        """Solution of the transposed system."""
        return self.transpose().solve(b)

    def multiply(self, b: Float[Array, "nodes 9"]) -> Float[Array, "nodes 9"]:
        """Matrix times vector."""
        product = self.blocks.multiply(b[:, :, None])[:, :, 0]
        return product if self.coupling is None else product + self.coupling.multiply(b)


class Eliminated(eqx.Module):
    """Factors of a system: of A, and of I + R^T A^-1 L K (padded with zeros) if it is coupled."""

    factors: Factors
    coupling: Coupling | None = None
    lu: Float[Array, "k k"] | None = None
    order: Int[Array, " k"] | None = None  # of the rows of the latter

    def solve(self, b: Float[Array, "nodes 9"]) -> Float[Array, "nodes 9"]:
        """Solution A^-1 (b - L K d), where d, displacements in contact, obey the dense system."""
        coupling = self.coupling
        free = _solve_columns(self.factors, b)
        if coupling is None:
            return free

        def moved(level):
            def joints(free, lu, order):
                k = _unknowns(level)
                nodal = jnp.einsum("nrk,nr->nk", coupling.right, free)
                right = coupling.read(nodal[:, :, None], level)[order[:k]]
                for lower in (True, False):
                    right = lax.linalg.triangular_solve(
                        lu[:k, :k], right, left_side=True, lower=lower, unit_diagonal=lower
                    )
                return coupling.joints(right[:, 0], level)

            return joints

        branches = [moved(level) for level in coupling.levels]
        joints = lax.switch(coupling.near.level - 1, branches, free, self.lu, self.order)
        return free - _solve_columns(self.factors, coupling.push(joints))


def _solve_one(system: CoupledSystem, b):
    assert system.coupling is not None
    touching = lambda system, b: system.eliminate().solve(b)
    return lax.cond(system.coupling.near.level > 0, touching, _solve_apart, system, b)


def _solve_apart(system: CoupledSystem, b):
    return _solve_columns(system.blocks.factorize(), b)


def _not_touching(system: CoupledSystem, b):
    assert system.coupling is not None
    return system.coupling.near.level == 0


_solve = one_by_one(_solve_one, (_not_touching, _solve_apart))


def _solve_columns(factors: Factors, b: Float[Array, "nodes 9"]) -> Float[Array, "nodes 9"]:
    return factors.solve(b[:, :, None])[:, :, 0]


def _unknowns(level: Level) -> int:
    """Size of the dense system."""
    return 3 * (level.joints if level.nodes is None else level.nodes)


def _response(factors: Factors, coupling: Coupling, level: Level) -> Float[Array, "k k"]:
    """R^T A^-1 L K: displacements in contact by the forces that such displacements cause."""
    # A^-1 (L K), not (A^-1 L) K: a product of large matrices less
    forces = coupling.rows(level)
    carried = jnp.concatenate([factors.inverse @ coupling.left, -factors.lower], 2)

    def forward(previous, row):
        carry, force = row
        current = carry @ jnp.concatenate([force, previous])
        return current, current

    def backward(following, row):
        upper, middle, right = row
        current = middle - upper @ following
        # only what is read is kept: all columns of a fine grid do not fit into the cache
        return current, right.T @ current

    zero = jnp.zeros((9, forces.shape[2]), forces.dtype)
    _, middle = lax.scan(forward, zero, (carried, forces))
    rows = (factors.upper, middle, coupling.right)
    return coupling.read(lax.scan(backward, zero, rows, reverse=True)[1], level)
