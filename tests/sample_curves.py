"""Curves, and the compiled writhe of them, shared by the tests of topology."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import settings
from hypothesis import strategies as st

from rodjax import topology

seeds = st.integers(0, 2**32 - 1)
quick = settings(max_examples=15, deadline=None)
compiled_writhe = jax.jit(topology.writhe, static_argnames="closed")
value_and_gradient = jax.jit(jax.value_and_grad(topology.writhe), static_argnames="closed")


def approx(expected, **tolerance):
    return pytest.approx(float(expected), **tolerance)


def random_polygon(seed, vertices=10):
    return np.random.default_rng(seed).normal(size=(vertices, 3))


def helix(turns, per_turn=40, radius=1.0, pitch=3.0, hand=1.0):
    angle = 2 * np.pi * np.arange(turns * per_turn + 1) / per_turn
    columns = [radius * np.cos(angle), hand * radius * np.sin(angle), pitch * angle / (2 * np.pi)]
    return jnp.array(np.stack(columns, axis=1))


def clamped_curve(seed, nodes=81, size=0.3):
    """A random curve, straight along e3 near its ends; e3 . r increases, so it is unknotted."""
    generator = np.random.default_rng(seed)
    s = np.linspace(0, 1, nodes)
    window = np.where((s > 0.05) & (s < 0.95), np.sin(np.pi * (s - 0.05) / 0.9) ** 2, 0.0)
    sideways = sum(
        generator.normal(size=2) * np.cos(2 * np.pi * k * s[:, None] + generator.uniform(0, 6, 2))
        for k in range(1, 6)
    )
    return jnp.array(np.concatenate([size * window[:, None] * sideways, s[:, None]], axis=1))
