"""The matrix of a Newton iteration: of elements, nodes, joints and strands, as they are held."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.equations import joint_terms
from rodjax.equations.anchored import AnchoredBordered, AnchoredSystem, anchors_of
from rodjax.equations.assembly import Scales, assemble
from rodjax.equations.border import BorderedSystem
from rodjax.equations.coupled import CoupledSystem
from rodjax.equations.coupling import Coupling, turned_moments
from rodjax.equations.imbalance import Acting, node_tangent
from rodjax.equations.jointed import JointedSystem
from rodjax.equations.schemes import AbstractScheme
from rodjax.rods import balance
from rodjax.rods.state import Moving, NodeMotion
from rodjax.scenes.scene import Scene


class Placed(NamedTuple):
    """The nodes at the unknowns of an iteration."""

    motion: NodeMotion
    acceleration: Float[Array, "nodes 6"] | None  # None at rest
    change: Float[Array, "nodes 6"]  # what the unknowns add to the scheme's prediction
    increment: Float[Array, "nodes 6"]  # displacement [m] and rotation vector [rad]


def newton_system(
    scene: Scene,
    scheme: AbstractScheme,
    projectors: Float[Array, "h 6 6"],
    scales: Scales,
    placed: Placed,
    force: Float[Array, "n 3"],
    joints: Float[Array, "j 6"] | None,
    push: Acting,
    coupling: Coupling | None,
) -> CoupledSystem | AnchoredSystem | JointedSystem:
    """Derivative of the scaled residual by the increments of the nodes and of the forces.

    Args:
        projectors: directions that ends and supports hold.
        placed: the nodes.
        force: internal force of the elements [N].
        joints: multipliers of the joints, [N] and [N m]; None without joints.
        push: what contact exerts on the nodes.
        coupling: its derivative.
    """
    motion, slopes, moving = placed.motion, scheme.slopes(), None
    if slopes is not None and placed.acceleration is not None:
        turn = placed.increment[:, 3:]
        numbers = slopes.by_velocity, slopes.by_acceleration
        moving = Moving(placed.acceleration, turn, *numbers)
    tangent = balance.element_tangent(scene.rod, motion, force, moving)
    node = node_tangent(scene, motion, moving=moving, load_factor=scheme.load_part())
    node = node._replace(own=scheme.stiffened(placed.change, node.own))
    moments = None if scene.contact is None else turned_moments(scene.contact, push[0])
    if moments is not None:
        node = node._replace(own=node.own + moments)
    border = None
    if joints is not None:
        found = joint_terms.terms(scene, motion, joints)
        node = node._replace(own=node.own + joint_terms.own_tangent(scene, found))
        at = projectors, scene.held_nodes, scales
        border = joint_terms.border_of(scene, found.slope, found.curvature, *at)
    anchors = anchors_of(scene)
    if slopes is not None or _at_ends(scene, anchors):
        blocks = assemble(scene.rod, tangent, node, projectors, scene.held_nodes, scales)
        coupled = CoupledSystem(blocks, coupling)
        if border is None:
            return coupled
        return JointedSystem(BorderedSystem(coupled, border), len(scene.joints))
    # what lies before a node is not held without inertia, or held twice: see `anchored`
    nowhere = jnp.zeros((0, 6, 6), force.dtype), ()
    free = assemble(scene.rod, tangent, node, *nowhere, scales)
    coupling = None if coupling is None else coupling.held(*nowhere)
    anchored = AnchoredSystem(CoupledSystem(free, coupling), projectors, scene.held_nodes, anchors)
    if border is None:
        return anchored
    return JointedSystem(AnchoredBordered(anchored, border), len(scene.joints))


def _at_ends(scene: Scene, anchors) -> bool:
    """Whether rods are clamped at their first nodes and held besides at their last alone."""
    return all(anchor.clamped for anchor in anchors) and not scene.supports
