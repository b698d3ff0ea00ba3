"""The block matrix of a rod's Newton systems, and the units of its rows and columns.

Row i of the unknowns x (n+1, 9) holds, for node i, its displacement over l, the internal force of
the element before it over F (none for i = 0), and its rotation; the rows of a residual are in the
same order (constraint of that element, force balance over F, moment balance over F l).
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.numerics.block_tridiagonal import BlockTridiagonal
from rodjax.rods.balance import ElementTangent, scatter
from rodjax.rods.node_blocks import NodeBlocks
from rodjax.rods.rod import Rod
from rodjax.scenes.holds import Node, with_part

# Rows of a block in the order of its columns: the constraint of an element, which stands before
# the balance of force, belongs to its internal force, which stands behind the displacement. So
# ordered the matrix is symmetric where forces have a potential. Its own inverse.
AS_COLUMNS = (3, 4, 5, 0, 1, 2, 6, 7, 8)


class Scales(NamedTuple):
    """Units that make the rows and columns of a Newton system dimensionless."""

    length: Float[Array, ""]  # l [m]
    force: Float[Array, ""]  # F [N]

    @property
    def motion(self) -> Float[Array, "6"]:
        """Units of a node's displacement and rotation, (l, l, l, 1, 1, 1)."""
        return jnp.repeat(jnp.stack([self.length, jnp.ones_like(self.length)]), 3)

    @property
    def wrench(self) -> Float[Array, "6"]:
        """Units of a node's force and moment, (F, F, F, F l, F l, F l)."""
        return self.force * jnp.repeat(jnp.stack([jnp.ones_like(self.length), self.length]), 3)

    def unknowns(
        self, change: Float[Array, "nodes 6"], force: Float[Array, "n 3"]
    ) -> Float[Array, "nodes 9"]:
        """x of displacements with rotations, and of the elements' internal forces."""
        before = scatter(jnp.zeros_like(force), force) / self.force
        return jnp.concatenate([change[:, :3] / self.length, before, change[:, 3:]], 1)

    def change(self, x: Float[Array, "nodes 9"]) -> Float[Array, "nodes 6"]:
        """Displacements [m] and rotations [rad] of the nodes in x."""
        return jnp.concatenate([x[:, :3] * self.length, x[:, 6:]], 1)

    def internal_force(self, x: Float[Array, "nodes 9"]) -> Float[Array, "n 3"]:
        """Internal forces of the elements in x [N]."""
        return x[1:, 3:6] * self.force


def residual_rows(
    x: Float[Array, "nodes 9"],
    constraint: Float[Array, "n 3"],
    balances: Float[Array, "nodes 6"],
) -> Float[Array, "nodes 9"]:
    """The rows of a residual, of the constraint and of scaled balances with the ends in them."""
    # the element before node 0 does not exist: its force is a dummy, zero
    return jnp.concatenate([jnp.concatenate([x[:1, 3:6], constraint]), balances], 1)


def assemble(
    rod: Rod,
    tangent: ElementTangent,
    node: NodeBlocks,
    projectors: Float[Array, "h 6 6"],
    nodes: tuple[Node, ...],
    scales: Scales,
) -> BlockTridiagonal:
    """The scaled block matrix of a Newton step.

    Block i has the columns (u_i, f of the element BEFORE node i, spin_i) and the rows
    (constraint of that element, force balance, moment balance); `node` holds what inertia and
    nodal loads add to the balances. At the held `nodes` the rows that `projectors` select
    (constrained directions of translation and of body rotation) become prescribed increments. With
    the element before the node, no leading principal block is singular for a clamped first node.
    Scaled so: rows by 1, 1/F, 1/(F l); columns by l, F, 1 (F, l of `scales`).
    """
    l, f = scales.length, scales.force
    n, dtype = rod.elements, node.own.dtype
    before = lambda blocks: jnp.pad(blocks, ((1, 0), (0, 0), (0, 0)))
    after = lambda blocks: jnp.pad(blocks, ((0, 1), (0, 0), (0, 0)))
    zero = jnp.zeros((n, 3, 3), dtype)
    edge = jnp.swapaxes(tangent.frame, 1, 2) * (l / rod.gauge_length)[:, None, None]
    if tangent.constraint_edge is not None:
        edge = l * tangent.constraint_edge
    give = zero
    if rod.compliance is not None:
        give = -f * rod.compliance[:, :, None] * jnp.eye(3, dtype=dtype)[None]
    cs_i, cs_j = jnp.split(tangent.constraint_spin, 2, axis=2)
    fs_i, fs_j = jnp.split(tangent.force_spin / f, 2, axis=2)
    me_i, me_j = jnp.split(tangent.moment_edge / f, 2, axis=1)
    mf_i, mf_j = jnp.split(tangent.moment_force / l, 2, axis=1)
    spin_i, spin_j = jnp.split(tangent.moment_spin / (f * l), 2, axis=1)
    (ms_ii, ms_ij), (ms_ji, ms_jj) = (jnp.split(part, 2, axis=2) for part in (spin_i, spin_j))

    def grid(*parts):
        return jnp.concatenate([jnp.concatenate(part, 2) for part in parts], 1)

    # what an element adds to the diagonal blocks of its two nodes, and between them
    nothing = (zero, zero, zero)
    as_first = grid(nothing, (zero, zero, -fs_i), (-me_i, zero, ms_ii))
    as_second = grid((edge, give, cs_j), (zero, tangent.frame, fs_j), (me_j, mf_j, ms_jj))
    lower = before(grid((-edge, zero, cs_i), (zero, zero, fs_i), (-me_j, zero, ms_ji)))
    upper = after(grid(nothing, (zero, -tangent.frame, -fs_j), (me_i, mf_i, ms_ij)))
    own = _columns(node.own, scales)
    # the element before node 0 does not exist: its force is a dummy, set to zero
    dummy = jnp.zeros((9, 9), dtype).at[:3, 3:6].set(jnp.eye(3, dtype=dtype))
    diagonal = jnp.pad(own, ((0, 0), (3, 0), (0, 0))) + jnp.pad(
        dummy[None], ((0, n), (0, 0), (0, 0))
    )
    diagonal = diagonal + after(as_first) + before(as_second)
    if node.before is not None and node.after is not None:
        balances = lambda blocks: jnp.pad(_columns(blocks, scales), ((0, 0), (3, 0), (0, 0)))
        lower, upper = lower + balances(node.before), upper + balances(node.after)

    # rows of the balances at the nodes that are held, before, of, and after their own block
    parts = [lower, diagonal, upper]
    gap = jnp.zeros((6, 3), dtype)
    for at, projector in zip(nodes, projectors, strict=True):
        row = jnp.concatenate([part[at, 3:] for part in parts], 1)
        aim = [gap, gap, gap, projector[:, :3], gap, projector[:, 3:], gap, gap, gap]
        row = row + jnp.concatenate(aim, 1) - projector @ row
        for k in range(3):
            replaced = row[None, :, 9 * k : 9 * k + 9]
            parts[k] = with_part(parts[k], replaced, (at, 3, 0))
    return BlockTridiagonal(*parts)


def _columns(blocks: Float[Array, "nodes 6 6"], scales: Scales) -> Float[Array, "nodes 6 9"]:
    """Scaled derivatives of the balances by motions of nodes, with no columns of forces."""
    scaled = blocks * (scales.motion[None, :] / scales.wrench[:, None])[None]
    return jnp.concatenate(
        [scaled[:, :, :3], jnp.zeros_like(blocks[:, :, :3]), scaled[:, :, 3:]], 2
    )
