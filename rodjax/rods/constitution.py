"""What a rod is made of, as its balances see it: moments, their slopes, energies.

A rod of a diagonal stiffness without material or actuation is linear and traces nothing of the
rest.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.numerics import rotations
from rodjax.rods.material import ElementMotion, Recalled, linear_moment, stiffness_matrix
from rodjax.rods.rod import Rod
from rodjax.rods.state import Moving, NodeMotion, State
from rodjax.rods.strains import element_rotation


def natural_curvature(rod: Rod, time: Float[Array, ""]) -> Float[Array, "n 3"]:
    """kappa0 at a time, actuation included [1/m]."""
    if rod.actuation is None:
        return rod.natural_curvature
    driven = rod.actuation(time).astype(rod.natural_curvature.dtype)
    return rod.natural_curvature + jnp.broadcast_to(driven, rod.natural_curvature.shape)


def rotation_rate(
    rotation: Float[Array, "n 3"], first: Float[Array, "n 3"], second: Float[Array, "n 3"]
) -> Float[Array, "n 3"]:
    """phi' of elements whose nodes spin so, in body components [rad/s]; zero in rigid motion."""
    squared = jnp.sum(rotation * rotation, -1, keepdims=True)
    jump = second - first
    twice = rotations.cross(rotation, rotations.cross(rotation, jump))
    return (
        jump
        + 0.5 * rotations.cross(rotation, first + second)
        + rotations.inverse_tangent_coefficient(squared) * twice
    )


def middle_spin(
    rotation: Float[Array, "n 3"], first: Float[Array, "n 3"], second: Float[Array, "n 3"]
) -> Float[Array, "n 3"]:
    """Spin of the element frame, in its own components [rad/s]."""
    squared = jnp.sum(rotation * rotation, -1, keepdims=True)
    turned = rotations.cross(rotation, second - first)
    return 0.5 * (first + second) + rotations.midframe_coefficient(squared) * turned


def element_motion(rod: Rod, rotation: Float[Array, "n 3"], motion: NodeMotion) -> ElementMotion:
    """What the rod's material sees of a motion."""
    assert rod.material is not None
    rate = jnp.zeros_like(rotation)
    if rod.material.viscous:
        spin = motion.angular_velocity
        rate = rotation_rate(rotation, spin[:-1], spin[1:]) / rod.gauge_length[:, None]
    return ElementMotion(
        rod.midpoints,
        rod.at_breaks(rod.stiffness, 1.0),  # where nothing is, whatever comes of it is left out
        rod.coupling,
        rotation / rod.gauge_length[:, None],
        natural_curvature(rod, motion.time),
        rate,
        motion.time,
    )


def seen_by_material(rod: Rod, motion: NodeMotion) -> ElementMotion:
    """`element_motion` of a motion."""
    rotation = rotations.logarithm(element_rotation(rod, motion.quaternion))
    return element_motion(rod, rotation, motion)


def recalled(rod: Rod, memory: Any) -> Rod:
    """The rod whose material knows what it remembers; as it is for None."""
    if memory is None or rod.material is None:
        return rod
    return eqx.tree_at(lambda rod: rod.material, rod, Recalled.of(rod.material, memory))


def in_state(rod: Rod, state: State) -> Rod:
    """The rod that knows what a state remembers of it."""
    return rod if state.memory is None else recalled(rod, state.memory.material)


def internal_moment(
    rod: Rod, rotation: Float[Array, "n 3"], motion: NodeMotion
) -> Float[Array, "n 3"]:
    """q = B (kappa - kappa0), Eq. (3), or what the rod's material says [N m]."""
    if rod.material is not None:
        moment = rod.material.moment(element_motion(rod, rotation, motion))
        return rod.at_breaks(moment, 0.0)
    change = rotation / rod.gauge_length[:, None] - natural_curvature(rod, motion.time)
    return linear_moment(rod.stiffness, rod.coupling, change)


def moment_slopes(
    rod: Rod, rotation: Float[Array, "n 3"], motion: NodeMotion
) -> tuple[Float[Array, "n 3 3"], Float[Array, "n 3 3"] | None]:
    """Derivatives of q by the curvature, and by its rate where a material is viscous."""
    if rod.material is None:
        return stiffness_matrix(rod.stiffness, rod.coupling), None
    slopes = rod.material.slopes(element_motion(rod, rotation, motion))
    by_curvature, by_rate = (rod.at_breaks(slope, 0.0) for slope in slopes)
    return by_curvature, by_rate if rod.material.viscous else None


def diagonal(rod: Rod) -> bool:
    """Whether the moment is B (kappa - kappa0) with diagonal B."""
    return rod.material is None and rod.coupling is None


def shortening(rod: Rod, rotation: Float[Array, "n 3"], time: Float[Array, ""]):
    """b tau along the tangent, of a cable that shortens as it is twisted; None of others."""
    if rod.torque_per_tension is None:
        return None
    twist = rotation[:, 2] / rod.gauge_length - natural_curvature(rod, time)[:, 2]
    return along_tangent(rod.torque_per_tension * twist)


def along_tangent(values: Float[Array, " n"]) -> Float[Array, "n 3"]:
    """Vectors along a_3."""
    zero = jnp.zeros_like(values)
    return jnp.stack([zero, zero, values], 1)


def node_spins(
    motion: NodeMotion, moving: Moving, z: Float[Array, "n 6"]
) -> tuple[Float[Array, "n 3"], Float[Array, "n 3"]]:
    """Spins of both nodes of every element after body spins z of them in a step."""
    first = rotations.tangent_inverse_apply(moving.turn[:-1], z[:, :3])
    second = rotations.tangent_inverse_apply(moving.turn[1:], z[:, 3:])
    spin = motion.angular_velocity
    return spin[:-1] + moving.by_velocity * first, spin[1:] + moving.by_velocity * second


def moment_energy_density(
    rod: Rod, rotation: Float[Array, "n 3"], motion: NodeMotion
) -> Float[Array, "n 3"]:
    """The terms of Eq. (4) in bending about a_1 and a_2 and in torsion; what couples them halved.

    What a material does not share out counts as bending.
    """
    if rod.material is not None:
        density = rod.material.energy(element_motion(rod, rotation, motion))
        if density.ndim == 2:
            return density
        zero = jnp.zeros_like(density)
        return jnp.stack([density, zero, zero], 1)
    change = rotation / rod.gauge_length[:, None] - natural_curvature(rod, motion.time)
    if rod.coupling is None:
        return 0.5 * rod.stiffness * change**2
    return 0.5 * change * linear_moment(rod.stiffness, rod.coupling, change)
