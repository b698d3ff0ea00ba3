"""Systems with a border against dense algebra: the weld that closes a chain to a ring."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import random_arrays, relative_difference

from rodjax.equations.assembly import AS_COLUMNS
from rodjax.equations.border import Border, BorderedSystem, Vector
from rodjax.equations.coupled import CoupledSystem
from rodjax.numerics.block_tridiagonal import BlockTridiagonal

NODES = 7
# where a node's motion stands among its columns, and its balances among its rows
MOTION, BALANCES = np.array([0, 1, 2, 6, 7, 8]), slice(3, None)


def chain(seed, symmetric):
    """A random chain, with eigenvalues of either sign."""
    blocks, signs = random_arrays(seed, (3, NODES, 9, 9), (NODES, 9))
    lower, diagonal, upper = blocks
    diagonal = diagonal + 4.0 * jax.vmap(jnp.diag)(jnp.sign(signs))
    if symmetric:
        diagonal = diagonal + jnp.swapaxes(diagonal, 1, 2)
        lower = jnp.roll(jnp.swapaxes(upper, 1, 2), 1, axis=0)
    # the rows as assembled
    return BlockTridiagonal(*(part[:, np.array(AS_COLUMNS)] for part in (lower, diagonal, upper)))


def weld():
    """The wrench between the last node and the first, which hold each other."""
    eye = jnp.eye(6)
    nothing = jnp.zeros((6, NODES, 9))
    columns = nothing.at[:, -1, BALANCES].set(eye).at[:, 0, BALANCES].set(-eye)
    rows = nothing.at[:, -1, MOTION].set(eye).at[:, 0, MOTION].set(-eye)
    return Border(columns, rows, jnp.zeros((6, 6)))


def flat(vector):
    return np.concatenate([np.ravel(vector.nodes), vector.border])


@jax.jit
def found(system, b):
    """The matrix; solutions: of it, by its factors, transposed twice; what its pivots tell."""
    size = b.nodes.size
    unit = lambda e: Vector(e[:size].reshape(b.nodes.shape), e[size:])
    multiplied = lambda system: jax.vmap(lambda e: system.multiply(unit(e)))
    columns = multiplied(system)(jnp.eye(size + b.border.size))
    factors, turned = system.eliminate(), system.transpose()
    solutions = system.solve(b), factors.solve(b), system.solve_transpose(b), turned.solve(b)
    return columns, solutions, factors.sign(), factors.negative()


@pytest.mark.parametrize("seed", range(4))
def test_a_ring_closed_by_six_multipliers(seed):
    for symmetric in (True, False):
        system = BorderedSystem(CoupledSystem(chain(10 * seed, symmetric)), weld())
        b = Vector(*random_arrays(seed + 5, (NODES, 9), (6,)))
        columns, solutions, sign, negative = found(system, b)
        matrix = np.stack([flat(Vector(*each)) for each in zip(*columns, strict=True)], 1)
        expected = np.linalg.solve(matrix, flat(b))
        for one, other in zip(solutions, (expected, expected), strict=False):
            assert relative_difference(flat(one), other) < 1e-11
        for one in solutions[2:]:
            assert relative_difference(flat(one), np.linalg.solve(matrix.T, flat(b))) < 1e-11
        assert float(sign) == np.linalg.slogdet(matrix)[0]
        if symmetric:
            ordered = np.arange(len(matrix)).reshape(-1)
            ordered[: 9 * NODES] = (9 * np.arange(NODES)[:, None] + np.array(AS_COLUMNS)).ravel()
            even = matrix[ordered]
            np.testing.assert_allclose(even, even.T, atol=1e-13)
            assert int(negative) == np.sum(np.linalg.eigvalsh(even) < 0)


def test_borders_joined_are_solved_together():
    system = CoupledSystem(chain(3, symmetric=False))
    columns, rows, corner, nodes, b = random_arrays(
        1, (5, NODES, 9), (5, NODES, 9), (5, 5), (NODES, 9), (5,)
    )
    corner = corner.at[:2, 2:].set(0.0).at[2:, :2].set(0.0)
    part = lambda a, z: Border(columns[a:z], rows[a:z], corner[a:z, a:z])
    solved = jax.jit(lambda *of: BorderedSystem(system, Border.joined(*of)).solve(Vector(nodes, b)))
    whole = solved(Border(columns, rows, corner))
    np.testing.assert_allclose(flat(solved(part(0, 2), part(2, 5))), flat(whole), rtol=1e-12)
