"""A small crookedness that starts buckling, whatever holds the ends."""

import dataclasses

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rodjax.inputs.argument_types import Number
from rodjax.inputs.validation import (
    as_integer,
    check_instance,
    check_integer,
    check_not_negative,
    check_scalar,
)
from rodjax.rods.chain import check_alone
from rodjax.rods.rod import Rod


def imperfect(
    rod: Rod,
    fraction: Number | Float[Array, ""] = 1e-3,
    *,
    amplitude: Number | Float[Array, ""] | None = None,
    modes: int = 4,
    seed: int = 0,
) -> Rod:
    """The rod with a small smooth natural curvature of random shape added, about a_1 and a_2.

    An imperfection excites a buckling mode by the integral of its curvature times the mode's.
    A uniform natural curvature therefore is none between two clamps, whose modes have curvatures
    of zero mean: such a column stays straight far beyond its critical load. The curvature here,

        kappa0 += sum over k = 1 .. modes of r_k (a_k cos(k pi s / L) + b_k sin(k pi s / L)),

    with unit vectors a_k, b_k of random directions in the cross-section and r_k = 1/k, has a part
    in every low mode of any ends (cos(2 pi s / L) between clamps, sin(pi s / L) between pins,
    cos(pi s / 2 L) of a cantilever), and in both planes.

    Args:
        rod: the rod; its placing is left as it is, so that one built straight starts straight.
        fraction: largest distance of the unloaded crooked rod from the line through its ends
            (from its own shape, if that is curved), over the rod's length.
        amplitude: the same as a length [m], instead of `fraction`.
        modes: number of half waves of the shortest wave; at most half the number of elements.
        seed: of the random directions. The same seed gives the same shape on every grid.

    Small means: well above the tolerance of the solution (step control, Newton), well below what
    is to be measured. In dynamics it decides when buckling is seen: the time that a growing mode
    needs from it on goes with its logarithm.

    Raises:
        ValueError: a size is negative, or `modes` does not fit the grid.

    Example:
        >>> crooked = rx.imperfect(rod, 1e-3, seed=1)
        >>> bool(jnp.any(crooked.natural_curvature != rod.natural_curvature))
        True
    """
    name, size = ("fraction", fraction) if amplitude is None else ("amplitude", amplitude)
    check_instance(Rod, "give a rod, of straight_rod or curved_rod", rod=rod)
    check_alone(rod, "an imperfection")
    check_scalar(**{name: size})
    check_not_negative(**{name: size})
    modes, seed = as_integer(modes), as_integer(seed)
    try:
        check_integer(1, rod.elements // 2, modes=modes)
    except ValueError as error:
        raise ValueError(f"{error}; the rod has {rod.elements} elements, two a half wave") from None
    check_integer(0, 2**63 - 1, seed=seed)
    length = jnp.sum(rod.length)
    # of the rod's precision, whatever the kind of the number given
    largest = jnp.asarray(size, length.dtype)
    if amplitude is None:
        largest = largest * length
    unit = jnp.asarray(_directions(modes, seed), length.dtype)
    curvature = _waves(jnp, modes, rod.midpoints / length).T @ unit
    # the shape at rest of an inextensible rod of this curvature, and its distance from the chord
    slope = jnp.cumsum(curvature * rod.length[:, None], 0) - 0.5 * curvature * rod.length[:, None]
    steps = slope * rod.length[:, None]
    shape = jnp.concatenate([jnp.zeros_like(steps[:1]), jnp.cumsum(steps, 0)])
    shape = shape - shape[-1:] * (rod.arc_length / length)[:, None]
    largest = largest / jnp.max(jnp.linalg.norm(shape, axis=1))
    added = jnp.pad(largest * curvature, ((0, 0), (0, 1)))
    return dataclasses.replace(rod, natural_curvature=rod.natural_curvature + added)


def _waves(numbers, modes: int, s):
    """cos(k pi s) / k and sin(k pi s) / k (2 modes, points), by numpy or jax.numpy."""
    k = numbers.arange(1, modes + 1, dtype=s.dtype)[:, None]
    angle = np.pi * k * s[None]
    return numbers.concatenate([numbers.cos(angle) / k, numbers.sin(angle) / k])


# Curvatures of the lowest buckling modes over s / L: between clamps, between pins, of a clamp and a
# pin, of a cantilever; the first two kinds with their second mode.
_BUCKLING = (
    lambda s: np.cos(2 * np.pi * s),
    lambda s: np.sin(8.98682 * (s - 0.5)),
    lambda s: np.sin(np.pi * s),
    lambda s: np.sin(2 * np.pi * s),
    lambda s: np.sin(4.49341 * s),
    lambda s: np.sin(4.49341 * (1 - s)),
    lambda s: np.cos(0.5 * np.pi * s),
    lambda s: np.sin(0.5 * np.pi * s),
)


def _directions(modes: int, seed: int) -> np.ndarray:
    """Unit vectors (2 modes, 2) of the waves.

    Waves may cancel each other's part in a mode: of some random draws that is taken whose least
    part in any buckling mode is the largest.
    """
    s = (np.arange(400) + 0.5) / 400
    parts = np.stack([mode(s) / np.linalg.norm(mode(s)) for mode in _BUCKLING])
    parts = parts @ _waves(np, modes, s).T
    angles = 2 * np.pi * np.random.default_rng(seed).random((16, 2 * modes))
    draws = np.stack([np.cos(angles), np.sin(angles)], -1)
    least = np.min(np.linalg.norm(parts @ draws, axis=2), 1)
    return draws[np.argmax(least)]
