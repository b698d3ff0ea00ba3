"""How many modes of a rod at rest are unstable, without computing any.

The tangent with the internal forces as multipliers, M = [[K, B^T], [B, -C]] (C the compliance times
the elements' lengths), has one negative eigenvalue for each of the 3n components of force and one
for each unstable mode: negative ones of K + B^T C^-1 B on what the constraint allows. What holds
the rod is a border of a cantilever's M (see `anchored`), of which each component of a wrench on
nodes behind the first adds another. They are counted by elimination: the negative eigenvalues are
those of the pivots (Sylvester, Haynsworth), also where strands touch.

Loads without a potential (followers, dead end moments) have a tangent without symmetry. There the
sign of its determinant tells whether the number of modes that diverge is odd; flutter is not seen.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from rodjax.equations import joint_terms
from rodjax.equations.anchored import anchors_of, bordered
from rodjax.equations.assembly import AS_COLUMNS, Scales, assemble
from rodjax.equations.coupled import CoupledSystem
from rodjax.equations.coupling import couple
from rodjax.equations.equations import Equations
from rodjax.equations.imbalance import node_tangent
from rodjax.equations.schemes import AtRest
from rodjax.equilibria.jointed_modes import negative_besides, with_joints
from rodjax.numerics import rotations
from rodjax.numerics.batching import one_by_one
from rodjax.numerics.block_tridiagonal import BlockTridiagonal
from rodjax.rods import balance
from rodjax.scenes.holds import Node, with_row
from rodjax.scenes.scene import Scene

# Rows of a block in the order of its columns.
_ORDER = np.array(AS_COLUMNS)

# Columns of a block that are motions of its node.
_MOTION = np.array([0, 1, 2, 6, 7, 8])

# Compliance of what holds a node, in scaled units: two clamps may hold the same thing twice.
_SLACK = 1e-9


def neutral(scene: Scene, force: Float[Array, "n 3"]) -> Float[Array, ""]:
    """What a mode's eigenvalue must be below to count as unstable: rounding of a neutral one [N].

    The norm of modes is the integral of |spin|^2 + |displacement|^2/L^2.
    """
    rod = scene.rod
    root = jnp.sqrt(jnp.finfo(force.dtype).eps)
    elastic = rod.mean_bending / jnp.sum(rod.length) ** 2
    return root * (100 * elastic + jnp.max(jnp.abs(force)))


def count_below(
    equations: Equations[AtRest],
    x: Float[Array, "rows 9"],
    added: Float[Array, "k nodes 6"],
    wanted: Int[Array, ""] | int,
) -> Int[Array, " k"]:
    """Number of unstable modes of the second variation at x, with stiffnesses added to its nodes.

    `added` to the displacements and body spins [N/m, N m]: a level times
    `motion_norms.moving_weight` counts the eigenvalues below minus that level. Only the first
    `wanted` are counted, those that are not are -1.
    """
    # a loop, for its program holds one count, and those that nobody wants cost nothing
    count = lambda i, found: found.at[i].set(_count(equations, x, added[i]))
    return lax.fori_loop(0, wanted, count, jnp.full((len(added),), -1, jnp.int32))


def _count(equations: Equations[AtRest], x, added: Float[Array, "nodes 6"]) -> Int[Array, ""]:
    blocks = _tangent(equations, x)
    even = _asymmetry(equations, blocks) < 10 * jnp.sqrt(jnp.finfo(x.dtype).eps)
    blocks = _stiffened(blocks, equations.scales, added)
    symmetric = _symmetric(blocks)
    blocks = jax.tree.map(lambda a, b: jnp.where(even, a, b), symmetric, blocks)
    scene = equations.scene
    # numbers of nodes that are known stay so: a branch would make tracers of them
    places = scene.held_nodes
    known = [node if isinstance(node, int) else None for node in places]
    moving = tuple(node for node in places if not isinstance(node, int))

    # given, not closed over: what `one_by_one` closes over must not differ from lane to lane
    arrays, rest = eqx.partition(equations, eqx.is_array)

    def counted(system, projectors, moving, even, arrays, x):
        given, same = iter(moving), eqx.combine(arrays, rest)
        nodes = tuple(next(given) if node is None else node for node in known)
        return _counted(system, projectors, nodes, even, equations=same, x=x)

    held = equations.projectors, moving, even, arrays, x
    if scene.contact is None:
        return counted(CoupledSystem(blocks), *held)
    motion = equations.motion(x)
    found = scene.find_contact(motion.position)
    nowhere = jnp.zeros((0, 6, 6), x.dtype), ()
    given = scene.contact, scene.rod, found, motion, None
    coupling = couple(*given, *nowhere, equations.scales)[1]
    derivative = jnp.where(even, coupling.symmetric().derivative, coupling.derivative)
    coupling = dataclasses.replace(coupling, derivative=derivative)
    apart = lambda blocks, coupling, *rest: counted(CoupledSystem(blocks), *rest)
    touching = lambda blocks, coupling, *rest: counted(CoupledSystem(blocks, coupling), *rest)

    def one(blocks, coupling, *rest):
        return lax.cond(coupling.acts, touching, apart, blocks, coupling, *rest)

    # under `vmap` those that touch one by one
    easy = lambda blocks, coupling, *rest: ~coupling.acts
    return one_by_one(one, (easy, apart))(blocks, coupling, *held)


def _tangent(equations: Equations[AtRest], x) -> BlockTridiagonal:
    """The tangent of the rod that nothing holds."""
    scene, motion, force = equations.scene, equations.motion(x), equations.force(x)
    elements = balance.element_tangent(scene.rod, motion, force)
    scheme = equations.scheme
    node = node_tangent(scene, motion, load_factor=scheme.load_part())
    joints = _joint_terms(equations, x)
    if joints is not None:
        node = node._replace(own=node.own + joint_terms.own_tangent(scene, joints))
    # by spins of the body a moment m that is not balanced leaves hat(m)/2 in the tangent; neither
    # what the path's start lacks nor a resistance is one of the rod's loads, while what holds an
    # end is
    lacking = scheme.lacking.moment
    holding = equations.projectors[:, 3:, 3:]
    for place, held in zip(scene.held_nodes, holding, strict=True):
        lacking = with_row(lacking, place, lacking[place] - held @ lacking[place])
    if scheme.resistance is not None:
        lacking = lacking - scheme.resistance[:, 3:] * equations.of_nodes(x)[:, 6:]
    node = node._replace(own=node.own.at[:, 3:, 3:].add(-0.5 * rotations.hat(lacking)))
    nowhere = jnp.zeros((0, 6, 6), x.dtype), ()
    blocks = assemble(scene.rod, elements, node, *nowhere, equations.scales)
    # in units in which the tangent is a second derivative
    length = equations.scales.length
    edges = jnp.concatenate([length[None], scene.rod.gauge_length]) / length
    factor = jnp.ones((len(edges), 9, 1), x.dtype).at[:, :3, 0].set(edges[:, None])
    return jax.tree.map(lambda rows: factor * rows, blocks)


def _joint_terms(equations: Equations[AtRest], x) -> joint_terms.JointTerms | None:
    multipliers = equations.joints(x)
    if multipliers is None:
        return None
    return joint_terms.terms(equations.scene, equations.motion(x), multipliers)


def _stiffened(blocks: BlockTridiagonal, scales: Scales, added) -> BlockTridiagonal:
    """The tangent with stiffnesses of the nodes added."""
    ones = jnp.ones((3,), added.dtype)
    unit = jnp.concatenate([ones * scales.length, ones / scales.length]) / scales.force
    diagonal = blocks.diagonal.at[:, 3 + np.arange(6), _MOTION].add(added * unit[None])
    return BlockTridiagonal(blocks.lower, diagonal, blocks.upper)


def _reordered(blocks: BlockTridiagonal) -> BlockTridiagonal:
    """Rows in the order of columns, or back."""
    return jax.tree.map(lambda rows: rows[:, _ORDER], blocks)


def _symmetric(blocks: BlockTridiagonal) -> BlockTridiagonal:
    ordered = _reordered(blocks)
    return _reordered(jax.tree.map(lambda a, b: 0.5 * (a + b), ordered, ordered.transpose()))


def _asymmetry(equations: Equations[AtRest], blocks: BlockTridiagonal) -> Float[Array, ""]:
    """Largest entry of the antisymmetric part on motions that the ends allow (scaled)."""
    ordered = _reordered(blocks)
    odd = jax.tree.map(lambda a, b: a - b, ordered, ordered.transpose())
    # of every node, what it is free to do
    free = jnp.broadcast_to(jnp.eye(9, dtype=odd.diagonal.dtype), odd.diagonal.shape)
    for node, held in zip(equations.scene.held_nodes, equations.projectors, strict=True):
        own = free[node].at[_MOTION[:, None], _MOTION].add(-held)
        free = with_row(free, node, own)
    diagonal = free @ odd.diagonal @ free
    upper = free[:-1] @ odd.upper[:-1] @ free[1:]
    return jnp.maximum(jnp.max(jnp.abs(diagonal)), jnp.max(jnp.abs(upper)))


def _counted(
    free: CoupledSystem,
    projectors: Float[Array, "h 6 6"],
    nodes: tuple[Node, ...],
    even: Bool[Array, ""],
    *,
    equations: Equations[AtRest],
    x: Float[Array, "rows 9"],
) -> Int[Array, ""]:
    """The number by elimination, from the tangent of the rod that nothing holds.

    Args:
        even: whether the tangent is symmetric.
        equations, x: what it is the tangent of.
    """
    elements, dtype = len(free.blocks.diagonal) - 1, projectors.dtype
    # what is held twice does not give way, but for the rounding of how far the cantilever does
    slack = jnp.full((6,), _SLACK, dtype).at[:3].max(2 * float(jnp.finfo(dtype).eps) * elements**3)
    scene, anchors = equations.scene, anchors_of(equations.scene)
    system = bordered(free, projectors, nodes, anchors, slack=slack)
    joints = _joint_terms(equations, x)
    if joints is not None:
        held = anchors, projectors, nodes
        system = with_joints(system, scene, joints, equations.scales, *held)
    eliminated = system.eliminate()
    # of forces and wrenches
    expected = 3 * elements + 6 * (len(nodes) - len(anchors)) + negative_besides(scene)
    # rows stand as assembled, not as columns: in each of the n + 1 blocks an odd permutation
    sign = (-1.0) ** (expected + elements + 1)
    count = lambda: eliminated.negative() - expected
    odd = lambda: (sign * eliminated.sign() < 0).astype(jnp.int32)
    return lax.cond(even, count, odd)
