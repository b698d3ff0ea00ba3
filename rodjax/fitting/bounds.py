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

from rodjax.inputs.validation import (
    as_float,
    broadcasts,
    check_numbers,
    check_positive,
    check_scalar,
    known,
)


class AbstractBound(eqx.Module):
    """What values a parameter may take."""

    @property
    def free(self) -> bool:
        """Whether the parameter is searched for."""
        return True

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


class _AbstractAnyNumber(AbstractBound):
    """No limit but that the parameter is finite."""

    def inside(self, value):
        return jnp.isfinite(value)

    @property
    def range(self):
        return "finite"


class Unbounded(_AbstractAnyNumber):
    """Any number: u = x / scale. The scale says what a large change is.

    Example:
        >>> bounds = {"stiffness": rx.Positive(), "offset": rx.Unbounded()}
    """

    scale: Float[Array, ""] = eqx.field(converter=as_float, default=1.0)

    def __check_init__(self):
        check_scalar(scale=self.scale)
        check_positive(scale=self.scale)

    def to_unbounded(self, value):
        return value / matched(self.scale, value)

    def to_bounded(self, unknown):
        return matched(self.scale, unknown) * unknown

    def label(self, name):
        return name if self.scale == 1 else f"{name}/{float(self.scale):.3g}"


class Fixed(_AbstractAnyNumber):
    """The guess's value: it is no unknown of the fit.

    Example:
        >>> bounds = {"friction": rx.Fixed(), "stiffness": rx.Positive()}
    """

    @property
    def free(self):
        return False

    def to_unbounded(self, value):
        return value

    def to_bounded(self, unknown):
        return unknown

    def label(self, name):
        return name


class Positive(AbstractBound):
    """A positive number: u = log x, so that changes are relative.

    Example:
        >>> bounds = {"stiffness": rx.Positive(), "offset": rx.Unbounded()}
    """

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
    number for each element of the parameter; they are rounded to its precision.

    Example:
        >>> bounds = {"friction": rx.Interval(0.0, 1.0)}
    """

    low: Float[Array, "..."] = eqx.field(converter=as_float)
    high: Float[Array, "..."] = eqx.field(converter=as_float)

    def __check_init__(self):
        check_numbers(low=self.low, high=self.high)
        if not (known(self.low) and known(self.high)):
            return
        low, high = np.asarray(self.low), np.asarray(self.high)
        if not (broadcasts(low.shape, high.shape) or broadcasts(high.shape, low.shape)):
            raise ValueError(f"low, high: shapes {low.shape} and {high.shape} do not fit")
        if not np.all(np.isfinite(low) & np.isfinite(high) & (low < high)):
            raise ValueError(f"low, high: must be finite and low < high, got {self.range}")

    def to_unbounded(self, value):
        low, high = matched(self.low, value), matched(self.high, value)
        return 0.25 * (jnp.log(value - low) - jnp.log(high - value))

    def to_bounded(self, unknown):
        low, high = matched(self.low, unknown), matched(self.high, unknown)
        return low + (high - low) * jax.nn.sigmoid(4 * unknown)

    def inside(self, value):
        return (value > matched(self.low, value)) & (value < matched(self.high, value))

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
    like: PyTree[Float[Array, "..."]]  # parameters, for their structure, shapes and fixed values

    def vector(self, parameters: PyTree) -> Float[Array, " p"]:
        """Unknowns of the parameters, in the default precision whatever theirs."""
        leaves = self._free(jax.tree.leaves(parameters))
        parts = [bound.to_unbounded(leaf).ravel() for bound, leaf in leaves]
        return jnp.concatenate([part.astype(jnp.result_type(float)) for part in parts])

    def parameters(self, vector: Float[Array, " p"]) -> PyTree:
        """Parameters of the unknowns."""
        parts = iter(self._parts(vector))

        def one(bound, leaf):
            return bound.to_bounded(next(parts)).astype(leaf.dtype) if bound.free else leaf

        leaves, structure = jax.tree.flatten(self.like)
        return structure.unflatten(map(one, self.bounds, leaves))

    def unflatten(self, vector: Float[Array, " p"]) -> PyTree:
        """The vector's numbers in the structure of the parameters, zeros for what is fixed."""
        parts = iter(self._parts(vector))
        one = lambda bound, leaf: next(parts) if bound.free else jnp.zeros_like(leaf)
        leaves, structure = jax.tree.flatten(self.like)
        return structure.unflatten(map(one, self.bounds, leaves))

    def _free(self, leaves):
        pairs = zip(self.bounds, leaves, strict=True)
        return [(bound, leaf) for bound, leaf in pairs if bound.free]

    def _parts(self, vector):
        """The vector cut up into arrays like the leaves that are not fixed."""
        leaves = [leaf for _, leaf in self._free(jax.tree.leaves(self.like))]
        parts = jnp.split(vector, np.cumsum([leaf.size for leaf in leaves])[:-1])
        parts = zip(parts, leaves, strict=True)
        return [part.reshape(leaf.shape).astype(leaf.dtype) for part, leaf in parts]

    def slopes(self, vector: Float[Array, " p"]) -> Float[Array, " p"]:
        """Derivative of each parameter with respect to its unknown."""
        slopes = jax.jvp(self.parameters, (vector,), (jnp.ones_like(vector),))[1]
        leaves = self._free(jax.tree.leaves(slopes))
        return jnp.concatenate([leaf.ravel().astype(vector.dtype) for _, leaf in leaves])

    def at_bound(self, vector: Float[Array, " p"]) -> tuple[str, ...]:
        """Names of the parameters that are at the end of their interval."""
        free = self._free(jax.tree.leaves(self.like))
        parts = zip(free, self._parts(vector), strict=True)
        there = np.concatenate([np.ravel(bound.at_bound(part)) for (bound, _), part in parts])
        return tuple(name for name, near in zip(self.names, there, strict=True) if near)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the unknown parameters by their place in the pytree, as 'stiffness[2]'."""
        return tuple(name for _, names in self._free(names_of(self.like)) for name in names)

    @property
    def fixed(self) -> tuple[str, ...]:
        """Names of the others."""
        pairs = zip(self.bounds, names_of(self.like), strict=True)
        return tuple(name for bound, names in pairs if not bound.free for name in names)

    @property
    def labels(self) -> tuple[str, ...]:
        """The unknowns as formulas, as 'log stiffness[2]'."""
        named = self._free(names_of(self.like))
        return tuple(bound.label(name) for bound, names in named for name in names)


def matched(numbers: Float[Array, "..."], value: Float[Array, "*d"]) -> Float[Array, "*d"]:
    """Numbers that go with a parameter or with data, in their shape and precision."""
    return jnp.broadcast_to(numbers, value.shape).astype(value.dtype)


def names_of(tree: PyTree) -> list[list[str]]:
    """Names of the numbers in every leaf of a pytree by their place, as 'stiffness[2]'."""
    paths = jax.tree_util.tree_leaves_with_path(tree)
    key = lambda path: jax.tree_util.keystr(path, simple=True, separator=".") or "parameter"
    index = lambda i: "[" + ", ".join(map(str, i)) + "]" if i else ""
    return [[key(path) + index(i) for i in np.ndindex(np.shape(leaf))] for path, leaf in paths]


def of_each_leaf(given: PyTree, parameters: PyTree, kind: type, name: str) -> list:
    """Objects of a kind, or None, for every leaf, given for leaves or for whole branches.

    Raises:
        ValueError: they do not have the parameters' structure, or are of another kind.
    """
    is_one = lambda x: x is None or isinstance(x, kind)
    try:
        spread = lambda one, branch: [one] * len(jax.tree.leaves(branch))
        each = jax.tree.map(spread, given, parameters, is_leaf=is_one)
    except ValueError as error:
        raise ValueError(f"{name}: not a prefix of the parameters' pytree: {error}") from None
    each = jax.tree.leaves(each, is_leaf=is_one)
    for one in each:
        if isinstance(one, type) and issubclass(one, kind):
            raise ValueError(f"{name}: {one.__name__} is a class; give {one.__name__}(...)")
        if not is_one(one):
            raise ValueError(f"{name}: expected {name} or None, got {one!r}")
    return each


def unknowns_of(guess: PyTree, bounds: PyTree = None) -> Unknowns:
    """The unknowns of parameters like `guess`.

    Args:
        bounds: a bound for each parameter, or for a whole branch of the pytree of parameters.
            None means any number, with the guess's size (its largest magnitude, 1 if that is
            zero) as the scale.

    Raises:
        ValueError: the guess is not strictly within the bounds, or does not have their structure.
    """
    for leaf, names in zip(jax.tree.leaves(guess), names_of(guess), strict=True):
        kind = getattr(leaf, "dtype", None) or np.asarray(leaf).dtype
        if not (jnp.issubdtype(kind, jnp.integer) or jnp.issubdtype(kind, jnp.floating)):
            place = names[0] if names else "an array without elements"
            raise ValueError(
                f"guess: must hold real numbers and arrays of them; {place} is {leaf!r}"
            )
    guess = jax.tree.map(as_float, guess)
    each = of_each_leaf(bounds, guess, AbstractBound, "bounds")
    if not each:
        raise ValueError("guess: it holds no parameter")
    leaves = jax.tree.leaves(guess)
    each = [_default(leaf) if one is None else one for one, leaf in zip(each, leaves, strict=True)]
    unknowns = Unknowns(tuple(each), guess)
    if not unknowns.names:
        raise ValueError("bounds: every parameter is fixed; leave one free")
    for bound, leaf, names in zip(each, leaves, names_of(guess), strict=True):
        shapes = [np.shape(x) for x in jax.tree.leaves(bound)]
        if not all(broadcasts(shape, leaf.shape) for shape in shapes):
            raise ValueError(
                f"bounds: that of {names[0]} has numbers of shapes {shapes}, which do not broadcast"
                f" to the parameter's, {leaf.shape}"
            )
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
