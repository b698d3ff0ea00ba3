"""Laws of contact against their definitions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import DIAMETER, LAWS, PAIR

from rodjax.interactions import contact_laws as laws
from rodjax.interactions.contact_law import continued, ignores_approach


@pytest.mark.parametrize("name", LAWS)
def test_law_is_c1_and_repels_when_close(name):
    law = LAWS[name]
    distance = jnp.linspace(0.3 * DIAMETER, 3 * DIAMETER, 20001)
    value = jax.vmap(lambda d: continued(law, d, jnp.asarray(0.0), PAIR))(distance)
    slope = jax.vmap(jax.grad(lambda d: continued(law, d, jnp.asarray(0.0), PAIR)))(distance)
    assert np.all(np.isfinite(value)) and np.all(np.isfinite(slope))
    assert value[0] > 0
    # the primitive of the slope is the value: no jump, and the slope is the derivative
    area = np.cumsum(0.5 * (slope[1:] + slope[:-1]) * np.diff(distance))
    scale = np.max(np.abs(value))
    np.testing.assert_allclose(value[1:] - value[0], area, atol=2e-3 * scale)


def test_damped_law_is_equation_13():
    law = laws.DampedInversePower(k1=1e-7, k3=1e-6, reference_spacing=1e-3)
    d, c = 0.013, 0.2
    expected = 0.5 * (1e-7 / (d - 0.5 * DIAMETER) ** 3 + 1e-6 / d * c * abs(c)) / 1e-3
    got = continued(law, jnp.asarray(d), jnp.asarray(c), PAIR)
    np.testing.assert_allclose(got, expected, rtol=1e-12)


def test_barrier_acts_from_touching_on_and_lennard_jones_rests_at_its_minimum():
    barrier = lambda d: continued(LAWS["barrier"], jnp.asarray(d), jnp.asarray(0.0), PAIR)
    assert barrier(1.2 * DIAMETER) == 0 and barrier(1.5 * DIAMETER) == 0
    assert barrier(1.05 * DIAMETER) > 0
    rest = 2 ** (1 / 6) * 0.03
    lj = lambda d: continued(LAWS["lennard_jones"], jnp.asarray(d), jnp.asarray(0.0), PAIR)
    assert abs(lj(rest)) < 1e-10 * lj(0.9 * rest)
    assert lj(1.1 * rest) < 0


def test_penalty_is_a_spring_and_a_dashpot():
    """Beyond the soft beginning K (x - width/2 + relaxation c), and its derivatives."""
    law, width = LAWS["damped_penalty"], 0.05 * DIAMETER
    depth, c = 0.2 * DIAMETER, 0.3
    value = lambda d, c: law.repulsion(d, c, PAIR)
    at = (jnp.asarray(DIAMETER - depth), jnp.asarray(c))
    np.testing.assert_allclose(value(*at), 1e6 * (depth - 0.5 * width + 2e-3 * c), rtol=1e-12)
    np.testing.assert_allclose(jax.grad(value)(*at), -1e6, rtol=1e-12)
    np.testing.assert_allclose(jax.grad(value, 1)(*at), 2e3, rtol=1e-12)
    # in the beginning it fades to nothing, dashpot and all; apart there is nothing
    at = (jnp.asarray(DIAMETER - 0.4 * width), jnp.asarray(c))
    expected = 1e6 * (0.08 * width + 2e-3 * 0.4 * c)
    np.testing.assert_allclose(value(*at), expected, rtol=1e-12)
    assert value(jnp.asarray(DIAMETER), jnp.asarray(c)) == 0
    assert value(jnp.asarray(1.1 * DIAMETER), jnp.asarray(-c)) == 0


def test_laws_that_damp_are_told_from_those_that_do_not():
    damped = {name for name, law in LAWS.items() if not ignores_approach(law, PAIR)}
    # a Penalty reads the approach, though its relaxation may be zero
    assert damped == {"damped", "penalty", "damped_penalty"}


def test_penalty_dissipates_over_a_cycle():
    """Work of the strands against the law as they approach and part: none without relaxation."""
    phase = np.linspace(0, 2 * np.pi, 20001)
    amplitude, rate = 0.3 * DIAMETER, 5.0
    distance = DIAMETER - amplitude * (1 - np.cos(phase)) / 2
    approach = 0.5 * amplitude * rate * np.sin(phase)

    def work(law):
        psi = jax.vmap(lambda d, c: law.repulsion(d, c, PAIR))
        force = np.asarray(psi(jnp.asarray(distance), jnp.asarray(approach)))
        return np.trapezoid(force * approach, phase / rate)

    scale = 1e6 * amplitude**2
    assert abs(work(LAWS["penalty"])) < 1e-9 * scale
    # K tau oint (d indentation/dt) c dt, the indentation's slope taken at its cubic beginning
    slope = np.minimum((DIAMETER - distance) / (0.05 * DIAMETER), 1.0)
    expected = 1e6 * 2e-3 * np.trapezoid(slope * approach**2, phase / rate)
    assert expected > 1e-4 * scale
    np.testing.assert_allclose(work(LAWS["damped_penalty"]), expected, rtol=1e-6)


def test_penalty_between_parallel_strands_is_that_of_its_docstring():
    law = laws.Penalty(stiffness=1e6, softness=1e-5)
    depth = 0.01 * DIAMETER
    gap = DIAMETER - depth
    reach = np.sqrt(DIAMETER**2 - gap**2)
    along = np.linspace(-reach, reach, 200001)
    distance = jnp.asarray(np.hypot(gap, along))
    psi = law.repulsion(distance, jnp.zeros_like(distance), PAIR)
    force = np.trapezoid(np.asarray(psi) * gap / np.asarray(distance), along)
    expected = 4 / 3 * 1e6 * depth * np.sqrt(2 * DIAMETER * depth)
    np.testing.assert_allclose(force, expected, rtol=0.02)  # to first order in depth / D


def test_penalty_rejects_a_negative_relaxation():
    with pytest.raises(ValueError, match="relaxation: must be finite and not negative"):
        laws.Penalty(stiffness=1e6, relaxation=-1.0)
