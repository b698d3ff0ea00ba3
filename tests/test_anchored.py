"""The solver of systems without inertia against dense linear algebra, for every pair of ends."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import UNIT_SECTION, random_arrays, random_configuration, relative_difference

from rodjax.constraints.ends import Clamped, Free, Pinned, Slider
from rodjax.equations.anchored import Anchor, AnchoredSystem
from rodjax.equations.assembly import Scales, assemble
from rodjax.equations.coupled import CoupledSystem
from rodjax.rods.balance import element_tangent
from rodjax.rods.builders import straight_rod
from rodjax.rods.node_blocks import NodeBlocks
from rodjax.rods.state import at_rest

ELEMENTS = 10
ENDS = {
    "free-clamped": (Free(), Clamped()),
    "clamped-free": (Clamped(), Free()),
    "slider-clamped": (Slider((0, 0, 1)), Clamped()),
    "slider-pinned": (Slider((0, 0, 1)), Pinned()),
    "pinned-slider": (Pinned(), Slider((0, 0, 1))),
    "sliders": (Slider((0, 0, 1)), Slider((1, 0, 1))),
}


@jax.jit
def solutions(first, last, bent, b):
    """The matrix, the anchored system's, and solutions by that and its transpose."""
    rod = straight_rod(1.0, ELEMENTS, UNIT_SECTION)
    position, quaternion, force = random_configuration(rod, 3)
    straight = rod.position, rod.quaternion, jnp.zeros_like(force)
    choose = lambda a, b: jnp.where(bent, a, b)
    state = jax.tree.map(choose, (position, quaternion, force), straight)
    scales = Scales(jnp.asarray(0.1), jnp.asarray(100.0))
    tangent = element_tangent(rod, at_rest(jnp.zeros(()), *state[:2]), state[2])
    node = NodeBlocks(jnp.zeros((ELEMENTS + 1, 6, 6)))
    built = lambda *held: CoupledSystem(assemble(rod, tangent, node, *held, scales))
    held = jnp.stack([first, last]), (0, ELEMENTS)
    system = AnchoredSystem(built(held[0][:0], ()), *held, (Anchor(0, clamped=False),))
    columns = jnp.eye(b.size).reshape(b.size, *b.shape)
    matrix = lambda system: jax.vmap(system.multiply)(columns).reshape(b.size, b.size).T
    solved = system.solve(b).ravel(), system.solve_transpose(b).ravel()
    return matrix(built(*held)), matrix(system), *solved


@pytest.mark.parametrize("bent", [False, True])
@pytest.mark.parametrize("ends", ENDS.values(), ids=ENDS)
def test_solutions_are_those_of_dense_algebra(ends, bent):
    (b,) = random_arrays(1, (ELEMENTS + 1, 9))
    both = [end.projector(jnp.zeros(())) for end in ends]
    matrix, same, solved, transposed = solutions(*both, jnp.asarray(bent), b)
    np.testing.assert_allclose(same, matrix, atol=1e-12 * np.max(np.abs(matrix)))
    assert relative_difference(solved, np.linalg.solve(matrix, b.ravel())) < 1e-10
    assert relative_difference(transposed, np.linalg.solve(matrix.T, b.ravel())) < 1e-10
