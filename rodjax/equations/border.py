"""Systems with a border: a few rows and columns besides those of the nodes.

    [A  B] [x]   [f]
    [C  D] [z] = [g]

A is the matrix of the nodes, z are multipliers: the wrench of what holds a node, of a joint between
two, or the motion of a node that is taken out of A. A is eliminated once, for the right side and
the columns of B together, which leaves the small Schur complement S = D - C A^-1 B for z.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from rodjax.equations.coupled import CoupledSystem, Eliminated, EliminatedBlocks
from rodjax.numerics.signs import determinant_signs, negative_in_all


class Vector(NamedTuple):
    """Unknowns, or a right side, of the nodes and of the border."""

    nodes: Float[Array, "nodes 9"]
    border: Float[Array, " k"]


class Border(eqx.Module):
    """Rows and columns of k multipliers."""

    columns: Float[Array, "k nodes 9"]  # B, one after the other: what each adds to rows of nodes
    rows: Float[Array, "k nodes 9"]  # C
    corner: Float[Array, "k k"]  # D

    @classmethod
    def joined(cls, *borders: "Border") -> "Border":
        """One border of several that do not know of each other."""
        columns = jnp.concatenate([border.columns for border in borders])
        rows = jnp.concatenate([border.rows for border in borders])
        corner = jax.scipy.linalg.block_diag(*(border.corner for border in borders))
        return cls(columns, rows, corner)

    def transpose(self) -> "Border":
        """The border of the transposed system."""
        return Border(self.rows, self.columns, self.corner.T)

    def read(self, x: Float[Array, "*c nodes 9"]) -> Float[Array, "*c k"]:
        """C x."""
        return jnp.einsum("knr,...nr->...k", self.rows, x)

    def spread(self, z: Float[Array, " k"]) -> Float[Array, "nodes 9"]:
        """B z."""
        return jnp.einsum("k,knr->nr", z, self.columns)

    def complement(self, response: Float[Array, "k nodes 9"]) -> Float[Array, "k k"]:
        """S, from the response A^-1 B."""
        return self.corner - self.read(response).T


class BorderedSystem(eqx.Module):
    """A system of nodes with a border."""

    system: CoupledSystem
    border: Border

    def transpose(self) -> "BorderedSystem":
        """The transposed system."""
        return BorderedSystem(self.system.transpose(), self.border.transpose())

    def multiply(self, b: Vector) -> Vector:
        """Matrix times vector."""
        border = self.border
        nodes = self.system.multiply(b.nodes) + border.spread(b.border)
        return Vector(nodes, border.read(b.nodes) + border.corner @ b.border)

    def solve(self, b: Vector) -> Vector:
        """Solution of the system."""
        return solved(self.system.solve, self.border, b)

    def solve_transpose(self, b: Vector) -> Vector:
        """Solution of the transposed system."""
        return solved(self.system.solve_transpose, self.border.transpose(), b)

    def eliminate(self) -> "EliminatedBorder":
        """The system ready for several right sides; see `CoupledSystem.eliminate`."""
        return EliminatedBorder.of(self.system, self.border)


class EliminatedBorder(eqx.Module):
    """Factors of A, and its response A^-1 B to the border."""

    eliminated: Eliminated | EliminatedBlocks
    border: Border
    response: Float[Array, "k nodes 9"]

    @classmethod
    def of(cls, system, border: Border) -> "EliminatedBorder":
        """Of a system, with a border."""
        eliminated = system.eliminate()
        return cls(eliminated, border, jax.vmap(eliminated.solve)(border.columns))

    def solve(self, b: Vector) -> Vector:
        """Solution for one right side."""
        return _closed(self.border, b, self.eliminated.solve(b.nodes), self.response)

    def sign(self) -> Float[Array, ""]:
        """Sign of the determinant."""
        complement = self.border.complement(self.response)
        return self.eliminated.sign() * determinant_signs(complement[None])[0]

    def negative(self) -> Int[Array, ""]:
        """Number of negative eigenvalues of a system that is symmetric.

        By Haynsworth those of A (see `EliminatedBlocks.negative`) and those of S.
        """
        complement = self.border.complement(self.response)
        return self.eliminated.negative() + negative_in_all(complement[None])


def solved(solve: Callable, border: Border, b: Vector) -> Vector:
    """The solution by a `solve` for the nodes, whose matrix is eliminated once for all columns."""
    columns = jax.vmap(solve)(jnp.concatenate([b.nodes[None], border.columns]))
    return _closed(border, b, columns[0], columns[1:])


def _closed(border: Border, b: Vector, free, response) -> Vector:
    """The solution from A^-1 f and A^-1 B."""
    complement = border.complement(response)
    z = jnp.linalg.solve(complement, b.border - border.read(free))
    return Vector(free - jnp.einsum("k,knr->nr", z, response), z)
