"""Lowest eigenvalues of K y = mu W y on held y = 0, of symmetric and of general K.

W is symmetric and not negative, perhaps singular, so the inverse problem is solved, shifted by the
first sigma of unit, 4 unit, 16 unit ... that makes S + sigma W = L L^T positive definite, with S
and A the symmetric and antisymmetric parts of K:

    B z = nu (I + C) z,   B = L^-1 W L^-T,  C = L^-1 A L^-T,  y = L^-T z,  mu = 1/nu - sigma.

C has no unit: the work of the part of the forces without potential over that of the part with one.
Where it is no more than rounding, B alone is diagonalised, which finds real values.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Complex, Float


class Eigenpairs(NamedTuple):
    """Eigenvalues by ascending real part, their vectors, and how they were found."""

    values: Complex[Array, " k"]
    vectors: Complex[Array, "k m"]  # y^H W y = 1
    antisymmetry: Float[Array, ""]  # spectral norm of C
    symmetric: Bool[Array, ""]  # whether it was taken to be zero


class _Factored(NamedTuple):
    """K and W without the held directions, and L of S + sigma W, all without derivative."""

    stiffness: Float[Array, "m m"]
    weight: Float[Array, "m m"]
    inverse: Float[Array, "m k"]  # pseudo-inverse of the held directions
    free: Float[Array, "m m"]  # projector on the directions that are not held
    lower: Float[Array, "m m"]
    sigma: Float[Array, ""]

    def whitened(self, matrix: Float[Array, "m m"]) -> Float[Array, "m m"]:
        """L^-1 matrix L^-T."""
        half = _solve_lower(self.lower, matrix)
        return _solve_lower(self.lower, half.T).T

    def antisymmetric(self) -> Float[Array, "m m"]:
        """C."""
        c = self.whitened(self.stiffness - self.stiffness.T)
        return 0.25 * (c - c.T)


def _solve_lower(lower, right):
    return jax.scipy.linalg.solve_triangular(lower, right, lower=True)


def _solve_upper(lower, right):
    """L^-T right."""
    return jax.scipy.linalg.solve_triangular(lower, right, lower=True, trans=1)


def _symmetric(a):
    return 0.5 * (a + a.T)


def far_above(matrix: Float[Array, "m m"]) -> Float[Array, ""]:
    """More than the largest eigenvalue of a symmetric matrix."""
    return 2 * jnp.max(jnp.sum(jnp.abs(matrix), 1))


def split(held: Float[Array, "k m"]):
    """Pseudo-inverse of the held directions, the projector on them and that on all others."""
    # they may depend on each other (two clamps of a straight inextensible rod) but for rounding
    negligible = 0.1 * float(jnp.finfo(held.dtype).eps) ** 0.5
    inverse = jnp.linalg.pinv(held, rtol=negligible)
    rows = _symmetric(inverse @ held)
    return inverse, rows, jnp.eye(len(rows), dtype=rows.dtype) - rows


def _factor(stiffness, weight, held, unit) -> _Factored:
    stiffness, weight, held, unit = lax.stop_gradient((stiffness, weight, held, unit))
    inverse, rows, free = split(held)
    k, w = free @ stiffness @ free, _symmetric(free @ weight @ free)
    even = _symmetric(k)
    even = even + far_above(even) * rows
    factor = lambda sigma: jnp.linalg.cholesky(even + sigma * w)
    indefinite = lambda carry: ~jnp.all(jnp.isfinite(carry[1])) & (carry[0] < 1e20 * unit)
    raised = lambda carry: (4 * carry[0], factor(4 * carry[0]))
    sigma, lower = lax.while_loop(indefinite, raised, (unit, factor(unit)))
    return _Factored(k, w, inverse, free, lower, sigma)


def lowest(
    stiffness: Float[Array, "m m"],
    weight: Float[Array, "m m"],
    held: Float[Array, "k m"],
    unit: Float[Array, ""],
    count: int,
) -> Eigenpairs:
    """The `count` eigenvalues of least real part; of a complex pair, that of positive imaginary
    part first.

    Values can be differentiated once, d mu = x^H (dK - mu dW) y / x^H W y with the left vector x,
    where x and y turn with the held directions, dy = -held^+ d(held) y; those that coincide as
    their mean (of a pair that is about to become complex, whose x^H W y vanishes, the derivative
    is infinite). Vectors are constants.
    """
    factored = _factor(stiffness, weight, held, unit)
    c = factored.antisymmetric()
    antisymmetry = jnp.linalg.norm(c, 2)
    symmetric = antisymmetry <= _negligible(c.dtype)
    # two more than asked for, so that the mean of the last that coincide is of all of them
    wanted = min(count + 2, c.shape[0])
    even = lambda: _symmetric_pairs(factored, wanted)
    general = lambda: _general_pairs(factored, c, wanted)
    values, left, right = lax.cond(symmetric, even, general)
    # there may be fewer modes with weight: the others must not enter a derivative
    finite = jnp.isfinite(values) & jnp.all(jnp.isfinite(left) & jnp.isfinite(right), 1)
    x, y = (jnp.where(finite[:, None], vectors, 0.0) for vectors in (left, right))
    # what else y changes by stays among free directions, in which x feels no force
    rows, inverse = held.astype(y.dtype), factored.inverse.astype(y.dtype)
    x, y = (vectors - (vectors @ rows.T) @ inverse.T for vectors in (x, y))
    work = jnp.einsum("ki,ij,kj->k", x, stiffness.astype(x.dtype), y)
    weighed = jnp.einsum("ki,ij,kj->k", x, weight.astype(x.dtype), y)
    work = work - jnp.where(finite, values, 0.0) * weighed
    gaps = jnp.abs(values[:, None] - values[None])
    near = jnp.sqrt(jnp.finfo(c.dtype).eps) * (jnp.abs(values) + factored.sigma)
    same = (gaps <= near[:, None]).astype(work.dtype)
    values = _with_slope(values, (same @ work) / jnp.sum(same, 1))
    return Eigenpairs(values[:count], right[:count], antisymmetry, symmetric)


def _negligible(dtype) -> Float[Array, ""]:
    """An antisymmetry that rounding, or an equilibrium within its tolerance, may leave."""
    return 100 * jnp.sqrt(jnp.finfo(dtype).eps)


def _symmetric_pairs(factored: _Factored, count: int):
    """Eigenvalues, left vectors (conjugated, with x^H W y = 1) and right vectors of S."""
    nu, z = jnp.linalg.eigh(_symmetric(factored.whitened(factored.weight)))
    nu, z = nu[::-1][:count], z[:, ::-1][:, :count]
    rounding = len(factored.free) * jnp.finfo(nu.dtype).eps * nu[0]
    nu = jnp.where(nu > rounding, nu, 0.0)  # without weight, mu is infinite
    y = _solve_upper(factored.lower, z).T @ factored.free
    y = lax.complex(y / jnp.sqrt(nu)[:, None], jnp.zeros_like(y))
    values = 1 / nu - factored.sigma
    return lax.complex(values, jnp.zeros_like(values)), y, y


def _general_pairs(factored: _Factored, c: Float[Array, "m m"], count: int):
    """The same of K, by (I + C)^-1 B."""
    b = _symmetric(factored.whitened(factored.weight))
    odd = jnp.eye(len(c), dtype=c.dtype) + c
    nu, z = lax.linalg.eig(jnp.linalg.solve(odd, b), compute_left_eigenvectors=False)
    # without weight: mu is infinite, and its rounding must not come first
    weightless = jnp.abs(nu) <= len(c) * jnp.finfo(c.dtype).eps * jnp.max(jnp.abs(nu))
    inverse = 1 / jnp.where(weightless, 1.0, nu)
    order = jnp.argsort(jnp.where(weightless, jnp.inf, inverse.real))[:count]
    values = jnp.where(weightless, jnp.inf, inverse)[order]
    values = values - jnp.asarray(factored.sigma, values.dtype)
    # left vectors from the inverse, orthogonal to the right ones also where values coincide
    left = jnp.linalg.inv(z)[order]
    left = jnp.linalg.solve(odd.T.astype(z.dtype), left.T)
    size = jnp.sqrt(jnp.einsum("ik,ij,jk->k", z.conj(), b.astype(z.dtype), z).real)[order]
    lower, free = factored.lower.astype(z.dtype), factored.free.astype(z.dtype)
    left = _solve_upper(lower, left).T @ free * (inverse[order] * size.astype(z.dtype))[:, None]
    right = _solve_upper(lower, z[:, order]).T @ free / size.astype(z.dtype)[:, None]
    return values, left, right


@jax.custom_jvp
def _with_slope(value, change):
    """The value, with the derivative of `change` (whose own value has more round-off)."""
    return value


@_with_slope.defjvp
def _with_slope_jvp(primals, tangents):
    return primals[0], tangents[1]


def grows(
    stiffness: Float[Array, "m m"],
    damping: Float[Array, "m m"],
    mass: Float[Array, "m m"] | None,
    held: Float[Array, "k m"],
    unit: Float[Array, ""],
) -> Bool[Array, ""]:
    """Whether M x'' + D x' + K x = 0 has a solution exp(s t) that grows (D x' + K x without mass).

    With S = s/s_0, S = 1 + 1/theta and s_0 = sqrt(sigma) (without mass sigma) it is

        (Q theta^2 + (2 M' + D') theta + M') x = 0,   Q = K + M' + D',   M' = sigma M,  D' = s_0 D.
    """
    factored = _factor(stiffness, damping if mass is None else mass, held, unit)
    sigma, free = factored.sigma, factored.free
    eye = jnp.eye(len(free), dtype=free.dtype)
    q = eye + factored.antisymmetric()
    weight = sigma * _symmetric(factored.whitened(factored.weight))
    if mass is None:
        # D need not be symmetric: the rest of it belongs to D' and Q alike
        rest = sigma * factored.whitened(free @ damping @ free) - weight
        theta = jnp.linalg.eigvals(-jnp.linalg.solve(q + rest, weight + rest))
    else:
        damped = jnp.sqrt(sigma) * factored.whitened(free @ damping @ free)
        rows = jnp.concatenate([2 * weight + damped, weight], 1)
        first = -jnp.linalg.solve(q + damped, rows)
        second = jnp.concatenate([eye, jnp.zeros_like(eye)], 1)
        theta = jnp.linalg.eigvals(jnp.concatenate([first, second]))
    # very fast modes, and infinite ones of what has neither mass nor damping, drown in rounding
    size = jnp.abs(theta)
    root = jnp.sqrt(jnp.finfo(free.dtype).eps)
    seen = size > 1e3 * root * jnp.max(size)
    s = 1 + 1 / jnp.where(seen, theta, 1.0)
    return jnp.any(seen & (s.real > 10 * root * (1 + jnp.abs(s) ** 2)))
