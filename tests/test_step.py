"""One step and short rollouts: conservation, vibrations, switches, failures, units."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import (
    UNIT_SECTION,
    advance_to,
    driven_scene,
    final_state,
    relative_difference,
)

from rodjax import rotations
from rodjax.adaptive import adaptive_rollout
from rodjax.consistency import restart, start
from rodjax.ends import Clamped, Free, Slider, Switched, Turn
from rodjax.fixed_rollout import rollout
from rodjax.generalized_alpha import GeneralizedAlpha
from rodjax.inertia import node_inertia
from rodjax.loads import DistributedLoad, Gravity, LinearDrag, MorisonDrag, PointLoad
from rodjax.results import Result, SimulationError
from rodjax.rod import circular_section, curved_rod, straight_rod
from rodjax.scene import Scene
from rodjax.schedules import Constant, Function, PiecewiseLinear, Smooth
from rodjax.step_control import StepControl
from rodjax.stepping import step
from rodjax.strains import strains

PRECISE = GeneralizedAlpha(0.8, tolerance=1e-12)
UP = (0.0, 0.0, 1.0)
ARC = lambda s: np.array([1 - np.cos(s), 0.0, np.sin(s)])


def time(value):
    return jnp.asarray(value, float)


def stretch_error(scene, state):
    stretch = strains(scene.rod, state.position, state.quaternion).stretch
    return float(jnp.max(jnp.abs(stretch - jnp.asarray([[0.0, 0.0, 1.0]]))))


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


# Free flight


@pytest.fixture(scope="module")
def tumbling():
    """A bent rod in free flight that moves, tumbles and vibrates."""
    scene = Scene(curved_rod(ARC, 1.0, 8, UNIT_SECTION, stress_free=False))
    position = scene.rod.position
    spin = jnp.asarray([0.4, 1.0, -0.6])
    drift = jnp.asarray([[0.3, -0.2, 0.5]])
    velocity = drift + jnp.cross(jnp.broadcast_to(spin, position.shape), position)
    body = rotations.rotate_inverse(scene.rod.quaternion, jnp.broadcast_to(spin, position.shape))
    return scene, start(scene, velocity=velocity, angular_velocity=body)


def momenta(scene, state):
    mass, rotary = node_inertia(scene.rod)
    linear = mass[:, None] * state.velocity
    spin = rotations.rotate(state.quaternion, rotary * state.angular_velocity)
    angular = spin + jnp.cross(state.position, linear)
    centre = jnp.sum(mass[:, None] * state.position, 0) / jnp.sum(mass)
    return np.asarray(jnp.sum(linear, 0)), np.asarray(jnp.sum(angular, 0)), np.asarray(centre)


def test_free_flight_conserves_momentum(tumbling):
    scene, state = tumbling
    linear, angular, centre = momenta(scene, state)
    assert np.linalg.norm(angular) > 0.05
    errors = []
    # 50 steps do not resolve the waves of the release, whose energy then grows at this radius
    for count in (100, 200, 400):
        final = final_state(scene, state, 1.0, count, PRECISE)
        assert stretch_error(scene, final) < 1e-12
        now = momenta(scene, final)
        np.testing.assert_allclose(now[0], linear, atol=1e-11)
        np.testing.assert_allclose(now[2], centre + linear, atol=1e-11)  # the mass is 1
        errors.append(np.linalg.norm(now[1] - angular))
    assert np.max(np.abs(final.position - state.position)) > 0.3
    # angular momentum is not an invariant of the scheme, but of its limit, at second order
    assert errors[-1] < 1e-3 * np.linalg.norm(angular)
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.25)
    assert errors[1] / errors[2] == pytest.approx(4, rel=0.25)


def test_spinning_rod_spins_on(tumbling):
    scene, _ = tumbling
    rod = straight_rod(1.0, 8, UNIT_SECTION)
    scene = eqx.tree_at(lambda s: s.rod, scene, rod)
    spin = jnp.tile(jnp.asarray([[0.0, 0.0, 3.0]]), (9, 1))
    drift = jnp.tile(jnp.asarray([[0.1, 0.2, -0.3]]), (9, 1))
    state = start(scene, velocity=drift, angular_velocity=spin)
    np.testing.assert_allclose(state.acceleration, 0.0, atol=1e-12)
    np.testing.assert_allclose(state.force, 0.0, atol=1e-12)
    final = final_state(scene, state, 2.0, 50, PRECISE)
    np.testing.assert_allclose(final.position, rod.position + 2 * drift, atol=1e-11)
    np.testing.assert_allclose(final.rate, state.rate, atol=1e-11)
    turned = rotations.exponential(2 * spin)
    found = np.sign(turned[:, :1] * final.quaternion[:, :1]) * final.quaternion
    np.testing.assert_allclose(found, turned, atol=1e-11)


# Vibrations


@pytest.fixture(scope="module")
def cantilever():
    section = circular_section(1e-2, 1.25e7, 5e6, 1500.0)
    return Scene(straight_rod(1.0, 40, section), Clamped(), Free())


def frequency(scene, state, expected, value):
    """Angular frequency by the phase of an undamped oscillation through zero, after a quarter."""
    count = 100
    quarter = 0.5 * np.pi / expected
    final, worst = advance_to(
        scene, state, time(quarter), jnp.asarray(count), GeneralizedAlpha(0.95)
    )
    assert int(worst) == 0
    position, rate = value(final)
    # x = sin(w t)/w, x' = cos(w t) from the start x = 0, x' = 1
    phase = np.arctan2(position * expected, rate)
    return phase / quarter


def test_cantilever_frequency(cantilever):
    scene = cantilever
    bend, mass = float(scene.rod.stiffness[0, 0]), float(scene.rod.mass[0])
    expected = 3.51602 * np.sqrt(bend / mass)
    root, s = 1.8751040687119611, scene.rod.arc_length
    ratio = (np.cosh(root) + np.cos(root)) / (np.sinh(root) + np.sin(root))
    shape = (
        jnp.cosh(root * s) - jnp.cos(root * s) - ratio * (jnp.sinh(root * s) - jnp.sin(root * s))
    )
    slope = root * (
        jnp.sinh(root * s) + jnp.sin(root * s) - ratio * (jnp.cosh(root * s) - jnp.cos(root * s))
    )
    size = 1e-4 * expected
    zero = jnp.zeros_like(s)
    state = start(
        scene,
        velocity=size * jnp.stack([shape, zero, zero], 1),
        angular_velocity=size * jnp.stack([zero, slope, zero], 1),
    )
    norm = float(state.velocity[-1, 0])
    value = lambda final: (final.position[-1, 0] / norm, final.velocity[-1, 0] / norm)
    assert frequency(scene, state, expected, value) == pytest.approx(expected, rel=1e-3)


def test_torsion_waves(cantilever):
    scene = cantilever
    speed = np.sqrt(5e6 / 1500)
    assert speed == pytest.approx(57.735, rel=1e-5)
    expected = 0.5 * np.pi * speed  # clamped-free: a quarter of a wave on the length 1
    s = scene.rod.arc_length
    spin = 1e-3 * jnp.sin(0.5 * np.pi * s)
    zero = jnp.zeros_like(s)
    state = start(scene, angular_velocity=jnp.stack([zero, zero, spin], 1))

    def value(final):
        turn = rotations.logarithm(final.quaternion[-1])[2]
        return turn / 1e-3, final.angular_velocity[-1, 2] / 1e-3

    assert frequency(scene, state, expected, value) == pytest.approx(expected, rel=5e-4)


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


# Rollouts


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


# Units


def growing(parameters, s, motion):
    """A load per length that grows along the rod."""
    return parameters[None, :] * (s / jnp.max(s))[:, None]


def loaded_scene(length, force, duration):
    """One scene in units in which a metre, a newton and a second have these numbers."""
    mass = force * duration**2 / length  # of a kilogram
    pressure, density, speed = force / length**2, mass / length**3, length / duration
    section = circular_section(
        lambda s: length * 5e-3 * (1 + 0.2 * s / length),
        1.25e7 * pressure,
        5e6 * pressure,
        1500.0 * density,
        extensible=True,
    )
    rod = straight_rod(
        length, 6, section, natural_curvature=(0.3 / length, lambda s: 0.1 * s / length**2, 0.0)
    )
    ramp = [0.0, 0.5 * duration, 10 * duration]
    push = Smooth(ramp, length * np.array([[0.0] * 3, [0.05, 0.02, 0.1], [0.05, 0.02, 0.1]]))
    loads = (
        Gravity(9.81 * length / duration**2 * np.array([0.3, 0.0, -0.2]), 1000.0 * density),
        MorisonDrag(1000.0 * density, 1.0, 0.1, speed * np.array([0.1, 0.0, 0.05])),
        LinearDrag(
            1e-2 * force * duration / length**2,
            5e-3 * force * duration / length**2,
            1e-6 * force * duration,
        ),
        PointLoad(
            -1, Constant(1e-3 * force * np.ones(3)), Constant(1e-4 * force * length * np.ones(3))
        ),
        DistributedLoad(growing, jnp.asarray([1e-3 * force / length] * 3 + [1e-5 * force] * 3)),
    )
    switch = Switched(Slider(UP), Clamped(), 0.2 * duration)
    return Scene(rod, Clamped(push, Turn(UP, Smooth(ramp, [0.0, 3.0, 3.0]))), switch, loads)


# metre, newton, second; nanometre, piconewton, microsecond; ton and megametre like
UNITS = {"nm pN us": (1e9, 1e12, 1e6), "Mm GN ks": (1e-6, 1e-9, 1e-3)}


@pytest.fixture(scope="module")
def in_si():
    scene = loaded_scene(1.0, 1.0, 1.0)
    state = start(scene)
    times = jnp.asarray(np.linspace(0, 0.3, 31)[1:])
    return rollout(scene, state, times, PRECISE), adaptive_rollout(scene, state, 0.3, PRECISE)


# the grid is coarse in any units, and the runs say so
@pytest.mark.filterwarnings("ignore::rodjax.results.ModelWarning")
@pytest.mark.parametrize("units", UNITS.values(), ids=UNITS)
def test_units_are_free(in_si, units):
    length, force, duration = units
    scene = loaded_scene(*units)
    state = start(scene)
    times = jnp.asarray(np.linspace(0, 0.3, 31)[1:]) * duration
    fixed = rollout(scene, state, times, PRECISE)
    chosen = adaptive_rollout(scene, state, 0.3 * duration, PRECISE)
    for found, expected in zip((fixed, chosen), in_si, strict=True):
        assert int(found.result) == 0
        assert len(found.times) == len(expected.times) > 20
        assert int(found.rejected) == int(expected.rejected)
        a, b = found.states, expected.states
        assert relative_difference(a.time / duration, b.time) < 1e-9
        assert relative_difference(a.position / length, b.position) < 1e-9
        assert relative_difference(a.quaternion, b.quaternion) < 1e-9
        assert relative_difference(a.velocity * (duration / length), b.velocity) < 1e-9
        spin = a.angular_velocity * duration
        assert relative_difference(spin, b.angular_velocity) < 1e-9
        assert relative_difference(a.force / force, b.force) < 1e-9
        loss = found.infos.projection_loss / (force * length)
        assert relative_difference(loss, expected.infos.projection_loss) < 1e-9
        errors = found.infos.error_position / length
        assert relative_difference(errors, expected.infos.error_position) < 1e-7
