"""Given steps that do not resolve the motion are reported, and no others."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rodjax.constraints.ends import Clamped
from rodjax.dynamics.consistency import start
from rodjax.dynamics.fixed_rollout import rollout
from rodjax.equations.generalized_alpha import GeneralizedAlpha
from rodjax.interactions.loads import Gravity, LinearDrag
from rodjax.numerics.results import Result, SimulationError
from rodjax.rods.builders import straight_rod
from rodjax.rods.section import circular_section
from rodjax.scenes.scene import Scene


def cantilever(youngs_modulus=1e9, weight=9.81, elements=10):
    """A rod of 1 m and 1 cm let go under its weight; its slowest period at 1e9 Pa is 0.87 s."""
    section = circular_section(1e-2, youngs_modulus, 0.4 * youngs_modulus, 1500.0)
    rod = straight_rod(1.0, elements, section, direction=(1.0, 0.0, 0.0))
    return Scene(rod, Clamped(), loads=(Gravity((0.0, 0.0, -weight)),))


def run(scene, dt, steps=20, **method):
    """The motion in equal steps."""
    times = dt * jnp.arange(1.0, steps + 1)
    return rollout(scene, start(scene), times, GeneralizedAlpha(**method), throw=False)


@pytest.mark.parametrize("dt", [1e-4, 1e-3, 1e-2, 5e-2])
def test_steps_that_follow_the_motion_succeed(dt):
    assert int(run(cantilever(), dt).result) == Result.SUCCESS


def test_steps_of_many_periods_are_reported_with_the_whole_run():
    scene = cantilever(1e13)
    times = jnp.arange(1.0, 21.0)
    with pytest.raises(SimulationError, match="do not resolve the motion") as failure:
        rollout(scene, start(scene), times)
    assert failure.value.result == Result.UNRESOLVED
    partial = failure.value.partial
    np.testing.assert_array_equal(partial.times[1:], times)
    # what is left is the equilibrium: m g L^4 / (8 EI)
    rod = scene.rod
    sag = rod.mass[0] * 9.81 / (8 * rod.stiffness[0, 0])
    np.testing.assert_allclose(-partial.final.position[-1, 2], sag, rtol=0.02)


def test_waves_without_damping_that_no_step_resolves_are_reported():
    assert int(run(cantilever(), 0.1, spectral_radius=0.99).result) == Result.UNRESOLVED


@pytest.mark.slow
def test_velocities_that_drown_in_rounding_are_reported():
    with jax.enable_x64(False):
        scene = cantilever()
        assert int(run(scene, 1e-6).result) == Result.UNRESOLVED
        assert int(run(scene, 1e-3).result) == Result.SUCCESS
    assert int(run(cantilever(), 1e-6).result) == Result.SUCCESS


def test_rest_is_resolved_by_every_step():
    still = cantilever(weight=0.0)
    assert int(run(still, 1.0).result) == Result.SUCCESS
    assert int(run(still, 1e-6).result) == Result.SUCCESS


def test_a_rod_without_inertia_has_no_waves_to_resolve():
    section = circular_section(1e-2, 1e9, 4e8, None, rotary_inertia=False)
    rod = straight_rod(1.0, 10, section, natural_curvature=(0.5, 0.0, 0.0))
    relaxing = Scene(rod, Clamped(), loads=(LinearDrag(20.0, 20.0, 0.1),))
    assert int(run(relaxing, 1.0, steps=3).result) == Result.SUCCESS


@pytest.mark.slow
def test_the_verdict_comes_out_of_traced_code_without_derivatives():
    scene = cantilever(1e13)

    @jax.jit
    def tip(weight):
        load = Gravity(weight * jnp.asarray([0.0, 0.0, -1.0]))
        heavy = dataclasses.replace(scene, loads=(load,))
        times = jnp.arange(1.0, 11.0)
        found = rollout(heavy, start(heavy), times, throw=False)
        return found.final.position[-1, 2], found.result

    (_, code), slope = jax.jvp(tip, (9.81,), (1.0,))
    assert int(code) == Result.UNRESOLVED
    assert np.isfinite(slope[0]) and slope[0] < 0
