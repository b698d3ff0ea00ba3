"""Averages over a stream of numbers that depend on each other, without keeping them.

Every number goes into blocks of 1, 2, 4, ... that double from level to level; of each level the
mean and the scatter of the finished blocks' means are kept (Welford 1962). The error of the mean
that a level says, s_l/sqrt(n_l), grows with the level until blocks are longer than the memory of
the stream, and then stays (Flyvbjerg & Petersen 1989). It is taken from the smallest level with

    b^3 > 2 n g^2,    g = error_l^2/error_0^2,

b the length of its blocks, n how many numbers there are (Lee et al. 2011; Jonsson 2018): there what
is left of the memory and the scatter of the estimate are about the same.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

# of blocks at least so many must be finished for a level to be asked
_FEWEST = 16


class Averages(eqx.Module):
    """Mean, variance, error and memory of a stream of numbers, updated by one after the other.

    A pure pytree of the size of a few dozen numbers: it can be carried through `lax.scan`, and
    mapped by `vmap`; of stacked ones, as `vmap` returns them, mean, variance, error and memory are
    those of each. Begun by `Averages.of`, gone on with by `added`.

    Attributes:
        count: how many numbers of each component it has been given.
        partial: sums of the blocks that are not finished, (..., levels) for every leaf.
        means: of the finished blocks' means.
        squares: sums of the squares of their deviations.

    Example:
        >>> found = rx.Averages.of(jnp.zeros(2))
        >>> for value in jax.random.normal(jax.random.key(0), (500, 2)):
        ...     found = found.added(value)
        >>> bool(jnp.all(jnp.abs(found.mean) < 4 * found.error))
        True
    """

    count: Int[Array, ""]
    partial: Any
    means: Any
    squares: Any

    @classmethod
    def of(cls, value: Any, levels: int = 24) -> "Averages":
        """Of nothing yet, for values such as this one.

        Args:
            value: a pytree of floating point arrays, whose numbers are of no account.
            levels: of blocks; 2^levels numbers are looked through.
        """
        empty = lambda leaf: jnp.zeros((*jnp.shape(leaf), levels), jnp.result_type(leaf))
        zeros = jax.tree.map(empty, value)
        return cls(jnp.asarray(0, jnp.int32), zeros, zeros, zeros)

    def added(self, value: Any) -> "Averages":
        """With one more value.

        Args:
            value: of the same structure as the first.
        """
        count = self.count + 1
        leaves, structure = jax.tree.flatten(value)
        parts = zip(leaves, *map(jax.tree.leaves, (self.partial, self.means, self.squares)),
                    strict=True)  # fmt: skip
        found = [_added(count, *part) for part in parts]
        whole = (jax.tree.unflatten(structure, one) for one in zip(*found, strict=True))
        return Averages(count, *whole)

    @property
    def mean(self) -> Any:
        """Mean of all values."""
        return jax.tree.map(lambda leaf: leaf[..., 0], self.means)

    @property
    def variance(self) -> Any:
        """Variance of the values (not of their mean)."""

        def one(leaf):
            spare = jnp.maximum(_counts(self.count, leaf)[..., 0] - 1, 1)
            return leaf[..., 0] / spare.astype(leaf.dtype)

        return jax.tree.map(one, self.squares)

    @property
    def error(self) -> Any:
        """Standard error of the mean, by blocks that are longer than the stream's memory."""
        return jax.tree.map(lambda leaf: jnp.sqrt(_squared_error(self.count, leaf)), self.squares)

    @property
    def correlation_time(self) -> Any:
        """Integrated autocorrelation time tau, in values: error^2 = variance 2 tau/count.

        One half for values that are independent; less where they alternate.
        """

        def one(leaf):
            plain = _squared_errors(self.count, leaf)[..., 0]
            return 0.5 * _squared_error(self.count, leaf) / jnp.where(plain > 0, plain, 1.0)

        return jax.tree.map(one, self.squares)

    def pooled(self) -> tuple[Any, Any]:
        """Mean and its error of all replicas along the first axis, which `vmap` put there.

        The error is that of the replicas' scatter, which needs no look at their memory.
        """
        count, means = self.count.shape[0], self.mean
        mean = jax.tree.map(lambda leaf: jnp.mean(leaf, 0), means)
        error = jax.tree.map(lambda leaf: jnp.std(leaf, 0, ddof=1) / np.sqrt(count), means)
        return mean, error


def _levels(leaf):
    return jnp.arange(leaf.shape[-1], dtype=jnp.int32)


def _counts(count, leaf):
    """Numbers of finished blocks of every level, beside a leaf."""
    wide = count.reshape(count.shape + (1,) * (leaf.ndim - count.ndim))
    return jnp.right_shift(wide, _levels(leaf).reshape((1,) * (leaf.ndim - 1) + (-1,)))


def _added(count, value, partial, means, squares):
    """One leaf with one more value."""
    dtype = partial.dtype
    size = jnp.left_shift(jnp.asarray(1, jnp.int32), _levels(partial))
    over = lambda numbers: numbers.reshape((1,) * (partial.ndim - 1) + (-1,))
    ends = over(count % size == 0)
    partial = partial + jnp.asarray(value, dtype)[..., None]
    block = partial / over(size).astype(dtype)
    off = block - means
    new = means + off / over(jnp.maximum(count // size, 1)).astype(dtype)
    squares = jnp.where(ends, squares + off * (block - new), squares)
    return jnp.where(ends, 0.0, partial), jnp.where(ends, new, means), squares


def _squared_errors(count, squares):
    """s_l^2/n_l of every level; nothing of levels that have no two blocks."""
    blocks = _counts(count, squares)
    number = jnp.maximum(blocks, 2).astype(squares.dtype)
    return jnp.where(blocks > 1, squares / (number * (number - 1)), jnp.nan)


def _squared_error(count, squares):
    """Squared error of the mean at the level that is long enough."""
    errors = _squared_errors(count, squares)
    plain = errors[..., :1]
    grown = jnp.nan_to_num(errors / jnp.where(plain > 0, plain, 1.0))
    cubed = 8.0 ** _levels(squares).astype(squares.dtype)
    cubed = cubed.reshape((1,) * (squares.ndim - 1) + (-1,))
    blocks = _counts(count, squares)
    asked = blocks >= _FEWEST
    enough = asked & (cubed > 2 * blocks[..., :1].astype(squares.dtype) * grown**2)
    # short streams: the longest blocks that may be asked
    last = jnp.maximum(jnp.sum(asked, -1) - 1, 0)
    index = jnp.where(jnp.any(enough, -1), jnp.argmax(enough, -1), last)
    index = jnp.broadcast_to(index, squares.shape[:-1])[..., None]
    return jnp.take_along_axis(errors, index, -1)[..., 0]
