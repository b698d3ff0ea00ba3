"""Toy models to be fitted, their data, and comparisons of what is found."""

import jax
import jax.numpy as jnp
import numpy as np

from rodjax.fitting.bounds import Positive
from rodjax.fitting.observations import Observations

TIMES = jnp.linspace(0.0, 3.0, 20)
TRUTH = {"a": 2.0, "k": 1.3}
GUESS = {"a": 1.0, "k": 0.3}
BOUNDS = {"a": None, "k": Positive()}


def decay(p):
    return p["a"] * jnp.exp(-p["k"] * TIMES)


def noisy(seed=0, deviation=0.02, truth=TRUTH, stated=None):
    noise = deviation * np.random.default_rng(seed).normal(size=TIMES.size)
    return Observations(TIMES, decay(truth) + noise, stated)


EXACT = noisy(deviation=0.0)


def wave(p):
    return p["size"] * jnp.sin(p["rate"] * TIMES)


WAVE = Observations(TIMES, wave({"size": 1.5, "rate": 7.0}), 0.1)
RATES = jnp.array([0.5, 2.0, 4.0, 6.5, 9.5])


def valley(p):
    return (1 - p["x"]) ** 2 + 10 * (p["y"] - p["x"] ** 2) ** 2


def relative(found, expected):
    return np.max(np.abs(np.asarray(found) / np.asarray(expected) - 1))


def numbers(tree):
    return np.array([float(leaf) for leaf in jax.tree.leaves(tree)])


def interrupting(after):
    def progress(trial, cost, parameters):
        if trial == after:
            raise KeyboardInterrupt

    return progress
