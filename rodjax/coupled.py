"""Newton systems whose block-tridiagonal matrix is coupled by a dense block at a few sites.

The matrix is A + L C R^T: A block tridiagonal, C the pair derivatives of the active contact
points (3m x 3m), R^T reads the displacements of those points, L puts forces on them into the
force balances. Eliminating A leaves a dense system of 3m unknowns (Woodbury's identity in the
form that needs no inverse of C).
"""

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from rodjax.block_tridiagonal import BlockTridiagonal, Factors
from rodjax.contact import ActiveSet, Contact, Sites, at_level, pairs


class Coupling(eqx.Module):
    """Contact of a Newton iterate, ready to be evaluated for any size of the active set."""

    contact: Contact
    where: Sites
    active: ActiveSet
    points: Float[Array, "p 3"]
    velocities: Float[Array, "p 3"]
    by_velocity: Float[Array, ""]
    scale: Float[Array, ""]  # of the derivative: length over force
    left: Float[Array, "nodes 9 3"]  # where a force on a node enters its block row
    right: Float[Array, "nodes 9 3"]  # where a node's displacement stands in its block column
    transposed: bool = eqx.field(static=True, default=False)

    def transpose(self) -> "Coupling":
        """The coupling of the transposed matrix."""
        return Coupling(
            self.contact,
            self.where,
            self.active,
            self.points,
            self.velocities,
            self.by_velocity,
            self.scale,
            left=self.right,
            right=self.left,
            transposed=not self.transposed,
        )

    def derivative(self, size: int) -> Float[Array, "rows rows"]:
        """Scaled derivative of minus the point forces by the points' positions."""
        return self.evaluate(size)[1]

    def evaluate(self, size: int) -> tuple[Float[Array, "m 3"], Float[Array, "k k"]]:
        """Forces on the active points [N], and `derivative`."""
        found = pairs(
            self.contact,
            self.where,
            self.active,
            size,
            self.points,
            self.velocities,
            self.by_velocity,
        )
        assert found.derivative is not None
        matrix = self.scale * found.derivative.reshape(3 * size, 3 * size)
        return found.force, matrix.T if self.transposed else matrix

    def enter(self, size: int, force: Float[Array, "m 3"]) -> Float[Array, "nodes 9"]:
        """Forces on the active points as they enter the block rows."""
        return jnp.einsum("jrk,jp,pk->jr", self.left, self.weights(size), force)

    def weights(self, size: int) -> Float[Array, "nodes m"]:
        """Interpolation weights of the active points at the nodes."""
        chosen = self.active.order[:size]
        element, weight = self.where.element[chosen], self.where.weight[chosen]
        node = jnp.arange(self.left.shape[0])[:, None]
        return (node == element) * (1 - weight) + (node == element + 1) * weight


class CoupledSystem(eqx.Module):
    """A block-tridiagonal matrix with a coupling, or without (None)."""

    blocks: BlockTridiagonal
    coupling: Coupling | None = None

    def transpose(self) -> "CoupledSystem":
        """The transposed system."""
        coupling = None if self.coupling is None else self.coupling.transpose()
        return CoupledSystem(self.blocks.transpose(), coupling)

    def solve(self, b: Float[Array, "nodes 9"]) -> Float[Array, "nodes 9"]:
        """Solution of the system."""
        if self.coupling is None:
            return self.blocks.solve(b)
        coupling = self.coupling
        none = lambda b: self.blocks.solve(b)  # noqa: PLW0108 (cond hashes a bound method)
        some = lambda size: (
            lambda b, factors: solve_coupled(factors, coupling, size, coupling.derivative(size), b)
        )
        return coupled_or_not(self.blocks, coupling, none, some, b)

    def solve_transpose(self, b: Float[Array, "nodes 9"]) -> Float[Array, "nodes 9"]:
        """Solution of the transposed system."""
        return self.transpose().solve(b)

    def multiply(self, b: Float[Array, "nodes 9"]) -> Float[Array, "nodes 9"]:
        """Matrix times vector."""
        product = self.blocks.multiply(b[:, :, None])[:, :, 0]
        if self.coupling is None:
            return product
        coupling = self.coupling

        def some(size):
            def branch(b):
                weights = coupling.weights(size)
                at_points = jnp.einsum("jp,jrk,jr->pk", weights, coupling.right, b)
                force = (coupling.derivative(size) @ at_points.reshape(-1)).reshape(size, 3)
                return coupling.enter(size, force)

            return branch

        return product + at_level(coupling.contact, coupling.active, jnp.zeros_like, some, b)


def coupled_or_not(blocks: BlockTridiagonal, coupling: Coupling, none, some, b):
    """`none(b)` without active points, else `some(size)(b, factors)` for the size in use."""
    branches = [some(size) for size in coupling.contact.sizes]

    def touching(b):
        return lax.switch(coupling.active.level - 1, branches, b, blocks.factorize())

    return lax.cond(coupling.active.level > 0, touching, none, b)


def solve_coupled(factors: Factors, coupling: Coupling, size: int, derivative, b):
    """Solve with m active points: 3m + 1 columns through A, then a dense system."""
    m = 3 * size
    weights = coupling.weights(size)
    entry = factors.inverse @ jnp.concatenate([coupling.left, b[:, :, None]], 2)

    def forward(previous, row):
        lower, inverse_entry, weight = row
        columns = (inverse_entry[:, None, :3] * weight[None, :, None]).reshape(9, m)
        columns = jnp.concatenate([columns, inverse_entry[:, 3:]], 1)
        current = columns - lower @ previous
        return current, current

    def backward(following, row):
        upper, middle = row
        current = middle - upper @ following
        return current, current

    zero = jnp.zeros((9, m + 1), b.dtype)
    _, middle = lax.scan(forward, zero, (factors.lower, entry, weights))
    _, columns = lax.scan(backward, zero, (factors.upper, middle), reverse=True)
    chosen = coupling.active.order[:size]
    element, weight = coupling.where.element[chosen], coupling.where.weight[chosen]

    def read(columns):  # (n+1, 9, c) -> (m, c)
        at = lambda node: jnp.einsum("prk,prc->pkc", coupling.right[node], columns[node])
        mixed = (1 - weight)[:, None, None] * at(element) + weight[:, None, None] * at(element + 1)
        return mixed.reshape(m, -1)

    response = read(columns)
    system = jnp.eye(m, dtype=b.dtype) + response[:, :m] @ derivative
    displacement = jnp.linalg.solve(system, response[:, m])
    return columns[:, :, m] - columns[:, :, :m] @ (derivative @ displacement)
