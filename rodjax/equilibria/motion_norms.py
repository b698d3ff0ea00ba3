"""Norms in which motions of a rod at rest are measured and resisted."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.scenes.scene import Scene


def moving_weight(scene: Scene) -> Float[Array, "nodes 6"]:
    """Weights of the norm of motions: the integral of |displacement|^2/L^2 + |spin|^2 [1/m, m]."""
    rod = scene.rod
    spin = jnp.repeat(rod.weighing_length[:, None], 3, 1)
    return jnp.concatenate([spin / jnp.sum(rod.length) ** 2, spin], 1)


def resisting_weight(scene: Scene) -> Float[Array, "nodes 6"]:
    """What resists the motions of a descent: `moving_weight`, but hardly a spin about the tangent.

    Twist hardly ever is what makes a rod unstable. Resisted in full it would come to rest, beyond
    the critical turns, in some thousand steps only.
    """
    return moving_weight(scene).at[:, 5].multiply(1e-2)
