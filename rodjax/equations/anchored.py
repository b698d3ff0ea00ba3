"""Systems without inertia, solved through a cantilever and a border.

Block elimination starts at node 0 and pivots inside a block only, but without inertia the
equations of a part of a rod that begins with a free, pinned or sliding end are singular. So the
elimination is done for a cantilever, clamped at its first node and free at the other end, of which
every part is held (and nothing is held twice, as a straight inextensible rod between two clamps
would be); of several rods each is one. What the rod's own ends and supports are besides stands in a
border (see `border`): with P the projector of what holds a node,

- a first node moves as q in the directions that it is free to: its balances, (1 - P) of them, are
  rows;
- each other held node is free in the cantilever and feels a wrench P w there, which holds it: its
  rows are P of its motion, and w = 0 in the directions that are free.

The border is symmetric where the balances have a potential.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rodjax.equations.border import Border, BorderedSystem, EliminatedBorder, Vector
from rodjax.equations.coupled import CoupledSystem
from rodjax.numerics.block_tridiagonal import BlockTridiagonal
from rodjax.scenes.holds import Node, impose, rows_at, with_part
from rodjax.scenes.scene import Scene


class Anchor(NamedTuple):
    """The first node of a rod."""

    held: int  # its number among the nodes that are held
    clamped: bool  # whether it is known to be, and so needs no border


def anchors_of(scene: Scene) -> tuple[Anchor, ...]:
    """The first nodes of the scene's rods, and its bodies, among what is held."""
    # both ends of the scene come first, then the last end of a rod and the first of the next; each
    # of the bodies is a first node by itself
    ends, rods = (*scene.ends, *scene.inner_ends), len(scene.rod.strands)
    firsts = (0, *range(3, 2 * rods, 2), *range(2 * rods, len(ends)))
    return tuple(Anchor(i, ends[i].clamped) for i in firsts)


class AnchoredSystem(eqx.Module):
    """The system of rods whose nodes are held, first nodes too; without what its border adds."""

    free: CoupledSystem  # of the rod that nothing holds
    projectors: Float[Array, "h 6 6"]
    nodes: tuple[Node, ...]
    anchors: tuple[Anchor, ...] = eqx.field(static=True)  # among the nodes

    def multiply(self, b: Float[Array, "nodes 9"]) -> Float[Array, "nodes 9"]:
        """Matrix times vector, rows of balances replaced by what is held as in `assembly`."""
        rows, held = self.free.multiply(b), rows_at(b, self.nodes)
        moved = jnp.concatenate([held[:, :3], held[:, 6:]], 1)
        balances = impose(rows[:, 3:], moved, self.projectors, self.nodes)
        return jnp.concatenate([rows[:, :3], balances], 1)

    def solve(self, b: Float[Array, "nodes 9"]) -> Float[Array, "nodes 9"]:
        """Solution of the system."""
        return self._solved(self._bordered(), b)

    def _solved(
        self, by: BorderedSystem | EliminatedBorder, b: Float[Array, "nodes 9"]
    ) -> Float[Array, "nodes 9"]:
        """Solution by the system with its border, or by factors of that."""
        given = self._rows(b)
        inside = self._inside(given)
        right = Vector(self._replaced(b, inside), jnp.ravel(given - inside))
        return by.solve(right).nodes

    def eliminate(self) -> "EliminatedAnchored":
        """The system, without contact or with some, ready for several right sides."""
        return EliminatedAnchored(self, self._bordered().eliminate())

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
        return bordered(self.free, self.projectors, self.nodes, self.anchors)

    @property
    def _others(self) -> np.ndarray:
        """Which of the nodes are held otherwise than the cantilever's."""
        return np.array(_in_border(self.nodes, self.anchors), int)

    @property
    def _nodes(self) -> tuple[Node, ...]:
        return tuple(self.nodes[i] for i in self._others)

    def _rows(self, b: Float[Array, "nodes 9"]) -> Float[Array, "o 6"]:
        """The balances of these nodes."""
        return rows_at(b[:, 3:], self._nodes)

    def _replaced(self, b: Float[Array, "nodes 9"], rows) -> Float[Array, "nodes 9"]:
        for node, row in zip(self._nodes, rows, strict=True):
            b = with_part(b, row[None], (node, 3))
        return b

    def _inside(self, rows: Float[Array, "o 6"]) -> Float[Array, "o 6"]:
        """What of right sides is one of the cantilever: all but that of the border's rows."""
        held = self.projectors
        first = np.array([anchor.held for anchor in self.anchors])
        inside = (jnp.eye(6, dtype=held.dtype)[None] - held).at[first].set(held[first])
        return jnp.einsum("oij,oj->oi", inside[self._others], rows)


class EliminatedAnchored(eqx.Module):
    """Factors of an anchored system."""

    system: AnchoredSystem
    eliminated: EliminatedBorder

    def solve(self, b: Float[Array, "nodes 9"]) -> Float[Array, "nodes 9"]:
        """Solution for one right side."""
        return self.system._solved(self.eliminated, b)


class AnchoredBordered(eqx.Module):
    """The system of rods whose nodes are held, with a border of further multipliers.

    Both borders are solved together: what the rods' ends leave free the further one may hold.
    """

    system: AnchoredSystem
    border: Border

    def solve(self, b: Vector) -> Vector:
        """Solution of the system."""
        return self._solved(self._whole(), b)

    def _solved(self, by: BorderedSystem | EliminatedBorder, b: Vector) -> Vector:
        """Solution by the system with its whole border, or by factors of that."""
        system = self.system
        given = system._rows(b.nodes)
        inside = system._inside(given)
        right = jnp.concatenate([jnp.ravel(given - inside), b.border])
        found = by.solve(Vector(system._replaced(b.nodes, inside), right))
        return Vector(found.nodes, found.border[-len(b.border) :])

    def eliminate(self) -> "EliminatedWhole":
        """The system ready for several right sides."""
        return EliminatedWhole(self, self._whole().eliminate())

    def solve_transpose(self, b: Vector) -> Vector:
        """Solution of the transposed system."""
        system, whole = self.system, self._whole()
        before = whole.border.corner.shape[0] - len(b.border)
        right = jnp.concatenate([jnp.zeros((before,), b.nodes.dtype), b.border])
        x, z = whole.solve_transpose(Vector(b.nodes, right))
        outside = z[:before].reshape(-1, 6)
        rows = system._inside(system._rows(x) - outside) + outside
        return Vector(system._replaced(x, rows), z[before:])

    def _whole(self) -> BorderedSystem:
        system = self.system
        held = system.projectors, system.nodes, system.anchors
        return extended(system._bordered(), self.border, *held)


class EliminatedWhole(eqx.Module):
    """Factors of an anchored system with a further border."""

    system: AnchoredBordered
    eliminated: EliminatedBorder

    def solve(self, b: Vector) -> Vector:
        """Solution for one right side."""
        return self.system._solved(self.eliminated, b)


def extended(
    bordered: BorderedSystem,
    more: Border,
    projectors: Float[Array, "h 6 6"],
    nodes: tuple[Node, ...],
    anchors: tuple[Anchor, ...],
) -> BorderedSystem:
    """The system with more in its border, behind what that had.

    Args:
        more: of the rods before their first nodes are taken out.
        projectors, nodes, anchors: as `bordered` was made of.
    """
    eye = jnp.eye(6, dtype=projectors.dtype)
    before, columns = bordered.border, more.columns
    corner = jnp.zeros((before.corner.shape[0], len(columns)), eye.dtype)
    row = 0
    for anchor in anchors:  # whose balances are rows of the border, if it moves at all
        node = int(nodes[anchor.held])
        if not anchor.clamped:
            moving = eye - projectors[anchor.held]
            corner = corner.at[row : row + 6].set(moving @ columns[:, node, 3:].T)
            row += 6
        columns = columns.at[:, node, 3:].set(0.0)
    whole = Border(
        jnp.concatenate([before.columns, columns]),
        jnp.concatenate([before.rows, more.rows]),
        jnp.block([[before.corner, corner], [jnp.zeros_like(corner.T), more.corner]]),
    )
    return BorderedSystem(bordered.system, whole)


def _in_border(nodes: tuple[Node, ...], anchors: tuple[Anchor, ...]) -> list[int]:
    """Which of the nodes stand in the border: the anchors that move, then the others."""
    first = [anchor.held for anchor in anchors]
    moving = [anchor.held for anchor in anchors if not anchor.clamped]
    return moving + [i for i in range(len(nodes)) if i not in first]


def bordered(
    free: CoupledSystem,
    projectors: Float[Array, "h 6 6"],
    nodes: tuple[Node, ...],
    anchors: tuple[Anchor, ...],
    *,
    slack: Float[Array, "6"] | None = None,
) -> BorderedSystem:
    """The cantilevers of rods that are free, with the border of their nodes that are held.

    Args:
        nodes: those held, the first of every rod among them, which the `anchors` tell.
        slack: how far what holds the others gives way (scaled), for directions that are held
            twice; None: not at all.
    """
    blocks, count = free.blocks, len(free.blocks.diagonal)
    eye = jnp.eye(6, dtype=blocks.diagonal.dtype)
    give = 0.0 * eye if slack is None else jnp.diag(slack)
    motion = jnp.insert(eye, np.array([3, 3, 3]), 0.0, axis=1)
    firsts = tuple(int(nodes[anchor.held]) for anchor in anchors)
    begin = np.array(firsts)
    # between rods nothing couples: what is below a first node is zero
    still = BlockTridiagonal(
        blocks.lower,
        blocks.diagonal.at[begin, 3:].set(motion),
        blocks.upper.at[begin, 3:].set(0.0),
    )
    every = jnp.broadcast_to(eye, (len(firsts), 6, 6))
    coupling = None if free.coupling is None else free.coupling.held(every, firsts)
    nothing = jnp.zeros((6, count, 9), eye.dtype)
    borders, anchored = [], {anchor.held for anchor in anchors}
    for i in _in_border(nodes, anchors):
        node, projector = nodes[i], projectors[i]
        if i in anchored:
            moving = eye - projector
            columns = nothing.at[:, node, 3:].set(-moving)
            rows = jnp.einsum("ij,jnr->inr", moving, _first_balances(free, int(node)))
            borders.append(Border(columns, rows, projector))
            continue
        columns = with_part(nothing, projector[:, None], (0, node, 3))
        rows = with_part(nothing, (projector @ motion)[:, None], (0, node, 0))
        # in this order the slack is not lost in rounding
        borders.append(Border(columns, rows, (projector - eye) - give))
    return BorderedSystem(CoupledSystem(still, coupling), Border.joined(*borders))


def _first_balances(free: CoupledSystem, node: int) -> Float[Array, "6 nodes 9"]:
    """The rows of the balances of a rod's first node."""
    blocks, coupling = free.blocks, free.coupling
    eye = jnp.eye(6, 9, k=3, dtype=blocks.diagonal.dtype)
    units = jnp.zeros((6, *blocks.diagonal.shape[:2]), eye.dtype).at[:, node].set(eye)
    rows = jnp.zeros_like(units)
    rows = rows.at[:, node].set(blocks.diagonal[node, 3:])
    if node + 1 < rows.shape[1]:
        rows = rows.at[:, node + 1].set(blocks.upper[node, 3:])
    if coupling is not None:
        rows = rows + jax.vmap(coupling.transpose().multiply)(units)
    return rows
