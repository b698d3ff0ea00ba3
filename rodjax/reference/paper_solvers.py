"""Two solvers for the linearised boundary-value problem of a step of the paper's own scheme.

Both solve the same equations, `Linearized`: 12 of every element between two nodes of 12 unknowns,
and 6 at each end, and both march from s = 0. Left free by the end there, the solutions form a
six-dimensional affine set. `Shooting` carries one particular and six homogeneous solutions as
they are (section 2.3 of the paper): over the rod they grow by about exp(k L / sqrt 2),
k = (m / (A (dt/2)^2))^(1/4), and digits are lost (less on a coarse grid, where n elements let them
grow by at most (1 + sqrt 2)^n). `BlockSolve` is the factorisation of the block system: it takes a
new orthonormal basis of the set at every element and returns by back substitution, so nothing
grows.
"""

import abc
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float


class Linearized(NamedTuple):
    """Equations of a Newton increment y of the nodes' fields; p are the slopes Y' carried along.

        left y_{i-1} + memory p_{i-1} + right y_i + residual = 0         every element i
        p_i = slope_left y_{i-1} + slope_memory p_{i-1} + slope_right y_i
        first y_0 + first_residual = 0,   last y_n + last_residual = 0   the two ends
    p_0 = 0: what the first slope depends on is part of the first element's `left`.
    """

    left: Float[Array, "n 12 12"]
    right: Float[Array, "n 12 12"]
    residual: Float[Array, "n 12"]
    slope_left: Float[Array, "n 12 12"]
    slope_right: Float[Array, "n 12 12"]
    memory: Float[Array, ""]
    slope_memory: Float[Array, ""]
    first: Float[Array, "6 12"]
    first_residual: Float[Array, " 6"]
    last: Float[Array, "6 12"]
    last_residual: Float[Array, " 6"]

    @property
    def rows(self) -> tuple[Array, ...]:
        """What a march along s takes at every element."""
        return (self.left, self.right, self.residual, self.slope_left, self.slope_right)

    def start(self) -> Float[Array, "12 7"]:
        """Columns of y_0 that obey the first end: a solution, and a basis of the free part."""
        full, triangle = jnp.linalg.qr(self.first.T, mode="complete")
        particular = full[:, :6] @ jnp.linalg.solve(triangle[:6].T, -self.first_residual)
        return jnp.concatenate([particular[:, None], full[:, 6:]], 1)

    def meet_last(self, columns: Float[Array, "12 7"]) -> Float[Array, " 6"]:
        """Amounts of the six homogeneous solutions that meet the last end."""
        reached = self.last @ columns
        return jnp.linalg.solve(reached[:, 1:], -self.last_residual - reached[:, 0])


class AbstractSolver(eqx.Module):
    """How the linear equations of a Newton iteration are solved."""

    @abc.abstractmethod
    def solve(self, equations: Linearized) -> Float[Array, "nodes 12"]:
        """The increments of all nodes."""


class BlockSolve(AbstractSolver):
    """Elimination of the block system with pivoting over all 18 unknowns of an element.

    Carried to element i: y_{i-1} = c + Q b and p_{i-1} = d + P b with six unknown b. Its 12
    equations in (b, y_i) are solved by a QR factorisation of their transpose, whose remaining six
    orthonormal columns span what is still free: they are the next Q. Neither block `left` nor
    `right` is inverted by itself, which would fail where a step of ds meets a pole of the march.
    """

    def solve(self, equations: Linearized) -> Float[Array, "nodes 12"]:
        e = equations

        def eliminate(carried, row):
            before, slopes = carried
            left, right, residual, slope_left, slope_right = row
            entered = left @ before + e.memory * slopes
            matrix = jnp.concatenate([entered[:, 1:], right], 1)
            full, triangle = jnp.linalg.qr(matrix.T, mode="complete")
            known = jnp.linalg.solve(triangle[:12].T, -residual - entered[:, 0])
            columns = jnp.concatenate([(full[:, :12] @ known)[:, None], full[:, 12:]], 1)
            back, after = columns[:6], columns[6:]
            old = _rebase(jnp.concatenate([before, slopes]), back)
            slopes = slope_left @ old[:12] + e.slope_memory * old[12:] + slope_right @ after
            return (after, slopes), (before, back)

        def substitute(amounts, row):
            before, back = row
            amounts = back[:, 0] + back[:, 1:] @ amounts
            return amounts, before[:, 0] + before[:, 1:] @ amounts

        start = e.start()
        (end, _), rows = lax.scan(eliminate, (start, jnp.zeros_like(start)), e.rows)
        amounts = e.meet_last(end)
        _, nodes = lax.scan(substitute, amounts, rows, reverse=True)
        return jnp.concatenate([nodes, (end[:, 0] + end[:, 1:] @ amounts)[None]])


def _rebase(columns, back):
    """Columns (solution, basis) in the unknowns that `back` expresses the old ones by."""
    return (columns[:, 1:] @ back).at[:, 0].add(columns[:, 0])


class Shooting(AbstractSolver):
    """Single shooting: seven marches along s, then six equations at the last end.

    Right to round-off where the growth is far below 1/eps = 5e15 (see above): in a rod of the
    paper's Table 1 with D = 2 mm at dt = 0.1 s, where it is e^15. Refining dt costs digits, which
    Newton's iterations in part restore, until they do not converge: there, with 60 elements, from
    0.007 s on. Thinner rods need the block solve.
    """

    def solve(self, equations: Linearized) -> Float[Array, "nodes 12"]:
        e = equations

        def march(carried, row):
            before, slopes = carried
            left, right, residual, slope_left, slope_right = row
            known = -(left @ before + e.memory * slopes).at[:, 0].add(residual)
            after = jnp.linalg.solve(right, known)
            slopes = slope_left @ before + e.slope_memory * slopes + slope_right @ after
            return (after, slopes), after

        start = e.start()
        _, reached = lax.scan(march, (start, jnp.zeros_like(start)), e.rows)
        columns = jnp.concatenate([start[None], reached])
        return columns[:, :, 0] + columns[:, :, 1:] @ e.meet_last(columns[-1])
