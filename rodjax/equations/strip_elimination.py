"""Strands in contact eliminated node by node along the strip that they form, see `frontal`."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from rodjax.equations.assembly import AS_COLUMNS
from rodjax.equations.coupling import Coupling
from rodjax.interactions import contact_graph
from rodjax.interactions.contact_capacities import Capacity
from rodjax.interactions.contact_graph import Graph
from rodjax.numerics import frontal
from rodjax.numerics.block_tridiagonal import BlockTridiagonal, Factors
from rodjax.numerics.frontal import FrontalFactors
from rodjax.numerics.signs import determinant_signs, negative_in_all


class StripElimination(eqx.Module):
    """Factors of the whole matrix by a front, with those rows and columns first that it is for.

    They are the displacements, the force balances; with the moments of friction the rotations too.
    """

    factors: FrontalFactors

    @classmethod
    def of(
        cls, blocks: BlockTridiagonal, coupling: Coupling, factors: Factors, capacity: Capacity
    ) -> "StripElimination":
        """Of blocks + coupling, whose nodes the front of the capacity must hold.

        The factors of the blocks alone it has no use for.
        """
        graph, width = _graph(coupling), coupling.width
        assert capacity.front is not None
        size = capacity.front._replace(reaching=width)
        rows, columns = _rows(width), _columns(width)
        parts = (blocks.lower, blocks.diagonal, blocks.upper)
        parts = (_taken(_taken(part, rows, 1), columns, 2) for part in parts)
        # ends take the directions that they hold out of the forces on their nodes
        given = coupling.sites, coupling.pairs.count, coupling.derivative
        of_force, of_motion = coupling.units
        left = coupling.left[:, 3 : 3 + width] * of_force[None, None]
        right = None
        if width > 3:
            right = jnp.swapaxes(_taken(coupling.right, columns, 1)[:, :width], 1, 2)
            right = of_motion[None, :, None] * right
        far = contact_graph.distant(graph, *given, left, right)
        paired = tuple(rows.index(column) for column in columns)
        return cls(frontal.factorize(BlockTridiagonal(*parts), far, graph.order, size, paired))

    def solve(self, b: Float[Array, "nodes 9"]) -> Float[Array, "nodes 9"]:
        """Solution for one right side."""
        width = self.factors.size.reaching
        return _back(self.factors.solve(_taken(b, _rows(width), 1)), _columns(width))

    def solve_transpose(self, b: Float[Array, "nodes 9"]) -> Float[Array, "nodes 9"]:
        """Solution of the transposed system for one right side."""
        width = self.factors.size.reaching
        return _back(self.factors.solve_transpose(_taken(b, _columns(width), 1)), _rows(width))

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
    def from_numbers(cls, coupling, factors, capacity, rows, order) -> "StripElimination":
        """What gave these numbers."""
        size = capacity.front._replace(reaching=coupling.width)
        return cls(FrontalFactors(_graph(coupling).order, rows, size))


def _rows(width: int) -> tuple[int, ...]:
    """The rows of a block in the order in which they are eliminated."""
    return AS_COLUMNS if width == 3 else (3, 4, 5, 6, 7, 8, 0, 1, 2)


def _columns(width: int) -> tuple[int, ...]:
    """The columns, in the order of these rows."""
    return tuple(range(9)) if width == 3 else (0, 1, 2, 6, 7, 8, 3, 4, 5)


def _taken(values, order: tuple[int, ...], axis: int):
    """The rows or columns of blocks in this order."""
    if order == tuple(range(9)):
        return values
    return jnp.take(values, jnp.asarray(order, jnp.int32), axis=axis)


def _back(values, order: tuple[int, ...]):
    """What was found in this order, in its own."""
    return _taken(values, tuple(np.argsort(order).tolist()), 1)


def _graph(coupling: Coupling) -> Graph:
    graph = coupling.pairs.graph
    assert graph is not None
    return graph
