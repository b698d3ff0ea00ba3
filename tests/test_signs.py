"""Counts of negative eigenvalues and signs of determinants, one matrix at a time."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import primitives

from rodjax.numerics.signs import determinant_signs, negative_eigenvalues

RNG = np.random.default_rng(3)
ROTATIONS = np.linalg.qr(RNG.normal(size=(4, 6, 6)))[0]
SIGNS = np.array([[1, 1, 1, 1, 1, 1], [-1, 1, 1, 1, 1, 1], [-1, -1, -1, 1, 1, 1], [-1] * 6])
MATRICES = np.einsum("mij,mj,mkj->mik", ROTATIONS, SIGNS * RNG.uniform(0.5, 2, (4, 6)), ROTATIONS)
# rows and columns in units far apart
SCALED = MATRICES * np.logspace(-6, 6, 6)[:, None] * np.logspace(-6, 6, 6)


@pytest.mark.parametrize("matrices", [MATRICES, SCALED], ids=["of one unit", "of many"])
def test_signs_are_those_they_were_made_of(matrices):
    found = negative_eigenvalues(jnp.asarray(matrices))
    np.testing.assert_array_equal(found, [0, 1, 3, 6])
    np.testing.assert_array_equal(determinant_signs(jnp.asarray(matrices)), [1, -1, -1, 1])


@pytest.mark.parametrize("function", [negative_eigenvalues, determinant_signs])
def test_no_kernel_takes_a_batch_whatever_is_mapped(function):
    """Two that do, at once, wait for ever on two cores."""
    lanes = jnp.asarray(np.stack([MATRICES, MATRICES[::-1]]))
    found = jax.vmap(function)(lanes)
    np.testing.assert_array_equal(found[1], found[0][::-1])
    kernels = [
        equation
        for equation in primitives(jax.make_jaxpr(jax.vmap(function))(lanes).jaxpr)
        if equation.primitive.name in ("eigh", "lu")
    ]
    assert kernels and all(kernel.invars[0].aval.ndim == 2 for kernel in kernels)
