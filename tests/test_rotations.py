"""Rotations against matrices, series, automatic differentiation and each other."""

from fractions import Fraction
from math import factorial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import random_arrays, relative_difference
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from rodjax import rotations

few = settings(max_examples=40, deadline=None)
exponential, logarithm = jax.jit(rotations.exponential), jax.jit(rotations.logarithm)
matrix_of = jax.jit(lambda vector: rotations.matrix(rotations.exponential(vector)))
component = st.floats(-1.0, 1.0)
direction = st.tuples(component, component, component).filter(lambda v: np.linalg.norm(v) > 0.1)
# from below the smallest normal numbers' square to just under a whole turn
angle = st.one_of(
    st.floats(1e-12, 2 * np.pi - 1e-3),
    st.sampled_from([0.0, 1e-300, 1e-160, 1e-8, 0.1264, 0.5 - 1e-9, 0.5 + 1e-9, np.pi]),
)


def vector_of(axis, size):
    return jnp.asarray(size * np.asarray(axis) / np.linalg.norm(axis))


# Exponential and logarithm


@few
@given(direction, angle)
def test_logarithm_inverts_exponential(axis, size):
    vector = vector_of(axis, size)
    q = exponential(vector)
    assert np.sum(np.asarray(q) ** 2) == pytest.approx(1.0, abs=1e-15)
    # near a whole turn the sine that carries the axis is small: the error grows as 1 / sine
    allowed = 4e-15 / max(np.sin(size / 2), 1e-3) if size > np.pi else 4e-15
    np.testing.assert_allclose(logarithm(q), vector, rtol=0, atol=allowed * max(size, 1))
    if 1e-150 < size < 1:  # small angles keep their relative precision
        assert relative_difference(logarithm(q), vector) < 1e-14


@few
@given(direction, angle)
def test_exponential_against_scipy(axis, size):
    vector = vector_of(axis, size)
    expected = Rotation.from_rotvec(np.array(vector)).as_matrix()
    np.testing.assert_allclose(matrix_of(vector), expected, atol=2e-15)


def test_quaternion_algebra():
    p, q, v = random_arrays(0, (5, 4), (5, 4), (5, 3))
    p, q = rotations.normalize(p), rotations.normalize(q)
    product = rotations.matrix(p) @ rotations.matrix(q)
    np.testing.assert_allclose(rotations.matrix(rotations.multiply(p, q)), product, atol=1e-15)
    turned = jnp.einsum("nij,nj->ni", rotations.matrix(q), v)
    np.testing.assert_allclose(rotations.rotate(q, v), turned, atol=1e-15)
    np.testing.assert_allclose(rotations.rotate_inverse(q, turned), v, atol=2e-15)
    np.testing.assert_allclose(rotations.tangent_director(q), rotations.matrix(q)[:, :, 2])
    identity = rotations.multiply(q, rotations.conjugate(q))
    np.testing.assert_allclose(identity, np.tile([1.0, 0, 0, 0], (5, 1)), atol=1e-15)
    np.testing.assert_allclose(
        jnp.einsum("nij,nj->ni", rotations.hat(v), turned), jnp.cross(v, turned), atol=1e-15
    )


def test_logarithm_is_continuous_through_half_a_turn():
    angles = jnp.linspace(0.0, 2 * np.pi - 1e-3, 301)
    vectors = angles[:, None] * jnp.asarray([[0.6, 0.0, 0.8]])
    found = rotations.logarithm(rotations.exponential(vectors))
    np.testing.assert_allclose(found, vectors, atol=1e-11)
    # the other sign of a quaternion is the rotation the other way round
    q = rotations.exponential(vectors[100])
    back = float(jnp.linalg.norm(rotations.logarithm(-q)))
    assert back == pytest.approx(2 * np.pi - float(angles[100]), abs=1e-13)


# Coefficient functions


def bernoulli(count):
    numbers = [Fraction(1)]
    for m in range(1, count):
        row = sum(
            Fraction(factorial(m + 1), factorial(k) * factorial(m + 1 - k)) * numbers[k]
            for k in range(m)
        )
        numbers.append(-row / (m + 1))
    return numbers


# series of c(a) = (1 - (a/2) cot(a/2))/a^2 and b(a) = tan(a/4)/(2 a) in a^2, exact rationals
_B = bernoulli(122)
INVERSE = [abs(_B[2 * k]) / factorial(2 * k) for k in range(1, 60)]
MIDFRAME = [
    abs(_B[2 * k]) * 4**k * (4**k - 1) / factorial(2 * k) / (8 * 16 ** (k - 1))
    for k in range(1, 60)
]


def rational(series, squared, slope=False):
    """Sum of an exact series at an exact argument; its (d/da)/a if `slope`."""
    x = Fraction(squared)
    if slope:
        return float(sum(2 * k * c * x ** (k - 1) for k, c in enumerate(series) if k))
    return float(sum(c * x**k for k, c in enumerate(series)))


CASES = {
    "inverse": (rotations.inverse_tangent_coefficient, INVERSE, False, 1 / 12),
    "inverse slope": (rotations.inverse_tangent_slope, INVERSE, True, 1 / 360),
    "midframe": (rotations.midframe_coefficient, MIDFRAME, False, 1 / 8),
    "midframe slope": (rotations.midframe_slope, MIDFRAME, True, 1 / 192),
}


@pytest.mark.parametrize("case", CASES)
def test_coefficients_against_exact_series(case):
    function, series, slope, at_zero = CASES[case]
    squared = np.concatenate(
        [[0.0, 1e-300, 1e-20, 1e-8], np.linspace(0.01, 0.24, 9), [0.25 - 1e-12, 0.25, 0.25 + 1e-12]]
    )
    squared = np.concatenate([squared, np.linspace(0.3, 9.0, 30)])  # up to nearly half a turn
    expected = np.array([rational(series, x, slope) for x in squared])
    assert expected[0] == pytest.approx(at_zero, rel=1e-15)
    found = function(jnp.asarray(squared))
    np.testing.assert_allclose(found, expected, rtol=1e-11)
    small = squared < 0.25
    np.testing.assert_allclose(found[small], expected[small], rtol=1e-14)


@pytest.mark.parametrize("kind", ["inverse", "midframe"])
def test_slopes_are_derivatives_also_beyond_half_a_turn(kind):
    function, slope = CASES[kind][0], CASES[kind + " slope"][0]
    squared = jnp.asarray([0.0, 0.1, 0.2499, 0.2501, 1.0, np.pi**2, 16.0, 36.0])
    by_squared = jax.vmap(jax.grad(function))(squared)
    np.testing.assert_allclose(slope(squared), 2 * by_squared, rtol=1e-10)


# Tangent maps


INCREMENT = jnp.asarray([0.3, -0.2, 0.5])


@jax.jit
def tangent_maps(vector):
    start = rotations.conjugate(rotations.exponential(vector))

    def turned(v):
        return rotations.logarithm(rotations.multiply(start, rotations.exponential(v)))

    return (
        jax.jacfwd(turned)(vector),
        rotations.tangent(vector),
        rotations.tangent_inverse(vector),
        rotations.tangent_inverse_apply(vector, INCREMENT),
    )


@few
@given(direction, st.one_of(st.floats(0.0, 6.0), st.sampled_from([0.4999999, 0.5000001, np.pi])))
def test_tangent_against_automatic_differentiation(axis, size):
    expected, tangent, inverse, applied = tangent_maps(vector_of(axis, size))
    np.testing.assert_allclose(tangent, expected, atol=1e-12)
    scale = np.max(np.abs(inverse))  # it grows without bound towards a whole turn
    np.testing.assert_allclose(inverse @ expected, np.eye(3), atol=1e-12 * scale)
    np.testing.assert_allclose(applied, inverse @ INCREMENT, atol=1e-13 * scale)


def test_tangent_inverse_is_the_derivative_of_the_logarithm():
    vector, spin = random_arrays(3, (3,), (3,))
    q = rotations.exponential(vector)

    def function(t):
        return rotations.logarithm(rotations.multiply(q, rotations.exponential(t * spin)))

    expected = jax.jacfwd(function)(0.0)
    found = rotations.tangent_inverse_apply(vector, spin)
    np.testing.assert_allclose(found, expected, atol=1e-14)


# Derivatives at special places


def test_derivatives_at_the_identity():
    zero = jnp.zeros(3)
    np.testing.assert_allclose(
        jax.jacfwd(rotations.exponential)(zero), np.vstack([np.zeros(3), 0.5 * np.eye(3)])
    )
    hessian = jax.jit(jax.jacfwd(jax.jacrev(rotations.exponential)))(zero)
    np.testing.assert_allclose(hessian[0], -0.25 * np.eye(3), atol=1e-15)
    np.testing.assert_allclose(hessian[1:], 0.0, atol=1e-15)
    identity = jnp.asarray([1.0, 0.0, 0.0, 0.0])
    expected = np.hstack([np.zeros((3, 1)), 2 * np.eye(3)])
    np.testing.assert_allclose(jax.jacrev(rotations.logarithm)(identity), expected)
    np.testing.assert_allclose(jax.jacfwd(rotations.logarithm)(identity), expected)
    derivative = jax.jacfwd(rotations.tangent)(zero)
    expected = jax.jacfwd(lambda v: -0.5 * rotations.hat(v))(zero)
    np.testing.assert_allclose(derivative, expected, atol=1e-15)


def everything(v):
    moment = jnp.asarray([0.7, 0.1, -0.4])
    maps = rotations.tangent(v) + rotations.tangent_inverse(v)
    squared = jnp.sum(v * v)
    slopes = rotations.inverse_tangent_slope(squared) + rotations.midframe_slope(squared)
    there_and_back = rotations.logarithm(rotations.exponential(v))
    return moment @ (maps @ INCREMENT) + moment @ there_and_back**2 + slopes


@jax.jit
def all_derivatives(v):
    gradient = jax.grad(everything)
    forward, reverse = jax.jacfwd(everything)(v), gradient(v)
    return forward, reverse, jax.jacfwd(gradient)(v), jax.jacrev(jax.jacfwd(everything))(v)


@pytest.mark.parametrize("size", [0.0, 1e-200, 1e-9, 0.1265, 0.5, 3.0, np.pi, 3.2, 5.0, 6.0])
def test_derivatives_in_both_modes_to_second_order(size):
    vector = size * jnp.asarray([2.0, -1.0, 2.0]) / 3
    forward, reverse, second, other = all_derivatives(vector)
    assert np.all(np.isfinite(forward)) and np.all(np.isfinite(second))
    np.testing.assert_allclose(reverse, forward, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(other, second, rtol=1e-6, atol=1e-6)
    step, width = jnp.asarray([0.2, 0.9, -0.3]), 1e-5
    change = all_derivatives(vector + width * step)[1] - all_derivatives(vector - width * step)[1]
    np.testing.assert_allclose(second @ step, change / (2 * width), rtol=2e-5, atol=2e-5)


@pytest.mark.parametrize("size", [0.1264, 0.1266, 0.4999, 0.5001, 3.1, np.pi, 3.2, 6.2])
def test_derivative_of_the_logarithm_against_differences(size):
    vector = size * jnp.asarray([2.0, -1.0, 2.0]) / 3
    spin = jnp.asarray([0.3, -0.2, 0.5])

    def function(t):
        turn = rotations.exponential(t * spin)
        return rotations.logarithm(rotations.multiply(rotations.exponential(vector), turn))

    width = 1e-6
    expected = (function(width) - function(-width)) / (2 * width)
    found = jax.jacfwd(function)(0.0)
    assert relative_difference(found, expected) < 1e-6


def test_single_precision_and_batches():
    vectors = random_arrays(4, (2, 5, 3))[0].astype(jnp.float32)
    q = rotations.exponential(vectors)
    assert q.dtype == jnp.float32 and q.shape == (2, 5, 4)
    np.testing.assert_allclose(rotations.logarithm(q), vectors, atol=2e-6)
    assert rotations.tangent_inverse(vectors).dtype == jnp.float32
    inverse = rotations.tangent(vectors) @ rotations.tangent_inverse(vectors)
    np.testing.assert_allclose(inverse, np.broadcast_to(np.eye(3), (2, 5, 3, 3)), atol=5e-6)
