"""Short rollouts: constraints that change, what is saved, failures midway."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import ARC, PRECISE, UNIT_SECTION, UP

from rodjax.constraints.ends import Clamped, Free, Slider, Switched, Turn
from rodjax.dynamics.adaptive import adaptive_rollout
from rodjax.dynamics.consistency import restart, start
from rodjax.dynamics.fixed_rollout import rollout
from rodjax.dynamics.step_control import StepControl
from rodjax.inputs.schedules import Function, Smooth
from rodjax.interactions.loads import LinearDrag, MorisonDrag, PointLoad
from rodjax.numerics.results import Result, SimulationError
from rodjax.rods.builders import curved_rod, straight_rod
from rodjax.rods.inertia import node_inertia
from rodjax.scenes.scene import Scene

# Constraints that change


@pytest.fixture(scope="module")
def held():
    """A straight rod, bent at the start, pushes a slider outwards that is held at t = 0.3."""
    rod = curved_rod(ARC, 1.0, 8, UNIT_SECTION, stress_free=False)
    last = Switched(Slider(UP), Clamped(), 0.3)
    turn = Turn((0.0, 1.0, 0.0), Smooth([0.0, 1.0], [0.0, 1.0]))
    scene = Scene(rod, Clamped(rotation=turn), last, (MorisonDrag(1.0, 2.0, 0.5),))
    times = jnp.linspace(0, 0.6, 61)[1:]
    return scene, rollout(scene, start(scene), times, PRECISE)


def kinetic(scene, state):
    mass, rotary = node_inertia(scene.rod)
    linear = jnp.sum(mass[:, None] * state.velocity**2)
    return 0.5 * float(linear + jnp.sum(rotary * state.angular_velocity**2))


@pytest.mark.slow
def test_slider_is_held_from_its_time_on(held):
    scene, run = held
    assert int(run.result) == Result.SUCCESS
    end = run.states.position[:, -1, 2]
    at = int(np.argmin(np.abs(np.asarray(run.times) - 0.3)))
    assert float(run.times[at]) == 0.3
    assert float(jnp.max(jnp.abs(jnp.diff(end[: at + 1])))) > 1e-4  # it slides before
    np.testing.assert_allclose(end[at:], end[at], atol=1e-14)  # and rests after
    assert abs(float(run.states.rate[at, -1, 2])) > 1e-2
    # velocities obey the new constraint within the step that begins there, and later
    np.testing.assert_allclose(run.states.rate[at + 1 :, -1], 0.0, atol=1e-9)
    assert int(jnp.max(run.infos.iterations[at:])) <= 6
    loss = np.array(run.infos.projection_loss)
    assert loss[at] > 1e-6
    assert np.all(np.delete(loss, at) == 0)


@pytest.mark.slow
def test_projection_loss_is_the_kinetic_energy_lost(held):
    scene, run = held
    before = run.nearest(0.3)
    after, loss = eqx.filter_jit(restart)(scene, before)
    assert float(loss) == pytest.approx(kinetic(scene, before) - kinetic(scene, after), rel=1e-12)
    at = int(np.argmin(np.abs(np.asarray(run.times) - 0.3)))
    assert float(loss) == pytest.approx(float(run.infos.projection_loss[at]), rel=1e-12)
    np.testing.assert_allclose(after.rate[-1], 0.0, atol=1e-13)
    np.testing.assert_array_equal(after.position, before.position)
    again, nothing = eqx.filter_jit(restart)(scene, after)
    assert abs(float(nothing)) < 1e-12 * kinetic(scene, after)
    np.testing.assert_allclose(again.rate, after.rate, atol=1e-11)


def test_switch_must_be_among_the_times(held):
    scene, run = held
    with pytest.raises(ValueError, match="times: a constraint changes at 0.3"):
        rollout(scene, run.state(0), jnp.linspace(0, 0.6, 8)[1:])


def test_switch_is_met_in_traced_code_and_a_miss_is_reported(held):
    scene, run = held
    tenth = jnp.asarray(0.1)
    assert float(3 * tenth) != 0.3  # rounding puts the third step beside the switch

    @jax.jit
    def ends(tenth):
        times = tenth * jnp.asarray([1.0, 2.0, 3.0, 4.0])
        found = rollout(scene, run.state(0), times, PRECISE, throw=False)
        return found.times[3], found.infos.projection_loss, found.result

    at, loss, _ = ends(tenth)
    assert float(at) == 0.3
    assert float(loss[3]) > 1e-6 and np.all(np.delete(np.asarray(loss), 3) == 0)
    # a step from before the switch to beyond it, and what follows is not blamed for another cause
    assert int(ends(2.2 * tenth / 2)[2]) == Result.SWITCH_MISSED


# What is saved


def test_saving_by_index_and_ending_with_the_same_state(held):
    scene, every = held
    state, times = every.state(0), every.times[1:]
    third = rollout(scene, state, times, PRECISE, save_every=3)
    np.testing.assert_array_equal(third.times, every.times[::3])
    np.testing.assert_allclose(third.states.position, every.states.position[::3], atol=1e-12)
    assert third.infos.iterations.shape == (60,)
    np.testing.assert_allclose(third.final.rate, every.final.rate, atol=1e-9)
    with pytest.raises(ValueError, match="save_every: 7 does not divide the 60 steps"):
        rollout(scene, state, times, save_every=7)
    for wrong in ([0.1, 0.1], [0.2, 0.1], [0.0, 0.1], [0.1, np.nan]):
        with pytest.raises(ValueError, match="times"):
            rollout(scene, state, jnp.asarray(wrong))


# Failures midway, and steps by the tolerances


@pytest.fixture(scope="module")
def breaking():
    """A cantilever whose tip load is not a number from t = 0.055 on."""
    load = PointLoad(-1, Function(lambda t: jnp.where(t > 0.055, jnp.nan, 1.0) * jnp.ones(3)))
    scene = Scene(straight_rod(1.0, 8, UNIT_SECTION), Clamped(), Free(), (load,))
    return scene, start(scene)


def test_failing_midway_keeps_what_there_is(breaking):
    scene, state = breaking
    times = jnp.linspace(0, 0.1, 11)[1:]
    run = rollout(scene, state, times, throw=False, save_every=2)
    assert int(run.result) == Result.NON_FINITE
    # the failure is within a saved block: that and what follows are no numbers
    np.testing.assert_allclose(run.times, [0, 0.02, 0.04, 0.06, 0.08, 0.1], atol=1e-15)
    assert np.all(np.isfinite(run.states.position[:3]))
    assert np.all(np.isnan(run.states.position[3:]))
    assert np.all(np.asarray(run.infos.result)[:5] == Result.SUCCESS)
    assert np.all(np.asarray(run.infos.result)[5:] != Result.SUCCESS)
    with pytest.raises(SimulationError, match="after t = 0.05: a value became infinite") as error:
        rollout(scene, state, times, save_every=2)
    assert error.value.result is Result.NON_FINITE
    partial = error.value.partial
    np.testing.assert_array_equal(partial.states.position, run.states.position[:3])
    assert partial.infos.iterations.shape == (4,)


def test_adaptive_run_that_fails_keeps_what_there_is(breaking):
    scene, state = breaking
    control = StepControl(max_step=0.01, min_step=1e-4)
    with pytest.raises(SimulationError, match="after t = 0.05") as error:
        adaptive_rollout(scene, state, 0.1, control=control, chunk=4)
    partial = error.value.partial
    assert 0.054 < float(partial.times[-1]) <= 0.055
    assert np.all(np.isfinite(partial.states.position))
    assert np.all(np.diff(partial.times) > 0)
    short = adaptive_rollout(scene, state, 0.04, max_steps=4, throw=False)
    assert int(short.result) == Result.MAX_STEPS and len(short.times) == 5


@pytest.mark.slow
def test_twist_is_resolved_as_its_tolerance_asks():
    """A straight rod that only twists: no other tolerance holds its steps."""
    turn = Turn(UP, Smooth([0.0, 1.0, 9.0], [0.0, 1.0, 1.0]))
    rod = straight_rod(1.0, 8, UNIT_SECTION)
    scene = Scene(rod, Clamped(rotation=turn), Slider(UP), (LinearDrag(1.0, 1.0, 0.1),))

    def steps(twisting):
        control = StepControl(max_step=0.5, twisting=twisting, relative=1e-4)
        return len(adaptive_rollout(scene, start(scene), 2.0, control=control).times)

    coarse, medium, fine = map(steps, (0.5, 1e-3, 1e-5))
    assert fine > 2 * medium and medium > coarse
