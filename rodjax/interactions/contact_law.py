"""The law of contact, or of remote interaction, between two short lengths of rod.

A law gives the repulsion psi(d, c) between two lengths of rod, per length of either [N/m^2], as a
function of the distance d of their centrelines and the approach speed c = -d'. The force between
two contact points that stand for the lengths h_a, h_b is psi h_a h_b: a midpoint rule for a
double integral, so the total does not depend on the spacing of the points.
"""

import abc
from typing import NamedTuple

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


class PairProperties(NamedTuple):
    """Means of the rod's properties at the two points of a pair."""

    diameter: Float[Array, "..."]
    mass: Float[Array, "..."] | None  # per length


class AbstractLaw(eqx.Module):
    """A pair interaction.

    Example:
        >>> class Exponential(rx.AbstractLaw):
        ...     strength: jax.Array
        ...     def repulsion(self, distance, approach, pair):
        ...         return self.strength * jnp.exp(-distance / pair.diameter)
        ...     def smallest(self, pair):
        ...         return 0.1 * pair.diameter
        >>> contact = rx.Contact(Exponential(jnp.asarray(1.0)), segments=40, cutoff=0.05)
    """

    @abc.abstractmethod
    def repulsion(self, distance, approach, pair: PairProperties) -> Array:
        """psi(d, c) [N/m^2] for d above `smallest`."""

    @abc.abstractmethod
    def smallest(self, pair: PairProperties) -> Array:
        """Distance below which the law is continued by its tangent in d (C1)."""

    def uses_mass(self) -> bool:
        """Whether the law needs the rod's mass per length."""
        return False

    def default_aperture(self) -> float | None:
        """Screening aperture [rad] of a `Contact` that is given none; None: all space.

        An aperture weakens the force between strands that are not exactly side by side, leaves it
        without potential and lets a tip through; only a law that was fitted with one needs it.
        """
        return None

    def extent(self, pair: PairProperties) -> Array | None:
        """Distance from which on psi is exactly zero [m], as for solids; None: it only fades.

        The cut-off must not lie below it, and does not touch the law.
        """
        return None

    def potential(self, distance, pair: PairProperties) -> Array:
        """phi(d) with psi(d, 0) = -dphi/dd, per length of either strand [J/m^2].

        A constant in it is of no account. Here it is integrated from d, which must not be below
        `smallest`, to one diameter or to `smallest` where that is more.
        """
        # by the logarithm of the distance from a place just below the smallest: a law that has a
        # pole below it may be steep there
        smallest = self.smallest(pair)
        origin = smallest - _BELOW * pair.diameter
        start = jnp.log(distance - origin)
        end = jnp.log(jnp.maximum(pair.diameter, smallest) - origin)
        points, weights = (
            jnp.asarray(v, distance.dtype).reshape((1,) * distance.ndim + (-1,)) for v in _GAUSS
        )
        beyond = jnp.exp(start[..., None] + points * (end - start)[..., None])
        x = origin[..., None] + beyond
        wide = jax.tree.map(lambda v: jnp.asarray(v)[..., None], pair)
        psi = self.repulsion(x, jnp.zeros_like(x), wide)
        return (end - start) * jnp.sum(weights * beyond * psi, -1)


_BELOW = 0.01
"""In diameters; about the distance of a law's pole from its `smallest`."""

_GAUSS = tuple(
    0.5 * v + o for v, o in zip(np.polynomial.legendre.leggauss(32), (0.5, 0.0), strict=True)
)
"""Points in (0, 1) and weights."""


def ignores_approach(law: AbstractLaw, pair: PairProperties) -> bool:
    """Whether psi is the same at any approach speed, whatever the law's numbers."""
    like = jnp.ones_like(pair.diameter)
    program = jax.make_jaxpr(lambda approach: law.repulsion(like, approach, pair))(like).jaxpr
    read = [*program.outvars, *(v for equation in program.eqns for v in equation.invars)]
    return not any(v is program.invars[0] for v in read)


def continued(law: AbstractLaw, distance, approach, pair: PairProperties):
    """psi(d, c), continued linearly below the law's smallest distance.

    Newton needs a finite slope to come back on when an iterate has strands too close.
    """
    floor = law.smallest(pair)
    at = jnp.maximum(distance, floor)
    value, slope = jax.jvp(lambda d: law.repulsion(d, approach, pair), (at,), (jnp.ones_like(at),))
    return value + slope * jnp.minimum(distance - floor, 0.0)


def continued_potential(law: AbstractLaw, distance, pair: PairProperties):
    """phi(d) of `continued` strands at rest [J/m^2]."""
    floor = law.smallest(pair)
    at = jnp.maximum(distance, floor)
    still = jnp.zeros_like(at)
    psi, slope = jax.jvp(lambda d: law.repulsion(d, still, pair), (at,), (jnp.ones_like(at),))
    below = jnp.minimum(distance - floor, 0.0)
    return law.potential(at, pair) - psi * below - 0.5 * slope * below**2
