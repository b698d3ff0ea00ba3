"""Newton systems whose block-tridiagonal matrix is coupled by contact between distant nodes.

A solver for what is in contact is chosen at run time, see `contact_capacities`: the vertices in
contact are eliminated as a dense system, or all nodes along the strip that the strands form.
"""

from collections.abc import Callable
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from rodjax.equations.assembly import AS_COLUMNS
from rodjax.equations.coupling import Coupling
from rodjax.equations.dense_elimination import DenseElimination
from rodjax.equations.strip_elimination import StripElimination
from rodjax.interactions.contact_capacities import Capacity
from rodjax.numerics.batching import one_by_one
from rodjax.numerics.block_tridiagonal import BlockTridiagonal, Factors
from rodjax.numerics.signs import determinant_signs, negative_in_all


class CoupledSystem(eqx.Module):
    """A block-tridiagonal matrix with a coupling, or without (None)."""

    blocks: BlockTridiagonal
    coupling: Coupling | None = None

    def transpose(self) -> "CoupledSystem":
        """The transposed system."""
        coupling = None if self.coupling is None else self.coupling.transpose()
        return CoupledSystem(self.blocks.transpose(), coupling)

    @jax.named_scope("solve")
    def solve(self, b: Float[Array, "nodes 9"]) -> Float[Array, "nodes 9"]:
        """Solution of the system. Under `vmap` over b alone the matrix is eliminated once."""
        return _solve_blocks(self, b) if self.coupling is None else _solve(self, b)

    def solve_once(self, b: Float[Array, "nodes 9"]) -> Float[Array, "nodes 9"]:
        """As `solve`, for one right side alone, which needs no factors to be kept."""
        return self.blocks.solve(b) if self.coupling is None else _solve(self, b)

    def solve_transpose(self, b: Float[Array, "nodes 9"]) -> Float[Array, "nodes 9"]:
        """Solution of the transposed system."""
        if self.coupling is None:
            return _solve_transpose_blocks(self, b)
        return _solve_transpose(self, b)

    def multiply(self, b: Float[Array, "nodes 9"]) -> Float[Array, "nodes 9"]:
        """Matrix times vector."""
        product = self.blocks.multiply(b[:, :, None])[:, :, 0]
        return product if self.coupling is None else product + self.coupling.multiply(b)

    @jax.named_scope("eliminate")
    def eliminate(self) -> "Eliminated | EliminatedBlocks":
        """The system ready for several right sides."""
        blocks, coupling = self.blocks, self.coupling
        if coupling is None:
            return EliminatedBlocks.of(blocks)

        def numbers(capacity, blocks, coupling, factors):
            if not capacity.kept:
                return jnp.zeros((len(blocks.diagonal), 0), blocks.diagonal.dtype), nothing
            return _elimination(capacity).of(blocks, coupling, factors, capacity).numbers()

        nothing = jnp.zeros((0,), jnp.int32)
        given = blocks, coupling, _factors(blocks, coupling)
        # jitted so as to be traced once, for the sizes and for the branches
        each = [jax.jit(partial(numbers, capacity)) for capacity in coupling.capacities]
        sizes = [[x.shape[-1] for x in jax.eval_shape(one, *given)] for one in each]
        row, order = (max(size) for size in zip(*sizes, strict=True))

        def padded(one):
            def branch(*given):
                found, permutation = one(*given)
                return (
                    jnp.pad(found, ((0, 0), (0, row - found.shape[1]))),
                    jnp.pad(permutation, (0, order - permutation.shape[0])),
                )

            return branch

        found = lax.switch(coupling.level, list(map(padded, each)), *given)
        return Eliminated(*given, *found)


class EliminatedBlocks(eqx.Module):
    """Factors of a system without coupling."""

    blocks: BlockTridiagonal
    factors: Factors

    @classmethod
    def of(cls, blocks: BlockTridiagonal) -> "EliminatedBlocks":
        """Of these blocks."""
        return cls(blocks, blocks.factorize())

    def solve(self, b: Float[Array, "nodes 9"]) -> Float[Array, "nodes 9"]:
        """Solution for one right side."""
        return self.factors.solve(b[:, :, None])[:, :, 0]

    def sign(self) -> Float[Array, ""]:
        """Sign of the determinant."""
        return jnp.prod(determinant_signs(self.blocks.pivots(self.factors)))

    def negative(self) -> Int[Array, ""]:
        """Number of negative eigenvalues of a symmetric system: those of its pivots.

        Symmetric with the rows of every block in the order of its columns, see `AS_COLUMNS`.
        """
        return negative_in_all(self.blocks.pivots(self.factors)[:, np.array(AS_COLUMNS)])


class Eliminated(eqx.Module):
    """Factors of a system, by the solver for what is in contact.

    What that solver holds stands in rows for the nodes, as long as the longest that any has.
    """

    blocks: BlockTridiagonal
    coupling: Coupling
    factors: Factors  # of the blocks, where what touches is a dense system
    rows: Float[Array, "nodes r"]
    order: Int[Array, " k"]

    def solve(self, b: Float[Array, "nodes 9"]) -> Float[Array, "nodes 9"]:
        """Solution for one right side."""
        return self._of_level(lambda elimination, b: elimination.solve(b), b)

    def sign(self) -> Float[Array, ""]:
        """Sign of the determinant."""
        return self._of_level(lambda elimination, blocks: elimination.sign(blocks), self.blocks)

    def negative(self) -> Int[Array, ""]:
        """Number of negative eigenvalues of a symmetric system, see `EliminatedBlocks.negative`."""
        return self._of_level(lambda elimination, blocks: elimination.negative(blocks), self.blocks)

    def _of_level(self, asked: Callable, *given):
        """What is asked of the solver for what is in contact."""

        def by(capacity):
            kind = _elimination(capacity)

            def answer(blocks, coupling, factors, rows, order, *given):
                if not capacity.kept:
                    return asked(kind.of(blocks, coupling, factors, capacity), *given)
                return asked(kind.from_numbers(coupling, factors, capacity, rows, order), *given)

            return answer

        branches = [by(capacity) for capacity in self.coupling.capacities]
        numbers = self.blocks, self.coupling, self.factors, self.rows, self.order
        return lax.switch(self.coupling.level, branches, *numbers, *given)


def _elimination(capacity: Capacity) -> type[DenseElimination] | type[StripElimination]:
    return DenseElimination if capacity.front is None else StripElimination


def _factors(blocks: BlockTridiagonal, coupling: Coupling) -> Factors:
    """Factors of the blocks, once for all sizes of dense systems; zeros where there is a front."""
    dense = jnp.asarray([size.front is None for size in coupling.capacities])
    nothing = jax.tree.map(jnp.zeros_like, jax.eval_shape(blocks.factorize))
    make = lambda blocks: blocks.factorize()
    return lax.cond(dense[coupling.level], make, lambda _: nothing, blocks)


def _solve_blocks(system: CoupledSystem, b):
    return EliminatedBlocks.of(system.blocks).solve(b)


def _solve_transpose_blocks(system: CoupledSystem, b):
    return _solve_blocks(CoupledSystem(system.blocks.transpose()), b)


def _uncoupled(system: CoupledSystem, b):
    assert system.coupling is not None
    return ~system.coupling.acts


def _by_capacity(uncoupled, transposed: bool):
    """A solve by the solver for what is in contact, one lane of a batch after the other."""

    def coupled(system: CoupledSystem, b):
        assert system.coupling is not None
        turned = system.transpose() if transposed else system
        assert turned.coupling is not None
        factors = _factors(turned.blocks, turned.coupling)
        branches = [
            partial(_solved, capacity, transposed) for capacity in system.coupling.capacities
        ]
        return lax.switch(system.coupling.level, branches, system, turned, factors, b)

    def one(system: CoupledSystem, b):
        return lax.cond(_uncoupled(system, b), uncoupled, coupled, system, b)

    return one_by_one(one, (_uncoupled, uncoupled))


def _solved(
    capacity: Capacity,
    transposed: bool,
    system: CoupledSystem,
    turned: CoupledSystem,
    factors: Factors,
    b: Float[Array, "nodes 9"],
) -> Float[Array, "nodes 9"]:
    """A solve of the turned system: the system itself, or transposed; the factors are its own.

    A front is of the system itself either way.
    """
    assert system.coupling is not None and turned.coupling is not None
    if capacity.front is None:
        return DenseElimination.of(turned.blocks, turned.coupling, factors, capacity).solve(b)
    eliminated = StripElimination.of(system.blocks, system.coupling, factors, capacity)
    solve = eliminated.solve_transpose if transposed else eliminated.solve
    return _refined(solve, turned.multiply, b)


def _refined(solve, multiply, b):
    """A solution refined once; not a number where it was too far off for that.

    In the order of a strip pivots might be small that in the order of the rod are not.
    """
    x = solve(b)
    left = b - multiply(x)
    size = jnp.maximum(jnp.max(jnp.abs(b)), jnp.max(jnp.abs(x)))
    lost = jnp.max(jnp.abs(left)) > jnp.finfo(b.dtype).eps ** 0.4 * size
    return jnp.where(lost, jnp.nan, x + solve(left))


_solve = _by_capacity(_solve_blocks, transposed=False)
_solve_transpose = _by_capacity(_solve_transpose_blocks, transposed=True)
