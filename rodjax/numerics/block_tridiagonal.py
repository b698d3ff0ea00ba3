"""Block-tridiagonal systems: one block row a node, solved by block elimination from the first.

Each diagonal block is factorised with partial pivoting inside the block and none across blocks,
so the order of the unknowns inside a block matters: see `assembly.assemble`.
"""

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from rodjax.numerics.small_systems import divide


class BlockTridiagonal(eqx.Module):
    """The matrix with `lower[i]`, `diagonal[i]`, `upper[i]` in block columns i-1, i, i+1.

    `lower[0]` and `upper[-1]` have no influence, but must be finite.
    """

    lower: Float[Array, "n b b"]
    diagonal: Float[Array, "n b b"]
    upper: Float[Array, "n b b"]

    def transpose(self) -> "BlockTridiagonal":
        """The transposed matrix."""
        swap = lambda blocks: jnp.swapaxes(blocks, 1, 2)
        return BlockTridiagonal(
            jnp.roll(swap(self.upper), 1, axis=0),
            swap(self.diagonal),
            jnp.roll(swap(self.lower), -1, axis=0),
        )

    def multiply(self, x: Float[Array, "n b m"]) -> Float[Array, "n b m"]:
        """Matrix times the columns x."""
        y = self.diagonal @ x
        y = y.at[1:].add(self.lower[1:] @ x[:-1])
        return y.at[:-1].add(self.upper[:-1] @ x[1:])

    def solve(self, rhs: Float[Array, "n b"]) -> Float[Array, "n b"]:
        """Solution for one right-hand side (factorisation included)."""
        b = rhs.shape[1]

        def eliminate(previous, row):
            lower, diagonal, upper, right = row
            update = lower @ previous
            matrix = diagonal - update[:, :b]
            columns = jnp.concatenate([upper, (right - update[:, b])[:, None]], 1)
            current = divide(matrix, columns)
            return current, current

        def substitute(x, row):
            x = row[:, b] - row[:, :b] @ x
            return x, x

        start = jnp.zeros((b, b + 1), rhs.dtype)
        _, rows = lax.scan(eliminate, start, (self.lower, self.diagonal, self.upper, rhs))
        return lax.scan(substitute, jnp.zeros((b,), rhs.dtype), rows, reverse=True)[1]

    def pivots(self, factors: "Factors") -> Float[Array, "n b b"]:
        """The diagonal blocks as elimination leaves them, with small entries beside large ones.

        Inverted they would be less exact.
        """
        left = self.lower[1:] @ factors.upper[:-1]
        return self.diagonal.at[1:].add(-left)

    def factorize(self) -> "Factors":
        """Factors that solve for any number of right-hand sides by matrix products alone."""
        b = self.diagonal.shape[1]
        eye = jnp.eye(b, dtype=self.diagonal.dtype)

        def eliminate(previous, row):
            lower, diagonal, upper = row
            matrix = diagonal - lower @ previous
            current = divide(matrix, jnp.concatenate([upper, eye], 1))
            return current[:, :b], current

        start = jnp.zeros((b, b), self.diagonal.dtype)
        _, rows = lax.scan(eliminate, start, (self.lower, self.diagonal, self.upper))
        inverse = rows[:, :, b:]
        return Factors(inverse, inverse @ self.lower, rows[:, :, :b])


class Factors(eqx.Module):
    """Block elimination of a `BlockTridiagonal`, stored for repeated solves."""

    inverse: Float[Array, "n b b"]
    lower: Float[Array, "n b b"]
    upper: Float[Array, "n b b"]

    def solve(self, rhs: Float[Array, "n b m"]) -> Float[Array, "n b m"]:
        """Solutions for the columns of rhs."""

        def forward(previous, row):
            inverse, lower, right = row
            current = inverse @ right - lower @ previous
            return current, current

        def backward(following, row):
            upper, middle = row
            current = middle - upper @ following
            return current, current

        zero = jnp.zeros_like(rhs[0])
        _, middle = lax.scan(forward, zero, (self.inverse, self.lower, rhs))
        return lax.scan(backward, zero, (self.upper, middle), reverse=True)[1]
