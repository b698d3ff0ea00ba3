"""Where along its mode a branch point is symmetric.

On either side disturbed states are as singular, at other loads: from a state on the branch that
leaves, at three times its distance. What tells them is that the load of the mode changes with its
amplitude, and that they need a disturbance, beta of `singular_points`.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from rodjax.continuation.family import elastic_of

# By how much a disturbance that a branch point needs may bend the rod [rad].
SYMMETRIC = 1e-5

# The search goes on from where an increment changes the parameter by less than this.
SETTLED = 1e-6

# A point is symmetric that needs no disturbance above the first [rad], or whose load changes with
# the amplitude of its mode by less than the second (over the unit, by radian).
_DISTURBED, _SKEW = 1e-13, 1e-6

# How far it is moved to find out, and at most [rad].
_PROBE, _MOST = 1e-3, 0.05


class Symmetry(NamedTuple):
    """What the search knows."""

    skew: Float[Array, ""]  # how the load changes with the amplitude, where it had settled last
    moved: Float[Array, ""]  # since then [rad]
    rate: Float[Array, ""]  # of the skew, NaN as long as it is not known

    @classmethod
    def unknown(cls, like: Float[Array, ""]) -> "Symmetry":
        """Before the first increment."""
        zero = jnp.zeros_like(like)
        return cls(zero, zero, jnp.full_like(like, jnp.nan))

    def search(self, skew, bent, settled: Bool[Array, ""], branches: Bool[Array, ""]):
        """How far to go along the mode [rad], what is then known, and whether there is a need."""
        asymmetric = branches & (bent > _DISTURBED) & (jnp.abs(skew) > _SKEW)
        rate = jnp.where(settled & (self.moved != 0), (skew - self.skew) / self.moved, self.rate)
        wanted = jnp.clip(-skew / rate, -_MOST, _MOST)
        wanted = jnp.where(jnp.isfinite(wanted), wanted, _PROBE)
        move = jnp.where(settled & asymmetric, wanted, 0.0)
        last = jnp.where(settled, skew, self.skew)
        known = Symmetry(last, jnp.where(settled, 0.0, self.moved) + move, rate)
        return move, known, asymmetric


def bent_by(equations, mode, column, beta) -> Float[Array, ""]:
    """About how far what beta stands for bends the rod [rad]."""
    wrench = column[: len(mode), 3:] * equations.scales.wrench[None]
    scene = equations.scene
    return jnp.abs(beta * jnp.sum(mode * wrench)) / (
        elastic_of(scene) * jnp.sqrt(jnp.sum(scene.rod.length))
    )
