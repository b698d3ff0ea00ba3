"""Measures on configurations whose values are known, and event times on synthetic samples."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import UNIT_SECTION, order_of

from rodjax import measures, rotations
from rodjax.constraints.ends import Clamped, Slider, Turn
from rodjax.dynamics.run import Run
from rodjax.dynamics.stepping import StepInfo
from rodjax.inputs.schedules import PiecewiseLinear
from rodjax.interactions.loads import LinearDrag
from rodjax.rods import builders
from rodjax.rods.section import Section
from rodjax.rods.state import State
from rodjax.scenes.scene import Scene

AXIS = jnp.array([0.0, 0.0, 1.0])
LENGTH = 2.0


def state_of(a_rod, position=None, quaternion=None, time=0.0):
    """A state at rest; the rod's own placing by default."""
    still = jnp.zeros((a_rod.elements + 1, 6))
    return State(
        jnp.asarray(time),
        a_rod.position if position is None else position,
        a_rod.quaternion if quaternion is None else quaternion,
        still,
        still,
        still,
        jnp.zeros((a_rod.elements, 3)),
    )


def straight(elements=16, section=UNIT_SECTION):
    return builders.straight_rod(LENGTH, elements, section)


def twisted(a_rod, turns, time=0.0):
    """A straight rod twisted uniformly, the end s = 0 by -turns about its tangent."""
    angle = 2 * jnp.pi * turns * (a_rod.arc_length / a_rod.arc_length[-1] - 1)
    spin = rotations.exponential(angle[:, None] * AXIS[None])
    return state_of(a_rod, quaternion=rotations.multiply(a_rod.quaternion, spin), time=time)


def helix(elements, turns=2.0, radius=0.1):
    """A helix about e3 with frames carried along without twist at rest."""
    rate = 2 * np.pi * turns / LENGTH
    climb = np.sqrt(1 - (radius * rate) ** 2)
    curve = lambda s: np.array(
        [radius * (np.cos(rate * s) - 1), radius * np.sin(rate * s), climb * s]
    )
    return builders.curved_rod(curve, LENGTH, elements, UNIT_SECTION)


def scene_of(a_rod, turns, *, second=0.0):
    """Ends turned by -turns and +second times t about their tangents."""
    ramp = lambda total: Turn(AXIS, PiecewiseLinear([0.0, 1.0], [0.0, 2 * np.pi * total]))
    return Scene(a_rod, Clamped(rotation=ramp(-turns)), Slider(AXIS, rotation=ramp(second)))


def test_twist_of_a_straight_rod_is_the_turns_of_its_end():
    """Positive for -turns at s = 0, in both forms; no writhe."""
    a_rod = straight()
    state = twisted(a_rod, 3.25)
    assert measures.twist(state) == pytest.approx(3.25, rel=1e-13)
    assert measures.twist_eq15(a_rod, state) == pytest.approx(3.25, rel=1e-13)
    assert measures.writhe(state) == pytest.approx(0, abs=1e-14)


def test_eq15_agrees_with_the_twist_of_the_polygon_to_second_order():
    """A helix whose frame turns about its tangent: the difference falls as ds^2."""
    differences = []
    sizes = (16, 32, 64)
    both = jax.jit(lambda a_rod, s: measures.twist(s) - measures.twist_eq15(a_rod, s))
    for elements in sizes:
        a_rod = helix(elements)
        spin = rotations.exponential(5.0 * a_rod.arc_length[:, None] * AXIS[None])
        state = state_of(a_rod, quaternion=rotations.multiply(a_rod.quaternion, spin))
        differences.append(abs(float(both(a_rod, state))))
    assert differences[-1] > 1e-6
    assert order_of([1 / n for n in sizes], differences) == pytest.approx(2, abs=0.2)


def test_writhe_takes_the_tangents_of_the_end_frames():
    """A right-handed helix is positive; turning an end's frame away changes the writhe."""
    state = state_of(helix(48))
    writhe = measures.writhe(state)
    assert 0.05 < writhe < 2
    tilt = rotations.exponential(jnp.array([0.3, 0.0, 0.0]))
    frames = state.quaternion.at[-1].set(rotations.multiply(state.quaternion[-1], tilt))
    tilted = eqx.tree_at(lambda s: s.quaternion, state, frames)
    assert abs(measures.writhe(tilted) - writhe) > 1e-3


def test_turns_of_both_drives():
    """-turns at s = 0 and turns at s = L both count positive, from the start given."""
    scene = scene_of(straight(), 3.0, second=0.5)
    assert measures.turns(scene, 1.0) == pytest.approx(3.5, rel=1e-14)
    assert measures.turns(scene, 1.0, 0.5) == pytest.approx(1.75, rel=1e-14)
    assert jax.jit(measures.turns)(scene, 0.5) == pytest.approx(1.75, rel=1e-14)
    against = Clamped(rotation=Turn(-AXIS, PiecewiseLinear([0.0, 1.0], [0.0, 2 * np.pi])))
    assert measures.turns(Scene(straight(), against), 1.0) == pytest.approx(1, rel=1e-14)
    assert measures.turns(Scene(straight()), 1.0) == 0


def test_turns_refuse_a_drive_across_the_tangent():
    drive = Turn((1.0, 0.0, 1.0), PiecewiseLinear([0.0, 1.0], [0.0, 1.0]))
    with pytest.raises(ValueError, match=r"last_end.rotation: .*45 degrees"):
        measures.turns(Scene(straight(), Clamped(), Clamped(rotation=drive)), 1.0)


def run_of(states):
    zero = jnp.asarray(0, jnp.int32)
    infos = StepInfo(*[jnp.zeros(len(states) - 1)] * len(StepInfo._fields))
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *states)
    return Run(stacked, infos, zero, zero, zero)


def test_linking_along_a_run():
    """The error is zero while turns go into twist, and shows what is lost when they do not."""
    a_rod = straight()
    offset = 0.4  # turns that were there before the run
    followed = [twisted(a_rod, offset + 3.0 * t, t) for t in (0.0, 0.3, 0.6)]
    slipped = twisted(a_rod, offset + 3.0 - 2.0, 1.0)
    found = measures.linking(scene_of(a_rod, 3.0), run_of([*followed, slipped]))
    np.testing.assert_allclose(found.turns, [0, 0.9, 1.8, 3.0], atol=1e-13)
    np.testing.assert_allclose(found.twist, [0.4, 1.3, 2.2, 1.4], atol=1e-12)
    np.testing.assert_allclose(found.twist_eq15, found.twist, atol=1e-12)
    np.testing.assert_allclose(found.error, [0, 0, 0, -2.0], atol=1e-12)


def test_stretch_error_counts_what_compliance_does_not_explain():
    """0.02 too long without compliance; explained by the force with it."""
    plain, elastic = straight(), straight(16, Section((1.0, 1.0, 1.0), 1.0, None, (0, 0, 0.01)))
    longer = plain.position * 1.02
    assert measures.stretch_error(plain, state_of(plain)) < 1e-14
    assert measures.stretch_error(plain, state_of(plain, longer)) == pytest.approx(0.02)
    stretched = state_of(elastic, longer)
    pulled = eqx.tree_at(lambda s: s.force, stretched, stretched.force.at[:, 2].set(2.0))
    assert measures.stretch_error(elastic, pulled) < 1e-14
    assert measures.stretch_error(elastic, stretched) == pytest.approx(0.02)


def loop(tilt, elements=40, shift=0.0):
    """A parabolic arch over e3 whose plane's tangent at the apex is turned by `tilt` about e1."""
    s = jnp.linspace(-1.0, 1.0, elements + 1)
    along = s + shift
    position = jnp.stack([2 - 2 * along**2, jnp.sin(tilt) * along, jnp.cos(tilt) * along], 1)
    tangent = jnp.stack(
        [-4 * along, jnp.sin(tilt) * jnp.ones_like(s), jnp.cos(tilt) * jnp.ones_like(s)], 1
    )
    tangent = tangent / jnp.linalg.norm(tangent, axis=1, keepdims=True)
    half = jnp.concatenate([1 + tangent[:, 2:], jnp.cross(AXIS, tangent)], 1)
    return state_of(straight(elements), position, rotations.normalize(half))


@pytest.mark.parametrize("part", [0.0, 0.26, -0.4])
def test_apex_of_an_arch(part):
    """A part of an element beside a node: index, place and tangent converge at third order."""
    errors = []
    for elements in (40, 80):
        state = loop(0.0, elements, 2 * part / elements)
        found = jax.jit(measures.apex)(state, AXIS, jnp.zeros(3))
        assert found.index == pytest.approx(elements / 2 - part, abs=1e-2)
        place = np.abs(found.position - jnp.array([2.0, 0, 0]))
        errors.append(float(np.max(np.abs(found.tangent - AXIS)) + np.max(place)))
    assert errors[0] < 3e-3
    assert errors[1] < errors[0] / 7 + 1e-12


def test_apex_angle_and_its_derivative():
    """The tilt of the arch; 90 degrees when it stands across the axis, beyond when it leans back.

    By symmetry the apex of the arch stays in its middle, at a node; beside it the derivative is
    compared with differences.
    """
    angle = jax.jit(lambda tilt: measures.apex_angle(loop(tilt), AXIS, jnp.zeros(3)))
    for tilt in (0.3, np.pi / 2, 2.0):
        assert angle(tilt) == pytest.approx(tilt, abs=1e-9)
        assert jax.grad(angle)(tilt) == pytest.approx(1, abs=1e-6)
    away = jax.jit(lambda tilt: measures.apex_angle(loop(tilt, shift=0.013), AXIS, jnp.zeros(3)))
    step = 1e-6
    differences = (away(0.8 + step) - away(0.8 - step)) / (2 * step)
    assert jax.grad(away)(0.8) == pytest.approx(float(differences), rel=1e-6)


def test_apex_of_a_straight_rod_is_finite():
    """No apex: the angle is zero and its derivative is finite."""
    state = state_of(straight())
    angle, slope = jax.value_and_grad(
        lambda q: measures.apex_angle(eqx.tree_at(lambda s: s.quaternion, state, q), AXIS)
    )(state.quaternion)
    assert angle == 0
    assert np.all(np.isfinite(slope))


def test_first_crossing_is_linear_between_samples():
    times = jnp.array([0.0, 1.0, 3.0, 4.0])
    values = jnp.array([-1.0, 0.5, 2.5, -3.0])
    crossing = jax.jit(measures.first_crossing)
    assert crossing(times, values, 1.5) == pytest.approx(2.0)
    assert crossing(times, values, 0.5) == pytest.approx(1.0)
    assert crossing(times, values, -2.0) == 0.0
    assert crossing(times, values, 2.6) == np.inf
    assert crossing(times, -values, 2.5) == pytest.approx(3 + 5 / 5.5)


@pytest.mark.parametrize("cubic", [False, True])
def test_first_crossing_and_its_derivatives(cubic):
    """sin reaches 0.6 at arcsin 0.6; near it with samples 0.01 apart; derivatives exact."""

    def crossing(level, speed, count):
        times = jnp.linspace(0.0, 3.0, count)
        values = jnp.sin(speed * times)
        rates = measures.slopes(times, values) if cubic else None
        return measures.first_crossing(times, values, level, rates)

    assert crossing(0.6, 1.0, 301) == pytest.approx(np.arcsin(0.6), abs=1e-6 if cubic else 1e-4)
    step = 1e-6
    by_level, by_speed = lambda x: crossing(x, 1.0, 301), lambda x: crossing(0.6, x, 301)
    for function, at in ((by_level, 0.6), (by_speed, 1.0)):
        found = jax.grad(function)(at)
        assert jax.jvp(function, (at,), (1.0,))[1] == pytest.approx(float(found), rel=1e-12)
        by_hand = (function(at + step) - function(at - step)) / (2 * step)
        assert found == pytest.approx(float(by_hand), rel=1e-6)
    assert jax.grad(crossing)(0.6, 1.0, 301) == pytest.approx(1 / 0.8, rel=1e-2)


def test_crossing_with_given_rates_is_exact_for_a_cubic():
    times = jnp.array([0.0, 0.7, 1.9, 3.0])
    values, rates = times**3 - times, 3 * times**2 - 1
    time = measures.first_crossing(times, values, 6.0, rates)
    assert time == pytest.approx(2.0, rel=1e-12)
    batch = jax.vmap(lambda level: measures.first_crossing(times, values, level, rates))
    levels = jnp.array([0.5, 6.0, 100.0, -9.0])
    found = batch(levels)
    np.testing.assert_allclose(found[:2] ** 3 - found[:2], levels[:2], rtol=1e-12)
    np.testing.assert_array_equal(found[2:], [np.inf, 0.0])
    gradient = jax.vmap(jax.grad(lambda v: measures.first_crossing(times, values, v, rates)))
    assert np.all(np.isfinite(gradient(levels)))


def test_slopes_are_exact_for_a_parabola():
    times = jnp.array([0.0, 0.4, 1.5, 1.7, 3.0])
    np.testing.assert_allclose(
        measures.slopes(times, 2 * times**2 - times), 4 * times - 1, atol=1e-12
    )


def test_time_of_maximum():
    """Exact for a parabola at uneven times; a sample's time at the ends or for repeated samples."""
    times = jnp.array([0.0, 0.4, 1.5, 1.7, 3.0])
    peak = jax.jit(lambda top: measures.time_of_maximum(times, 5 - (times - top) ** 2))
    assert peak(1.3) == pytest.approx(1.3, rel=1e-12)
    assert jax.grad(peak)(1.3) == pytest.approx(1, rel=1e-12)
    assert peak(9.0) == 3.0 and peak(-9.0) == 0.0
    assert np.isfinite(jax.grad(peak)(9.0))
    stopped = jnp.array([0.0, 1.0, 2.0, 2.0, 2.0])
    assert measures.time_of_maximum(stopped, jnp.array([0.0, 1.0, 3.0, 3.0, 3.0])) == 2.0


@pytest.mark.slow
def test_times_of_buckling_and_of_the_orthogonal_apex():
    """Torsional energy (t - 1.3)^2 below its peak; apex angle 0.6 t."""
    a_rod = straight(elements=8, section=Section((1.0, 1.0, 1.0)))
    scene = Scene(a_rod, loads=(LinearDrag(1.0, 1.0, 1.0),))
    times = (0.0, 0.5, 1.1, 1.6, 2.0)
    run = run_of([twisted(a_rod, np.sqrt(5 - (t - 1.3) ** 2), t) for t in times])
    assert measures.buckling_time(scene, run) == pytest.approx(1.3, rel=1e-10)
    arches = [eqx.tree_at(lambda s: s.time, loop(0.6 * t), jnp.asarray(t)) for t in (1.0, 2.0, 4.0)]
    origin = jnp.zeros(3)
    orthogonal = measures.apex_orthogonal_time(run_of(arches), AXIS, origin)
    assert orthogonal == pytest.approx(np.pi / 1.2, rel=1e-9)
    assert measures.apex_orthogonal_time(run_of(arches[:2]), AXIS, origin) == np.inf
