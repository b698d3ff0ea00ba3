"""What joints hold and exert, with derivatives, and their border of a Newton system.

For a joint with the gap g = (t, r) of two nodes and multipliers p the balances of its nodes get
G^T P p, with G the derivative of g by displacements and body spins of both, and the rows
P g - (1 - P) p = 0 determine p; of a driven joint g is counted from where its schedule has it. The
second derivative of p . P g stands in the tangent: within one node in its own block, between the
two in more rows and columns of the border,

    [K_ab y]  with  y = x_b,        [K_ba z]  with  z = x_a,

which a joint has none of that neither turns nor holds rotations.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.equations.assembly import Scales
from rodjax.equations.border import Border
from rodjax.numerics import rotations
from rodjax.rods.state import NodeMotion, State
from rodjax.scenes.holds import Node, impose
from rodjax.scenes.scene import Scene


class JointTerms(NamedTuple):
    """Of every joint, by its two nodes where there are two axes of them."""

    gap: Float[Array, "j 6"]  # P g [m, rad]
    slope: Float[Array, "j 6 2 6"]  # P G
    lacking: Float[Array, "j 2 6"]  # G^T P p, of the balances [N, N m]
    curvature: Float[Array, "j 2 6 2 6"]  # its derivative, multipliers held


def nodes_of(scene: Scene) -> list[tuple[int, int]]:
    """The two nodes of every joint."""
    parts = scene.rod.parts
    return [(joint.first.place(parts), joint.second.place(parts)) for joint in scene.joints]


def projectors_of(scene: Scene) -> Float[Array, "j 6 6"]:
    """The projectors of all joints."""
    dtype = scene.rod.position.dtype
    return jnp.stack([joint.projector().astype(dtype) for joint in scene.joints])


class _At(NamedTuple):
    """The two nodes of a joint."""

    position: Float[Array, "2 3"]
    quaternion: Float[Array, "2 4"]

    def after(self, z: Float[Array, "2 6"]) -> "_At":
        """After displacements and body spins."""
        turned = rotations.multiply(self.quaternion, rotations.exponential(z[:, 3:]))
        return _At(self.position + z[:, :3], turned)


def _held(scene: Scene, motion: NodeMotion) -> list[tuple[Callable, _At]]:
    """P g of every joint, as a function of its nodes and of how much later, and where these are."""
    found = []
    for joint, nodes in zip(scene.joints, nodes_of(scene), strict=True):
        index = jnp.asarray(nodes)
        first, second = scene.rod.quaternion[index]
        placed = rotations.multiply(rotations.conjugate(first), second)
        projector = joint.projector().astype(placed.dtype)

        def held(at, later=0.0, *, joint=joint, placed=placed, projector=projector):
            first, second = zip(*at, strict=True)
            return projector @ joint.gap(first, second, placed, motion.time + later)

        found.append((held, _At(motion.position[index], motion.quaternion[index])))
    return found


def gaps(scene: Scene, motion: NodeMotion) -> Float[Array, "j 6"]:
    """P g [m, rad]."""
    return jnp.stack([held(at) for held, at in _held(scene, motion)])


def slopes(scene: Scene, motion: NodeMotion) -> Float[Array, "j 6 2 6"]:
    """P G."""
    return jnp.stack([_slope(held, at) for held, at in _held(scene, motion)])


def _slope(held: Callable, at: _At) -> Float[Array, "6 2 6"]:
    return jax.jacfwd(lambda z: held(at.after(z)))(jnp.zeros((2, 6), at.position.dtype))


def exerted(
    scene: Scene, motion: NodeMotion, multipliers: Float[Array, "j 6"]
) -> Float[Array, "nodes 6"]:
    """What joints exert on the nodes, force (inertial) [N] and moment (body) [N m]."""
    lacking = jnp.einsum("jikl,ji->jkl", slopes(scene, motion), multipliers)
    return -on_nodes(scene, lacking)


def on_nodes(scene: Scene, values: Float[Array, "j 2 *k"]) -> Float[Array, "nodes *k"]:
    """Sum at the nodes of values of joints' points."""
    nodes = jnp.zeros((scene.rod.elements + 1, *values.shape[2:]), values.dtype)
    return nodes.at[jnp.asarray(nodes_of(scene))].add(values)


def at_points(scene: Scene, rows: Float[Array, "nodes *k"]) -> Float[Array, "j 2 *k"]:
    """The rows of the nodes of joints."""
    return rows[jnp.asarray(nodes_of(scene))]


def terms(scene: Scene, motion: NodeMotion, multipliers: Float[Array, "j 6"]) -> JointTerms:
    """All of it at a configuration with these multipliers [N, N m]."""
    still = jnp.zeros((2, 6), motion.position.dtype)
    found = []
    for (held, at), p in zip(_held(scene, motion), multipliers, strict=True):

        def pulled(z, *, held=held, at=at, p=p):
            """G^T P p after these motions, by further ones."""
            moved = at.after(z)
            return jax.grad(lambda further: p @ held(moved.after(further)))(still)

        found.append(
            JointTerms(held(at), _slope(held, at), pulled(still), jax.jacfwd(pulled)(still))
        )
    return jax.tree.map(lambda *of_joints: jnp.stack(of_joints), *found)


def rates_of_gaps(
    scene: Scene,
    motion: NodeMotion,
    rate: Float[Array, "nodes 6"],
    acceleration: Float[Array, "nodes 6"],
    order: int,
) -> Float[Array, "j 6"]:
    """The derivative in time of this order <= 3 of P g, in a motion of these accelerations."""
    found = []
    for (held, at), nodes in zip(_held(scene, motion), nodes_of(scene), strict=True):
        v, a = rate[jnp.asarray(nodes)], acceleration[jnp.asarray(nodes)]
        # of body spins w + a t the rotation vector has w x a / 12 to third order
        bent = rotations.cross(v[:, 3:], a[:, 3:]) / 12

        def along(t, *, held=held, at=at, v=v, a=a, bent=bent):
            z = v * t + 0.5 * a * t**2
            return held(at.after(z.at[:, 3:].add(bent * t**3)), t)

        of_order = functools.reduce(lambda f, _: _rate_of(f), range(order), along)
        found.append(of_order(jnp.zeros((), rate.dtype)))
    return jnp.stack(found)


def _rate_of(function):
    return lambda t: jax.jvp(function, (t,), (jnp.ones_like(t),))[1]


def border_of(
    scene: Scene,
    slope: Float[Array, "j 6 2 6"],
    curvature: Float[Array, "j 2 6 2 6"] | None,
    projectors: Float[Array, "h 6 6"],
    held: tuple[Node, ...],
    scales: Scales,
) -> Border:
    """Rows and columns of the multipliers of all joints, then of what couples their nodes.

    At the held nodes the balances are replaced by what is held, as in `assembly`.

    Args:
        slope, curvature: of `JointTerms`; None for rates, whose rows are linear in them.
    """
    count, dtype = scene.rod.elements + 1, slope.dtype
    eye, motion = jnp.eye(6, dtype=dtype), scales.motion
    slope = slope * motion[None, None, None] / motion[None, :, None, None]
    columns, rows, corners = [], [], []
    nothing = jnp.zeros((6, count, 6), dtype)
    both = nodes_of(scene)
    for joint, nodes, own in zip(scene.joints, both, slope, strict=True):
        at = nothing.at[:, jnp.asarray(nodes)].add(own)
        columns.append(at)
        rows.append(at)
        corners.append(joint.projector().astype(dtype) - eye)
    for i, (joint, (a, b)) in enumerate(zip(scene.joints, both, strict=True)):
        if curvature is None or not joint.turning:
            continue
        # by scaled motions, of scaled wrenches
        own = curvature[i] * motion[None, None, None] / scales.wrench[None, :, None, None]
        for one, other, block in ((a, b, own[0, :, 1]), (b, a, own[1, :, 0])):
            columns.append(nothing.at[:, one].set(block.T))
            rows.append(nothing.at[:, other].set(eye))
            corners.append(-eye)
    still = jnp.zeros((len(held), 6), dtype)
    freed = jax.vmap(lambda column: impose(column, still, projectors, held))
    columns, rows = jnp.concatenate(columns), jnp.concatenate(rows)
    if held:
        columns = freed(columns)
    zero = jnp.zeros_like(rows[:, :, :3])
    return Border(
        jnp.concatenate([zero, columns], 2),
        jnp.concatenate([rows[:, :, :3], zero, rows[:, :, 3:]], 2),
        jax.scipy.linalg.block_diag(*corners),
    )


def own_tangent(scene: Scene, found: JointTerms) -> Float[Array, "nodes 6 6"]:
    """What joints add to the tangents of their nodes."""
    own = jnp.stack([found.curvature[:, 0, :, 0], found.curvature[:, 1, :, 1]], 1)
    return on_nodes(scene, own)


def rows_of(
    scene: Scene, gap: Float[Array, "j 6"], multipliers: Float[Array, "j 6"], scales: Scales
) -> Float[Array, "j 9"]:
    """Scaled rows of joints, P g - (1 - P) p, as `Jointed` has them."""
    scaled = multipliers / scales.wrench[None]
    loose = scaled - jnp.einsum("jik,jk->ji", projectors_of(scene), scaled)
    return spread(gap / scales.motion[None] - loose)


def spread(values: Float[Array, "j 6"]) -> Float[Array, "j 9"]:
    """Six numbers a joint as rows of a system, which have three between them that say nothing."""
    return jnp.concatenate([values[:, :3], jnp.zeros_like(values[:, :3]), values[:, 3:]], 1)


def gathered(rows: Float[Array, "j 9"]) -> Float[Array, "j 6"]:
    """The reverse."""
    return jnp.concatenate([rows[:, :3], rows[:, 6:]], 1)


def driving(scene: Scene, state: State) -> list[tuple[Float[Array, "1"], Float[Array, "1"]]]:
    """What driven joints exert along their drives, on the second point, and their coordinates."""
    if state.joints is None:
        return []
    found = []
    for joint, multipliers in zip(scene.joints, state.joints, strict=True):
        along = joint.driven()
        if along is None:
            continue
        # the opposite acts on the first point
        force = -jnp.sum(along.astype(multipliers.dtype) * multipliers)
        found.append((force[None], joint.coordinate(state.time).astype(force.dtype)[None]))
    return found
