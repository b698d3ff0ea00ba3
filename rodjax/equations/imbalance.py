"""What the nodes' balances and the elements' constraint lack, moving or at rest.

internal + inertia - what acts on the nodes, summed here for the equations of a step, of a rod at
rest, of a start, and for the reactions of what holds it.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.inputs.argument_types import Number
from rodjax.interactions.load import total_wrench
from rodjax.interactions.roles import Role
from rodjax.interactions.self_contact import FoundContact
from rodjax.numerics import rotations
from rodjax.rods import balance
from rodjax.rods.balance import Internal
from rodjax.rods.inertia import inertial_wrench
from rodjax.rods.node_blocks import NodeBlocks, node_blocks
from rodjax.rods.state import Moving, NodeMotion, State, at_rest
from rodjax.scenes.scene import Scene

Factor = Number | Float[Array, ""]
Acting = tuple[Float[Array, "nodes 6"], ...]


def imbalance(
    scene: Scene,
    motion: NodeMotion,
    force: Float[Array, "n 3"],
    acting: Acting,
    acceleration: Float[Array, "nodes 6"] | None = None,
) -> tuple[Float[Array, "nodes 6"], Float[Array, "n 3"]]:
    """Wrench that every node lacks (force inertial, moment body), and the constraint.

    Args:
        force: internal force of the elements [N].
        acting: what else acts on the nodes, see `acting_on`.
        acceleration: of the nodes; None for no inertia.
    """
    inner = balance.internal(scene.rod, motion, force)
    wrench = jnp.concatenate([inner.force, inner.moment], 1)
    if scene.rod.mass is not None and acceleration is not None:
        wrench = wrench + inertial_wrench(scene, motion, acceleration)
    for one in acting:
        wrench = wrench - one
    return wrench, inner.constraint


def of_loads(scene: Scene, motion: NodeMotion, load_factor: Factor | None = None) -> Acting:
    """What the loads exert on the nodes, or a part of it; nothing without loads.

    What the rod touches is there in full on a path of loads, as its own strands are.
    """
    if not scene.loads:
        return ()
    if load_factor is None:
        return (total_wrench(scene.loads, scene.rod, motion),)
    touched = tuple(load for load in scene.loads if load.role is Role.CONTACT)
    brought = tuple(load for load in scene.loads if load.role is not Role.CONTACT)
    acting = ()
    if brought:
        acting = (load_factor * total_wrench(brought, scene.rod, motion),)
    if touched:
        acting = (*acting, total_wrench(touched, scene.rod, motion))
    return acting


def of_contact(scene: Scene, motion: NodeMotion, found: FoundContact | None = None) -> Acting:
    """What strands exert on the nodes, searched for where these are unless that is given."""
    contact = scene.self_contact
    if contact is None:
        return ()
    near = scene.find_contact(motion.position) if found is None else found
    return (contact.exerted(scene.rod, motion, near),)


def acting_on(scene: Scene, motion: NodeMotion, load_factor: Factor | None = None) -> Acting:
    """What all that acts on the nodes exerts on them, strands searched for where these are."""
    return (*of_loads(scene, motion, load_factor), *of_contact(scene, motion))


def node_tangent(
    scene: Scene,
    motion: NodeMotion,
    *,
    moving: Moving | None = None,
    load_factor: Factor | None = None,
) -> NodeBlocks:
    """Derivative of inertia less loads of each node by displacements and body spins.

    Args:
        moving: how rates follow; None at rest.
        load_factor: what part of the loads acts; None for all of it.
    """
    dtype = motion.position.dtype
    zero = jnp.zeros((scene.rod.elements + 1, 6), dtype)
    if not scene.loads and (moving is None or scene.rod.mass is None):
        return NodeBlocks(jnp.zeros((*zero.shape, 6), dtype))
    # of a quaternion by a body spin: its products with half of i, j, k
    units = 0.5 * jnp.eye(4, dtype=dtype)[1:]
    product = lambda unit: rotations.multiply(
        motion.quaternion, jnp.broadcast_to(unit, motion.quaternion.shape)
    )
    by_spin = jax.vmap(product, out_axes=2)(units)

    def lacking(z):
        moved = motion._replace(
            position=motion.position + z[:, :3],
            quaternion=motion.quaternion + jnp.einsum("nij,nj->ni", by_spin, z[:, 3:]),
        )
        total = jnp.zeros_like(z)
        if moving is not None:
            vector = rotations.tangent_inverse_apply(moving.turn, z[:, 3:])
            moved = moved._replace(
                velocity=motion.velocity + moving.by_velocity * z[:, :3],
                angular_velocity=motion.angular_velocity + moving.by_velocity * vector,
            )
            if scene.rod.mass is not None:
                rate = moving.by_acceleration * jnp.concatenate([z[:, :3], vector], 1)
                total = total + inertial_wrench(scene, moved, moving.acceleration + rate)
        for one in of_loads(scene, moved, load_factor):
            total = total - one
        return total

    return node_blocks(lacking, zero, scene.between_nodes)


def static_imbalance(
    scene: Scene,
    motion: NodeMotion,
    force: Float[Array, "n 3"],
    load_factor: Factor | None = None,
) -> tuple[Float[Array, "nodes 6"], Float[Array, "n 3"]]:
    """`imbalance` without inertia, contact searched for where the nodes are."""
    return imbalance(scene, motion, force, acting_on(scene, motion, load_factor))


def lacking(scene: Scene, state: State, load_factor: Factor = 0.0) -> Internal:
    """What a state lacks at rest under this part of the loads."""
    scene = scene.recalling(state.memory)
    motion = at_rest(state.time, state.position, state.quaternion)
    wrench, constraint = static_imbalance(scene, motion, state.force, load_factor)
    return Internal(wrench[:, :3], wrench[:, 3:], constraint)
