"""Strands in contact eliminated node by node along the strip that they form, see `frontal`."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from rodjax.equations.assembly import AS_COLUMNS
from rodjax.equations.coupling import Coupling
from rodjax.interactions import contact_graph
from rodjax.interactions.contact_capacities import Capacity
from rodjax.interactions.contact_graph import Graph
from rodjax.numerics import frontal
from rodjax.numerics.block_tridiagonal import BlockTridiagonal
from rodjax.numerics.frontal import FrontalFactors
from rodjax.numerics.signs import determinant_signs, negative_in_all


class StripElimination(eqx.Module):
    """Factors of the whole matrix by a front."""

    factors: FrontalFactors

    @classmethod
    def of(
        cls, blocks: BlockTridiagonal, coupling: Coupling, capacity: Capacity
    ) -> "StripElimination":
        """Of blocks + coupling, whose nodes the front of the capacity must hold."""
        parts = (_permuted(part) for part in (blocks.lower, blocks.diagonal, blocks.upper))
        graph, size = _graph(coupling), capacity.front
        assert size is not None
        # ends take the directions that they hold out of the forces on their nodes
        left = coupling.left[:, 3:6]
        given = coupling.sites, coupling.pairs.count, coupling.derivative
        far = contact_graph.distant(graph, *given, left)
        return cls(frontal.factorize(BlockTridiagonal(*parts), far, graph.order, size))

    def solve(self, b: Float[Array, "nodes 9"]) -> Float[Array, "nodes 9"]:
        """Solution for one right side."""
        return self.factors.solve(_permuted(b))

    def solve_transpose(self, b: Float[Array, "nodes 9"]) -> Float[Array, "nodes 9"]:
        """Solution of the transposed system for one right side."""
        return _permuted(self.factors.solve_transpose(b))

    def sign(self, blocks: BlockTridiagonal) -> Float[Array, ""]:
        """Sign of the determinant, of what these `blocks` are part of."""
        pivots = self.factors.pivots
        # of every block the rows were exchanged
        exchanged = (-1.0) ** len(pivots)
        return exchanged * jnp.prod(determinant_signs(pivots))

    def negative(self, blocks: BlockTridiagonal) -> Int[Array, ""]:
        """Number of negative eigenvalues of a symmetric system: those of its pivots."""
        return negative_in_all(self.factors.pivots)

    def numbers(self) -> tuple[Float[Array, "nodes r"], Int[Array, " 0"]]:
        """What it holds besides what follows from the coupling, see `DenseElimination`."""
        return self.factors.rows, jnp.zeros((0,), jnp.int32)

    @classmethod
    def from_numbers(cls, coupling, capacity, rows, order) -> "StripElimination":
        """What gave these numbers."""
        return cls(FrontalFactors(_graph(coupling).order, rows, capacity.front))


def _permuted(rows):
    """Rows of blocks with those first that contact touches, as among the columns, or back."""
    return rows[:, jnp.asarray(AS_COLUMNS, jnp.int32)]


def _graph(coupling: Coupling) -> Graph:
    graph = coupling.pairs.graph
    assert graph is not None
    return graph
