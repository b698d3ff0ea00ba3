"""Systems of rods with joints: that of the nodes, and a border of multipliers (see `border`).

Their unknowns and rows (n+1+j, 9) are those of the nodes, then a row for each joint: a force over
F, three numbers that are zero, and a moment over F l.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.equations.anchored import AnchoredBordered, EliminatedWhole
from rodjax.equations.border import BorderedSystem, EliminatedBorder, Vector
from rodjax.equations.joint_terms import gathered, spread

Rows = Float[Array, "rows 9"]


class JointedSystem(eqx.Module):
    """The system of the nodes with the border of the joints."""

    bordered: BorderedSystem | AnchoredBordered
    joints: int = eqx.field(static=True)

    def _split(self, b: Rows) -> Vector:
        nodes = b.shape[0] - self.joints
        given = jnp.ravel(gathered(b[nodes:]))
        # what couples the nodes has nothing on the right side
        more = jnp.zeros((self.bordered.border.corner.shape[0] - given.shape[0],), b.dtype)
        return Vector(b[:nodes], jnp.concatenate([given, more]))

    def _joined(self, x: Vector, b: Rows) -> Rows:
        nodes = b.shape[0] - self.joints
        own = spread(x.border[: 6 * self.joints].reshape(-1, 6))
        return jnp.concatenate([x.nodes, own.at[:, 3:6].set(b[nodes:, 3:6])])

    def multiply(self, b: Rows) -> Rows:
        """Matrix times vector."""
        given, border, k = self._split(b), self.bordered.border, 6 * self.joints
        # the further unknowns are what their rows read
        read = border.read(given.nodes)
        unknown = jnp.concatenate([given.border[:k], read[k:]])
        nodes = self.bordered.system.multiply(given.nodes) + border.spread(unknown)
        rows = read + border.corner @ jnp.concatenate([given.border[:k], jnp.zeros_like(read[k:])])
        return self._joined(Vector(nodes, rows), b)

    def solve(self, b: Rows) -> Rows:
        """Solution of the system."""
        return self._joined(self.bordered.solve(self._split(b)), b)

    def solve_once(self, b: Rows) -> Rows:
        """As `solve`."""
        return self.solve(b)

    def solve_transpose(self, b: Rows) -> Rows:
        """Solution of the transposed system."""
        return self._joined(self.bordered.solve_transpose(self._split(b)), b)

    def transpose(self) -> "JointedSystem":
        """The transposed system, of nodes that are not anchored."""
        of_nodes: Any = self.bordered
        return JointedSystem(of_nodes.transpose(), self.joints)

    def eliminate(self) -> "EliminatedJoints":
        """The system ready for several right sides."""
        return EliminatedJoints(self, self.bordered.eliminate())


class EliminatedJoints(eqx.Module):
    """Factors of the nodes' system, and its response to the joints."""

    whole: JointedSystem
    eliminated: EliminatedBorder | EliminatedWhole

    def solve(self, b: Rows) -> Rows:
        """Solution for one right side."""
        return self.whole._joined(self.eliminated.solve(self.whole._split(b)), b)
