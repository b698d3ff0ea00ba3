"""Joints in the systems whose negative eigenvalues are counted.

Multipliers of the joints stand in the border of the rods that nothing holds (see
`equations.anchored`), and so does the part K of the tangent that couples their two nodes, by the
motions d of both and the forces p on them,

    [A    E   0] [x]
    [E^T  0  -I] [p]
    [0   -I   K] [d]

of which Haynsworth's theorem tells the number of the negative eigenvalues that are none of
A + E K E^T: one for each p.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rodjax.equations.anchored import Anchor, extended
from rodjax.equations.assembly import Scales
from rodjax.equations.border import Border, BorderedSystem
from rodjax.equations.joint_terms import JointTerms, border_of, nodes_of
from rodjax.scenes.holds import Node
from rodjax.scenes.scene import Scene


def with_joints(
    bordered: BorderedSystem,
    scene: Scene,
    found: JointTerms,
    scales: Scales,
    anchors: tuple[Anchor, ...],
    projectors: Float[Array, "h 6 6"],
    nodes: tuple[Node, ...],
) -> BorderedSystem:
    """The system with the joints in its border, behind what that had.

    Args:
        anchors, projectors, nodes: as `bordered` was made of.
    """
    nowhere = jnp.zeros((0, 6, 6), projectors.dtype), ()
    borders = [border_of(scene, found.slope, None, *nowhere, scales)]
    for joint, places, curvature in zip(
        scene.joints, nodes_of(scene), found.curvature, strict=True
    ):
        if joint.turning:
            borders.append(_coupling(scene, places, curvature, scales))
    return extended(bordered, Border.joined(*borders), projectors, nodes, anchors)


def negative_besides(scene: Scene) -> int:
    """Negative eigenvalues that joints add to those of the tangent."""
    return sum(6 + (12 if joint.turning else 0) for joint in scene.joints)


def _coupling(
    scene: Scene, places: tuple[int, int], curvature: Float[Array, "2 6 2 6"], scales: Scales
) -> Border:
    """p and d of one joint."""
    dtype = curvature.dtype
    eye, index = jnp.eye(12, dtype=dtype), jnp.repeat(jnp.asarray(places), 6)
    within = np.arange(12) % 6
    rows = jnp.zeros((12, scene.rod.elements + 1, 6), dtype)
    rows = rows.at[np.arange(12), index, within].set(1.0)
    zero = jnp.zeros_like(rows[:, :, :3])
    columns = jnp.concatenate([zero, rows], 2)
    rows = jnp.concatenate([rows[:, :, :3], zero, rows[:, :, 3:]], 2)
    scaled = curvature * scales.motion[None, None, None] / scales.wrench[None, :, None, None]
    across = scaled[0, :, 1]
    across = 0.5 * (across + scaled[1, :, 0].T)
    nothing = jnp.zeros_like(across)
    coupled = jnp.block([[nothing, across], [across.T, nothing]])
    corner = jnp.block([[jnp.zeros_like(eye), -eye], [-eye, coupled]])
    none = jnp.zeros_like(rows)
    return Border(jnp.concatenate([columns, none]), jnp.concatenate([rows, none]), corner)
