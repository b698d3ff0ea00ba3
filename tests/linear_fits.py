"""A linear model to be fitted, its data and the solution of its normal equations."""

import jax.numpy as jnp
import numpy as np

COUNT = 12
DESIGN = jnp.asarray(np.random.default_rng(1).normal(size=(COUNT, 2, 3)) * [1.0, 50.0, 0.1])
TRUTH = np.array([1.0, -0.2, 30.0])
GUESS = jnp.array([3.0, 1.0, 1.0])
TIMES = np.arange(float(COUNT))


def line(p):
    return DESIGN @ p


def measured(seed, deviation=0.5):
    noise = np.random.default_rng(seed).normal(size=(COUNT, 2))
    return np.asarray(line(TRUTH)) + deviation * noise


def normal_equations(rows, values, deviation):
    """Solution, covariance and chi squared of a linear problem."""
    rows, values = rows / deviation, values / deviation
    covariance = np.linalg.inv(rows.T @ rows)
    solution = covariance @ rows.T @ values
    return solution, covariance, np.sum((rows @ solution - values) ** 2)


def bare(function):
    """The function as users have it, without the checks of types that the tests add."""
    return getattr(function, "__wrapped__", function)
