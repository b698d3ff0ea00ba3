"""Systems without inertia, solved through a cantilever and a border.

Block elimination starts at node 0 and pivots inside a block only, but without inertia the
equations of a part of a rod that begins with a free, pinned or sliding end are singular. So the
elimination is done for a cantilever, clamped at node 0 and free at the other end, of which every
part is held (and nothing is held twice, as a straight inextensible rod between two clamps would
be). What the rod's own ends and supports are besides stands in a border (see `border`): with P the
projector of what holds a node,

- node 0 moves as q in the directions that it is free to: its balances, (1 - P) of them, are rows;
- each other held node is free in the cantilever and feels a wrench P w there, which holds it: its
  rows are P of its motion, and w = 0 in the directions that are free.

The border is symmetric where the balances have a potential.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rodjax.equations.border import Border, BorderedSystem, Vector
from rodjax.equations.coupled import CoupledSystem
from rodjax.numerics.block_tridiagonal import BlockTridiagonal
from rodjax.scenes.holds import Node, impose, rows_at, with_part


class AnchoredSystem(eqx.Module):
    """The system of a rod whose nodes are held, node 0 first; without what its border adds."""

    free: CoupledSystem  # of the rod that nothing holds
    projectors: Float[Array, "h 6 6"]
    nodes: tuple[Node, ...]
    clamped: bool = eqx.field(static=True)  # whether node 0 is known to be

    def multiply(self, b: Float[Array, "nodes 9"]) -> Float[Array, "nodes 9"]:
        """Matrix times vector, rows of balances replaced by what is held as in `assembly`."""
        rows, held = self.free.multiply(b), rows_at(b, self.nodes)
        moved = jnp.concatenate([held[:, :3], held[:, 6:]], 1)
        balances = impose(rows[:, 3:], moved, self.projectors, self.nodes)
        return jnp.concatenate([rows[:, :3], balances], 1)

    def solve(self, b: Float[Array, "nodes 9"]) -> Float[Array, "nodes 9"]:
        """Solution of the system."""
        given = self._rows(b)
        inside = self._inside(given)
        right = Vector(self._replaced(b, inside), jnp.ravel(given - inside))
        return self._bordered().solve(right).nodes

    def solve_once(self, b: Float[Array, "nodes 9"]) -> Float[Array, "nodes 9"]:
        """As `solve`."""
        return self.solve(b)

    def solve_transpose(self, b: Float[Array, "nodes 9"]) -> Float[Array, "nodes 9"]:
        """Solution of the transposed system."""
        bordered = self._bordered()
        nothing = jnp.zeros(bordered.border.corner.shape[:1], b.dtype)
        x, z = bordered.solve_transpose(Vector(b, nothing))
        outside = z.reshape(-1, 6)
        rows = self._inside(self._rows(x) - outside) + outside
        return self._replaced(x, rows)

    def _bordered(self) -> BorderedSystem:
        return bordered(self.free, self.projectors, self.nodes, clamped=self.clamped)

    @property
    def _others(self) -> slice:
        """Which of the nodes are held otherwise than the cantilever's."""
        return slice(1 if self.clamped else 0, None)

    def _rows(self, b: Float[Array, "nodes 9"]) -> Float[Array, "o 6"]:
        """The balances of these nodes."""
        return rows_at(b[:, 3:], self.nodes[self._others])

    def _replaced(self, b: Float[Array, "nodes 9"], rows) -> Float[Array, "nodes 9"]:
        for node, row in zip(self.nodes[self._others], rows, strict=True):
            b = with_part(b, row[None], (node, 3))
        return b

    def _inside(self, rows: Float[Array, "o 6"]) -> Float[Array, "o 6"]:
        """What of right sides is one of the cantilever: all but that of the border's rows."""
        held = self.projectors
        inside = (jnp.eye(6, dtype=held.dtype)[None] - held).at[0].set(held[0])
        return jnp.einsum("oij,oj->oi", inside[self._others], rows)


def bordered(
    free: CoupledSystem,
    projectors: Float[Array, "h 6 6"],
    nodes: tuple[Node, ...],
    *,
    clamped: bool,
    slack: Float[Array, "6"] | None = None,
) -> BorderedSystem:
    """The cantilever of a rod that is free, with the border of its nodes that are held.

    Args:
        nodes: node 0 first; where it is `clamped`, it needs no border.
        slack: how far what holds the others gives way (scaled), for directions that are held
            twice; None: not at all.
    """
    blocks, count = free.blocks, len(free.blocks.diagonal)
    eye = jnp.eye(6, dtype=blocks.diagonal.dtype)
    give = 0.0 * eye if slack is None else jnp.diag(slack)
    motion = jnp.insert(eye, np.array([3, 3, 3]), 0.0, axis=1)
    still = BlockTridiagonal(
        blocks.lower,
        blocks.diagonal.at[0, 3:].set(motion),
        blocks.upper.at[0, 3:].set(0.0),
    )
    coupling = None if free.coupling is None else free.coupling.held(eye[None], (0,))
    nothing = jnp.zeros((6, count, 9), eye.dtype)
    borders = []
    if not clamped:
        moving = eye - projectors[0]
        columns = nothing.at[:, 0, 3:].set(-moving)
        rows = jnp.einsum("ij,jnr->inr", moving, _first_balances(free))
        borders.append(Border(columns, rows, projectors[0]))
    for node, projector in zip(nodes[1:], projectors[1:], strict=True):
        columns = with_part(nothing, projector[:, None], (0, node, 3))
        rows = with_part(nothing, (projector @ motion)[:, None], (0, node, 0))
        # in this order the slack is not lost in rounding
        borders.append(Border(columns, rows, (projector - eye) - give))
    return BorderedSystem(CoupledSystem(still, coupling), Border.joined(*borders))


def _first_balances(free: CoupledSystem) -> Float[Array, "6 nodes 9"]:
    """The rows of the balances of node 0."""
    blocks, coupling = free.blocks, free.coupling
    eye = jnp.eye(6, 9, k=3, dtype=blocks.diagonal.dtype)
    units = jnp.zeros((6, *blocks.diagonal.shape[:2]), eye.dtype).at[:, 0].set(eye)
    rows = jnp.zeros_like(units)
    rows = rows.at[:, 0].set(blocks.diagonal[0, 3:]).at[:, 1].set(blocks.upper[0, 3:])
    if coupling is not None:
        rows = rows + jax.vmap(coupling.transpose().multiply)(units)
    return rows
