"""Equilibria whose tangent is singular: folds and branch points, as roots of extended equations.

With A = dR/dx and fixed borders b, c the system

    [A  b] [v]   [0]
    [c  0] [g] = [1]

is regular where A has lost one rank, and g = 0 exactly there (Govaerts 2000, minimally extended
systems); v is then the null vector. The unknowns are x, the parameter p and a disturbance beta:

    R(x, p) + beta b = 0,     g(x, p) = 0,     and at
    a fold:          beta = 0;
    a branch point:  c.x = 0: x moves in no direction that breaks the symmetry, beta is zero there
                     by itself, as long as nothing else does (Werner & Spence 1984).
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from rodjax.continuation.bordered_solve import Bordered, Free
from rodjax.continuation.family import Family, Parameter, Place, Rows
from rodjax.interactions.screening import NearPairs
from rodjax.numerics import newton


class Increment(NamedTuple):
    """Of the unknowns of a `SingularPoint`."""

    x: Rows
    parameter: Float[Array, ""]  # over its unit
    beta: Float[Array, ""]


class Increments(NamedTuple):
    """Newton's, and what is known besides where it is made."""

    newton: Increment
    sideways: Increment  # what a motion c.x = 1 of a branch point adds to that
    null: Rows  # v
    skew: Float[Array, ""]  # g' along v, over that by the parameter's unit


class Responses(NamedTuple):
    """Of x, beta and g: to the residual, to each change of a parameter, to c.x = 1."""

    x: Float[Array, "k rows 9"]
    beta: Float[Array, " k"]  # the last is g
    g: Float[Array, " k"]  # how it changes


class SingularPoint(eqx.Module):
    """Equations of a fold or a branch point near a place, see `numerics.newton`.

    Their unknowns z are those of the equations at rest, x, and one more row that begins with the
    parameter over its unit and beta.
    """

    family: Family
    place: Place  # from which x counts
    column: Rows  # b
    row: Rows  # c
    free: Free  # what holds motions that cost nothing besides
    unit: Float[Array, ""]  # of the parameter
    branches: Bool[Array, ""]  # or folds; an array, so that both share a program
    pairs: NearPairs | None  # strands near each other

    def packed(self, x: Rows, parameter: Parameter, beta) -> Float[Array, "more 9"]:
        """z."""
        return _packed(x, parameter / self.unit, beta)

    def parameter(self, z) -> Parameter:
        """That of z."""
        return z[-1, 0] * self.unit

    def residual(self, z):
        """What z lacks."""
        x, p, beta = z[:-1], self.parameter(z), z[-1, 1]
        rows = self._equations(p).residual(x) + beta * self.column
        start = self.family.guess(p, self.place)
        second = jnp.where(self.branches, jnp.sum(self.row * (x - start)), beta)
        return _packed(rows, self.singular(x, p)[1], second, z[-1, 2:])

    def singular(self, x: Rows, p: Parameter) -> tuple[Rows, Float[Array, ""]]:
        """v and g."""
        residual = self._equations(p).residual
        free = lax.stop_gradient(self.free)

        def multiply(both):
            v, g = both[:-1], both[-1, 0]
            moved = jax.jvp(residual, (x,), (v,))[1]
            along = jnp.sum(self.row * v)
            moved = moved + jnp.einsum("k,knr->nr", free.along(v), free.columns)
            return _packed(moved + g * self.column, along, both[-1, 1], both[-1, 2:])

        right = _packed(jnp.zeros_like(x), jnp.ones_like(p), jnp.zeros_like(p))
        found = _solved(multiply, self._bordered(x, p), right)
        return found[:-1], found[-1, 0]

    def _bordered(self, x: Rows, p: Parameter) -> Bordered:
        fixed = lax.stop_gradient
        derivative = self.family.derivative(p, self.place, x, self.pairs)
        derivative = newton.constant(derivative)
        border = self.column, self.row, jnp.zeros((), x.dtype), self.free
        return Bordered(derivative, *fixed(border))

    def _equations(self, p: Parameter):
        return self.family.equations(p, self.place, self.pairs)

    def increment(self, p: Parameter) -> Increments:
        """Newton's increment of z at the place itself, with beta zero."""
        along, betas, of_g = self.responses(p, self.unit[None])
        zero, one = jnp.zeros_like(p), jnp.ones_like(p)
        # x goes on by the first, and by so much of the other two that g is zero, and the second
        # of the equations above holds
        second = jnp.where(self.branches, jnp.stack([zero, one]), betas[1:])
        known = jnp.stack([-betas[2] - of_g[0], jnp.where(self.branches, zero, -betas[0])])
        both = jnp.stack([known, jnp.stack([zero, jnp.where(self.branches, one, zero)])])
        numbers = jnp.linalg.solve(jnp.stack([of_g[1:], second]), both.T).T
        dx = jnp.einsum("ki,inr->knr", numbers, along[1:])
        more = numbers @ betas[1:]
        straight = Increment(along[0] + dx[0], numbers[0, 0], betas[0] + more[0])
        sideways = Increment(dx[1], numbers[1, 0], more[1])
        return Increments(straight, sideways, along[2], of_g[2] / of_g[1])

    def responses(self, p: Array, changes: Array) -> "Responses":
        """What the residual, changes of the parameter (or of several) and c.x = 1 do to x and g.

        Derivatives of g, along d, are those of the same bordered system: g' of
        [A b; c 0] [v' g'] = [-A' v, 0], A' the derivative of A along d.
        """
        x = self.family.guess(p, self.place)
        residual = lambda x, p: self._equations(p).residual(x)
        solve = jax.vmap(self._bordered(x, p).solve)
        lacking, pushed = jax.linearize(lambda p: residual(x, p), p)
        slopes = jax.vmap(pushed)(changes)
        rights = jnp.concatenate([-lacking[None], -slopes, jnp.zeros_like(x)[None]])
        none = jnp.zeros((len(rights),), x.dtype)
        along, betas = solve(rights, none.at[-1].set(1.0))

        def turned(x, p):
            return jax.jvp(lambda x: residual(x, p), (x,), (along[-1],))[1]

        curved = lambda dx, dp: jax.jvp(turned, (x, p), (dx, dp))[1]
        still = jnp.zeros_like(changes[:1])
        curved = jax.vmap(curved)(along, jnp.concatenate([still, changes, still]))
        return Responses(along, betas, solve(-curved, none)[1])

    def linearize(self, z) -> "_Extended":
        """The derivative at z, whose nodes must not have turned from the place."""
        x, p = z[:-1], self.parameter(z)
        slope = self.unit * self.family.residual(p, self.place, x, self.pairs)[1]
        g = lambda x, p: self.singular(x, p)[::-1]
        (g, null), (by_x, by_p) = jax.value_and_grad(g, (0, 1), has_aux=True)(x, p)
        bordered = self._bordered(x, p)
        response, beta = bordered.solve(-slope, jnp.zeros_like(g))
        columns, betas = jnp.stack([response, null]), jnp.stack([beta, g])
        by_p = self.unit * by_p
        return _Extended(bordered, slope, by_x, by_p, columns, betas, self.branches)

    def lift(self, z, dz):
        """Increment of z for solved increments."""
        return dz


class _Extended(eqx.Module):
    """The derivative of the extended equations."""

    bordered: Bordered
    slope: Rows  # of R by the parameter over its unit
    by_x: Rows  # of g
    by_p: Float[Array, ""]
    # what the parameter and a motion along c do to x, the second by v, and to beta, by g
    columns: Float[Array, "2 rows 9"]
    betas: Float[Array, "2"]
    branches: Bool[Array, ""]

    def multiply(self, dz):
        """Matrix times vector."""
        dx, dp, beta = dz[:-1], dz[-1, 0], dz[-1, 1]
        rows, along = self.bordered.multiply(dx, beta)
        of_g = jnp.sum(self.by_x * dx) + self.by_p * dp
        second = jnp.where(self.branches, along, beta)
        return _packed(rows + self.slope * dp, of_g, second, dz[-1, 2:])

    def solve(self, right):
        """Solution, by two numbers: the parameter, and how far x moves along c."""
        f, of_g, second = right[:-1], right[-1, 0], right[-1, 1]
        x, beta = self.bordered.solve(f, jnp.zeros_like(of_g))
        second = jnp.where(self.branches, second, second - beta)
        known = jnp.stack([of_g - jnp.sum(self.by_x * x), second])
        numbers = jnp.linalg.solve(self._numbers(), known)
        dx = x + jnp.einsum("i,inr->nr", numbers, self.columns)
        return _packed(dx, numbers[0], beta + jnp.sum(numbers * self.betas), right[-1, 2:])

    def solve_transpose(self, right):
        """Solution of the transposed system."""
        x, p, beta = right[:-1], right[-1, 0], right[-1, 1]
        asked = jnp.einsum("nr,inr->i", x, self.columns) + beta * self.betas
        of_g, second = jnp.linalg.solve(self._numbers().T, asked.at[0].add(p))
        beta = jnp.where(self.branches, beta, beta - second)
        f, _ = self.bordered.solve_transpose(x - of_g * self.by_x, beta)
        return _packed(f, of_g, second, right[-1, 2:])

    def _numbers(self) -> Float[Array, "2 2"]:
        """The equations for both numbers."""
        first = jnp.einsum("nr,inr->i", self.by_x, self.columns).at[0].add(self.by_p)
        second = jnp.where(self.branches, jnp.asarray([0.0, 1.0], first.dtype), self.betas)
        return jnp.stack([first, second])


def _solved(multiply, bordered: Bordered, right):
    """Solution of a bordered system, in a way that can be differentiated."""

    def by(solve):
        def packed(_, b):
            x, y = solve(b[:-1], b[-1, 0])
            return _packed(x, y, b[-1, 1], b[-1, 2:])

        return packed

    return lax.custom_linear_solve(
        multiply, right, by(bordered.solve), by(bordered.solve_transpose)
    )


def _packed(x: Rows, first, second, rest=None):
    rest = jnp.zeros((7,), x.dtype) if rest is None else rest
    last = jnp.concatenate([jnp.stack([first, second]), rest])
    return jnp.concatenate([x, last[None]])
