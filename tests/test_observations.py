"""Observations, and the centreline of a run at their times."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import UNIT_SECTION, order_of, random_arrays

from rodjax.dynamics.run import Run
from rodjax.dynamics.stepping import StepInfo
from rodjax.fitting.observations import Observations, positions_at
from rodjax.rods.builders import straight_rod
from rodjax.rods.state import State

ROD = straight_rod(1.0, 4, UNIT_SECTION)
TIMES = jnp.array([0.0, 0.7, 1.0, 2.5])
COEFFICIENTS = jnp.stack(random_arrays(3, *[(5, 3)] * 4))


def run_of(times, motion):
    """A run whose nodes move as `motion(time)`."""

    def state(time):
        position, velocity = jax.jvp(motion, (time,), (jnp.ones_like(time),))
        rate = jnp.concatenate([velocity, jnp.zeros_like(velocity)], 1)
        force = jnp.zeros((ROD.elements, 3))
        return State(time, position, ROD.quaternion, rate, 0 * rate, 0 * rate, force)

    infos = StepInfo(*[jnp.zeros(len(times) - 1)] * len(StepInfo._fields))
    zero = jnp.asarray(0, jnp.int32)
    return Run(jax.jit(jax.vmap(state))(jnp.asarray(times)), infos, zero, zero, zero)


def cubic(time):
    a, b, c, d = COEFFICIENTS
    return a + time * (b + time * (c + time * d))


def test_positions_are_exact_for_a_cubic_motion():
    """Between, on and at the ends of the saved times; the derivative in time is the velocity."""
    run = run_of(TIMES, cubic)
    times = jnp.array([0.0, 0.1, 0.7, 0.93, 2.0, 2.5])
    found = jax.jit(positions_at)(run, times)
    np.testing.assert_allclose(found, jax.vmap(cubic)(times), rtol=0, atol=1e-12)
    np.testing.assert_allclose(positions_at(run, TIMES), run.states.position, rtol=0, atol=1e-13)
    inner = times[jnp.array([1, 3, 4])]
    _, slope = jax.jit(lambda t: jax.jvp(lambda t: positions_at(run, t), (t,), (0 * t + 1,)))(inner)
    np.testing.assert_allclose(slope, jax.vmap(jax.jacfwd(cubic))(inner), rtol=0, atol=1e-12)


def test_positions_are_of_fourth_order():
    motion = lambda t: jnp.sin(t + COEFFICIENTS[0])
    times, errors = jnp.linspace(0.0, 3.0, 77), []
    sizes = (10, 20, 40)
    for count in sizes:
        found = jax.jit(positions_at)(run_of(np.linspace(0, 3, count + 1), motion), times)
        errors.append(np.max(np.abs(found - jax.vmap(motion)(times))))
    assert order_of([1 / n for n in sizes], errors) == pytest.approx(4, abs=0.2)


def test_positions_are_differentiable_in_the_run():
    """Linear in positions and velocities, smooth in the saved times: against differences."""
    run = run_of(TIMES, cubic)
    times = jnp.array([0.05, 0.9, 2.0])
    where = lambda s: (s.time, s.position, s.rate)
    changes = random_arrays(0, *[leaf.shape for leaf in where(run.states)])
    direction = eqx.tree_at(where, jax.tree.map(np.zeros_like, run.states), changes)

    @jax.jit
    def moved(size):
        states = jax.tree.map(lambda a, b: a + size * b, run.states, direction)
        return positions_at(eqx.tree_at(lambda r: r.states, run, states), times)

    step = 1e-5
    slope = jax.jit(jax.jacfwd(moved))(0.0)
    by_hand = (moved(step) - moved(-step)) / (2 * step)
    np.testing.assert_allclose(slope, by_hand, rtol=1e-6, atol=1e-6)
    weights = jnp.cos(jnp.arange(slope.size)).reshape(slope.shape)
    reverse = jax.jit(jax.grad(lambda size: jnp.sum(weights * moved(size))))(0.0)
    assert reverse == pytest.approx(float(jnp.sum(weights * slope)), rel=1e-12)


@pytest.mark.parametrize("time", [-0.01, 2.51])
def test_times_outside_the_run(time):
    """An error; in traced code NaN there, and nowhere else."""
    run = run_of(TIMES, cubic)
    times = jnp.array([0.5, time])
    with pytest.raises(ValueError, match=rf"times: {time:g} lies outside the run, from 0 to 2.5"):
        positions_at(run, times)
    found = jax.jit(positions_at)(run, times)
    np.testing.assert_allclose(found[0], cubic(0.5), atol=1e-12)
    assert np.all(np.isnan(found[1]))


def test_a_run_that_failed():
    """It repeats its last good state: good up to there, NaN after it, and finite derivatives."""
    good = run_of(TIMES, cubic)
    kept = jnp.array([0, 1, 2, 2])
    failed = eqx.tree_at(lambda r: r.states, good, jax.tree.map(lambda x: x[kept], good.states))
    times = jnp.array([0.3, 1.0, 1.2])
    with pytest.raises(ValueError, match=r"1.2 lies outside the run, from 0 to 1$"):
        positions_at(failed, times)
    found = jax.jit(positions_at)(failed, times)
    np.testing.assert_allclose(found[:2], jax.vmap(cubic)(times[:2]), atol=1e-12)
    assert np.all(np.isnan(found[2]))
    gradient = jax.grad(lambda states: jnp.nansum(positions_at(_with(failed, states), times)))
    found = jax.jit(gradient)(failed.states)
    assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves(found))


def _with(run, states):
    return eqx.tree_at(lambda r: r.states, run, states)


def test_residuals():
    """Divided by the deviation where it is stated; the first time of a mark."""
    values = np.arange(6.0).reshape(3, 2)
    plain = Observations([0, 1, 3], values)
    np.testing.assert_array_equal(plain.residuals(jnp.asarray(values + 1)), np.ones(6))
    for deviation in (0.5, [0.5, 0.5], np.full((3, 2), 0.5)):
        weighted = Observations([0, 1, 3], values, deviation)
        np.testing.assert_array_equal(weighted.residuals(jnp.asarray(values + 1)), np.full(6, 2.0))
    assert plain.first_time(np.array([0, 0, 0, 0, 1, 1], bool)) == 3
    with pytest.raises(ValueError, match=r"predict: expected shape \(3, 2\).*got \(3,\)"):
        plain.residuals(jnp.ones(3))


def test_missing_samples_leave_derivatives_finite():
    """Whatever stands in their place: no value, no deviation, no prediction."""
    observed = Observations([0.0, 1.0, 2.0], [1.0, np.nan, 2.0], [0.1, 0.0, 0.2])
    predicted = jnp.asarray([1.5, jnp.nan, 2.5])
    loss = lambda prediction, seen: jnp.sum(seen.residuals(prediction) ** 2)
    slope, of_data = jax.grad(loss, (0, 1), allow_int=True)(predicted, observed)
    np.testing.assert_allclose(slope, [100.0, 0.0, 25.0], rtol=1e-14)  # 2 (p - v) / deviation^2
    np.testing.assert_allclose(of_data.values, -slope, rtol=1e-14)
    # -2 (p - v)^2 / deviation^3
    np.testing.assert_allclose(of_data.deviation, [-500.0, 0.0, -62.5], rtol=1e-14)
    forward = jax.jvp(lambda x: loss(x, observed), (predicted,), (jnp.ones(3),))
    np.testing.assert_allclose(forward, [25.0 + 6.25, 125.0], rtol=1e-14)


@pytest.mark.parametrize(
    ("times", "values", "deviation", "message"),
    [
        ([0.0, 0.0], [1.0, 2.0], None, "times: must be finite and strictly increasing"),
        ([0.0, np.nan], [1.0, 2.0], None, "times: must be finite"),
        ([0.0, 1.0], [1.0, 2.0, 3.0], None, r"values: expected 2 .* got shape \(3,\)"),
        ([0.0, 1.5], [[1.0], [np.inf]], None, "values: not finite at time 1.5"),
        ([0.0, 1.0], [1.0, 2.0], 0.0, "deviation: must be positive"),
        ([0.0, 1.0], [1.0, 2.0], [1.0, np.inf], "deviation: must be positive and finite"),
        ([0.0, 1.0], [1.0, 2.0], np.ones(3), r"deviation: shape \(3,\) does not broadcast"),
        ([0.0, 1.0], [1.0, 2.0], np.ones((2, 2)), r"deviation: shape \(2, 2\) does not"),
    ],
)
def test_bad_observations(times, values, deviation, message):
    with pytest.raises(ValueError, match=message):
        Observations(times, values, deviation)
