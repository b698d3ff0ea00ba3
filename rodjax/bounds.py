"""Bounds of parameters, as transforms to unknowns that range over all numbers.

A fit searches in the unknowns, scaled so that a change by one is a large change of the parameter.
The transforms act on each element of a parameter by itself.
"""

import abc

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

from rodjax.validation import as_float, known


class AbstractBound(eqx.Module):
    """What values a parameter may take."""

    @abc.abstractmethod
    def to_unbounded(self, value: Float[Array, "*d"]) -> Float[Array, "*d"]:
        """Unknown of a parameter within its bounds."""

    @abc.abstractmethod
    def to_bounded(self, unknown: Float[Array, "*d"]) -> Float[Array, "*d"]:
        """Parameter of any unknown."""

    @abc.abstractmethod
    def inside(self, value: Float[Array, "*d"]) -> Bool[Array, "*d"]:
        """Whether a parameter lies strictly within its bounds."""

    def at_bound(self, unknown: Float[Array, "*d"]) -> Bool[Array, "*d"]:
        """Whether a parameter is so near to its bound that its unknown has lost influence."""
        return jnp.zeros(unknown.shape, bool)

    @property
    @abc.abstractmethod
    def range(self) -> str:
        """The bounds in words: 'the parameter must be ...'."""

    @abc.abstractmethod
    def label(self, name: str) -> str:
        """The unknown of the parameter so named, as a formula."""


class Unbounded(AbstractBound):
    """Any number: u = x / scale. The scale says what a large change is."""

    scale: Float[Array, ""] = eqx.field(converter=as_float, default=1.0)

    def __check_init__(self):
        if known(self.scale) and not (np.isfinite(self.scale) and np.asarray(self.scale) > 0):
            raise ValueError(f"scale: must be positive, got {self.scale}")

    def to_unbounded(self, value):
        return value / self.scale

    def to_bounded(self, unknown):
        return self.scale * unknown

    def inside(self, value):
        return jnp.isfinite(value)

    @property
    def range(self):
        return "finite"

    def label(self, name):
        return name if self.scale == 1 else f"{name}/{float(self.scale):.3g}"


class Positive(AbstractBound):
    """A positive number: u = log x, so that changes are relative."""

    def to_unbounded(self, value):
        return jnp.log(value)

    def to_bounded(self, unknown):
        return jnp.exp(unknown)

    def inside(self, value):
        return jnp.isfinite(value) & (value > 0)

    @property
    def range(self):
        return "positive"

    def label(self, name):
        return f"log {name}"


class Interval(AbstractBound):
    """Between two numbers: u = log((x - low) / (high - x)) / 4.

    In the middle of the interval a unit of u is its width. Bounds are numbers, or arrays with a
    number for each element of the parameter.
    """

    low: Float[Array, "..."] = eqx.field(converter=as_float)
    high: Float[Array, "..."] = eqx.field(converter=as_float)

    def __check_init__(self):
        if not (known(self.low) and known(self.high)):
            return
        low, high = np.asarray(self.low), np.asarray(self.high)
        if not np.all(np.isfinite(low) & np.isfinite(high) & (low < high)):
            raise ValueError(f"low, high: must be finite and low < high, got {self.range}")

    def to_unbounded(self, value):
        return 0.25 * (jnp.log(value - self.low) - jnp.log(self.high - value))

    def to_bounded(self, unknown):
        return self.low + (self.high - self.low) * jax.nn.sigmoid(4 * unknown)

    def inside(self, value):
        return (value > self.low) & (value < self.high)

    def at_bound(self, unknown):
        return jnp.abs(unknown) > 2.0  # within 0.03 % of the width

    @property
    def range(self):
        return f"between {np.asarray(self.low)} and {np.asarray(self.high)}"

    def label(self, name):
        return f"logit {name}"


class Unknowns(eqx.Module):
    """The unknowns of a pytree of parameters as one vector; `unknowns_of` makes it."""

    bounds: tuple[AbstractBound, ...]  # one for each leaf
    like: PyTree[Float[Array, "..."]]  # parameters, for their structure and shapes

    def vector(self, parameters: PyTree) -> Float[Array, " p"]:
        """Unknowns of the parameters."""
        leaves = zip(self.bounds, jax.tree.leaves(parameters), strict=True)
        return jnp.concatenate([bound.to_unbounded(leaf).ravel() for bound, leaf in leaves])

    def parameters(self, vector: Float[Array, " p"]) -> PyTree:
        """Parameters of the unknowns."""
        like = jax.tree.leaves(self.unflatten(vector))
        leaves = zip(self.bounds, like, strict=True)
        leaves = [bound.to_bounded(leaf).astype(leaf.dtype) for bound, leaf in leaves]
        return jax.tree.unflatten(jax.tree.structure(self.like), leaves)

    def unflatten(self, vector: Float[Array, " p"]) -> PyTree:
        """The vector's numbers in the structure of the parameters."""
        leaves, structure = jax.tree.flatten(self.like)
        parts = jnp.split(vector, np.cumsum([leaf.size for leaf in leaves])[:-1])
        parts = zip(parts, leaves, strict=True)
        return structure.unflatten([p.reshape(leaf.shape).astype(leaf.dtype) for p, leaf in parts])

    def slopes(self, vector: Float[Array, " p"]) -> Float[Array, " p"]:
        """Derivative of each parameter with respect to its unknown."""
        slopes = jax.jvp(self.parameters, (vector,), (jnp.ones_like(vector),))[1]
        return jnp.concatenate([leaf.ravel() for leaf in jax.tree.leaves(slopes)])

    def at_bound(self, vector: Float[Array, " p"]) -> tuple[str, ...]:
        """Names of the parameters that are at the end of their interval."""
        leaves = zip(self.bounds, jax.tree.leaves(self.unflatten(vector)), strict=True)
        there = np.concatenate([np.ravel(bound.at_bound(leaf)) for bound, leaf in leaves])
        return tuple(name for name, near in zip(self.names, there, strict=True) if near)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters by their place in the pytree, as 'stiffness[2]'."""
        return tuple(name for names in self._names() for name in names)

    @property
    def labels(self) -> tuple[str, ...]:
        """The unknowns as formulas, as 'log stiffness[2]'."""
        named = zip(self.bounds, self._names(), strict=True)
        return tuple(bound.label(name) for bound, names in named for name in names)

    def _names(self):
        paths = jax.tree_util.tree_leaves_with_path(self.like)
        key = lambda path: jax.tree_util.keystr(path, simple=True, separator=".") or "parameter"
        index = lambda i: "[" + ", ".join(map(str, i)) + "]" if i else ""
        return [[key(path) + index(i) for i in np.ndindex(leaf.shape)] for path, leaf in paths]


def unknowns_of(guess: PyTree, bounds: PyTree = None) -> Unknowns:
    """The unknowns of parameters like `guess`.

    Args:
        bounds: a bound for each parameter, or for a whole branch of the pytree of parameters.
            None means any number, with the guess's size (its largest magnitude, 1 if that is
            zero) as the scale.

    Raises:
        ValueError: the guess is not strictly within the bounds, or does not have their structure.
    """
    guess = jax.tree.map(as_float, guess)

    def resolve(bound, branch):
        return jax.tree.map(lambda leaf: _default(leaf) if bound is None else bound, branch)

    is_bound = lambda x: x is None or isinstance(x, AbstractBound)
    try:
        each = jax.tree.map(resolve, bounds, guess, is_leaf=is_bound)
    except ValueError as error:
        raise ValueError(f"bounds: not a prefix of the parameters' pytree: {error}") from None
    each = jax.tree.leaves(each, is_leaf=lambda x: isinstance(x, AbstractBound))
    if not each:
        raise ValueError("guess: it holds no parameter")
    for bound in each:
        if not isinstance(bound, AbstractBound):
            raise ValueError(f"bounds: expected bounds or None, got {bound!r}")
    unknowns = Unknowns(tuple(each), guess)
    leaves = zip(each, jax.tree.leaves(guess), unknowns._names(), strict=True)
    for bound, leaf, names in leaves:
        outside = ~np.ravel(bound.inside(leaf))
        if np.any(outside):
            first = int(np.argmax(outside))
            raise ValueError(
                f"guess: {names[first]} is {float(leaf.ravel()[first]):g}, but must be"
                f" {bound.range}"
            )
    return unknowns


def _default(leaf):
    size = float(jnp.max(jnp.abs(leaf)))
    return Unbounded(size if size > 0 and np.isfinite(size) else 1.0)
