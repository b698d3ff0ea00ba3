"""What ends and supports exert on the rod."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.equations import joint_terms
from rodjax.equations.imbalance import Acting, acting_on, imbalance
from rodjax.measuring.energies import node_motion
from rodjax.numerics import rotations
from rodjax.rods.state import State
from rodjax.scenes.holds import rows_at
from rodjax.scenes.scene import Scene, projectors


def unbalanced(scene: Scene, state: State, acting: Acting) -> Float[Array, "h 6"]:
    """Inertia + internal - external wrench of the nodes that are held: what must be supplied."""
    motion = node_motion(state)
    if state.joints is not None:
        acting = (*acting, joint_terms.exerted(scene, motion, state.joints))
    wrench, _ = imbalance(scene, motion, state.force, acting, state.acceleration)
    return rows_at(wrench, scene.held_nodes)


class Reactions(NamedTuple):
    """What holds the rod exerts on it: the end s = 0, the end s = L, then the supports in order.

    So row 1 is that of the last end, with supports or without.

    Attributes:
        force: inertial components [N].
        torque: about the held node, inertial components [N m].
        body_torque: the same in the node's cross-section frame (a_1, a_2, tangent).
    """

    force: Float[Array, "h 3"]  # inertial components [N]
    torque: Float[Array, "h 3"]  # about the held node, inertial components [N m]
    body_torque: Float[Array, "h 3"]  # the same in the node's cross-section frame


def reactions(scene: Scene, state: State) -> Reactions:
    """Force and torque by which the constraints of ends and supports act on the rod at a state.

    The imbalance of the held nodes in the directions that are constrained from `state.time` on;
    zero in the free ones. Curves over a run are one line each:
        torque about an axis:    jax.lax.map(lambda s: reactions(scene, s).torque[0] @ axis, states)
        force along the axis:    jax.lax.map(lambda s: reactions(scene, s).force[1] @ axis, states)
    """
    scene = scene.recalling(state.memory)
    lacking = unbalanced(scene, state, acting_on(scene, node_motion(state)))
    supplied = jnp.einsum("eij,ej->ei", projectors(scene, state.time), lacking)
    frames = rows_at(state.quaternion, scene.held_nodes)
    return Reactions(supplied[:, :3], rotations.rotate(frames, supplied[:, 3:]), supplied[:, 3:])
