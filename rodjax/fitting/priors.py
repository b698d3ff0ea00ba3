"""What is known of parameters before a fit: one more datum for each number with a prior."""

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from rodjax.fitting.bounds import Unknowns, matched, names_of, of_each_leaf
from rodjax.inputs.validation import as_float, broadcasts, check_finite, check_positive


class AbstractPrior(eqx.Module):
    """Knowledge of each element of a parameter by itself."""

    @abc.abstractmethod
    def residuals(self, value: Float[Array, "*d"]) -> Float[Array, "*d"]:
        """By how many standard deviations the parameter is off."""


class NormalPrior(AbstractPrior):
    """Normally distributed about `mean` with the standard `deviation`, in the parameter's units.

    Numbers, or arrays with a number for each element of the parameter.

    Example:
        >>> priors = {"diameter": rx.NormalPrior(0.01, 5e-4)}
    """

    mean: Float[Array, "..."] = eqx.field(converter=as_float)
    deviation: Float[Array, "..."] = eqx.field(converter=as_float)

    def __check_init__(self):
        check_finite(mean=self.mean)
        check_positive(deviation=self.deviation)

    def residuals(self, value):
        return (value - matched(self.mean, value)) / matched(self.deviation, value)


class LogNormalPrior(AbstractPrior):
    """A positive parameter whose logarithm is normally distributed about that of `median`.

    `deviation`: standard deviation of the logarithm, for a small one that relative to the value.

    Example:
        >>> priors = {"drag": rx.LogNormalPrior(1.0, 0.3)}  # within 30 %
    """

    median: Float[Array, "..."] = eqx.field(converter=as_float)
    deviation: Float[Array, "..."] = eqx.field(converter=as_float)

    def __check_init__(self):
        check_positive(median=self.median, deviation=self.deviation)

    def residuals(self, value):
        return jnp.log(value / matched(self.median, value)) / matched(self.deviation, value)


class Priors(eqx.Module):
    """A prior or None for each leaf of the parameters; `priors_of` makes it."""

    each: tuple[AbstractPrior | None, ...]

    def residuals(self, parameters: PyTree) -> Float[Array, " m"]:
        """Those of all parameters with a prior."""
        leaves = zip(self.each, jax.tree.leaves(parameters), strict=True)
        parts = [prior.residuals(leaf).ravel() for prior, leaf in leaves if prior is not None]
        none = jnp.zeros(0)
        return jnp.concatenate([none, *(part.astype(none.dtype) for part in parts)])

    def count(self, parameters: PyTree) -> int:
        """Number of them."""
        leaves = zip(self.each, jax.tree.leaves(parameters), strict=True)
        return sum(leaf.size for prior, leaf in leaves if prior is not None)


def priors_of(priors: PyTree, unknowns: Unknowns) -> Priors:
    """The priors of parameters.

    Args:
        priors: a prior or None for each parameter, or for a whole branch of the pytree.

    Raises:
        ValueError: not of the parameters' structure or shapes, or a prior of what is fixed.
    """
    like = unknowns.like
    each = of_each_leaf(priors, like, AbstractPrior, "priors")
    leaves = zip(each, unknowns.bounds, jax.tree.leaves(like), names_of(like), strict=True)
    for prior, bound, leaf, names in leaves:
        if prior is None:
            continue
        if not bound.free:
            raise ValueError(f"priors: {names[0]} is fixed; leave its prior out (None)")
        shapes = [np.shape(x) for x in jax.tree.leaves(prior)]
        if not all(broadcasts(shape, leaf.shape) for shape in shapes):
            raise ValueError(
                f"priors: that of {names[0]} has numbers of shapes {shapes}, which do not broadcast"
                f" to the parameter's, {leaf.shape}"
            )
        if not np.all(np.isfinite(prior.residuals(leaf))):
            raise ValueError(f"priors: that of {names[0]} is not finite at the guess, {leaf}")
    return Priors(tuple(each))
