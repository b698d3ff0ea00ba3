"""Fits with priors and with robust losses: what statistics say."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from linear_fits import DESIGN, GUESS, TIMES, TRUTH, line, measured, normal_equations
from toy_fits import relative

from rodjax.fitting.bounds import Positive
from rodjax.fitting.fit import least_squares
from rodjax.fitting.fit_results import FitResult
from rodjax.fitting.observations import Observations
from rodjax.fitting.priors import LogNormalPrior, NormalPrior
from rodjax.fitting.robust import Huber, SoftL1

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
