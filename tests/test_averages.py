"""Averages of a stream against the same numbers taken at once."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

import rodjax as rx


@jax.jit
def _of(values):
    add = lambda found, value: (found.added(value), None)
    return lax.scan(add, rx.Averages.of(jax.tree.map(lambda leaf: leaf[0], values)), values)[0]


def _remembering(count, memory, lanes, seed=0):
    """Autoregressive streams x' = memory x + noise of variance 1."""
    noise = jax.random.normal(jax.random.key(seed), (count, lanes))
    one = lambda x, w: (memory * x + np.sqrt(1 - memory**2) * w,) * 2
    return lax.scan(one, noise[0], noise)[1]


def test_mean_and_variance_are_those_of_all():
    values = 3.0 + _remembering(1000, 0.5, 2)
    found = _of(values)
    np.testing.assert_allclose(found.mean, np.mean(values, 0), rtol=1e-12)
    np.testing.assert_allclose(found.variance, np.var(values, 0, ddof=1), rtol=1e-10)
    assert int(found.count) == 1000


@pytest.mark.parametrize("memory", [0.0, 0.9])
def test_error_and_memory(memory):
    """tau = (1 + r)/(2 (1 - r)) of streams that remember r; the error is their scatter."""
    found = _of(_remembering(2**13, memory, 200))
    tau = 0.5 * (1 + memory) / (1 - memory)
    np.testing.assert_allclose(np.mean(found.correlation_time), tau, rtol=0.05)
    scatter = np.std(np.asarray(found.mean), ddof=1)
    np.testing.assert_allclose(np.mean(found.error), scatter, rtol=0.12)


def test_pytrees_and_replicas():
    values = {"a": _remembering(64, 0.0, 3), "b": _remembering(64, 0.0, 6).reshape(64, 2, 3)}
    found = _of(values)
    np.testing.assert_allclose(found.mean["b"], np.mean(values["b"], 0), atol=1e-14)
    many = jax.vmap(_of)(jnp.moveaxis(_remembering(64, 0.0, 5), 1, 0))
    mean, error = many.pooled()
    np.testing.assert_allclose(mean, np.mean(many.mean), rtol=1e-12)
    for name in ("mean", "variance", "error", "correlation_time"):
        each = jax.vmap(lambda one, name=name: getattr(one, name))(many)
        np.testing.assert_allclose(getattr(many, name), each, rtol=1e-12)
    np.testing.assert_allclose(error, np.std(np.asarray(many.mean), ddof=1) / np.sqrt(5))
