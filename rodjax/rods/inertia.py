"""Inertia of the nodes: half of that of either neighbouring element, lumps, and added mass."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.rods import lumped
from rodjax.rods.state import NodeMotion


def node_inertia(rod) -> tuple[Float[Array, " nodes"], Float[Array, "nodes 3"] | None]:
    """Mass [kg] and principal rotary inertia [kg m^2] of the nodes, without lumps."""
    rotary = None if rod.rotary_inertia is None else rod.to_nodes(rod.rotary_inertia)
    return rod.to_nodes(rod.mass), rotary


def inertial_wrench(
    scene, motion: NodeMotion, acceleration: Float[Array, "nodes 6"]
) -> Float[Array, "nodes 6"]:
    """Mass times acceleration and, in the body frame, I omega' + omega x I omega."""
    mass, rotary = node_inertia(scene.rod)
    linear = mass[:, None] * acceleration[:, :3]
    for load in scene.loads:
        added = load.added_mass(scene.rod, motion)
        if added is not None:
            linear = linear + jnp.einsum("nij,nj->ni", added, acceleration[:, :3])
    if rotary is None:
        wrench = jnp.concatenate([linear, jnp.zeros_like(linear)], 1)
    else:
        spin = motion.angular_velocity
        angular = rotary * acceleration[:, 3:] + jnp.cross(spin, rotary * spin)
        wrench = jnp.concatenate([linear, angular], 1)
    if scene.rod.lumps:
        wrench = wrench + lumped.inertial_wrench(scene.rod, motion, acceleration)
    return wrench


def kinetic_energy(scene, motion: NodeMotion) -> Float[Array, ""]:
    """Eq. (6) summed over the nodes [J]; zero for a rod without inertia."""
    if scene.rod.mass is None:
        return jnp.zeros((), motion.position.dtype)
    mass, rotary = node_inertia(scene.rod)
    energy = 0.5 * jnp.sum(mass[:, None] * motion.velocity**2)
    if rotary is not None:
        energy = energy + 0.5 * jnp.sum(rotary * motion.angular_velocity**2)
    for load in scene.loads:
        added = load.added_mass(scene.rod, motion)
        if added is not None:
            energy = energy + 0.5 * jnp.einsum("ni,nij,nj", motion.velocity, added, motion.velocity)
    if scene.rod.lumps:
        energy = energy + lumped.kinetic_energy(scene.rod, motion)
    return energy


def node_jacobian(function, z: Float[Array, "nodes 6"]) -> Float[Array, "nodes 6 6"]:
    """Derivative of a function whose rows depend on the same rows of z only."""
    push = lambda direction: jax.jvp(function, (z,), (jnp.broadcast_to(direction, z.shape),))[1]
    return jax.vmap(push, out_axes=2)(jnp.eye(6, dtype=z.dtype))
