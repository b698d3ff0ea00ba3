"""Small systems solved without exchange of rows where that is safe, and with it where not."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rodjax.numerics import small_systems
from rodjax.numerics.small_systems import divide

divided = jax.jit(divide)


def system(seed=0, near=0.3):
    """Blocks near rotations, as of a node, and columns."""
    rng = np.random.default_rng(seed)
    matrix = near * rng.normal(size=(9, 9)) / 3
    for k in range(3):
        at = slice(3 * k, 3 * k + 3)
        matrix[at, at] += np.linalg.qr(rng.normal(size=(3, 3)))[0]
    return matrix, rng.normal(size=(9, 10))


def exchanged(monkeypatch, matrix, columns):
    """Whether rows were exchanged."""
    seen = []
    monkeypatch.setattr(
        small_systems, "only_where", lambda needed, *rest: seen.append(bool(needed)) or rest[2][2]
    )
    divide(matrix, columns)
    return seen[0]


def test_blocks_near_rotations_need_no_exchange(monkeypatch):
    matrix, columns = system()
    np.testing.assert_allclose(divided(matrix, columns), np.linalg.solve(matrix, columns), 1e-12)
    assert not exchanged(monkeypatch, jnp.asarray(matrix), jnp.asarray(columns))


def singular(matrix):
    """Its first three rows begin with zeros, as those of a held node may."""
    matrix[:3, :3] = 0
    return matrix


def tiny(matrix):
    """Its first pivot is far smaller than what stands below it."""
    matrix[:3, :3] *= 1e-9
    return matrix


def flat(matrix):
    """A pivot whose three rows lie nearly in a plane, with nothing below it."""
    matrix[:3, :3] = [[1, 1, 0], [1, 1 + 1e-9, 0], [0, 0, 1]]
    matrix[3:, :3] = 0
    return matrix


def late(matrix):
    """Its second pivot vanishes as the first rows are eliminated."""
    matrix[3:6, 3:6] = matrix[3:6, :3] @ np.linalg.solve(matrix[:3, :3], matrix[:3, 3:6])
    return matrix


@pytest.mark.parametrize("spoiled", [singular, tiny, flat, late])
def test_rows_are_exchanged_where_a_pivot_is_bad(spoiled, monkeypatch):
    matrix, columns = system()
    matrix = spoiled(matrix)
    want = np.linalg.solve(matrix, columns)
    found = divided(matrix, columns)
    np.testing.assert_allclose(matrix @ found, columns, atol=1e-13 * (1 + np.abs(want).max()))
    assert exchanged(monkeypatch, jnp.asarray(matrix), jnp.asarray(columns))


@given(
    st.integers(0, 1000),
    st.lists(st.sampled_from([0.0, 1e-12, 1e-3, 1.0, 1e3]), min_size=9, max_size=9),
)
def test_the_residual_is_small_whatever_the_sizes_of_the_rows(seed, sizes):
    matrix, columns = system(seed, 1.0)
    matrix = matrix * np.array([size or 1.0 for size in sizes])[:, None]
    found = np.asarray(divided(matrix, columns))
    left = np.abs(matrix @ found - columns)
    # of what cancels in it; three digits are lost to multipliers at most
    assert np.all(left <= 1e-12 * (np.abs(matrix) @ np.abs(found) + np.abs(columns)))


def test_lanes_that_need_it_are_exchanged_and_others_not_disturbed():
    matrix, columns = system()
    both = np.stack([matrix, singular(matrix.copy())])
    found = jax.jit(jax.vmap(divide, (0, None)))(both, columns)
    np.testing.assert_allclose(found, np.linalg.solve(both, columns), 1e-11)


def test_derivatives_in_both_modes():
    matrix, columns = system()
    direction = np.random.default_rng(1).normal(size=(9, 9))
    loss = lambda matrix: jnp.sum(divide(matrix, jnp.asarray(columns)) ** 2)
    steps = [loss(jnp.asarray(matrix + h * direction)) for h in (1e-6, -1e-6)]
    difference = (steps[0] - steps[1]) / 2e-6
    forward = jax.jvp(loss, (jnp.asarray(matrix),), (jnp.asarray(direction),))[1]
    reverse = jnp.sum(jax.grad(loss)(jnp.asarray(matrix)) * direction)
    np.testing.assert_allclose([forward, reverse], difference, 1e-7)


def test_single_precision():
    matrix, columns = system()
    found = divided(jnp.asarray(matrix, jnp.float32), jnp.asarray(columns, jnp.float32))
    assert found.dtype == jnp.float32
    np.testing.assert_allclose(found, np.linalg.solve(matrix, columns), atol=1e-4)


@pytest.mark.parametrize("dtype, size", [(jnp.float32, 3e-15), (float, 1e-107)])
def test_determinants_that_underflow_are_not_divided_by(dtype, size):
    matrix, columns = system()
    matrix[:3] *= size
    columns[:3] *= size
    found = divided(jnp.asarray(matrix, dtype), jnp.asarray(columns, dtype))
    np.testing.assert_allclose(found, np.linalg.solve(matrix, columns), atol=1e-4)


def test_what_is_singular_is_no_number():
    matrix, columns = system()
    matrix[:, 4] = 0
    assert not np.all(np.isfinite(divided(matrix, columns)))


def test_of_any_size():
    matrix, columns = system()
    np.testing.assert_allclose(
        divided(matrix[:5, :5], columns[:5]), np.linalg.solve(matrix[:5, :5], columns[:5]), 1e-11
    )
