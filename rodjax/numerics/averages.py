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
    mapped by `vmap`. Begun by `Averages.of`, gone on with by `added`.

    Attributes:
        count: how many numbers of each component it has been given.
        partial: sums of the blocks that are not finished, (levels, ...) for every leaf.
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
        empty = lambda leaf: jnp.zeros((levels, *jnp.shape(leaf)), jnp.result_type(leaf))
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
        return jax.tree.map(lambda leaf: leaf[0], self.means)

    @property
    def variance(self) -> Any:
        """Variance of the values (not of their mean)."""
        spare = jnp.maximum(self.count - 1, 1)
        return jax.tree.map(lambda leaf: leaf[0] / spare.astype(leaf.dtype), self.squares)

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
            plain = _squared_errors(self.count, leaf)[0]
            return 0.5 * _squared_error(self.count, leaf) / jnp.where(plain > 0, plain, 1.0)

        return jax.tree.map(one, self.squares)

    def pooled(self) -> tuple[Any, Any]:
        """Mean and its error of all replicas along the first axis, which `vmap` put there.

        The error is that of the replicas' scatter, which needs no look at their memory.
        """
        means = jax.vmap(lambda one: one.mean)(self)
        count = self.count.shape[0]
        mean = jax.tree.map(lambda leaf: jnp.mean(leaf, 0), means)
        error = jax.tree.map(lambda leaf: jnp.std(leaf, 0, ddof=1) / np.sqrt(count), means)
        return mean, error


def _over(numbers, leaf):
    """Numbers a level beside a leaf with that axis first."""
    return numbers.reshape((-1,) + (1,) * (leaf.ndim - 1))


def _added(count, value, partial, means, squares):
    """One leaf with one more value."""
    dtype = partial.dtype
    level = jnp.arange(partial.shape[0], dtype=jnp.int32)
    size = jnp.left_shift(jnp.asarray(1, jnp.int32), level)
    ends = _over(count % size == 0, partial)
    blocks = _over(jnp.maximum(count // size, 1), partial).astype(dtype)
    partial = partial + jnp.asarray(value, dtype)[None]
    block = partial / _over(size, partial).astype(dtype)
    off = block - means
    new = means + off / blocks
    squares = jnp.where(ends, squares + off * (block - new), squares)
    return jnp.where(ends, 0.0, partial), jnp.where(ends, new, means), squares


def _squared_errors(count, squares):
    """s_l^2/n_l of every level; nothing of levels that have no two blocks."""
    level = jnp.arange(squares.shape[0], dtype=jnp.int32)
    blocks = _over(jnp.right_shift(count, level), squares)
    number = jnp.maximum(blocks, 2).astype(squares.dtype)
    return jnp.where(blocks > 1, squares / (number * (number - 1)), jnp.nan)


def _squared_error(count, squares):
    """Squared error of the mean at the level that is long enough."""
    errors = _squared_errors(count, squares)
    plain = jnp.where(errors[0] > 0, errors[0], 1.0)
    grown = jnp.nan_to_num(errors / plain[None])
    level = np.arange(squares.shape[0])
    cubed = _over(jnp.asarray(8.0**level, squares.dtype), squares)
    enough = cubed > 2 * count.astype(squares.dtype) * grown**2
    blocks = jnp.right_shift(count, jnp.asarray(level, jnp.int32))
    asked = _over(blocks >= _FEWEST, squares)
    first = jnp.argmax(enough & asked, 0)
    # short streams: the longest blocks that may be asked
    last = jnp.maximum(jnp.sum(blocks >= _FEWEST) - 1, 0)
    index = jnp.where(jnp.any(enough & asked, 0), first, last)
    return jnp.take_along_axis(errors, index[None], 0)[0]
