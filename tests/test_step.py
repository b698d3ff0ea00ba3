"""One step: its compilation, what holds exactly after it, and what is refused."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import PRECISE, UNIT_SECTION, UP, driven_scene, final_state, stretch_error, time

from rodjax import rotations
from rodjax.constraints.ends import Clamped, Free, Slider, Turn
from rodjax.dynamics.adaptive import adaptive_rollout
from rodjax.dynamics.consistency import start
from rodjax.dynamics.fixed_rollout import rollout
from rodjax.dynamics.stepping import step
from rodjax.equations.generalized_alpha import GeneralizedAlpha
from rodjax.inputs.schedules import PiecewiseLinear, Smooth
from rodjax.interactions.loads import Gravity, LinearDrag, MorisonDrag, PointLoad
from rodjax.numerics.results import Result
from rodjax.rods.builders import straight_rod
from rodjax.rods.section import circular_section
from rodjax.rods.strains import strains
from rodjax.scenes.scene import Scene


@pytest.fixture(scope="module")
def driven():
    scene = driven_scene(8)
    return scene, start(scene)


@pytest.fixture(scope="module")
def counted():
    """The jitted step, which refuses to be traced a second time."""
    return eqx.filter_jit(eqx.debug.assert_max_traces(step, max_traces=1))


# The step itself


def test_step_is_traced_once(driven, counted):
    scene, state = driven
    for i, rho in enumerate((0.8, 0.5, 0.0)):
        state, info = counted(scene, state, time(0.01 * (i + 1) ** 2), GeneralizedAlpha(rho))
        assert int(info.result) == Result.SUCCESS
        assert 1 <= int(info.iterations) <= 6
    assert float(state.time) == 0.09
    again = start(driven_scene(8, UNIT_SECTION, (MorisonDrag(3.0, 1.0, 0.2),)))
    counted(scene, again, time(0.02), GeneralizedAlpha())


def test_ends_and_constraint_hold_exactly(driven):
    scene, state = driven
    final = final_state(scene, state, 0.8, 80, PRECISE)
    assert stretch_error(scene, final) < 1e-12
    first, last = scene.first_end, scene.last_end
    shift = first.displacement(time(0.8))
    np.testing.assert_allclose(final.position[0], shift, atol=1e-14)
    frame = rotations.exponential(first.rotation(time(0.8)))
    expected = rotations.multiply(frame, scene.rod.quaternion[0])
    np.testing.assert_allclose(final.quaternion[0], expected, atol=1e-12)
    np.testing.assert_allclose(final.position[-1, :2], 0.0, atol=1e-14)
    assert abs(float(final.position[-1, 2]) - 1.0) > 1e-3  # free to slide
    np.testing.assert_allclose(final.quaternion[-1], scene.rod.quaternion[-1], atol=1e-12)
    norms = np.linalg.norm(final.quaternion, axis=1)
    np.testing.assert_allclose(norms, 1.0, atol=1e-15)
    assert isinstance(last, Slider)


def test_consistent_start_has_the_rates_of_the_ends():
    ramp = Smooth([-1.0, 1.0, 9.0], [[0.0] * 3, [0.1, 0.2, 0.3], [0.1, 0.2, 0.3]])
    turn = Turn(UP, Smooth([-1.0, 1.0, 9.0], [0.0, 2.0, 2.0]))
    scene = Scene(straight_rod(1.0, 8, UNIT_SECTION), Clamped(ramp, turn), Free())
    state = start(scene)
    width = 1e-4
    speed = (ramp(time(width)) - ramp(time(-width))) / (2 * width)
    np.testing.assert_allclose(state.velocity[0], speed, atol=1e-6)
    spin = (turn.angle(time(width)) - turn.angle(time(-width))) / (2 * width)
    np.testing.assert_allclose(state.angular_velocity[0], [0, 0, float(spin)], atol=1e-6)
    # a step backwards and forwards along the motion leaves the constraint: its rate is zero
    position = lambda t: state.position + t * state.velocity
    frames = lambda t: rotations.multiply(
        state.quaternion, rotations.exponential(t * state.angular_velocity)
    )
    stretch = lambda t: strains(scene.rod, position(t), frames(t)).stretch
    np.testing.assert_allclose(jax.jacfwd(stretch)(0.0), 0.0, atol=1e-12)


@pytest.mark.slow
def test_a_rod_in_single_precision_stays_in_it():
    """Where double precision is the default, so that settings and drives are in it."""
    scene = driven_scene(6)
    single = lambda leaf: leaf.astype(jnp.float32) if eqx.is_inexact_array(leaf) else leaf
    times = np.linspace(0, 0.2, 21)[1:]
    runs = []
    for one in (scene, jax.tree.map(single, scene)):
        ends = jnp.asarray(times, one.rod.position.dtype)
        runs.append(rollout(one, start(one), ends, GeneralizedAlpha(0.8)))
    assert runs[1].final.position.dtype == jnp.float32
    np.testing.assert_allclose(runs[1].final.position, runs[0].final.position, atol=1e-4)


# What is refused


def test_steps_that_cannot_be_solved_are_reported(driven, counted):
    scene, state = driven
    _, info = counted(scene, state, time(0.3), GeneralizedAlpha(0.8, max_iterations=1))
    assert int(info.result) == Result.NEWTON_FAILED
    assert int(info.iterations) == 1
    _, info = counted(scene, state, time(np.nan), GeneralizedAlpha())
    assert int(info.result) == Result.NON_FINITE
    fast = eqx.tree_at(lambda s: s.rate, state, state.rate.at[:, 5].set(1e3))
    _, info = counted(scene, fast, time(0.1), GeneralizedAlpha())
    assert int(info.result) != Result.SUCCESS


def test_schedule_that_ends_before_the_run_is_refused(driven):
    scene, state = driven
    pushed = PointLoad(-1, force=PiecewiseLinear([0.0, 1.0], [[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]]))
    loaded = dataclasses.replace(scene, loads=(pushed,))
    with pytest.raises(ValueError, match=r"loads\[0\].force: its schedule ends at 1"):
        rollout(loaded, state, jnp.asarray([1.0, 3.0]))
    with pytest.raises(ValueError, match="first_end.displacement: its schedule ends at 10"):
        rollout(scene, state, jnp.asarray([1.0, 11.0]))
    with pytest.raises(ValueError, match="first_end.displacement: its schedule ends at 10"):
        adaptive_rollout(scene, state, 11.0)


def test_start_names_what_has_no_answer():
    section = circular_section(0.02, 1e6, 4e5, 1000.0)
    rod = straight_rod(1.0, 8, section)
    with pytest.raises(ValueError, match="first_end, last_end: .* hold the rod twice"):
        start(Scene(rod, Clamped(), Clamped(), (Gravity((0.0, 0.0, -9.8)),)))
    bare = dataclasses.replace(rod, rotary_inertia=jnp.asarray([[1e-6, 1e-6, 0.0]] * 8))
    assert np.all(np.isfinite(start(Scene(bare, Clamped())).acceleration))
    turned = rod.quaternion.at[3:].multiply(-1.0)
    state = start(Scene(rod, Clamped()), quaternion=turned)
    np.testing.assert_array_equal(state.quaternion, rod.quaternion)
    added = MorisonDrag(1000.0, 0.1, 0.01, added_mass_coefficient=1.0)
    massless = dataclasses.replace(rod, mass=None, rotary_inertia=None)
    with pytest.raises(ValueError, match="loads: added mass"):
        Scene(massless, Clamped(), loads=(LinearDrag(1.0, 1.0, 1.0), added))


@pytest.mark.slow
def test_element_wound_too_far_is_refused():
    """Near a full turn of an element its rotation vector would jump to the other side."""
    turns = lambda n: Turn(UP, Smooth([0.0, 1.0, 9.0], 2 * np.pi * np.asarray([0.0, n, n])))
    rod = straight_rod(1.0, 2, UNIT_SECTION)
    wound = lambda n: Scene(rod, Clamped(), Slider(UP, rotation=turns(n)))
    times = jnp.linspace(0.0, 1.0, 41)[1:]
    run = lambda n: rollout(wound(n), start(wound(n)), times, throw=False)
    assert int(run(1.2).result) == Result.SUCCESS
    assert int(run(2.4).result) == Result.ROTATION_TOO_LARGE


def test_state_refuses_what_does_not_fit():
    scene = Scene(straight_rod(1.0, 4, UNIT_SECTION), Clamped(), Free())
    rod = scene.rod
    with pytest.raises(ValueError, match="^position: stretched"):
        start(scene, position=1.01 * rod.position)
    with pytest.raises(ValueError, match="^position: must be finite"):
        start(scene, position=rod.position.at[1].set(np.nan))
    with pytest.raises(ValueError, match="^quaternion: must have unit length"):
        start(scene, quaternion=rod.quaternion.at[1].set(0.0))
    with pytest.raises(ValueError, match="^velocity: must be finite"):
        start(scene, velocity=jnp.full((5, 3), np.inf))
    for name, wrong in (("tolerance", 0.0), ("tolerance", np.nan), ("max_iterations", 0)):
        with pytest.raises(ValueError, match=f"^{name}"):
            GeneralizedAlpha(**{name: wrong})
    for rho in (1.0, -0.1, np.nan):
        with pytest.raises(ValueError, match="^spectral_radius"):
            GeneralizedAlpha(rho)
    with pytest.raises(ValueError, match="^tolerance.*float64"):
        GeneralizedAlpha(0.8, 1e-17).check_precision(jnp.float64)
    with pytest.raises(ValueError, match="^tolerance.*float32"):
        GeneralizedAlpha(0.8, 1e-9).check_precision(jnp.float32)
