"""Fits of data with gaps, of fixed parameters, with priors, with outliers: what statistics say."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from helpers import UNIT_SECTION

from rodjax.bounds import Fixed, Interval, Positive
from rodjax.descent import minimize
from rodjax.fit import least_squares, several_starts
from rodjax.fit_results import FitError, FitResult
from rodjax.observations import Observations, positions_at
from rodjax.priors import LogNormalPrior, NormalPrior
from rodjax.results import ModelWarning
from rodjax.robust import Huber, SoftL1
from rodjax.rod import straight_rod
from rodjax.run import Run
from rodjax.state import State
from rodjax.stepping import no_info

COUNT = 12


def bare(function):
    """The function as users have it, without the checks of types that the tests add."""
    return getattr(function, "__wrapped__", function)


DESIGN = jnp.asarray(np.random.default_rng(1).normal(size=(COUNT, 2, 3)) * [1.0, 50.0, 0.1])
TRUTH = np.array([1.0, -0.2, 30.0])
GUESS = jnp.array([3.0, 1.0, 1.0])
TIMES = np.arange(float(COUNT))


def line(p):
    return DESIGN @ p


def measured(seed, deviation=0.5):
    noise = np.random.default_rng(seed).normal(size=(COUNT, 2))
    return np.asarray(line(TRUTH)) + deviation * noise


def normal_equations(rows, values, deviation):
    """Solution, covariance and chi squared of a linear problem."""
    rows, values = rows / deviation, values / deviation
    covariance = np.linalg.inv(rows.T @ rows)
    solution = covariance @ rows.T @ values
    return solution, covariance, np.sum((rows @ solution - values) ** 2)


def relative(found, expected):
    return np.max(np.abs(np.asarray(found) / np.asarray(expected) - 1))


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
    at = lambda t: jnp.einsum("k,knj->nj", jnp.asarray(t) ** jnp.arange(4), powers)
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


# Priors

MEAN, SPREAD = np.array([0.9, -0.21, 25.0]), np.array([0.05, 0.4, 2.0])


def test_posterior_of_a_linear_model():
    """Mean and covariance of the exact Gaussian posterior; its chi squared in two parts."""
    values, prior = measured(0), NormalPrior(MEAN, SPREAD)
    rows = np.concatenate([np.asarray(DESIGN).reshape(-1, 3), np.eye(3)])
    deviation = np.concatenate([np.full(24, 0.5), SPREAD])
    data = np.concatenate([values.ravel(), MEAN])
    solution, covariance, squares = normal_equations(
        rows / deviation[:, None], data / deviation, 1.0
    )
    found = least_squares(line, GUESS, Observations(TIMES, values, 0.5), priors=prior)
    assert found.result == FitResult.CONVERGED
    assert relative(found.parameters, solution) < 1e-7
    assert relative(found.covariance, covariance) < 1e-8
    assert found.chi_squared == pytest.approx(squares, rel=1e-10)
    expected = np.sum(((np.asarray(found.parameters) - MEAN) / SPREAD) ** 2)
    assert found.prior_chi_squared == pytest.approx(expected, rel=1e-8)
    assert found.freedom == 24 and found.residuals.shape == (12, 2)
    informed = np.trace(rows[:24] @ covariance @ rows[:24].T) / 0.25
    assert found.data_freedom == pytest.approx(24 - informed, rel=1e-8)


def test_a_prior_determines_what_the_data_do_not():
    """Only a product is seen: with a prior of the one the other is known as well."""
    predict = lambda p: p["a"] * p["b"] * jnp.exp(-0.3 * TIMES)
    data = Observations(TIMES, predict({"a": 2.0, "b": 3.0}), 0.01)
    priors = {"a": LogNormalPrior(2.0, 0.1), "b": None}
    guess = {"a": 1.0, "b": 1.0}
    found = least_squares(predict, guess, data, bounds=Positive(), priors=priors)
    assert not found.undetermined
    assert found.parameters["a"] == pytest.approx(2.0, rel=1e-7)
    assert found.parameters["b"] == pytest.approx(3.0, rel=1e-7)
    assert found.deviations["a"] == pytest.approx(0.2, rel=1e-6)
    product = 0.01 / np.sqrt(np.sum(np.exp(-0.6 * TIMES)))
    expected = 3.0 * np.hypot(0.1, product / 6.0)
    assert found.deviations["b"] == pytest.approx(expected, rel=1e-6)
    # fewer data than unknowns: the prior is one of them
    one = Observations([0.0], [6.0], 0.01)
    few = least_squares(lambda p: predict(p)[:1], guess, one, bounds=Positive(), priors=priors)
    assert few.parameters["b"] == pytest.approx(3.0, rel=1e-6) and few.freedom == 0


@pytest.mark.parametrize(
    ("priors", "message"),
    [
        (1.0, "priors: expected priors or None, got 1.0"),
        (NormalPrior, "priors: NormalPrior is a class; give NormalPrior"),
        ({"a": None}, "priors: not a prefix"),
        (NormalPrior(np.zeros(2), 1.0), "which do not broadcast to the parameter's"),
        (LogNormalPrior(1.0, 1.0), "is not finite at the guess"),
    ],
)
def test_bad_priors(priors, message):
    guess = jnp.array([1.0, -1.0, 1.0])
    with pytest.raises(ValueError, match=message):
        least_squares(line, guess, Observations(TIMES, measured(0), 0.5), priors=priors)


def test_priors_and_robust_losses_need_a_deviation():
    data = Observations(TIMES, measured(0))
    with pytest.raises(ValueError, match="priors: only with the `deviation`"):
        least_squares(line, GUESS, data, priors=NormalPrior(MEAN, SPREAD))
    with pytest.raises(ValueError, match="robust: only with the `deviation`"):
        least_squares(line, GUESS, data, robust=Huber())


@pytest.mark.parametrize(
    "make",
    [
        lambda: NormalPrior(0.0, 0.0),
        lambda: NormalPrior(np.nan, 1.0),
        lambda: LogNormalPrior(-1.0, 1.0),
        lambda: LogNormalPrior(1.0, np.inf),
        lambda: Huber(0.0),
        lambda: Huber(np.nan),
        lambda: SoftL1(-1.0),
    ],
)
def test_bad_numbers_of_priors_and_losses(make):
    with pytest.raises(ValueError, match="(mean|deviation|median|scale): must be"):
        make()


# Robust losses

LOSSES = {"huber": Huber(), "soft": SoftL1()}


@pytest.mark.parametrize("name", LOSSES)
def test_losses(name):
    """Squares when small, linear when large, and what is fitted has them as its squares."""
    r = jnp.linspace(-8.0, 8.0, 33)
    loss, k = LOSSES[name], float(LOSSES[name].scale)
    rho = {
        "huber": np.where(abs(r) < k, r**2, 2 * k * abs(r) - k**2),
        "soft": 2 * k**2 * (np.sqrt(1 + (r / k) ** 2) - 1),
    }[name]
    np.testing.assert_allclose(loss.shrunk(r) ** 2, rho, atol=1e-13)
    pull = {"huber": np.clip(r, -k, k), "soft": r / np.sqrt(1 + (r / k) ** 2)}[name]
    np.testing.assert_allclose(loss.influence(r), pull, atol=1e-13)
    weights = np.asarray(loss.weights(r))
    assert weights[16] == 1
    np.testing.assert_allclose(weights * r, pull, atol=1e-13)
    assert np.all(np.isfinite(jax.vmap(jax.grad(loss.influence))(r)))


@pytest.mark.parametrize("name", LOSSES)
def test_a_robust_location(name):
    """The solution has no pull left, and no outlier, however far, moves it further.

    (To a thousandth of a deviation: the loss is flat, and the fit ends when it falls no more.)
    """
    values = np.array([0.1, -0.3, 0.2, 0.4, -0.1, 0.0, 0.25, -0.2, 50.0])
    predict = lambda p: p * jnp.ones(9)
    fit = lambda last: least_squares(
        predict, 1.0, Observations(np.arange(9), np.array([*values[:-1], last]), 0.2),
        robust=LOSSES[name],
    )  # fmt: skip
    found = fit(50.0)
    assert found.result in (FitResult.CONVERGED, FitResult.SETTLED)
    pull = LOSSES[name].influence(jnp.asarray(found.residuals / 0.2))
    assert abs(float(jnp.sum(pull))) < 1e-3
    assert abs(found.parameters - fit(5e3).parameters) < 2e-3
    plain = least_squares(predict, 1.0, Observations(np.arange(9), values, 0.2))
    assert abs(found.parameters) < 0.15 < 5 < plain.parameters
    assert found.weights[-1] < 0.01 and np.min(found.weights[:-1]) > 0.4
    squares = LOSSES[name].shrunk(jnp.asarray(found.residuals / 0.2)) ** 2
    assert found.chi_squared == pytest.approx(float(jnp.sum(squares)), rel=1e-9)


def test_without_outliers_a_wide_loss_is_least_squares():
    data = Observations(TIMES, measured(0), 0.5)
    plain = least_squares(line, GUESS, data)
    found = least_squares(line, GUESS, data, robust=Huber(100.0))
    assert relative(found.parameters, plain.parameters) < 1e-7
    assert found.chi_squared == pytest.approx(plain.chi_squared, rel=1e-12)
    estimated = plain.covariance * plain.reduced  # from the residuals' scatter
    assert relative(found.covariance, estimated) < 1e-8


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["plain", "gaps", "huber", "soft", "prior"])
def test_coverage_of_the_deviations(kind):
    """Truth within one and two deviations in 68.3 and 95.4 % of 60 data sets, within 3 sigma.

    With a tenth of the data wrong by ten deviations for the robust losses, and with the truth
    drawn from the prior where there is one.
    """
    generator = np.random.default_rng(7)
    off, sets = [], 60
    for seed in range(sets):
        truth, options, deviation = TRUTH, {}, 0.5
        if kind == "prior":
            truth = MEAN + SPREAD * generator.normal(size=3)
            options["priors"] = NormalPrior(MEAN, SPREAD)
        values = np.asarray(line(truth)) + measured(seed) - np.asarray(line(TRUTH))
        if kind == "gaps":
            values[generator.random(values.shape) < 0.3] = np.nan
        if kind in LOSSES:
            options["robust"] = LOSSES[kind]
            sign = generator.choice([-1.0, 1.0], values.shape)
            values += 10 * deviation * sign * (generator.random(values.shape) < 0.1)
        found = least_squares(line, GUESS, Observations(TIMES, values, deviation), **options)
        off.append((np.asarray(found.parameters) - truth) / np.asarray(found.deviations))
    off = np.abs(np.array(off))
    for size, part in ((1.0, 0.683), (2.0, 0.954)):
        spread = 3 * np.sqrt(part * (1 - part) / sets)
        slack = 0.04 if kind in LOSSES else 0.0  # of 24 data the scatter itself is not well known
        assert np.all(np.abs(np.mean(off < size, 0) - part) < spread + slack), (kind, size)


# Descent by L-BFGS, and settings


def valley(p):
    return (1 - p["x"]) ** 2 + 10 * (p["y"] - p["x"] ** 2) ** 2


def test_lbfgs_needs_few_steps():
    guess = {"x": -1.0, "y": 0.5}
    found = minimize(valley, guess, optimizer=optax.lbfgs(), max_steps=100, tolerance=1e-9)
    assert found.result == FitResult.CONVERGED and found.steps < 40
    np.testing.assert_allclose([float(v) for v in found.parameters.values()], 1, atol=1e-8)
    within = minimize(
        valley, {"x": 0.3, "y": 1.0}, bounds={"x": Interval(0.0, 0.8), "y": Positive()},
        optimizer=optax.lbfgs(), max_steps=60,
    )  # fmt: skip
    assert within.parameters["x"] == pytest.approx(0.8, abs=1e-3)
    assert within.parameters["y"] == pytest.approx(0.64, abs=2e-3)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"max_steps": -1}, "max_steps: must be a whole number"),
        ({"max_steps": 2.5}, "max_steps: must be a whole number"),
        ({"max_steps": True}, "max_steps: must be a whole number"),
        ({"tolerance": -1e-3}, "tolerance: must be a number"),
        ({"tolerance": np.nan}, "tolerance: must be a number"),
        ({"tolerance": "small"}, "tolerance: must be a number"),
        ({"threshold": 2.0}, "threshold: must be a number"),
        ({"progress": 3}, "progress: give True, False or a function"),
        ({"robust": "huber"}, "robust: give None, or rx.Huber"),
        ({"robust": Huber}, "robust: give None, or rx.Huber"),
        ({"bounds": Positive}, r"bounds: Positive is a class; give Positive\(...\)"),
        ({"predict": None}, "predict: give a function"),
        ({"predict": line(GUESS)}, "predict: give a function"),
        ({"observations": np.ones(3)}, "observations: give rx.Observations"),
        ({"guess": {"a": "x"}}, "guess: must hold real numbers .* a is 'x'"),
        ({"guess": {"a": 1j}}, "guess: must hold real numbers"),
        ({"guess": {"a": True}}, "guess: must hold real numbers"),
        ({"guess": np.array(["x"])}, "guess: must hold real numbers"),
        ({"guess": None}, "guess: it holds no parameter"),
        ({"bounds": Interval(np.zeros(2), np.ones(2)), "guess": 0.5 * GUESS}, "bounds: "),
    ],
)
def test_senseless_settings(change, message):
    given = {"predict": line, "guess": GUESS, "observations": Observations(TIMES, measured(0), 1.0)}
    given |= change
    run = lambda: bare(least_squares)(
        given.pop("predict"), given.pop("guess"), given.pop("observations"), **given
    )
    with pytest.raises(ValueError, match=message):
        run()


@pytest.mark.parametrize(
    ("loss", "change", "message"),
    [
        (1.0, {}, "loss: give a function"),
        (valley, {"optimizer": "lbfgs"}, "optimizer: give one of optax"),
        (valley, {"optimizer": optax.lbfgs}, "optimizer: give one of optax"),
        (valley, {"max_steps": None}, "max_steps: must be a whole number"),
        (valley, {"tolerance": [1e-3]}, "tolerance: must be a number"),
        (lambda p: jnp.stack([p["x"], p["y"]]), {}, "loss: must give one number"),
    ],
)
def test_senseless_settings_of_minimize(loss, change, message):
    with pytest.raises(ValueError, match=message):
        bare(minimize)(loss, {"x": 1.0, "y": 1.0}, **change)


def test_short_representations():
    data = Observations(TIMES, measured(0), 0.5)
    found = least_squares(line, GUESS, data)
    text = repr(found)
    assert text.startswith("Fit(CONVERGED: parameter[0] = ") and "\n" not in text
    assert " +- " in text and "degrees of freedom 21)" in text
    starts = several_starts(line, jnp.stack([GUESS] * 3), data)
    assert repr(starts).startswith("Starts(chi squared ") and "of 3 starts; best=Fit(" in repr(
        starts
    )
    least = minimize(valley, {"x": -1.0, "y": 0.5}, max_steps=2)
    assert repr(least).startswith("Minimum(MAX_STEPS: loss ") and "x = " in repr(least)
    many = least_squares(lambda p: p, jnp.arange(9.0), Observations(np.arange(9), np.ones(9)))
    assert "(9 in all)" in repr(many)
