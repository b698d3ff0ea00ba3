"""Fits of data with gaps, of markers with their own times, and with fixed parameters."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import UNIT_SECTION
from linear_fits import COUNT, DESIGN, GUESS, TIMES, bare, line, measured, normal_equations
from toy_fits import relative

from rodjax.dynamics.run import Run
from rodjax.dynamics.stepping import no_info
from rodjax.fitting.bounds import Fixed
from rodjax.fitting.descent import minimize
from rodjax.fitting.fit import least_squares, several_starts
from rodjax.fitting.fit_results import FitError, FitResult
from rodjax.fitting.observations import Observations, positions_at
from rodjax.fitting.priors import NormalPrior
from rodjax.numerics.results import ModelWarning
from rodjax.rods.builders import straight_rod
from rodjax.rods.state import State

# Missing samples


GAPS = np.random.default_rng(5).random((COUNT, 2)) < 0.3


@pytest.mark.parametrize("stated", [None, 0.5, "each"])
@pytest.mark.parametrize("marked", ["nan", "mask", "both"])
def test_missing_samples_take_no_part(stated, marked):
    """Solution, covariance, chi squared and freedom are those of the samples that are there."""
    values, present = measured(0), None
    deviation = np.where(GAPS, np.nan, 0.5) if stated == "each" else stated
    some = GAPS if marked == "nan" else GAPS & (np.arange(COUNT) < 6)[:, None]
    if marked != "mask":
        values = np.where(some, np.nan, values)
    if marked != "nan":
        values = np.where(GAPS & ~some, 1e3, values) if marked == "both" else values
        present = ~GAPS
    here = ~GAPS.ravel()
    rows = np.asarray(DESIGN).reshape(-1, 3)[here]
    solution, covariance, squares = normal_equations(rows, values.ravel()[here], 0.5)
    freedom = int(np.sum(here)) - 3
    if stated is None:
        covariance = covariance * squares / freedom
        squares = 0.25 * squares
    predict = lambda p: jnp.where(GAPS, jnp.nan, line(p))  # a run that ended, a marker not there
    found = least_squares(predict, GUESS, Observations(TIMES, values, deviation, present))
    assert found.result == FitResult.CONVERGED and found.freedom == freedom
    assert relative(found.parameters, solution) < 1e-7
    assert relative(found.covariance, covariance) < 1e-8
    assert found.chi_squared == pytest.approx(squares, rel=1e-10)
    assert found.residual_deviation == pytest.approx(
        np.sqrt(np.nansum(found.residuals**2) / freedom)
    )
    np.testing.assert_array_equal(np.isnan(found.residuals), GAPS)
    np.testing.assert_array_equal(found.weights, np.where(GAPS, 0.0, 1.0))
    assert f"{np.sum(GAPS)} of 24 samples are missing" in str(found)


def test_what_is_there_must_be_predicted():
    values = np.where(GAPS, np.nan, measured(0))
    first = int(np.argmax(~GAPS.all(1)))
    with pytest.raises(FitError, match=f"prediction is not finite at time {first}"):
        least_squares(lambda p: jnp.nan * line(p), GUESS, Observations(TIMES, values))


def test_missing_samples_are_not_data():
    """Two values for three unknowns."""
    values = np.where(np.arange(24).reshape(12, 2) < 2, measured(0), np.nan)
    with pytest.raises(FitError, match="2 data cannot determine the 3 unknowns"):
        least_squares(line, GUESS, Observations(TIMES, values))


def test_a_deviation_for_what_is_missing_is_questioned():
    values = np.nan_to_num(np.where(GAPS, np.nan, measured(0)))
    with pytest.warns(ModelWarning, match="mark missing samples by NaN"):
        Observations(TIMES, values, np.where(GAPS, 1e6, 0.5))
    with pytest.raises(ValueError, match="deviation: must be positive .* NaN among the values"):
        Observations(TIMES, values, np.where(GAPS, np.inf, 0.5))


# Own times


STEPS = np.linspace(0.0, 2.0, 9)


def cubic_run():
    """Nodes that move as cubics in time, which `positions_at` follows exactly."""
    rod = straight_rod(1.0, 3, UNIT_SECTION)
    powers = jnp.asarray(np.random.default_rng(2).normal(size=(4, 4, 3)))
    at = lambda t: jnp.einsum("k,knj->nj", jnp.stack([t**k for k in range(4)]), powers)
    zero = jnp.zeros((4, 6))

    def state(t):
        place, velocity = jax.jvp(at, (t,), (jnp.ones(()),))
        rate = zero.at[:, :3].set(velocity)
        return State(t, place, rod.quaternion, rate, zero, zero, jnp.zeros((3, 3)))

    none = jnp.asarray(0, jnp.int32)
    run = Run(jax.vmap(state)(jnp.asarray(STEPS)), no_info(jnp.float64), none, none, none)
    return run, at


def test_every_marker_has_its_own_times():
    run, at = cubic_run()
    nodes = [2, -1, 0]
    times = jnp.asarray(np.sort(np.random.default_rng(3).uniform(0, 2, (5, 3)), 0))
    found = positions_at(run, times, nodes)
    for k in range(5):
        for m, node in enumerate(nodes):
            np.testing.assert_allclose(found[k, m], at(times[k, m])[node], atol=1e-12)
    same = positions_at(run, times[:, 0])
    np.testing.assert_allclose(same[:, 2], found[:, 0], atol=1e-14)
    np.testing.assert_array_equal(positions_at(run, times[:, 0], nodes), same[:, np.array(nodes)])
    data = Observations(times, found + 0.01, 0.02)
    fit = least_squares(lambda p: positions_at(run, times + p, nodes), 0.1, data)
    assert abs(fit.parameters) < 0.05 and fit.freedom == 44
    assert data.first_time(np.arange(45) // 9 == 2) == np.min(times[2])


@pytest.mark.parametrize(
    ("times", "nodes", "message"),
    [
        (np.ones((5, 2)), [0, 1, 2], r"times: must have shape \(k,\), or \(k, 3\)"),
        (np.ones((5, 2)), None, r"or \(k, 4\)"),
        (np.ones(()), None, "times: must have shape"),
        (np.ones(2), [4], "nodes: must be among the 4"),
        (np.ones(2), [-5], "nodes: must be among the 4"),
        (np.ones(2), [1.0], "nodes: give the numbers"),
        (np.ones(2), 1, "nodes: give the numbers"),
        (np.full((5, 4), 2.5), None, "times: 2.5 lies outside the run"),
    ],
)
def test_bad_times_and_nodes(times, nodes, message):
    with pytest.raises(ValueError, match=message):
        bare(positions_at)(cubic_run()[0], times, nodes)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((1.0, [1.0]), "values: expected at least one time"),
        (([], np.zeros((0, 2))), "values: expected 0|values: expected at least"),
        (([0.0, 1.0], [np.nan, np.nan]), "values: every sample is missing"),
        (([0.0, 1.0], [1.0, 2.0], None, [1, 0]), "present: give truth values"),
        (([0.0, 1.0], [1.0, 2.0], None, [True]), None),
        (([0.0, 1.0], [1.0, 2.0], None, [True] * 3), r"present: shape \(3,\) does not broadcast"),
        (([0.0, 1.0], [1.0, 2.0], None, [False, False]), "every sample is missing"),
        (([[0.0, 1.0], [1.0, 1.0]], np.ones((2, 2))), "times: must be finite and strictly"),
        (([[0.0, 1.0], [1.0, 2.0]], np.ones((2, 3))), "values: expected 2"),
    ],
)
def test_bad_observations(arguments, message):
    if message is None:
        assert Observations(*arguments).count == 2
        return
    with pytest.raises(ValueError, match=message):
        Observations(*arguments)


# Fixed parameters


@pytest.mark.slow
def test_fixed_parameters_are_no_unknowns():
    """As if they were constants of the model; another value needs no compilation."""
    data = Observations(TIMES, measured(0), 0.5)
    traces = []

    def split(p):
        traces.append(1)
        return line(jnp.concatenate([p["first"], p["rest"]]))

    bounds = {"first": Fixed(), "rest": None}
    for first in (1.0, 0.7):
        guess = {"first": jnp.array([first]), "rest": GUESS[1:]}
        found = least_squares(split, guess, data, bounds=bounds)
        alone = least_squares(lambda p, f=first: line(jnp.array([f, *p])), GUESS[1:], data)
        assert found.parameters["first"] == first and found.deviations["first"] == 0
        assert relative(found.parameters["rest"], alone.parameters) < 1e-9
        assert relative(found.covariance, alone.covariance) < 1e-9
        assert found.names == ("rest[0]", "rest[1]") and found.freedom == 22
        assert found.fixed == ("first[0]",)
        assert f"first[0]  {first:<12.6g}  fixed" in str(found)
    assert len(traces) <= 2
    starts = {"first": jnp.ones((3, 1)), "rest": jnp.stack([GUESS[1:]] * 3)}
    several = several_starts(split, starts, data, bounds=bounds)
    assert several.best.fixed == ("first[0]",) and several.best.parameters["first"] == 1
    with pytest.raises(ValueError, match="guesses: what is fixed must be the same"):
        several_starts(split, starts | {"first": jnp.arange(3.0)[:, None]}, data, bounds=bounds)
    least = minimize(lambda p: jnp.sum((split(p) - data.values) ** 2), guess, bounds=bounds)
    assert least.parameters["first"] == 0.7
    with pytest.raises(ValueError, match="bounds: every parameter is fixed"):
        least_squares(split, guess, data, bounds=Fixed())
    with pytest.raises(ValueError, match="priors: first.0. is fixed"):
        least_squares(
            split, guess, data, bounds=bounds, priors={"first": NormalPrior(1, 1), "rest": None}
        )
