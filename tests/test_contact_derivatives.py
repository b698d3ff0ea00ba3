"""Derivatives of a rollout through contact: nested, mapped, and against differences."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import hairpin

from rodjax.constraints.ends import Clamped
from rodjax.dynamics.consistency import start
from rodjax.dynamics.fixed_rollout import rollout
from rodjax.interactions.contact import Contact
from rodjax.interactions.contact_laws import DampedInversePower
from rodjax.scenes.scene import Scene

pytestmark = pytest.mark.slow

STOPS = 1e-3 * jnp.arange(1, 5)
LAW = DampedInversePower(k1=1e-4, k3=1e-1, reference_spacing=1e-3)
POINT = jnp.ones(3)  # factors on strength, bending stiffness and the cut-off
DIRECTION = jnp.asarray([1.0, -0.7, 0.4])


@pytest.fixture(scope="module")
def loss():
    """How fast and how far the strands of a hairpin are pushed apart in four steps."""
    contact = Contact(LAW, segments=20, cutoff=0.1, points_per_segment=2, exclusion=0.2)
    base = Scene(hairpin(), Clamped(), Clamped(), contact=contact)
    state = start(base)
    velocity = 0.1 * np.random.default_rng(0).normal(size=state.position.shape)
    state = dataclasses.replace(state, rate=state.rate.at[:, :3].set(velocity))

    def value(factors):
        scene = eqx.tree_at(
            lambda s: (s.contact.law.k1, s.rod.stiffness, s.contact.cutoff),
            base,
            (factors[0] * LAW.k1, factors[1] * base.rod.stiffness, factors[2] * contact.cutoff),
        )
        run = rollout(scene, state, STOPS, save_every=2, throw=False)
        moved = run.states.position[-1] - run.states.position[0]
        return 1e3 * jnp.sum(moved[:8, 0]) + jnp.sum(run.final.velocity[:8, 0] ** 2)

    return value


@pytest.fixture(scope="module")
def gradient(loss):
    return jax.jit(jax.grad(loss))


def test_gradient_against_differences(loss, gradient):
    value = jax.jit(loss)
    at = lambda x: value(POINT + x * DIRECTION)
    h = 1e-4
    difference = (8 * (at(h) - at(-h)) - (at(2 * h) - at(-2 * h))) / (12 * h)
    found = gradient(POINT)
    assert np.all(np.abs(found) > 1e-6)  # contact takes part
    np.testing.assert_allclose(found @ DIRECTION, difference, rtol=1e-7)


def test_hessian_vector_product(gradient, loss):
    product = jax.jit(lambda x: jax.jvp(jax.grad(loss), (x,), (DIRECTION,))[1])(POINT)
    h = 1e-4
    at = lambda x: gradient(POINT + x * DIRECTION)
    difference = (8 * (at(h) - at(-h)) - (at(2 * h) - at(-2 * h))) / (12 * h)
    np.testing.assert_allclose(product, difference, rtol=1e-6, atol=1e-7)


def test_gradient_and_vmap_in_both_orders(loss, gradient):
    points = jnp.stack([POINT, 0.9 * POINT, POINT + 0.05 * DIRECTION])
    expected = [gradient(point) for point in points]
    mapped = jax.jit(jax.vmap(jax.grad(loss)))(points)
    total = jax.jit(jax.grad(lambda many: jnp.sum(jax.vmap(loss)(many))))(points)
    np.testing.assert_allclose(mapped, expected, rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(total, expected, rtol=1e-8, atol=1e-10)
