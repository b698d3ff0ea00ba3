"""Schedules of time, and the ends that they move."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest
from helpers import UNIT_SECTION
from hypothesis import given, settings
from hypothesis import strategies as st

from rodjax import rotations
from rodjax.constraints.ends import Clamped, Free, Pinned, Slider, Switched, Turn, increments, rates
from rodjax.dynamics.adaptive import adaptive_rollout
from rodjax.dynamics.consistency import start
from rodjax.dynamics.stepping import switching
from rodjax.inputs.schedules import Constant, Function, PiecewiseLinear, PiecewiseLinearRate, Smooth
from rodjax.interactions.loads import PointLoad
from rodjax.rods.builders import straight_rod
from rodjax.scenes.placing import placing
from rodjax.scenes.scene import Scene, projectors

few = settings(max_examples=30, deadline=None)
NAN = float("nan")


def at(time):
    return jnp.asarray(time, float)


# Schedules

knots = st.lists(st.floats(0.1, 3.0), min_size=1, max_size=5)


def random_knots(gaps):
    times = np.concatenate([[0.0], np.cumsum(gaps)])
    return times, np.random.default_rng(len(gaps)).normal(size=len(times))


@few
@given(knots, st.floats(0.0, 1.0))
def test_piecewise_linear_interpolates(gaps, fraction):
    times, values = random_knots(gaps)
    schedule = PiecewiseLinear(times, values)
    time = fraction * times[-1]
    assert float(schedule(at(time))) == pytest.approx(np.interp(time, times, values), abs=1e-13)
    assert float(schedule.until) == times[-1]


@few
@given(knots, st.floats(0.0, 1.0))
def test_piecewise_linear_rate_is_the_integral(gaps, fraction):
    times, rates = random_knots(gaps)
    schedule = PiecewiseLinearRate(times, rates)
    time = fraction * times[-1]
    below = np.concatenate([times[times < time], [time]])
    expected = np.trapezoid(np.interp(below, times, rates), below)
    assert float(schedule(at(time))) == pytest.approx(expected, abs=1e-12)
    slope = float(jax.grad(schedule)(at(time)))
    assert slope == pytest.approx(np.interp(time, times, rates), abs=1e-12)
    assert float(schedule.until) == times[-1]


@jax.jit
def slopes(schedule, times):
    """First and second derivatives at all times."""
    rate = jax.grad(schedule)
    return jax.vmap(rate)(times), jax.vmap(jax.grad(rate))(times)


@few
@given(knots, st.floats(0.0, 1.0))
def test_smooth_is_a_quintic_step(gaps, fraction):
    times, values = random_knots(gaps)
    schedule = Smooth(times, values)
    i = len(gaps) - 1
    time = times[i] + fraction * gaps[i]
    x = (time - times[i]) / gaps[i]
    blend = x**3 * (10 - 15 * x + 6 * x**2)
    expected = values[i] + blend * (values[i + 1] - values[i])
    assert float(schedule(at(time))) == pytest.approx(expected, abs=1e-12)
    # C2: rate and acceleration vanish at every knot, from both sides
    near = (jnp.asarray(times)[:, None] + jnp.asarray([[0.0, -1e-9, 1e-9]])).ravel()
    rate, acceleration = slopes(schedule, near)
    np.testing.assert_allclose(rate, 0.0, atol=1e-10)
    np.testing.assert_allclose(acceleration, 0.0, atol=1e-3)
    assert float(schedule(at(times[-1] + 1.0))) == pytest.approx(values[-1], abs=1e-13)
    assert float(schedule.until) == times[-1]


@pytest.mark.parametrize("kind", [PiecewiseLinear, PiecewiseLinearRate, Smooth])
def test_vector_schedules_and_derivatives_in_their_knots(kind):
    times, values = [0.0, 1.0, 3.0], [[0.0, 1.0], [2.0, -1.0], [3.0, 0.0]]
    both = kind(times, values)(at(1.7))
    for j in range(2):
        one = kind(times, [v[j] for v in values])(at(1.7))
        assert float(both[j]) == pytest.approx(float(one), abs=1e-15)
    value = lambda t, v: kind(t, v)(at(1.7))[0]
    by_times, by_values = jax.grad(value, (0, 1))(jnp.asarray(times), jnp.asarray(values))
    width = 1e-6
    for j in range(3):
        shift = jnp.asarray(times).at[j].add(width), jnp.asarray(times).at[j].add(-width)
        slope = (value(shift[0], values) - value(shift[1], values)) / (2 * width)
        assert float(by_times[j]) == pytest.approx(float(slope), abs=1e-8)
    assert np.all(np.isfinite(by_values)) and float(jnp.max(jnp.abs(by_values))) > 0
    # integers are taken as numbers
    assert kind([0, 2], [0, 1])(at(1.0)).dtype == jnp.float64


LATE = [1.0, 2.0, 10.0]


@pytest.mark.parametrize("kind", [PiecewiseLinear, PiecewiseLinearRate, Smooth])
@pytest.mark.parametrize("time", [-3.0, 0.0, 0.5, 1 - 1e-9])
def test_schedules_rest_before_their_first_knot(kind, time):
    values = jnp.asarray([[0.3, -1.0], [2.0, 1.0], [0.0, 4.0]])
    first = jnp.zeros(2) if kind is PiecewiseLinearRate else values[0]
    schedule = kind(LATE, values)
    np.testing.assert_array_equal(schedule(at(time)), first)
    for derivative in (jax.jacfwd, jax.jacrev):
        np.testing.assert_array_equal(derivative(schedule)(at(time)), 0.0)
        np.testing.assert_array_equal(derivative(derivative(schedule))(at(time)), 0.0)
    by_times, by_values = jax.jacrev(lambda t, v: kind(t, v)(at(time)), (0, 1))(
        jnp.asarray(LATE), values
    )
    np.testing.assert_array_equal(by_times, 0.0)
    expected = np.zeros((2, 3, 2))
    expected[:, 0] = 0.0 if kind is PiecewiseLinearRate else np.eye(2)
    np.testing.assert_array_equal(by_values, expected)
    assert 1.0 in schedule.corners


def test_the_first_knot_begins_what_follows():
    assert float(jax.grad(PiecewiseLinear(LATE, [0.0, 3.0, 3.0]))(at(1.0))) == 3.0
    rate = PiecewiseLinearRate(LATE, [2.0, 4.0, 4.0])
    assert float(rate(at(1.0))) == 0.0 and float(jax.grad(rate)(at(1.0))) == 2.0
    assert float(rate(at(2.0))) == pytest.approx(3.0, abs=1e-15)


@pytest.mark.slow
def test_nothing_moves_before_the_first_knot():
    knee = [[0.0, 0.0, 0.0], [0.0, 0.1, 0.2], [0.0, 0.1, 0.2]]
    rod = straight_rod(1.0, 8, UNIT_SECTION, direction=(1.0, 0.0, 0.0))
    loads = (PointLoad(-1, PiecewiseLinear(LATE, knee), Smooth(LATE, knee)),)
    turn = Turn((1, 0, 0), PiecewiseLinearRate(LATE, [0.5, 1.0, 1.0]))
    scene = Scene(rod, Clamped(PiecewiseLinear(LATE, knee), turn), loads=loads)
    assert sorted({float(corner) for corner in scene.corners}) == LATE
    run = adaptive_rollout(scene, start(scene), 1.1)
    times = np.asarray(run.times)
    assert 1.0 in times  # a step ends there
    moved = np.max(np.abs(np.asarray(run.states.position) - np.asarray(rod.position)), (1, 2))
    turned = np.max(np.abs(np.asarray(run.states.quaternion - rod.quaternion[None])), (1, 2))
    assert np.max(moved[times <= 1]) < 1e-13 and np.max(turned[times <= 1]) < 1e-13
    np.testing.assert_allclose(run.final.position[0], [0.0, 0.01, 0.02], atol=1e-12)
    angle = 0.5 * 0.1 + 0.5 * 0.5 * 0.1**2
    about = rotations.logarithm(
        rotations.multiply(run.final.quaternion[0], rotations.conjugate(rod.quaternion[0]))
    )
    np.testing.assert_allclose(about, [angle, 0.0, 0.0], atol=1e-12)


def test_constant_and_function():
    assert float(Constant(3)(at(7.0))) == 3.0
    assert Constant(3).until == np.inf
    wave = Function(jnp.sin, 5.0)
    assert float(jax.grad(wave)(at(1.0))) == pytest.approx(np.cos(1.0))
    assert wave.until == 5.0 and Function(jnp.sin).until == np.inf


@pytest.fixture
def unchecked():
    """Without the tests' run-time type checks, which would come before the package's own."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("kind", [PiecewiseLinear, PiecewiseLinearRate, Smooth])
@pytest.mark.parametrize(
    ("times", "values", "match"),
    [
        ([0.0], [1.0], "^times"),
        ([0.0, 0.0], [1.0, 2.0], "^times"),
        ([1.0, 0.0], [1.0, 2.0], "^times"),
        ([0.0, NAN], [1.0, 2.0], "^times"),
        ([0.0, np.inf], [1.0, 2.0], "^times"),
        ([[0.0, 1.0]], [1.0, 2.0], "^times"),
        ([0.0, 1.0], [1.0, 2.0, 3.0], "^(values|rates): expected 2"),
        ([0.0, 1.0], [1.0, NAN], "^(values|rates): must be finite"),
    ],
)
def test_schedules_refuse(kind, times, values, match):
    with pytest.raises(ValueError, match=match) as error:
        kind(times, values)
    if not match.startswith("^times"):
        assert str(error.value).startswith("rates" if kind is PiecewiseLinearRate else "values")


# Ends

SHIFT = Smooth([0.0, 2.0], [[0.0, 0.0, 0.0], [1.0, -2.0, 0.5]])
TURN = Turn((0.0, 3.0, 4.0), Smooth([0.0, 2.0], [0.5, 2.5]))


def slider_projector(axis):
    projector = np.eye(6)
    projector[:3, :3] -= np.outer(axis, axis)
    return projector


def test_projectors():
    time = at(0.0)
    np.testing.assert_array_equal(Free().projector(time), np.zeros((6, 6)))
    np.testing.assert_array_equal(Clamped().projector(time), np.eye(6))
    np.testing.assert_array_equal(Pinned().projector(time), np.diag([1.0, 1, 1, 0, 0, 0]))
    expected = slider_projector([0.6, 0.0, 0.8])
    np.testing.assert_allclose(Slider((3, 0, 4)).projector(time), expected, atol=1e-15)


@few
@given(st.tuples(*[st.floats(-5, 5)] * 3).filter(lambda v: np.linalg.norm(v) > 1e-3))
def test_slider_projector_is_orthogonal(axis):
    projector = np.asarray(Slider(axis).projector(at(0.0)))
    np.testing.assert_allclose(projector @ projector, projector, atol=1e-14)
    np.testing.assert_allclose(projector, projector.T, atol=1e-16)
    np.testing.assert_allclose(projector @ [*axis, 0, 0, 0], 0.0, atol=1e-13)


def test_switched_changes_once_and_may_nest():
    end = Switched(Slider((0, 0, 1)), Switched(Clamped(), Free(), 5.0), 3.0, SHIFT)
    assert [float(t) for t in end.switch_times] == [3.0, 5.0]
    for time, part in ((2.9, Slider((0, 0, 1))), (3.0, Clamped()), (4.9, Clamped()), (5.0, Free())):
        np.testing.assert_array_equal(end.projector(at(time)), part.projector(at(time)))
    rod = straight_rod(1.0, 3, UNIT_SECTION)
    scene = Scene(rod, Free(), end)
    assert [float(t) for t in scene.switch_times] == [3.0, 5.0]
    both = projectors(scene, at(3.0))
    np.testing.assert_array_equal(both[0], 0.0)
    np.testing.assert_array_equal(both[1], np.eye(6))
    assert Clamped().switch_times == ()


def test_a_switch_in_single_precision_begins_at_its_rounded_time():
    end = Switched(Slider((0, 0, 1)), Clamped(), 0.7)  # which single precision rounds down
    single = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), end)
    for one in (end, single):
        for time, part in ((0.6, end.before), (0.7, end.after)):
            found = one.projector(jnp.asarray(time, jnp.float32))
            assert found.dtype == jnp.float32
            np.testing.assert_array_equal(found, part.projector(at(time)))
        assert one.fixed is False
    scene = Scene(straight_rod(1.0, 3, UNIT_SECTION), Clamped(SHIFT), single)
    scene = dataclasses.replace(scene, first_end=jax.tree.map(jnp.float32, scene.first_end))
    np.testing.assert_array_equal(np.sort(scene.corners), [0.0, 2.0])


def test_a_rod_in_single_precision_meets_a_switch_in_double():
    single = lambda leaf: leaf.astype(jnp.float32) if eqx.is_inexact_array(leaf) else leaf
    rod = jax.tree.map(single, straight_rod(1.0, 3, UNIT_SECTION))
    scene = Scene(rod, Clamped(), Switched(Free(), Clamped(), 0.7))
    state = dataclasses.replace(placing(scene), time=jnp.asarray(0.7, jnp.float32))
    assert [t.dtype for t in scene.switch_times] == [jnp.float32]
    assert bool(switching(scene, state))
    double = Scene(straight_rod(1.0, 3, UNIT_SECTION), Clamped(), scene.last_end)
    assert double.switch_times[0] is scene.last_end.at


def test_increments_follow_the_schedules():
    start, stop = at(0.3), at(0.9)
    quaternion = rotations.exponential(jnp.asarray([0.4, -0.2, 0.9]))
    found = increments(Clamped(SHIFT, TURN), start, stop, quaternion)
    np.testing.assert_allclose(found[:3], SHIFT(stop) - SHIFT(start), atol=1e-15)
    # the turn is about an inertial axis: it multiplies from the left
    angle = TURN.angle(stop) - TURN.angle(start)
    inertial = rotations.exponential(angle * jnp.asarray([0.0, 0.6, 0.8]))
    expected = rotations.multiply(inertial, quaternion)
    after = rotations.multiply(quaternion, rotations.exponential(found[3:]))
    np.testing.assert_allclose(after, expected, atol=1e-15)
    np.testing.assert_array_equal(increments(Clamped(), start, stop, quaternion), np.zeros(6))
    np.testing.assert_allclose(increments(Pinned(SHIFT), start, stop, quaternion)[:3], found[:3])


@pytest.mark.parametrize("time", [0.1, 1.0, 1.7])
def test_rates_against_differences(time):
    quaternion = rotations.exponential(jnp.asarray([0.4, -0.2, 0.9]))
    end = Clamped(SHIFT, TURN)
    velocity, acceleration = rates(end, at(time), quaternion)
    width = 1e-4
    ahead = increments(end, at(time), at(time + width), quaternion)
    behind = increments(end, at(time), at(time - width), quaternion)
    np.testing.assert_allclose(velocity, (ahead - behind) / (2 * width), atol=1e-6)
    np.testing.assert_allclose(acceleration, (ahead + behind) / width**2, atol=1e-5)
    still = rates(Clamped(), at(time), quaternion)
    np.testing.assert_array_equal(np.stack(still), np.zeros((2, 6)))


def test_turn_is_a_rotation_vector_about_its_unit_axis():
    np.testing.assert_allclose(TURN(at(2.0)), [0.0, 1.5, 2.0], atol=1e-15)
    assert float(TURN.until) == 2.0


ONE = Constant(1.0)
REFUSALS = {
    "axis zero": ("axis", lambda: Slider((0.0, 0.0, 0.0))),
    "axis plane": ("axis", lambda: Slider((0.0, 1.0))),
    "axis nan": ("axis", lambda: Turn((0.0, NAN, 1.0), ONE)),
    "axis infinite": ("axis", lambda: Turn((0.0, np.inf, 1.0), ONE)),
    "angle of three": ("angle", lambda: Turn((0.0, 0.0, 1.0), SHIFT)),
    "shift of one": ("displacement", lambda: Clamped(ONE)),
    "shift of two": ("displacement", lambda: Pinned(Constant([1.0, 2.0]))),
    "slider's shift": ("displacement", lambda: Slider((0, 0, 1), ONE)),
    "schedules in a part": ("before, after", lambda: Switched(Clamped(SHIFT), Free(), 1.0)),
    "nested before": ("before", lambda: Switched(Switched(Clamped(), Free(), 1.0), Free(), 2.0)),
}


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("case", REFUSALS)
def test_ends_refuse(case):
    match, build = REFUSALS[case]
    with pytest.raises(ValueError, match=f"^{match}"):
        build()


def test_schedule_that_ends_early_is_refused():
    rod = straight_rod(1.0, 3, UNIT_SECTION)
    scene = Scene(rod, Clamped(SHIFT, Turn((0, 0, 1), PiecewiseLinear([0.0, 4.0], [0.0, 1.0]))))
    scene.check_until(2.0)
    with pytest.raises(ValueError, match=r"first_end.displacement: its schedule ends at 2.*run"):
        scene.check_until(3.0)
    with pytest.raises(ValueError, match=r"last_end.rotation: its schedule ends at 4"):
        turned = Clamped(rotation=Turn((0, 0, 1), Smooth([0, 4], [0, 1])))
        Scene(rod, Free(), turned).check_until(5.0)
    before = Scene(rod, Clamped(rotation=Turn((0, 0, 1), PiecewiseLinear([-4.0, -1.0], [0, 1]))))
    before.check_until(-1.0)
    before.check_until(-1.0 + 1e-12)
    with pytest.raises(ValueError, match=r"its schedule ends at -1, before the run's end at -0.5"):
        before.check_until(-0.5)


@pytest.mark.parametrize("kind", [PiecewiseLinear, PiecewiseLinearRate, Smooth])
def test_padded_schedules_are_the_same(kind):
    """Values and rates at, between and outside the knots; so are last time and corners."""
    schedule = kind([0.5, 0.9, 2.0], [[1.0, 2.0], [-1.0, 0.5], [0.3, 0.2]])
    padded = schedule.padded(7)
    assert padded.times.shape == (7,) and padded.until == schedule.until
    assert set(np.asarray(padded.corners)) == set(np.asarray(schedule.corners))
    times = jnp.array([0.0, 0.5, 0.7, 0.9, 1.7, 2.0])
    motion = lambda s: jax.vmap(lambda t: jax.jvp(s, (t,), (jnp.ones_like(t),)))(times)
    for found, expected in zip(motion(padded), motion(schedule), strict=True):
        np.testing.assert_array_equal(found, expected)
    slope = jax.grad(lambda s: jnp.sum(s(jnp.asarray(1.7)) + s(jnp.asarray(0.1))))
    for found, expected in zip(*map(jax.tree.leaves, map(slope, (padded, schedule))), strict=True):
        assert np.all(np.isfinite(found))
        total = lambda leaf: np.concatenate([np.sum(leaf[:-2], 0)[None], leaf[-2:]])
        np.testing.assert_allclose(total(found), total(expected), atol=1e-13)
    again = dataclasses.replace(padded)  # passes the checks
    assert again.padded(9).times.shape == (9,)
    with pytest.raises(ValueError, match="knots: must be at least the 3"):
        schedule.padded(2)
    assert Constant(1.0).padded(4)(0.0) == 1
