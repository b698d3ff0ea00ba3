"""The drag of the nodes on their own motion: linear, local, and what noise needs of it."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.interactions.load import total_wrench
from rodjax.rods.inertia import node_jacobian
from rodjax.rods.node_blocks import node_blocks
from rodjax.rods.state import NodeMotion
from rodjax.scenes.scene import Scene


def node_drag(scene: Scene, motion: NodeMotion) -> Float[Array, "nodes 6 6"]:
    """Z: minus the derivative of the loads by the rates of the nodes, of nodes at rest.

    Forces and velocities in inertial axes, moments and spins in body axes [N s/m, N s, N m s].
    Where nothing resists the turning of a section across its tangent (no drag along a rod does) it
    gets c ds^2/4, c the node's drag and ds the longer element beside it: no mode is without
    noise, and in shear a section turns at the fastest rate at which nodes move. (A rigid segment
    has c ds^2/12. Either matters at wavelengths of an element alone.)
    """
    zero = jnp.zeros((scene.rod.elements + 1, 6), motion.position.dtype)
    matrix = node_jacobian(_resisting(scene, motion), zero)
    length = scene.rod.length
    longer = jnp.maximum(jnp.pad(length, (0, 1)), jnp.pad(length, (1, 0)))
    across = jnp.trace(matrix[:, :3, :3], axis1=1, axis2=2) / 3 * longer**2 / 4
    own = jnp.diagonal(matrix, axis1=1, axis2=2)[:, 3:5]
    lacking = jnp.where(own > 0, 0.0, across[:, None])
    sides = jnp.arange(3, 5)
    return matrix.at[:, sides, sides].add(lacking)


def _resisting(scene: Scene, motion: NodeMotion):
    """Minus what the loads exert, by the rates of the nodes."""

    def resisting(rate):
        moving = motion._replace(velocity=rate[:, :3], angular_velocity=rate[:, 3:])
        return -total_wrench(scene.loads, scene.rod, moving)

    return resisting


def shared_drag(scene: Scene, motion: NodeMotion) -> Float[Array, ""]:
    """Largest derivative of what the loads exert on a node by the rates of those beside it."""
    zero = jnp.zeros((scene.rod.elements + 1, 6), motion.position.dtype)
    blocks = node_blocks(_resisting(scene, motion), zero, True)
    assert blocks.before is not None and blocks.after is not None
    return jnp.maximum(jnp.max(jnp.abs(blocks.before)), jnp.max(jnp.abs(blocks.after)))


def excess_drag(scene: Scene, motion: NodeMotion, rate: Float[Array, "nodes 6"]) -> Array:
    """What the loads exert at these rates beyond what they do at rest and beyond -Z times these."""
    wrench = lambda rate: total_wrench(
        scene.loads,
        scene.rod,
        motion._replace(velocity=rate[:, :3], angular_velocity=rate[:, 3:]),
    )
    still = jnp.zeros_like(rate)
    _, along = jax.jvp(wrench, (still,), (rate,))
    return wrench(rate) - wrench(still) - along
