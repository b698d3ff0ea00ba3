"""Frontal elimination against dense algebra."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rodjax.numerics.block_tridiagonal import BlockTridiagonal
from rodjax.numerics.front_order import FrontSize, arrange
from rodjax.numerics.frontal import Distant, Stencils, factorize

NODES = 30
ROWS = 180  # of distant blocks, more than any of the patterns has: one program serves them all
SIZE = FrontSize(16, 6)


def folded(nodes, reach):
    """Pairs of nodes of a chain folded in the middle whose halves touch, each pair twice."""
    pairs = [
        (a, nodes - 1 - a + shift) for a in range(nodes // 2 - 4) for shift in range(-reach, reach)
    ]
    inside = [(a, b) for a, b in pairs if 0 <= b < nodes]
    return np.array([*inside, *((b, a) for a, b in inside)])


def crossing(nodes, reach):
    """Two far stretches that touch, and a last node that touches the first ones."""
    pairs = [(5 + a, nodes - 8 + b) for a in range(reach) for b in range(reach)]
    pairs += [(2, nodes - 1), (3, nodes - 1)]
    return np.array([*pairs, *((b, a) for a, b in pairs)])


def system(pairs, dtype=float):
    """Blocks and distant blocks, unused ones among these, and the dense matrix of both."""
    rng = np.random.default_rng(0)
    blocks = rng.normal(size=(3, NODES, 9, 9))
    blocks[1] += 12 * np.eye(9)
    own = np.stack([np.arange(NODES)] * 2, 1)
    unused = np.full((ROWS - len(pairs) - NODES, 2), NODES)
    assert len(unused) > 3
    row, column = np.concatenate([pairs, own, unused]).T
    distant = rng.normal(size=(len(row), 3, 3))
    dense = np.zeros((NODES, 9, NODES, 9))
    for i in range(NODES):
        dense[i, :, i] += blocks[1, i]
        if i > 0:
            dense[i, :, i - 1] += blocks[0, i]
            dense[i - 1, :, i] += blocks[2, i - 1]
    factor = rng.normal(size=(NODES, 3, 3))
    for i, j, block in zip(row, column, distant, strict=True):
        if i < NODES:
            dense[i, :3, j, :3] += factor[i] @ block
    matrix = BlockTridiagonal(*jnp.asarray(blocks, dtype))
    integer = lambda index: jnp.asarray(index, jnp.int32)
    # every point with two thirds on its node, a third there again, and a node that is not used
    node = np.stack([np.minimum(np.arange(NODES + 1), NODES - 1)] * 3, 1)
    weight = jnp.asarray(np.tile([2 / 3, 1 / 3, 1.0], (NODES + 1, 1)), dtype)
    value, factor = jnp.asarray(distant, dtype), jnp.asarray(factor, dtype)
    stencils = Stencils(integer(node), weight, integer(2))
    count = integer(np.sum(row < NODES))
    given = Distant(integer(row), integer(column), value, count, stencils, factor)
    return matrix, given, dense.reshape(9 * NODES, -1)


def touching(pairs):
    out = np.zeros((NODES, NODES), bool)
    out[pairs[:, 0], pairs[:, 1]] = True
    return jnp.asarray(out)


@jax.jit
def solutions(matrix, distant, order, b):
    factors = factorize(matrix, distant, order, SIZE)
    return jax.vmap(factors.solve)(b), jax.vmap(factors.solve_transpose)(b)


@pytest.mark.parametrize("pairs", [folded(NODES, 3), crossing(NODES, 3), folded(NODES, 1)])
@pytest.mark.parametrize("dtype, tolerance", [(float, 1e-13), (jnp.float32, 1e-4)])
def test_solves_as_dense_algebra_does(pairs, dtype, tolerance):
    matrix, distant, dense = system(pairs, dtype)
    order = arrange(touching(pairs), 8)
    assert bool(order.fits(SIZE))
    b = np.random.default_rng(1).normal(size=(2, NODES, 9))
    solved, transposed = solutions(matrix, distant, order, jnp.asarray(b, dtype))
    for found, expected in ((solved, dense), (transposed, dense.T)):
        assert found.dtype == dtype
        exact = np.linalg.solve(expected, b.reshape(2, -1).T).T.reshape(b.shape)
        np.testing.assert_allclose(found, exact, atol=tolerance)


@pytest.mark.parametrize("pairs", [folded(NODES, 3), crossing(NODES, 3)])
def test_an_order_takes_every_node_once_and_the_last_node_last(pairs):
    order = arrange(touching(pairs), 8)
    np.testing.assert_array_equal(np.sort(order.node), np.arange(NODES))
    np.testing.assert_array_equal(order.place[order.node], np.arange(NODES))
    assert order.place[-1] == NODES - 1
    others = pairs[np.all(pairs < NODES - 1, axis=1)]
    apart = np.abs(np.diff(np.asarray(order.place)[others]))
    assert np.max(apart) < int(order.window)


def test_a_chain_alone_needs_two_places_and_two_seats():
    order = arrange(jnp.zeros((NODES, NODES), bool), 8)
    np.testing.assert_array_equal(order.node, np.arange(NODES))
    assert (int(order.window), int(order.seats)) == (2, 2)


def test_what_does_not_fit_says_so():
    everywhere = arrange(jnp.ones((NODES, NODES), bool), 8)
    assert int(everywhere.window) == NODES - 1 and not bool(everywhere.fits(SIZE))
    # every third node touches the first: each then is the neighbour of two that wait
    comb = np.zeros((NODES, NODES), bool)
    comb[0, 2::3] = True
    scattered = arrange(jnp.asarray(comb), 4)
    assert int(scattered.seats) == 5 and not bool(scattered.fits(FrontSize(NODES, 4)))


def test_a_singular_matrix_gives_no_number():
    pairs = folded(NODES, 2)
    matrix, distant, _ = system(pairs)
    matrix = jax.tree.map(lambda blocks: blocks.at[:, :, 4].set(0.0), matrix)
    found = solutions(matrix, distant, arrange(touching(pairs), 8), jnp.ones((1, NODES, 9)))
    assert not np.any(np.isfinite(found[0][:, 0]))
