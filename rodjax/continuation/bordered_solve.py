"""Solutions of a Newton system with one more row and column, also where that system is singular.

    [A  b] [x]   [f]
    [c  d] [y] = [g]

Block elimination divides by what A, nearly singular at a fold or a branch point, hardly resists.
One refinement of its result takes back what rounding did there (Govaerts & Pryce 1993), and what
the resistance did that keeps A from being singular for good (see `family`).
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

Rows = Float[Array, "rows 9"]


class Bordered(NamedTuple):
    """A system, and its border of one row and one column."""

    system: Any  # A: multiply, multiply_transpose, solve, solve_transpose (these may be rough)
    column: Rows  # b
    row: Rows  # c
    corner: Float[Array, ""]  # d

    def solve(self, f: Rows, g) -> tuple[Rows, Float[Array, ""]]:
        """x and y."""
        return _refined(self.system.solve, self.multiply, self, f, g)

    def solve_transpose(self, f: Rows, g) -> tuple[Rows, Float[Array, ""]]:
        """Those of the transposed system: A^T x + c y = f, b.x + d y = g."""
        solve = self.system.solve_transpose
        turned = self._replace(column=self.row, row=self.column)
        return _refined(solve, self.multiply_transpose, turned, f, g)

    def multiply(self, x: Rows, y) -> tuple[Rows, Float[Array, ""]]:
        """Matrix times vector."""
        return self.system.multiply(x) + self.column * y, jnp.sum(self.row * x) + self.corner * y

    def multiply_transpose(self, x: Rows, y) -> tuple[Rows, Float[Array, ""]]:
        """Transposed matrix times vector."""
        transposed = self.system.multiply_transpose(x)
        return transposed + self.row * y, jnp.sum(self.column * x) + self.corner * y


def _refined(solve, multiply, bordered: Bordered, f, g):
    """The solution by elimination, refined once."""
    response, first = jax.vmap(solve)(jnp.stack([bordered.column, f]))
    complement = bordered.corner - jnp.sum(bordered.row * response)

    def closed(free, g):
        y = (g - jnp.sum(bordered.row * free)) / complement
        return free - response * y, y

    x, y = closed(first, g)
    of_nodes, of_border = multiply(x, y)
    dx, dy = closed(solve(f - of_nodes), g - of_border)
    return x + dx, y + dy
