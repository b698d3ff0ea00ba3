"""Block elimination against dense linear algebra, and under the transformations of JAX."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import random_arrays, relative_difference
from hypothesis import given, settings
from hypothesis import strategies as st

from rodjax.numerics.block_tridiagonal import BlockTridiagonal

ROWS, BLOCK = 6, 4


def random_matrix(seed, rows=ROWS, block=BLOCK):
    lower, diagonal, upper = random_arrays(seed, *[(rows, block, block)] * 3)
    # away from singular leading blocks, but far from diagonally dominant
    return BlockTridiagonal(lower, diagonal + 4 * jnp.eye(block)[None], upper)


def dense(matrix):
    rows, block = matrix.diagonal.shape[:2]
    full = np.zeros((rows, block, rows, block))
    for i in range(rows):
        full[i, :, i] = matrix.diagonal[i]
        if i:
            full[i, :, i - 1] = matrix.lower[i]
            full[i - 1, :, i] = matrix.upper[i - 1]
    return full.reshape(rows * block, rows * block)


solve = jax.jit(lambda matrix, b: matrix.solve(b))
solve_many = jax.jit(lambda matrix, b: matrix.factorize().solve(b))
multiply = jax.jit(lambda matrix, x: matrix.multiply(x))


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**31))
def test_solve_factorize_multiply_and_transpose_against_dense(seed):
    matrix = random_matrix(seed)
    one, many = random_arrays(seed + 1, (ROWS, BLOCK), (ROWS, BLOCK, 3))
    full = dense(matrix)
    allowed = 1e-13 * np.linalg.cond(full) * 10
    expected = np.linalg.solve(full, np.ravel(one)).reshape(ROWS, BLOCK)
    assert relative_difference(solve(matrix, one), expected) < allowed
    flat = np.reshape(many, (-1, 3))
    expected = np.linalg.solve(full, flat).reshape(ROWS, BLOCK, 3)
    assert relative_difference(solve_many(matrix, many), expected) < allowed
    product = (full @ flat).reshape(ROWS, BLOCK, 3)
    assert relative_difference(multiply(matrix, many), product) < 1e-13
    np.testing.assert_array_equal(dense(matrix.transpose()), full.T)


def test_unused_corners_have_no_influence():
    matrix = random_matrix(1)
    other = BlockTridiagonal(
        matrix.lower.at[0].set(1e3), matrix.diagonal, matrix.upper.at[-1].set(-1e3)
    )
    one, many = random_arrays(2, (ROWS, BLOCK), (ROWS, BLOCK, 3))
    for what, x in ((solve, one), (multiply, many), (solve_many, many)):
        np.testing.assert_array_equal(what(other, x), what(matrix, x))
    transposed = solve(other.transpose(), one)
    np.testing.assert_array_equal(transposed, solve(matrix.transpose(), one))


def test_pivots_within_a_block():
    # zero diagonal entries, as the constraint rows of the rod have them
    swap = jnp.asarray([[0.0, 1.0], [1.0, 0.0]])
    zero = jnp.zeros((3, 2, 2))
    matrix = BlockTridiagonal(zero, jnp.tile(swap[None], (3, 1, 1)), zero)
    b = jnp.asarray([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]])
    np.testing.assert_array_equal(solve(matrix, b), b[:, ::-1])
    np.testing.assert_array_equal(solve_many(matrix, b[:, :, None])[:, :, 0], b[:, ::-1])


@pytest.mark.parametrize("rows", [1, 2, 40])
def test_any_number_of_rows(rows):
    matrix = random_matrix(3, rows, 9)
    b = random_arrays(4, (rows, 9))[0]
    residual = multiply(matrix, solve(matrix, b)[:, :, None])[:, :, 0] - b
    assert np.max(np.abs(residual)) < 1e-10


def test_vmap_over_matrices_and_right_hand_sides():
    matrices = [random_matrix(seed) for seed in range(3)]
    together = jax.tree.map(lambda *leaves: jnp.stack(leaves), *matrices)
    b = random_arrays(7, (3, ROWS, BLOCK))[0]
    expected = np.stack([solve(matrix, row) for matrix, row in zip(matrices, b, strict=True)])
    found = jax.jit(jax.vmap(lambda matrix, row: matrix.solve(row)))(together, b)
    np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-12)
    factored = jax.jit(jax.vmap(lambda matrix, row: matrix.factorize().solve(row)))(
        together, b[..., None]
    )
    np.testing.assert_allclose(factored[..., 0], expected, rtol=1e-9, atol=1e-11)


@pytest.mark.parametrize("how", ["solve", "factorize"])
def test_derivatives_in_both_modes(how):
    matrix, change = random_matrix(11), random_matrix(12)
    b, db, weight = random_arrays(13, *[(ROWS, BLOCK)] * 3)

    def solution(matrix, b):
        if how == "solve":
            return matrix.solve(b)
        return matrix.factorize().solve(b[:, :, None])[:, :, 0]

    x, dx = jax.jit(lambda *a: jax.jvp(solution, a, (change, db)))(matrix, b)
    # A dx = db - dA x
    right = db - change.multiply(x[:, :, None])[:, :, 0]
    expected = np.linalg.solve(dense(matrix), np.ravel(right)).reshape(ROWS, BLOCK)
    np.testing.assert_allclose(dx, expected, rtol=1e-9, atol=1e-10)

    value = lambda matrix, b: jnp.vdot(weight, solution(matrix, b))
    by_matrix, by_b = jax.jit(jax.grad(value, (0, 1)))(matrix, b)
    adjoint = np.linalg.solve(dense(matrix).T, np.ravel(weight)).reshape(ROWS, BLOCK)
    np.testing.assert_allclose(by_b, adjoint, rtol=1e-9, atol=1e-10)
    pairing = sum(
        jnp.vdot(g, d)
        for g, d in zip(jax.tree.leaves(by_matrix), jax.tree.leaves(change), strict=True)
    )
    np.testing.assert_allclose(pairing + jnp.vdot(by_b, db), jnp.vdot(weight, dx), rtol=1e-9)
    np.testing.assert_array_equal(by_matrix.lower[0], 0.0)
    np.testing.assert_array_equal(by_matrix.upper[-1], 0.0)
