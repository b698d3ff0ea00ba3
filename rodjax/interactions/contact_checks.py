"""Whether a contact law acts where it is meant to: looked at once, when a scene is made."""

from typing import Any

import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rodjax.inputs.validation import all_known, check_instance
from rodjax.interactions.contact_law import AbstractLaw, PairProperties
from rodjax.interactions.friction import AbstractFriction
from rodjax.numerics.compilation import compiled
from rodjax.rods.rod import Rod

# Distances at which a law is tried, from its smallest to the cut-off, and the one tried by itself.
_TRIED, _ALONE = 64, 7


def check_friction(friction: Any) -> None:
    """Raise ValueError where strands cannot rub on each other by this law."""
    if friction is None:
        return
    mend = "give a law such as SlidingFriction(0.3, slip_speed=1e-4), or None for smooth strands"
    check_instance(AbstractFriction, mend, friction=friction)
    if friction.remembers:
        raise ValueError(
            f"friction: strands have no anchors on each other, as {type(friction).__name__} needs"
            " them; give SlidingFriction with a slip speed that is small beside the motion"
        )


def check_law(law: AbstractLaw, cutoff: Float[Array, ""], rod: Rod) -> None:
    """Raise ValueError where the law does nothing below the cut-off, or no numbers come of it.

    Values that are not known are not looked at.
    """
    leaves = jax.tree.leaves((law, cutoff, rod.diameter, rod.mass))
    if not all_known(leaves) or np.ndim(cutoff) != 0:
        return
    # numpy's: in traced code an operation of jax would be traced
    of_both = lambda v: np.asarray([np.min(v), np.max(v)], rod.position.dtype)
    mass: Any = None if rod.mass is None else of_both(np.asarray(rod.mass))
    diameter: Any = of_both(np.asarray(rod.diameter))
    pair = PairProperties(diameter, mass)
    # evaluated also where a scene is made in traced code
    with jax.core.eval_context():
        psi, among, alone, tried, smallest, extent = jax.tree.map(
            np.asarray, _try(law, cutoff, pair)
        )
    limit = float(cutoff)
    if extent is not None and limit <= np.max(extent):
        raise ValueError(
            f"cutoff: {limit:.4g} is not beyond {np.max(extent):.4g}, where this law begins to"
            f" act: strands would overlap without a force; give at least {1.1 * np.max(extent):.4g}"
        )
    if limit <= np.max(smallest):
        raise ValueError(
            f"cutoff: {limit:.4g} is not beyond {np.max(smallest):.4g}, the smallest distance of"
            " this law, so that nothing of it would act"
        )
    if psi.shape != tried.shape:
        raise ValueError(
            f"law: `{type(law).__name__}.repulsion` must give one number for each distance, got"
            f" shape {psi.shape} for {tried.shape}"
        )
    wrong = ~np.isfinite(np.asarray(psi))
    if np.any(wrong):
        raise ValueError(
            f"law: {type(law).__name__} gives {np.asarray(psi)[wrong][0]} at a distance of"
            f" {np.asarray(tried)[wrong][0]:.4g}; it must be finite from `smallest` to the cut-off"
        )
    eps = np.finfo(psi.dtype).eps
    for all_pairs, one_pair in zip(among, alone, strict=True):
        many, one, scale = all_pairs[_ALONE, 0], one_pair[0], np.max(np.abs(all_pairs))
        if not np.isclose(one, many, rtol=np.sqrt(eps), atol=eps * scale, equal_nan=True):
            raise ValueError(
                f"law: `{type(law).__name__}.repulsion` gives {float(one):.6g} for a pair"
                f" alone and {float(many):.6g} for the same among others; a pair's force must not"
                " depend on other pairs, so write it distance by distance"
            )
    if not np.any(np.asarray(psi) != 0):
        raise ValueError(
            f"law: {type(law).__name__} gives no force at any distance below the cut-off"
            f" {limit:.4g}; check its strength and range"
        )


@compiled
def _try(law, cutoff, pair):
    smallest, extent = law.smallest(pair), law.extent(pair)
    low = jnp.maximum(smallest, 1e-3 * pair.diameter)
    high = cutoff if extent is None else jnp.minimum(cutoff, extent)
    parts = jnp.linspace(0.001, 0.999, _TRIED, dtype=low.dtype)[:, None]
    tried = low[None] + parts * (high - low)[None]
    wide = jax.tree.map(lambda v: jnp.broadcast_to(v, tried.shape), pair)
    # at rest, and with speeds of the order of the distances in a second
    among, alone = [], []
    for speed in (jnp.zeros_like(tried), tried * jnp.where(parts > 0.3, 1.0, -1.0)):
        among.append(law.repulsion(tried, speed, wide))
        first = jax.tree.map(lambda v: v[:1], pair)
        alone.append(law.repulsion(tried[_ALONE, :1], speed[_ALONE, :1], first))
    return among[0], among, alone, tried, smallest, extent
