"""What the lumps of a rod demand of their nodes and store, all at once; see `lump`."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rodjax.numerics import rotations
from rodjax.rods.state import NodeMotion


class Lumped(NamedTuple):
    """The lumps of a rod in rows; None for what none of them has."""

    nodes: np.ndarray  # of each lump
    mass: Float[Array, " k"]
    inertia: Float[Array, "k 3 3"] | None
    offset: Float[Array, "k 3"] | None
    volume: Float[Array, " k"] | None

    def at_nodes(self, rows: Float[Array, "k *m"], like: Float[Array, "nodes *m"]):
        """Sum at the nodes of rows of the lumps."""
        return jnp.zeros_like(like).at[self.nodes].add(rows)

    def about_node(self, motion: NodeMotion, force: Float[Array, "k 3"]) -> Float[Array, "k 6"]:
        """Forces at the centres of mass (inertial), with their moments about the nodes (body)."""
        if self.offset is None:
            return jnp.concatenate([force, jnp.zeros_like(force)], 1)
        turned = rotations.rotate_inverse(motion.quaternion[self.nodes], force)
        return jnp.concatenate([force, rotations.cross(self.offset, turned)], 1)

    def centre(self, motion: NodeMotion) -> Float[Array, "k 3"]:
        """Where the centres of mass are [m]."""
        if self.offset is None:
            return motion.position[self.nodes]
        arm = rotations.rotate(motion.quaternion[self.nodes], self.offset)
        return motion.position[self.nodes] + arm


def lumped(rod) -> Lumped:
    """The lumps of a rod, of which there is at least one."""
    dtype, lumps = rod.position.dtype, rod.lumps

    def rows(name, shape):
        values = [getattr(lump, name) for lump in lumps]
        if all(value is None for value in values):
            return None
        zero = jnp.zeros(shape, dtype)
        own = [zero if value is None else _matrix(value, shape) for value in values]
        return jnp.stack(own).astype(dtype)

    nodes = np.array([lump.place(rod.parts) for lump in lumps])
    mass = jnp.stack([lump.mass for lump in lumps]).astype(dtype)
    return Lumped(nodes, mass, rows("inertia", (3, 3)), rows("offset", (3,)), rows("volume", ()))


def _matrix(value, shape):
    return jnp.diag(value) if value.ndim < len(shape) else value


def inertial_wrench(
    rod, motion: NodeMotion, acceleration: Float[Array, "nodes 6"]
) -> Float[Array, "nodes 6"]:
    """What lumps demand of the nodes, force (inertial) [N] and moment (body) [N m]."""
    lumps = lumped(rod)
    spin, gain = motion.angular_velocity[lumps.nodes], acceleration[lumps.nodes]
    centre = gain[:, :3]
    if lumps.offset is not None:
        swung = rotations.cross(spin, rotations.cross(spin, lumps.offset))
        swung = swung + rotations.cross(gain[:, 3:], lumps.offset)
        centre = centre + rotations.rotate(motion.quaternion[lumps.nodes], swung)
    wrench = lumps.about_node(motion, lumps.mass[:, None] * centre)
    if lumps.inertia is not None:
        of = lambda rates: jnp.einsum("kij,kj->ki", lumps.inertia, rates)
        own = of(gain[:, 3:]) + rotations.cross(spin, of(spin))
        wrench = wrench + jnp.concatenate([jnp.zeros_like(own), own], 1)
    return lumps.at_nodes(wrench, acceleration)


def kinetic_energy(rod, motion: NodeMotion) -> Float[Array, ""]:
    """Kinetic energy of the lumps [J]."""
    lumps = lumped(rod)
    spin, velocity = motion.angular_velocity[lumps.nodes], motion.velocity[lumps.nodes]
    if lumps.offset is not None:
        swung = rotations.cross(spin, lumps.offset)
        velocity = velocity + rotations.rotate(motion.quaternion[lumps.nodes], swung)
    energy = 0.5 * jnp.sum(lumps.mass[:, None] * velocity**2)
    if lumps.inertia is not None:
        energy = energy + 0.5 * jnp.einsum("ki,kij,kj", spin, lumps.inertia, spin)
    return energy


def matrix_diagonal(rod) -> Float[Array, "nodes 6"]:
    """Diagonal of what lumps add to the mass matrix of the nodes, about these [kg, kg m^2]."""
    lumps = lumped(rod)
    linear = jnp.repeat(lumps.mass[:, None], 3, 1)
    angular = jnp.zeros_like(linear)
    if lumps.offset is not None:
        squares = lumps.offset**2
        angular = linear * (jnp.sum(squares, 1, keepdims=True) - squares)
    if lumps.inertia is not None:
        angular = angular + jax.vmap(jnp.diag)(lumps.inertia)
    like = jnp.zeros((rod.elements + 1, 6), linear.dtype)
    return lumps.at_nodes(jnp.concatenate([linear, angular], 1), like)
