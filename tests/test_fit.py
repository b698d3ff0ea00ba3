"""Fits of toy models whose answers are known."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import slow
from toy_fits import BOUNDS, EXACT, GUESS, TIMES, TRUTH, decay, noisy, numbers, relative

from rodjax.constraints.ends import Clamped
from rodjax.dynamics.consistency import start
from rodjax.dynamics.fixed_rollout import rollout
from rodjax.fitting.bounds import Interval, Positive, Unbounded
from rodjax.fitting.descent import minimize
from rodjax.fitting.fit import least_squares, several_starts
from rodjax.fitting.fit_results import MESSAGES, FitResult
from rodjax.fitting.observations import Observations, positions_at
from rodjax.fitting.priors import LogNormalPrior, NormalPrior
from rodjax.fitting.robust import Huber
from rodjax.interactions.loads import LinearDrag
from rodjax.rods.builders import straight_rod
from rodjax.rods.section import Section
from rodjax.scenes.scene import Scene


def scaled_decay(p):
    return p["a"] * p["b"] ** 2 * jnp.exp(-p["k"] * TIMES)


# Values and deviations


@pytest.mark.parametrize("stated", [None, 0.3, "each"])
def test_a_linear_model(stated):
    """Solution and covariance of the normal equations, with noise stated or estimated."""
    generator = np.random.default_rng(1)
    matrix = generator.normal(size=(12, 2, 3)) * [1.0, 50.0, 0.1]
    values = matrix @ [1.0, -0.2, 30.0] + generator.normal(size=(12, 2))
    if stated == "each":
        stated = generator.uniform(0.2, 2.0, (12, 1))
    weight = np.broadcast_to(1.0 if stated is None else 1 / np.asarray(stated), (12, 2)).ravel()
    weighted, flat = weight[:, None] * matrix.reshape(24, 3), weight * values.ravel()
    expected, squares, *_ = np.linalg.lstsq(weighted, flat, rcond=None)
    covariance = np.linalg.inv(weighted.T @ weighted)
    if stated is None:
        covariance *= squares[0] / 21

    array = jnp.asarray(matrix)
    observations = Observations(np.arange(12.0), values, stated)
    found = least_squares(lambda p: array @ p, jnp.array([3.0, 1.0, 1.0]), observations)
    assert found.result == FitResult.CONVERGED
    assert relative(found.parameters, expected) < 1e-7
    assert relative(found.covariance, covariance) < 1e-9
    assert relative(found.deviations, np.sqrt(np.diag(covariance))) < 1e-9
    assert found.chi_squared == pytest.approx(squares[0], rel=1e-12)
    assert found.freedom == 21 and found.reduced == pytest.approx(squares[0] / 21)
    residuals = matrix @ expected - values
    np.testing.assert_allclose(found.residuals, residuals, atol=1e-6)
    assert found.residual_deviation == pytest.approx(np.sqrt(np.sum(residuals**2) / 21))
    assert len(found.determined) == 3 and not found.undetermined


def test_exact_data():
    """The truth to round-off, from afar; every cost is below the one before."""
    found = least_squares(decay, {"a": 30.0, "k": 0.05}, EXACT, bounds=BOUNDS)
    assert found.result == FitResult.CONVERGED
    assert relative(numbers(found.parameters), [2.0, 1.3]) < 1e-9
    assert found.names == ("a", "k") and found.labels == ("a/30", "log k")
    assert np.all(np.diff(found.history) < 0) and found.history[-1] == found.chi_squared
    assert found.steps == len(found.history) - 1 < found.evaluations


def test_deviations_do_not_depend_on_the_transform():
    """To first order: the same with other unknowns."""
    data, plain = noisy(), None
    for bounds in (None, {"a": Positive(), "k": Interval(0.0, 4.0)}, Unbounded(10.0)):
        found = least_squares(decay, GUESS, data, bounds=bounds)
        assert found.result == FitResult.CONVERGED
        plain = found if plain is None else plain
        assert relative(numbers(found.parameters), numbers(plain.parameters)) < 1e-6
        assert relative(found.covariance, plain.covariance) < 1e-5


def test_covariance_against_repeated_fits():
    """Scatter of fits to 60 data sets: 18 % is two deviations of it."""
    data = [noisy(seed, stated=0.02) for seed in range(60)]
    fits = [least_squares(decay, TRUTH, one, bounds=BOUNDS) for one in data]
    scatter = np.cov(np.array([numbers(f.parameters) for f in fits]).T)
    mean = np.mean([f.covariance for f in fits], 0)
    assert relative(np.sqrt(np.diag(scatter)), np.sqrt(np.diag(mean))) < 0.18
    correlation = lambda c: c[0, 1] / np.sqrt(c[0, 0] * c[1, 1])
    assert correlation(scatter) == pytest.approx(correlation(mean), abs=0.16)
    assert np.mean([f.reduced for f in fits]) == pytest.approx(1, abs=0.1)


def test_as_many_data_as_unknowns():
    """Noise that is not stated cannot be estimated."""
    predict = lambda p: p["a"] * jnp.exp(-p["k"] * jnp.array([0.0, 1.0]))
    for stated, known in ((None, False), (0.1, True)):
        data = Observations([0.0, 1.0], [2.0, 0.5], stated)
        found = least_squares(predict, GUESS, data)
        assert relative(numbers(found.parameters), [2.0, np.log(4)]) < 1e-9
        assert np.isnan(found.reduced) and np.isnan(found.residual_deviation)
        assert np.all(np.isfinite(numbers(found.deviations)) == known)


def test_every_result_has_a_message():
    assert set(MESSAGES) == set(FitResult)


# What the data do not determine


def test_only_a_product_is_determined():
    """log a + 2 log b is; neither a nor b; k keeps its value and its deviation."""
    data = noisy()
    guess = {"a": 1.0, "b": 3.0, "k": 0.3}
    found = least_squares(scaled_decay, guess, data, bounds=Positive())
    alone = least_squares(decay, GUESS, data, bounds=Positive())
    assert found.result == FitResult.CONVERGED
    p = found.parameters
    assert p["a"] * p["b"] ** 2 == pytest.approx(float(alone.parameters["a"]), rel=1e-7)
    assert np.isinf(found.deviations["a"]) and np.isinf(found.deviations["b"])
    assert found.deviations["k"] == pytest.approx(float(alone.deviations["k"]), rel=1e-6)
    assert np.isnan(found.covariance[0, 2]) and found.freedom == 18
    (null,) = found.undetermined
    np.testing.assert_allclose(np.abs(null.weights), [2 / 5**0.5, 1 / 5**0.5, 0], atol=1e-9)
    assert null.strength < 1e-12 and [c.strength > 1e-2 for c in found.determined] == [True] * 2
    assert found.combinations() == (("0.5 log a + log b",), ("log a - 0.5 log b",))
    text = str(found)
    assert "the data determine 0.5 log a + log b but not log a - 0.5 log b" in text
    assert text.count("not determined") == 2 and "k  1.3" in text


def test_several_combinations_are_not_determined():
    """Of a b / c, only that: what is said has two parts, and names only who takes part."""
    predict = lambda p: p["a"] * p["b"] / p["c"] + p["d"] * TIMES
    guess = {"a": 1.0, "b": 2.0, "c": 3.0, "d": 4.0}
    found = least_squares(predict, guess, Observations(TIMES, 2 + TIMES, 1.0), bounds=Positive())
    assert len(found.undetermined) == 2
    known, unknown = found.combinations()
    assert len(known) == 1 and set(known[0]) >= set("abc") and "log d" not in known[0]
    assert len(unknown) == 2 and not any("log d" in text for text in unknown)
    assert np.isfinite(found.deviations["d"])


def test_threshold():
    """A combination that the data hardly determine is taken as either, by the threshold."""
    predict = lambda p: p["a"] + p["b"] * (1 + 1e-4 * TIMES)
    data = Observations(TIMES, 1 + 2e-4 * TIMES, 0.1)
    guess = {"a": 1.0, "b": 1.0}
    fine = least_squares(predict, guess, data)
    coarse = least_squares(predict, guess, data, threshold=1e-3)
    assert not fine.undetermined and np.all(np.isfinite(fine.covariance))
    assert len(coarse.undetermined) == 1 and np.all(np.isinf(np.diag(coarse.covariance)))


# Bounds


@pytest.mark.parametrize(("interval", "end"), [((0.1, 1.0), 1.0), ((1.5, 3.0), 1.5)])
def test_an_active_bound(interval, end):
    """The parameter ends at its bound, the other at its best with it there."""
    bounds = {"a": None, "k": Interval(*interval)}
    found = least_squares(decay, {"a": 1.0, "k": np.mean(interval)}, noisy(), bounds=bounds)
    assert found.result in (FitResult.CONVERGED, FitResult.SETTLED)
    assert found.parameters["k"] == pytest.approx(end, abs=1e-4)
    assert interval[0] <= found.parameters["k"] <= interval[1]
    held = least_squares(lambda p: decay({"a": p, "k": end}), 1.0, noisy())
    assert found.parameters["a"] == pytest.approx(float(held.parameters), rel=1e-4)
    assert found.at_bound == ("k",)
    starts = {"a": jnp.ones(2), "k": jnp.linspace(*interval, 4)[1:3]}
    several = several_starts(decay, starts, noisy(), bounds=bounds)
    assert several.best.at_bound == ("k",)
    assert "at its bound" in str(found) and "not determined" not in str(found)


def test_a_positive_parameter_that_wants_to_be_negative():
    data = Observations(TIMES, -0.3 * TIMES)
    found = least_squares(lambda p: p["a"] * TIMES, {"a": 1.0}, data, bounds=Positive())
    assert found.result in (FitResult.CONVERGED, FitResult.SETTLED)
    assert 0 < found.parameters["a"] < 1e-4


# Compilation and precision


def test_one_compilation_serves_all_steps_and_fits():
    traces = []

    def predict(p):
        traces.append(1)
        return decay(p)

    for seed in range(3):
        assert least_squares(predict, GUESS, noisy(seed), bounds=BOUNDS).evaluations > 4
    assert len(traces) <= 2


def test_single_precision():
    """As exact as single precision allows, and it ends."""
    times = TIMES.astype(jnp.float32)
    predict = lambda p: p[0] * jnp.exp(-p[1] * times)
    data = Observations(times, noisy().values.astype(jnp.float32))
    found = least_squares(predict, jnp.array([1.0, 0.3], jnp.float32), data)
    assert found.parameters.dtype == jnp.float32
    assert found.result in (FitResult.CONVERGED, FitResult.SETTLED)
    reference = least_squares(decay, GUESS, noisy())
    assert relative(found.parameters, numbers(reference.parameters)) < 1e-4


@pytest.mark.parametrize("how", ["one start", slow("several starts"), slow("descent")])
def test_single_precision_with_bounds_priors_and_a_loss(how):
    """Whose numbers are of double precision: as the fit in double precision throughout."""
    bounds = {"a": Interval(0.1, 9.0), "k": Positive()}
    priors = {"a": NormalPrior(2.0, 1.0), "k": LogNormalPrior(1.3, 1.0)}
    settings = {"bounds": bounds, "priors": priors, "robust": Huber()}
    single = lambda tree: jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), tree)
    times, guess = single(TIMES), single(GUESS)
    predict = lambda p: p["a"] * jnp.exp(-p["k"] * times)
    data = Observations(times, single(noisy().values), 0.02)
    if how == "descent":
        loss = lambda p: jnp.sum((predict(p) - data.values) ** 2)
        least = minimize(loss, guess, bounds=bounds, max_steps=5)
        assert least.loss < 0.9 * least.history[0]
        return
    if how == "one start":
        found = least_squares(predict, guess, data, **settings)
    else:
        starts = jax.tree.map(lambda x: jnp.stack([x, 1.5 * x]), guess)
        found = several_starts(predict, starts, data, **settings).best
    reference = least_squares(decay, GUESS, noisy(stated=0.02), **settings)
    assert found.parameters["k"].dtype == jnp.float32
    assert relative(numbers(found.parameters), numbers(reference.parameters)) < 1e-4
    assert relative(found.covariance, reference.covariance) < 1e-3


def test_numbers_for_every_column():
    """Deviations, gaps, bounds and priors that broadcast along leading axes."""
    truth, deviation = np.array([[1.0, -2.0, 0.5], [0.3, 0.1, -0.4]]), np.array([0.1, 0.2, 0.3])
    predict = lambda p: p[:1] + p[1:] * TIMES[:, None]
    data = Observations(TIMES, predict(jnp.asarray(truth)), deviation, [True, True, True])
    bounds, priors = Interval([-9.0, -8.0, -7.0], 9.0), NormalPrior(np.zeros(3), 1e6)
    found = least_squares(predict, jnp.zeros((2, 3)), data, bounds=bounds, priors=priors)
    assert relative(found.parameters, truth) < 1e-6
    spread = np.asarray(found.deviations) / deviation
    np.testing.assert_allclose(spread[:, 1:], spread[:, :1] * np.ones((1, 2)), rtol=1e-6)


# A rod


ROD_TIMES = 0.04 * jnp.arange(1.0, 11.0)
OBSERVED = ROD_TIMES[4::2] - 0.01  # between steps


def relaxing_rod(p):
    """Nodes of a curved rod without inertia, clamped straight; NaN after a failure."""
    section = Section((p["bending"], p["bending"], 1.0))
    rod = straight_rod(1.0, 4, section, natural_curvature=(1.0, 0.0, 0.0))
    scene = Scene(rod, Clamped(), loads=(LinearDrag(p["drag"], p["drag"], 0.1),))
    run = rollout(scene, start(scene), ROD_TIMES, throw=False)
    return positions_at(run, OBSERVED)


@pytest.mark.slow
def test_the_motion_of_an_overdamped_rod_determines_stiffness_over_drag():
    """And nothing else. A fit of no steps to zeros tells what the rod does."""
    truth, zeros = {"bending": 0.8, "drag": 1.2}, Observations(OBSERVED, jnp.zeros((3, 5, 3)))
    data = least_squares(relaxing_rod, truth, zeros, bounds=Positive(), max_steps=0).residuals
    assert np.max(np.abs(np.diff(data, axis=0))) > 0.01
    guess, data = {"bending": 0.5, "drag": 1.5}, Observations(OBSERVED, data)
    found = least_squares(relaxing_rod, guess, data, bounds=Positive())
    assert found.result == FitResult.CONVERGED and found.evaluations < 10
    assert found.parameters["bending"] / found.parameters["drag"] == pytest.approx(0.8 / 1.2)
    assert found.combinations() == (("log bending - log drag",), ("log bending + log drag",))
