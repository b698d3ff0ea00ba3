"""Strains of the elements: curvature and twist, and the stretch-shear vector.

For the relative rotation phi = log(q_i^-1 q_{i+1}) of an element:
    kappa = phi / ds,   q_e = q_i exp(phi / 2),   gamma = q_e^-1 (R_{i+1} - R_i) / ds.
An inextensible, unshearable rod has gamma = e3. Both are objective: a rigid motion leaves them.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from rodjax.numerics import rotations
from rodjax.rods.rod import Rod

# Real part of an element's relative rotation beyond which it is refused: 0.9 of a revolution.
_FULLY_WOUND = -0.95


class Strains(NamedTuple):
    """Kinematics of all elements."""

    rotation: Float[Array, "n 3"]  # phi [rad]
    frame: Float[Array, "n 3 3"]  # rotation matrix of q_e, body to inertial
    stretch: Float[Array, "n 3"]  # gamma


def relative_rotation(quaternion: Float[Array, "nodes 4"]) -> Float[Array, "n 4"]:
    """q_i^-1 q_{i+1} of successive frames."""
    return rotations.multiply(rotations.conjugate(quaternion[:-1]), quaternion[1:])


def element_rotation(rod: Rod, quaternion: Float[Array, "nodes 4"]) -> Float[Array, "n 4"]:
    """q_i^-1 q_{i+1} of every element; no rotation where there is none (`Rod.breaks`)."""
    return rod.at_breaks(relative_rotation(quaternion), (1.0, 0.0, 0.0, 0.0))


def wound(rod: Rod, quaternion: Float[Array, "nodes 4"]) -> Bool[Array, ""]:
    """Whether an element has turned by nearly a revolution, where its rotation vector jumps."""
    return jnp.min(element_rotation(rod, quaternion)[:, 0]) < _FULLY_WOUND


def halfway(relative: Float[Array, "n 4"]) -> Float[Array, "n 4"]:
    """exp(phi/2) of exp(phi): the square root of a unit quaternion."""
    w = relative[..., :1]
    scale = 1 / jnp.sqrt(2 * (1 + w))
    return jnp.concatenate([(1 + w) * scale, relative[..., 1:] * scale], -1)


def element_quaternions(quaternion: Float[Array, "nodes 4"]) -> Float[Array, "n 4"]:
    """Frames q_e of the elements, halfway between those of their nodes."""
    return rotations.multiply(quaternion[:-1], halfway(relative_rotation(quaternion)))


def strains(
    rod: Rod, position: Float[Array, "nodes 3"], quaternion: Float[Array, "nodes 4"]
) -> Strains:
    """Strains of every element of a configuration.

    Where there is no element (`Rod.breaks`) they are those at rest, and the frame is zero, so that
    its force acts on no node.
    """
    relative = element_rotation(rod, quaternion)
    frame = rotations.matrix(rotations.multiply(quaternion[:-1], halfway(relative)))
    frame = rod.at_breaks(frame, 0.0)
    edge = (position[1:] - position[:-1]) / rod.gauge_length[:, None]
    stretch = rod.at_breaks(jnp.einsum("nji,nj->ni", frame, edge), (0.0, 0.0, 1.0))
    # the barrier keeps XLA from evaluating the rotations anew in every kernel that reads them
    return Strains(*lax.optimization_barrier((rotations.logarithm(relative), frame, stretch)))


def curvature(rod: Rod, quaternion: Float[Array, "nodes 4"]) -> Float[Array, "n 3"]:
    """kappa of every element in its own frame [1/m]."""
    return rotations.logarithm(element_rotation(rod, quaternion)) / rod.gauge_length[:, None]
