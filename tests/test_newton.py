"""Newton's iteration itself, on two equations: where it ends, and what it leaves."""

import functools
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rodjax.numerics import newton
from rodjax.numerics.results import Result


class Matrix(NamedTuple):
    """A small linear system."""

    matrix: list[list[jax.Array]]

    def eliminate(self):
        return self

    def solve(self, b):
        (p, q), (r, s) = self.matrix
        return jnp.stack([s * b[0] - q * b[1], p * b[1] - r * b[0]]) / (p * s - q * r)


class Pendulum(eqx.Module):
    """Height and angle of a pendulum at rest between gravity, a spring and a torque.

    The height is constrained by the angle. From far below, which the equations are linear in,
    increments shrink so fast that the tolerance is met before the constraint is.
    """

    torque: jax.Array
    noise: jax.Array  # below which no rotation comes

    def residual(self, x):
        height, angle = x[0], x[1]
        balance = angle + 1 - jnp.cos(angle) - self.torque
        return jnp.stack([height - jnp.cos(angle), balance])

    def linearize(self, x):
        angle = x[1]
        slopes = [[1.0, jnp.sin(angle)], [0.0, 1 + jnp.sin(angle)]]
        return Matrix([[jnp.asarray(slope, x.dtype) for slope in row] for row in slopes])

    def linearize_with_residual(self, x):
        return self.linearize(x), self.residual(x)

    def newton_increment(self, x):
        return self.linearize(x).solve(-self.residual(x))

    def retract(self, x, dx):
        return x + dx

    def limit(self, x, dx):
        return jnp.ones((), x.dtype)

    def size(self, dx):
        return jnp.max(jnp.abs(dx)) + 1e-9 * self.noise

    def rotation(self, dx):
        return jnp.abs(dx[1]) + self.noise


@functools.cache
def compiled(method):
    return jax.jit(method)


def solved(method, torque, noise=0.0, *, dtype=jnp.float64, tolerance=1e-10, most=20):
    """How the iteration went from far below, and the errors of the constraint and the balance."""
    equations = Pendulum(*(jnp.asarray(value, dtype) for value in (torque, noise)))
    below, tolerance = jnp.zeros(2, dtype), jnp.asarray(tolerance, dtype)
    x, info = compiled(method)(equations, below, tolerance, jnp.asarray(most, jnp.int32))
    return info, *np.abs(equations.residual(x))


ways = pytest.mark.parametrize("method", [newton.iterate, newton.iterate_held])


@ways
@pytest.mark.parametrize("torque", [2e-3, 4e-3])
def test_a_constraint_is_kept_better_than_the_tolerance(method, torque):
    info, constraint, balance = solved(method, torque)
    assert int(info.result) == Result.SUCCESS
    assert constraint < 1e-12 and balance < 1e-10
    assert int(info.iterations) <= 4


@ways
def test_what_rounding_leaves_of_a_constraint_is_not_iterated_for_ever(method):
    """As where rotations stop to shrink, too large for what is to be left of the constraint."""
    (least, *_), (info, constraint, _) = (solved(method, 2e-3, noise) for noise in (0.0, 1e-3))
    assert int(info.result) == Result.SUCCESS and constraint < 1e-12
    assert int(info.iterations) <= int(least.iterations) + newton._FINER
    # nor is what the tolerance allows refused where no increment is left for the constraint
    most = int(info.iterations) - 1
    short, *_ = solved(method, 2e-3, 1e-3, most=most)
    assert int(short.result) == Result.SUCCESS and int(short.iterations) == most


@ways
def test_in_single_precision_a_constraint_is_kept_to_a_few_units_of_rounding(method):
    info, constraint, _ = solved(method, 2e-3, dtype=jnp.float32, tolerance=2e-5)
    assert int(info.result) == Result.SUCCESS and int(info.iterations) <= 4
    assert constraint < 4 * np.finfo(np.float32).eps
