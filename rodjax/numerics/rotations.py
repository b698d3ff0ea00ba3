"""Unit quaternions and rotation vectors, smooth at the identity.

A quaternion is stored scalar first, (..., 4), and maps body components to inertial ones.
A rotation vector is an axis times an angle in radians, (..., 3). Every coefficient function
takes the *squared* angle and switches to its power series near zero, so that all derivatives
are finite at the identity.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

# Below this squared angle the series are used: eight terms reach round-off there, and the
# closed forms, which cancel, keep at least eleven digits above it.
_SERIES_BELOW = 0.25


def _blend(squared, series, closed):
    """Power series below the threshold, closed form of the angle above it (both kept safe)."""
    small = squared < _SERIES_BELOW
    angle = jnp.sqrt(jnp.where(small, 1.0, squared))
    return jnp.where(small, _polynomial(series, squared), closed(angle))


def _polynomial(series, x):
    """Horner's rule, highest power first (jnp.polyval unrolls a scan, slow to compile)."""
    value = jnp.full_like(x, series[0])
    for coefficient in series[1:]:
        value = value * x + coefficient
    return value


# Series coefficients in the squared angle, lowest power first.
_SINC_HALF = [(-1) ** k / 2 / 4**k / math.factorial(2 * k + 1) for k in range(6)]
_COS_HALF = [(-1) ** k / 4**k / math.factorial(2 * k) for k in range(7)]
_VERSINE = [(-1) ** k / math.factorial(2 * k + 2) for k in range(7)]
_CUBIC = [(-1) ** k / math.factorial(2 * k + 3) for k in range(6)]
# Bernoulli numbers: 1 - (a/2) cot(a/2) = sum |B_2k| a^2k / (2k)!
_INVERSE = [1 / 12, 1 / 720, 1 / 30240, 1 / 1209600, 1 / 47900160, 691 / 1307674368000,
            1 / 74724249600, 3617 / 10670622842880000]  # fmt: skip
# tan(y)/y with y = a/4, over 8
_TANGENT = [c / 8 / 16**k for k, c in enumerate((1, 1 / 3, 2 / 15, 17 / 315, 62 / 2835,
            1382 / 155925, 21844 / 6081075, 929569 / 638512875))]  # fmt: skip


def _derivative(series):
    """Series of (d/da)/a = 2 d/d(a^2) of a series in a^2 (lowest power first)."""
    return [2 * k * c for k, c in enumerate(series)][1:]


def _cotangent(angle):
    """cos/sin: unlike 1/tan it keeps its higher derivatives at a quarter turn."""
    return jnp.cos(angle) / jnp.sin(angle)


def inverse_tangent_coefficient(squared):
    """c(a) = (1 - (a/2) cot(a/2)) / a^2 as a function of a squared; 1/12 at zero."""
    closed = lambda a: (1 - 0.5 * a * _cotangent(0.5 * a)) / a**2
    return _blend(squared, _INVERSE[::-1], closed)


def inverse_tangent_slope(squared):
    """c'(a) / a for c of `inverse_tangent_coefficient`, by a squared; 1/360 at zero."""

    def closed(a):
        cot = _cotangent(0.5 * a)
        return ((0.25 * a * (1 + cot**2) - 0.5 * cot) - 2 * (1 - 0.5 * a * cot) / a) / a**3

    return _blend(squared, _derivative(_INVERSE)[::-1], closed)


def midframe_coefficient(squared):
    """b(a) = tan(a/4) / (2 a) as a function of a squared; 1/8 at zero."""
    return _blend(squared, _TANGENT[::-1], lambda a: jnp.tan(0.25 * a) / (2 * a))


def midframe_slope(squared):
    """b'(a) / a for b of `midframe_coefficient`, as a function of a squared; 1/192 at zero."""

    def closed(a):
        tangent = jnp.tan(0.25 * a)
        return ((1 + tangent**2) / 8 - tangent / (2 * a)) / a**2

    return _blend(squared, _derivative(_TANGENT)[::-1], closed)


def _bilinear(form: np.ndarray, a: Float[Array, "*b j"], b: Float[Array, "*b k"]) -> Array:
    """sum_jk form[i, j, k] a_j b_k, leading axes broadcast."""
    size, first, second = form.shape
    flat = jnp.asarray(form.transpose(1, 0, 2).reshape(first, -1), jnp.result_type(a, b))
    highest = lax.Precision.HIGHEST  # others round to half precision on accelerators
    half = jnp.matmul(a, flat, precision=highest).reshape(*a.shape[:-1], size, second)
    return jnp.einsum("...ik,...k->...i", half, b, precision=highest)


def _with_tangent(form: np.ndarray):
    """Gives a bilinear function of two arrays, written out by components, its derivative.

    Components are the fastest to evaluate, but their derivatives make long programs, slow to
    compile; those of small products of matrices are much shorter.
    """

    def decorate(function):
        wrapped = jax.custom_jvp(function)

        @wrapped.defjvp
        def _tangent(primals, tangents):
            (a, b), (da, db) = primals, tangents
            return wrapped(a, b), _bilinear(form, da, b) + _bilinear(form, a, db)

        return wrapped

    return decorate


# product of quaternions: rows w, x, y, z
_PRODUCT = np.zeros((4, 4, 4))
for _i, _row in enumerate(
    [
        [(0, 0, 1), (1, 1, -1), (2, 2, -1), (3, 3, -1)],
        [(0, 1, 1), (1, 0, 1), (2, 3, 1), (3, 2, -1)],
        [(0, 2, 1), (1, 3, -1), (2, 0, 1), (3, 1, 1)],
        [(0, 3, 1), (1, 2, 1), (2, 1, -1), (3, 0, 1)],
    ]
):
    for _j, _k, _sign in _row:
        _PRODUCT[_i, _j, _k] = _sign
_CROSS = _PRODUCT[1:, 1:, 1:]  # the vector part of a product of vectors
# matrix(q) = I + 2 (w hat(v) + v v^T - v.v I): its derivative, symmetric in q and dq
_TWICE_MATRIX = np.zeros((3, 3, 4, 4))
_TWICE_MATRIX[:, :, 0, 1:] = _TWICE_MATRIX[:, :, 1:, 0] = 2 * _CROSS.transpose(0, 2, 1)
_TWICE_MATRIX[:, :, 1:, 1:] = 2 * (
    np.einsum("ik,jl->ijkl", np.eye(3), np.eye(3))
    + np.einsum("il,jk->ijkl", np.eye(3), np.eye(3))
    - 2 * np.einsum("ij,kl->ijkl", np.eye(3), np.eye(3))
)
_TWICE_MATRIX = _TWICE_MATRIX.reshape(9, 4, 4)


@_with_tangent(_CROSS)
def cross(a: Float[Array, "*b 3"], b: Float[Array, "*b 3"]) -> Float[Array, "*b 3"]:
    """a x b."""
    return jnp.cross(a, b)


def hat(vector: Float[Array, "*b 3"]) -> Float[Array, "*b 3 3"]:
    """Skew matrix of a vector, with hat(a) b = a x b."""
    x, y, z = vector[..., 0], vector[..., 1], vector[..., 2]
    zero = jnp.zeros_like(x)
    rows = [(zero, -z, y), (z, zero, -x), (-y, x, zero)]
    return jnp.stack([jnp.stack(row, -1) for row in rows], -2)


@_with_tangent(_PRODUCT)
def multiply(p: Float[Array, "*b 4"], q: Float[Array, "*b 4"]) -> Float[Array, "*b 4"]:
    """Quaternion product p q: rotate by q first, then by p."""
    pw, px, py, pz = (p[..., i] for i in range(4))
    qw, qx, qy, qz = (q[..., i] for i in range(4))
    return jnp.stack(
        [
            pw * qw - px * qx - py * qy - pz * qz,
            pw * qx + px * qw + py * qz - pz * qy,
            pw * qy - px * qz + py * qw + pz * qx,
            pw * qz + px * qy - py * qx + pz * qw,
        ],
        -1,
    )


def conjugate(q: Float[Array, "*b 4"]) -> Float[Array, "*b 4"]:
    """Inverse of a unit quaternion q."""
    return jnp.concatenate([q[..., :1], -q[..., 1:]], -1)


def normalize(q: Float[Array, "*b 4"]) -> Float[Array, "*b 4"]:
    """Unit quaternion along q, which must not be zero."""
    return q / jnp.sqrt(jnp.sum(q * q, -1, keepdims=True))


@jax.custom_jvp
def matrix(q: Float[Array, "*b 4"]) -> Float[Array, "*b 3 3"]:
    """Rotation matrix of a unit quaternion; its columns are the directors a_1, a_2, a_3."""
    w, x, y, z = (q[..., i] for i in range(4))
    rows = [
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    ]
    return jnp.stack([jnp.stack(row, -1) for row in rows], -2)


@matrix.defjvp
def _matrix_tangent(primals, tangents):
    (q,), (dq,) = primals, tangents
    return matrix(q), _bilinear(_TWICE_MATRIX, dq, q).reshape(*q.shape[:-1], 3, 3)


def tangent_director(q: Float[Array, "*b 4"]) -> Float[Array, "*b 3"]:
    """Third director a_3 of a frame q, the normal of the cross-section, in inertial components."""
    w, x, y, z = (q[..., i] for i in range(4))
    return jnp.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], -1)


def rotate(q: Float[Array, "*b 4"], vector: Float[Array, "*b 3"]) -> Float[Array, "*b 3"]:
    """Body components of a vector to inertial components, by the quaternion q of the body."""
    axis = q[..., 1:]
    twice = 2 * cross(axis, vector)
    return vector + q[..., :1] * twice + cross(axis, twice)


def rotate_inverse(q: Float[Array, "*b 4"], vector: Float[Array, "*b 3"]) -> Float[Array, "*b 3"]:
    """Inertial components of a vector to body components, by the quaternion q of the body."""
    return rotate(conjugate(q), vector)


def exponential(vector: Float[Array, "*b 3"]) -> Float[Array, "*b 4"]:
    """Unit quaternion of a rotation vector [rad]."""
    squared = jnp.sum(vector * vector, -1, keepdims=True)
    scale = _blend(squared, _SINC_HALF[::-1], lambda a: jnp.sin(0.5 * a) / a)
    cosine = _blend(squared, _COS_HALF[::-1], lambda a: jnp.cos(0.5 * a))
    return jnp.concatenate([cosine, scale * vector], -1)


def logarithm(q: Float[Array, "*b 4"]) -> Float[Array, "*b 3"]:
    """Rotation vector [rad] of a unit quaternion.

    The quaternion's sign is kept: q and -q give vectors that differ by a full turn, so that a
    continuous sequence of quaternions has a continuous logarithm through angles of pi, up to 2 pi.
    """
    w, v = q[..., :1], q[..., 1:]
    squared = jnp.sum(v * v, -1, keepdims=True)
    small = (squared < 4e-3) & (w > 0)
    sine = jnp.sqrt(jnp.where(small, 1.0, squared))
    # atan(t)/t with t = sine / cosine
    ratio = jnp.where(small, squared, 0.0) / jnp.where(small, w, 1.0) ** 2
    series = _polynomial([(-1) ** k / (2 * k + 1) for k in range(7)][::-1], ratio)
    scale = jnp.where(small, 2 * series / jnp.where(small, w, 1.0), 2 * jnp.arctan2(sine, w) / sine)
    return scale * v


def tangent(vector: Float[Array, "*b 3"]) -> Float[Array, "*b 3 3"]:
    """Right Jacobian J at a vector v: exp(v + dv) = exp(v) exp(J(v) dv) to first order."""
    squared = jnp.sum(vector * vector, -1)[..., None, None]
    skew = hat(vector)
    first = _blend(squared, _VERSINE[::-1], lambda a: (1 - jnp.cos(a)) / a**2)
    second = _blend(squared, _CUBIC[::-1], lambda a: (a - jnp.sin(a)) / a**3)
    return (
        jnp.broadcast_to(jnp.eye(3, dtype=vector.dtype), skew.shape)
        - first * skew
        + second * (skew @ skew)
    )


def tangent_inverse(vector: Float[Array, "*b 3"]) -> Float[Array, "*b 3 3"]:
    """Inverse of `tangent` at a vector v: I + hat(v)/2 + c hat(v)^2."""
    squared = jnp.sum(vector * vector, -1)[..., None, None]
    skew = hat(vector)
    return (
        jnp.broadcast_to(jnp.eye(3, dtype=vector.dtype), skew.shape)
        + 0.5 * skew
        + inverse_tangent_coefficient(squared) * (skew @ skew)
    )


def tangent_inverse_apply(
    vector: Float[Array, "*b 3"], increment: Float[Array, "*b 3"]
) -> Float[Array, "*b 3"]:
    """`tangent_inverse(vector) @ increment` without the matrix."""
    squared = jnp.sum(vector * vector, -1, keepdims=True)
    once = jnp.cross(vector, increment)
    twice = jnp.cross(vector, once)
    return increment + 0.5 * once + inverse_tangent_coefficient(squared) * twice
