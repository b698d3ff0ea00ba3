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


class Free(NamedTuple):
    """Motions that nothing resists, and that are resisted here: U V^T is added to the system."""

    columns: Float[Array, "k rows 9"]  # U
    rows: Float[Array, "k rows 9"]  # V

    def along(self, x: Rows) -> Float[Array, " k"]:
        """V^T x."""
        return jnp.einsum("knr,nr->k", self.rows, x)


class Bordered(NamedTuple):
    """A system, and its border of one row and one column."""

    system: Any  # A: multiply, multiply_transpose, solve, solve_transpose (these may be rough)
    column: Rows  # b
    row: Rows  # c
    corner: Float[Array, ""]  # d
    free: Free

    def solve(self, f: Rows, g) -> tuple[Rows, Float[Array, ""]]:
        """x and y."""
        border = self._border()
        x, y = _refined(self.system.solve, self.system.multiply, border, f, _first(g, border))
        return x, y[0]

    def solve_transpose(self, f: Rows, g) -> tuple[Rows, Float[Array, ""]]:
        """Those of the transposed system: A^T x + c y = f, b.x + d y = g."""
        border = self._border()
        border = border._replace(columns=border.rows, rows=border.columns)
        multiply = self.system.multiply_transpose
        x, y = _refined(self.system.solve_transpose, multiply, border, f, _first(g, border))
        return x, y[0]

    def multiply(self, x: Rows, y) -> tuple[Rows, Float[Array, ""]]:
        """Matrix times vector, of the system as it is."""
        return self.system.multiply(x) + self.column * y, jnp.sum(self.row * x) + self.corner * y

    def _border(self) -> "_Border":
        """All rows and columns: y' = V^T x is one more unknown for each free motion."""
        column, row = self.column[None], self.row[None]
        corner = jnp.asarray(self.corner).reshape(1, 1)
        count = len(self.free.rows)
        corner = jnp.diag(jnp.concatenate([corner[0], -jnp.ones((count,), corner.dtype)]))
        join = lambda one, others: jnp.concatenate([one, others])
        return _Border(join(column, self.free.columns), join(row, self.free.rows), corner)


class _Border(NamedTuple):
    columns: Float[Array, "m rows 9"]
    rows: Float[Array, "m rows 9"]
    corner: Float[Array, "m m"]


def _first(g, border: _Border) -> Float[Array, " m"]:
    return jnp.zeros((len(border.rows),), border.rows.dtype).at[0].set(g)


def _refined(solve, multiply, border: _Border, f, g):
    """The solution by elimination, refined once."""
    columns, rows, corner = border
    along = lambda x: jnp.einsum("mnr,nr->m", rows, x)
    found = jax.vmap(solve)(jnp.concatenate([columns, f[None]]))
    response, first = found[:-1], found[-1]
    complement = corner - jnp.einsum("mnr,knr->mk", rows, response)

    def closed(free, g):
        y = jnp.linalg.solve(complement, g - along(free))
        return free - jnp.einsum("m,mnr->nr", y, response), y

    x, y = closed(first, g)
    of_nodes = multiply(x) + jnp.einsum("m,mnr->nr", y, columns)
    dx, dy = closed(solve(f - of_nodes), g - along(x) - corner @ y)
    return x + dx, y + dy
