"""How many modes of a rod at rest are unstable, without computing any.

The tangent with the internal forces as multipliers, M = [[K, B^T], [B, -C]] (C the compliance times
the elements' lengths), has one negative eigenvalue for each of the 3n components of force and one
for each unstable mode: negative ones of K + B^T C^-1 B on what the constraint allows. They are
counted by block elimination: the negative eigenvalues of M are those of its pivots (Sylvester,
Haynsworth). It is the cantilever's, clamped at node 0, of which every part is held; the motion of
node 0 and the wrenches that hold the ends follow from a small bordered matrix (see `anchored`).

Where strands touch or supports hold the rod between its ends, K is formed on the admissible motions
instead and its eigenvalues counted.

Loads without a potential (followers, dead end moments) have a tangent without symmetry. There the
sign of its determinant tells whether the number of modes that diverge is odd; flutter is not seen.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from rodjax.equations.assembly import Scales, assemble
from rodjax.equations.coupling import Coupling, couple
from rodjax.equations.equations import Equations
from rodjax.equations.imbalance import node_tangent
from rodjax.equations.schemes import AtRest
from rodjax.equilibria.admissible import allowed, constrained, mean_bending
from rodjax.numerics import rotations
from rodjax.numerics.block_tridiagonal import BlockTridiagonal
from rodjax.numerics.eigenvalues import far_above, split
from rodjax.numerics.signs import determinant_signs, negative_eigenvalues
from rodjax.rods import balance
from rodjax.rods.state import NodeMotion
from rodjax.scenes.holds import with_row
from rodjax.scenes.scene import Scene

# Rows of a block in the order of its columns: (force, constraint, moment).
_ORDER = np.array([3, 4, 5, 0, 1, 2, 6, 7, 8])

# Columns of a block that are motions of its node.
_MOTION = np.array([0, 1, 2, 6, 7, 8])

# How stiff what holds an end is, in scaled units: two clamps may hold the same thing twice.
_END_COMPLIANCE = 1e-9


def neutral(scene: Scene, force: Float[Array, "n 3"]) -> Float[Array, ""]:
    """What a mode's eigenvalue must be below to count as unstable: rounding of a neutral one [N].

    The norm of modes is the integral of |spin|^2 + |displacement|^2/L^2.
    """
    rod = scene.rod
    root = jnp.sqrt(jnp.finfo(force.dtype).eps)
    elastic = jnp.mean(rod.stiffness[:, :2]) / jnp.sum(rod.length) ** 2
    return root * (100 * elastic + jnp.max(jnp.abs(force)))


def count_below(
    equations: Equations[AtRest],
    x: Float[Array, "nodes 9"],
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
    by_elimination = lambda: _eliminated(equations, blocks, added, even)
    contact, supports = equations.scene.contact, equations.scene.supports
    if contact is None and not supports:
        return by_elimination()
    motion, coupling = equations.motion(x), None
    by_eigenvalues = lambda: _reduced(equations, motion, blocks, coupling, added, even)
    if contact is None:
        return by_eigenvalues()
    nearby = equations.scene.find(motion.position)[-1]
    still, nowhere = jnp.zeros((), x.dtype), (jnp.zeros((0, 6, 6), x.dtype), ())
    coupling = couple(contact, nearby, motion, still, *nowhere, equations.scales)[1]
    if supports:
        return by_eigenvalues()
    return lax.cond(nearby.near.level > 0, by_eigenvalues, by_elimination)


def _tangent(equations: Equations[AtRest], x) -> BlockTridiagonal:
    """The tangent of the rod free at both ends, its rows in the order of the columns."""
    scene, motion, force = equations.scene, equations.motion(x), equations.force(x)
    elements = balance.element_tangent(scene.rod, motion.position, motion.quaternion, force)
    scheme = equations.scheme
    node = node_tangent(scene, motion, load_factor=scheme.load_part())
    # by spins of the body a moment m that is not balanced leaves hat(m)/2 in the tangent; neither
    # what the path's start lacks nor a resistance is one of the rod's loads, while what holds an
    # end is
    lacking = scheme.lacking.moment
    holding = equations.projectors[:, 3:, 3:]
    for place, held in zip(scene.held_nodes, holding, strict=True):
        lacking = with_row(lacking, place, lacking[place] - held @ lacking[place])
    if scheme.resistance is not None:
        lacking = lacking - scheme.resistance[:, 3:] * x[:, 6:]
    node = node.at[:, 3:, 3:].add(-0.5 * rotations.hat(lacking))
    nowhere = jnp.zeros((0, 6, 6), node.dtype), ()
    blocks = assemble(scene.rod, elements, node, *nowhere, equations.scales)
    # in units in which the tangent is a second derivative
    length = equations.scales.length
    edges = jnp.concatenate([length[None], scene.rod.length]) / length
    factor = jnp.ones((len(edges), 9, 1), node.dtype).at[:, :3, 0].set(edges[:, None])
    return jax.tree.map(lambda rows: (factor * rows)[:, _ORDER], blocks)


def _stiffened(blocks: BlockTridiagonal, scales: Scales, added) -> BlockTridiagonal:
    """The tangent with stiffnesses of the nodes added."""
    ones = jnp.ones((3,), added.dtype)
    unit = jnp.concatenate([ones * scales.length, ones / scales.length]) / scales.force
    diagonal = blocks.diagonal.at[:, _MOTION, _MOTION].add(added * unit[None])
    return BlockTridiagonal(blocks.lower, diagonal, blocks.upper)


def _symmetric(blocks: BlockTridiagonal) -> BlockTridiagonal:
    return jax.tree.map(lambda a, b: 0.5 * (a + b), blocks, blocks.transpose())


def _asymmetry(equations: Equations[AtRest], blocks: BlockTridiagonal) -> Float[Array, ""]:
    """Largest entry of the antisymmetric part on motions that the ends allow (scaled)."""
    odd = jax.tree.map(lambda a, b: a - b, blocks, blocks.transpose())
    # of every node, what it is free to do
    free = jnp.broadcast_to(jnp.eye(9, dtype=odd.diagonal.dtype), odd.diagonal.shape)
    for node, held in zip(equations.scene.held_nodes, equations.projectors, strict=True):
        own = free[node].at[_MOTION[:, None], _MOTION].add(-held)
        free = with_row(free, node, own)
    diagonal = free @ odd.diagonal @ free
    upper = free[:-1] @ odd.upper[:-1] @ free[1:]
    return jnp.maximum(jnp.max(jnp.abs(diagonal)), jnp.max(jnp.abs(upper)))


def _eliminated(
    equations: Equations[AtRest], blocks: BlockTridiagonal, added, even: Bool[Array, ""]
) -> Int[Array, ""]:
    """`count_below` by block elimination."""
    scene = equations.scene
    blocks = _stiffened(blocks, equations.scales, added)
    blocks = jax.tree.map(lambda a, b: jnp.where(even, a, b), _symmetric(blocks), blocks)
    rest = jax.tree.map(lambda rows: rows[1:], blocks)
    factors = rest.factorize()
    eye = jnp.eye(9, dtype=added.dtype)[:, _MOTION]
    columns = jnp.zeros((scene.rod.elements, 9, 12), added.dtype)
    columns = columns.at[0, :, :6].set(blocks.lower[1][:, _MOTION]).at[-1, :, 6:].set(eye)
    response = factors.solve(columns)
    first = blocks.upper[0][_MOTION] @ response[0]
    last = response[-1][_MOTION]
    held, aside = equations.projectors
    unit = (1 + _END_COMPLIANCE) * jnp.eye(6, dtype=added.dtype)
    own = blocks.diagonal[0][_MOTION[:, None], _MOTION] - first[:, :6]
    zero = jnp.zeros_like(own)
    border = jnp.block(
        [
            [own, held, -first[:, 6:] @ aside],
            [held, held - unit, zero],
            [-aside @ last[:, :6], zero, aside - unit - aside @ last[:, 6:] @ aside],
        ]
    )
    expected = 3 * scene.rod.elements + 12

    def count():
        turned = lambda matrix: 0.5 * (matrix + jnp.swapaxes(matrix, -1, -2))
        pivots = jnp.sum(negative_eigenvalues(turned(factors.inverse)), dtype=jnp.int32)
        return pivots + negative_eigenvalues(turned(border)[None])[0] - expected

    def odd():
        sign = jnp.prod(determinant_signs(factors.inverse)) * determinant_signs(border[None])[0]
        return (sign * (-1) ** expected < 0).astype(jnp.int32)

    return lax.cond(even, count, odd)


def _reduced(
    equations: Equations[AtRest],
    motion: NodeMotion,
    blocks: BlockTridiagonal,
    coupling: Coupling | None,
    added,
    even: Bool[Array, ""],
) -> Int[Array, ""]:
    """`count_below` by the eigenvalues on admissible motions (see `admissible`)."""
    scene, scales = equations.scene, equations.scales
    blocks = _stiffened(blocks, scales, added)
    basis = allowed(scene.rod, motion.position, motion.quaternion)
    # the tangent's displacements are over l, its works over F l
    length = jnp.sum(scene.rod.length) / scales.length
    unit = jnp.repeat(jnp.stack([length, jnp.ones_like(length)]), 3)[None, None]
    moved = unit * basis
    columns = jnp.insert(moved, np.array([3, 3, 3]), 0.0, axis=2)
    pushed = jnp.moveaxis(blocks.multiply(jnp.moveaxis(columns, 0, 2)), 2, 0)[:, :, _MOTION]
    if coupling is not None:
        pushed = pushed + jax.vmap(coupling.multiply)(columns)[:, :, 3:]
    size = len(basis)
    stiffness = moved.reshape(size, -1) @ pushed.reshape(size, -1).T
    energy = mean_bending(scene) / jnp.sum(scene.rod.length)
    stiffness = stiffness * (scales.force * scales.length / energy)
    motions = constrained(scene, equations.projectors, basis, stiffness)
    _, rows, free = split(motions.ends)
    matrix = free @ motions.stiffness @ free
    matrix = matrix + far_above(matrix) * rows
    count = lambda: negative_eigenvalues(0.5 * (matrix + matrix.T)[None])[0]
    odd = lambda: (determinant_signs(matrix[None])[0] < 0).astype(jnp.int32)
    return lax.cond(even, count, odd)
