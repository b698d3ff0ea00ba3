"""Fits of toy models whose answers are known."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from jax import lax

from rodjax import descent, fit
from rodjax.bounds import Interval, Positive, Unbounded
from rodjax.consistency import start
from rodjax.descent import minimize
from rodjax.ends import Clamped
from rodjax.fit import least_squares, several_starts
from rodjax.fit_results import MESSAGES, FitError, FitResult
from rodjax.fixed_rollout import rollout
from rodjax.loads import LinearDrag
from rodjax.observations import Observations, positions_at
from rodjax.rod import Section, straight_rod
from rodjax.scene import Scene

TIMES = jnp.linspace(0.0, 3.0, 20)
TRUTH = {"a": 2.0, "k": 1.3}
GUESS = {"a": 1.0, "k": 0.3}
BOUNDS = {"a": None, "k": Positive()}


def decay(p):
    return p["a"] * jnp.exp(-p["k"] * TIMES)


def scaled_decay(p):
    return p["a"] * p["b"] ** 2 * jnp.exp(-p["k"] * TIMES)


def noisy(seed=0, deviation=0.02, truth=TRUTH, stated=None):
    noise = deviation * np.random.default_rng(seed).normal(size=TIMES.size)
    return Observations(TIMES, decay(truth) + noise, stated)


EXACT = noisy(deviation=0.0)


def relative(found, expected):
    return np.max(np.abs(np.asarray(found) / np.asarray(expected) - 1))


def numbers(tree):
    return np.array([float(leaf) for leaf in jax.tree.leaves(tree)])


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
    """Scatter of fits to 150 data sets: 12 % is two deviations of it."""
    data = [noisy(seed, stated=0.02) for seed in range(150)]
    fits = [least_squares(decay, TRUTH, one, bounds=BOUNDS) for one in data]
    scatter = np.cov(np.array([numbers(f.parameters) for f in fits]).T)
    mean = np.mean([f.covariance for f in fits], 0)
    assert relative(np.sqrt(np.diag(scatter)), np.sqrt(np.diag(mean))) < 0.12
    correlation = lambda c: c[0, 1] / np.sqrt(c[0, 0] * c[1, 1])
    assert correlation(scatter) == pytest.approx(correlation(mean), abs=0.1)
    assert np.mean([f.reduced for f in fits]) == pytest.approx(1, abs=0.06)


def test_as_many_data_as_unknowns():
    """Noise that is not stated cannot be estimated."""
    predict = lambda p: p["a"] * jnp.exp(-p["k"] * jnp.array([0.0, 1.0]))
    for stated, known in ((None, False), (0.1, True)):
        data = Observations([0.0, 1.0], [2.0, 0.5], stated)
        found = least_squares(predict, GUESS, data)
        assert relative(numbers(found.parameters), [2.0, np.log(4)]) < 1e-9
        assert np.isnan(found.reduced) and np.isnan(found.residual_deviation)
        assert np.all(np.isfinite(numbers(found.deviations)) == known)


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


# Bounds and failing predictions


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


def fails_above(limit, failing=jnp.nan):
    """The decay, where k is below the limit."""
    return lambda p: jnp.where(p["k"] < limit, decay(p), failing)


def infinite_slope_above(limit):
    """A prediction that is finite everywhere, its derivative not."""

    @jax.custom_jvp
    def poisoned(k):
        return k

    @poisoned.defjvp
    def _(primals, tangents):
        (k,), (dk,) = primals, tangents
        return k, jnp.where(k < limit, dk, jnp.nan)

    return lambda p: decay({"a": p["a"], "k": poisoned(p["k"])})


FAILING = {
    "nan": fails_above(1.35),
    "inf": fails_above(1.35, jnp.inf),
    "slope": infinite_slope_above(1.35),
    "error": lambda p: eqx.error_if(decay(p), p["k"] > 1.35, "a check of the simulation"),
}


@pytest.mark.parametrize("kind", FAILING)
def test_trials_that_fail_are_taken_back(kind):
    """The first step from a guess with too small an amplitude goes to k = 1.7."""
    seen, guess = [], {"a": 0.3, "k": 1.2}
    predict = FAILING[kind]
    note = lambda trial, cost, p: seen.append(cost)
    found = least_squares(predict, guess, EXACT, progress=note)
    assert found.result == FitResult.CONVERGED
    assert relative(numbers(found.parameters), [2.0, 1.3]) < 1e-8
    assert np.all(np.isfinite(seen)) and np.all(np.diff(seen) <= 0)
    assert found.evaluations - 1 > found.steps  # some did fail


def test_best_at_the_edge_of_failure():
    """It comes near to the edge, and stays finite."""
    found = least_squares(fails_above(1.2), GUESS, EXACT)
    assert found.result in (FitResult.SETTLED, FitResult.MAX_STEPS)
    assert 1.19 < found.parameters["k"] < 1.2 and np.isfinite(found.chi_squared)


# Bad input


def test_fewer_data_than_unknowns():
    data = Observations([0.0], [2.0])
    with pytest.raises(FitError, match="1 data cannot determine the 2 unknowns a, k"):
        least_squares(lambda p: decay(p)[:1], GUESS, data)


def test_a_parameter_without_influence():
    predict = lambda p: decay(p) + 0 * jnp.sum(p["other"]["x"]) + p["other"]["y"] * TIMES
    guess = GUESS | {"other": {"x": jnp.ones(2), "y": 1.0}}
    with pytest.raises(FitError, match=r"does not depend on other.x\[0\], other.x\[1\]$"):
        least_squares(predict, guess, EXACT)


def test_a_prediction_that_fails_at_the_guess():
    late = lambda p: jnp.where(TIMES < 1.0, decay(p), jnp.nan)
    with pytest.raises(FitError, match=r"prediction is not finite at time 1.10526; did the sim"):
        least_squares(late, GUESS, EXACT)


def test_a_derivative_that_is_not_finite_at_the_guess():
    def predict(p):
        root = jnp.sqrt(p["b"]) + jnp.linalg.norm(p["c"])
        return decay(p) + jnp.where(TIMES > 2, root, 0.0)

    guess = GUESS | {"b": 1.0, "c": jnp.ones(2)}
    for name, zero in (("b", {"b": 0.0}), (r"c\[0\], c\[1\]", {"c": jnp.zeros(2)})):
        with pytest.raises(FitError, match=f"respect to {name} is not finite at time 2.05263"):
            least_squares(predict, guess | zero, EXACT)


def test_other_bad_input():
    with pytest.raises(ValueError, match=r"predict: expected shape \(20,\)"):
        least_squares(lambda p: decay(p)[:-1], GUESS, EXACT)
    with pytest.raises(ValueError, match="guess: k is -1, but must be positive"):
        least_squares(decay, {"a": 1.0, "k": -1.0}, EXACT, bounds=BOUNDS)


# Progress, interruption, compilation


def test_progress_and_largest_number_of_steps(capsys):
    seen = []
    note = lambda trial, cost, p: seen.append((trial, cost, float(p["k"])))
    found = least_squares(decay, GUESS, noisy(), max_steps=3, progress=note)
    assert found.result == FitResult.MAX_STEPS and found.evaluations == 4
    assert [trial for trial, *_ in seen] == [0, 1, 2, 3]
    assert seen[0][2] == pytest.approx(0.3, rel=1e-14)
    assert seen[-1][1:] == (found.chi_squared, float(found.parameters["k"]))
    least_squares(decay, GUESS, noisy(), progress=True)
    assert "cost=0.0057" in capsys.readouterr().err
    assert "max_steps was reached" in str(found)


def interrupting(after):
    def progress(trial, cost, parameters):
        if trial == after:
            raise KeyboardInterrupt

    return progress


@pytest.mark.parametrize("after", [0, 2])
def test_an_interruption_keeps_the_best(after):
    found = least_squares(decay, GUESS, noisy(), progress=interrupting(after))
    same = least_squares(decay, GUESS, noisy(), max_steps=after)
    assert found.result == FitResult.INTERRUPTED and "interrupted" in str(found)
    assert found.history == same.history
    np.testing.assert_array_equal(numbers(found.parameters), numbers(same.parameters))
    assert np.all(np.isfinite(found.covariance))


def test_other_exceptions_pass():
    def progress(*_):
        raise RuntimeError("of the caller")

    with pytest.raises(RuntimeError, match="of the caller"):
        least_squares(decay, GUESS, noisy(), progress=progress)


def out_of_memory(*_):
    raise jax.errors.JaxRuntimeError(
        "RESOURCE_EXHAUSTED: Out of memory allocating 8589934592 bytes"
    )


def faulty_callback(p, limit):
    """The decay, by way of the host, where the machine fails above the limit."""

    def on_host(k):
        if k > limit:
            raise OSError("a disk that is full")
        return np.asarray(k)

    host = lambda k: jax.pure_callback(on_host, jax.ShapeDtypeStruct((), k.dtype), k)
    seen = lax.stop_gradient(host(lax.stop_gradient(p["k"])))
    return decay({"a": p["a"], "k": p["k"] + 0 * seen})


def runs_out_after(monkeypatch, module, name, count):
    """The compiled program, which runs out of memory after so many calls."""
    program, calls = getattr(module, name), []

    def one(*arguments):
        calls.append(1)
        return program(*arguments) if len(calls) <= count else out_of_memory()

    monkeypatch.setattr(module, name, one)


@pytest.mark.parametrize("count", [0, 1, 2, 4])
def test_faults_of_the_machine_are_raised(monkeypatch, count):
    """Whenever they come, and by whatever function: no half-way result."""
    fault = pytest.raises(jax.errors.JaxRuntimeError, match="RESOURCE_EXHAUSTED")
    runs_out_after(monkeypatch, fit, "_linearized_one", count)
    with fault:
        least_squares(decay, GUESS, EXACT)
    runs_out_after(monkeypatch, fit, "_linearized_all", count)
    with fault:
        several_starts(wave, {"size": jnp.ones(5), "rate": RATES}, WAVE, bounds=Positive())
    runs_out_after(monkeypatch, descent, "_descend", count)
    with fault:
        minimize(valley, {"x": -1.0, "y": 0.5})


def test_faults_of_a_callback_are_raised():
    """JAX reports them by a RuntimeError or a ValueError, from the compiled program."""
    predict = lambda p: faulty_callback(p, 1.35)
    loss = lambda p: jnp.sum((predict(p) - EXACT.values) ** 2)
    guess = {"a": 0.3, "k": 1.2}
    starts = jax.tree.map(lambda leaf: jnp.array([leaf, leaf]), guess)
    for run in (
        lambda: least_squares(predict, guess, EXACT),
        lambda: several_starts(predict, starts, EXACT),
        lambda: minimize(loss, {"a": 2.0, "k": 0.5}, optimizer=optax.adam(2.0)),
    ):
        with pytest.raises((RuntimeError, ValueError)):  # whose message may lack the cause
            run()


def test_starts_that_fail_by_a_check_lose():
    """Like those that are not finite."""
    predict = lambda p: eqx.error_if(wave(p), p["rate"] > 9, "a check of the simulation")
    guesses = {"size": jnp.ones(3), "rate": jnp.array([9.5, 6.5, 2.0])}
    found = several_starts(predict, guesses, WAVE)
    assert np.isinf(found.costs[0]) and np.all(np.isfinite(found.costs[1:]))
    assert found.best.parameters["rate"] == pytest.approx(7, rel=1e-8)


def test_minimize_halves_steps_that_a_check_stops():
    walled = lambda x: x - jnp.log(eqx.error_if(x, x < 0, "a check of the simulation"))
    found = minimize(walled, 1.5, optimizer=optax.sgd(6.0), max_steps=1, bounds=Unbounded())
    assert found.history[1] == pytest.approx(0.5 - np.log(0.5), rel=1e-12)
    with pytest.raises(eqx.EquinoxRuntimeError, match="a check"):
        minimize(walled, -1.0, bounds=Unbounded())


def test_repeated_minimizations_share_a_program():
    traces = []

    def loss(p):
        traces.append(1)
        return valley(p)

    for x in (-1.0, 0.3):
        minimize(loss, {"x": x, "y": 0.5}, max_steps=3)
    assert len(traces) == 1


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


# Several starts


def wave(p):
    return p["size"] * jnp.sin(p["rate"] * TIMES)


WAVE = Observations(TIMES, wave({"size": 1.5, "rate": 7.0}), 0.1)
RATES = jnp.array([0.5, 2.0, 4.0, 6.5, 9.5])


def test_several_starts_find_the_best_of_local_minima():
    """A wave's frequency: one start is near enough; all report what they reached."""
    guesses = {"size": jnp.ones(5), "rate": RATES}
    seen = []
    found = several_starts(
        wave, guesses, WAVE, bounds=Positive(), progress=lambda *now: seen.append(now)
    )
    assert found.best.result == FitResult.CONVERGED
    assert relative(numbers(found.best.parameters), [7.0, 1.5]) < 1e-7
    assert found.costs.shape == (5,) and np.argmin(found.costs) == 3
    others = np.delete(found.costs, 3)
    assert np.all(others > 1) and found.costs[3] < 1e-6
    reached = [
        np.sum(WAVE.residuals(wave(jax.tree.map(lambda x, i=i: x[i], found.parameters))) ** 2)
        for i in range(5)
    ]
    np.testing.assert_allclose(reached, found.costs, rtol=1e-9, atol=1e-15)
    assert [now[0] for now in seen] == list(range(len(seen)))
    assert np.all(np.diff([now[1] for now in seen]) <= 0)
    worse = least_squares(wave, {"size": 1.0, "rate": 2.0}, WAVE, bounds=Positive())
    assert worse.chi_squared > 1


def test_starts_that_fail_lose():
    """One is NaN from the beginning, though its neighbours are not."""
    predict = lambda p: jnp.where(p["rate"] > 9, jnp.nan, wave(p))
    guesses = {"size": jnp.ones(3), "rate": jnp.array([9.5, 6.5, 2.0])}
    found = several_starts(predict, guesses, WAVE)
    assert np.isinf(found.costs[0]) and np.all(np.isfinite(found.costs[1:]))
    assert found.best.parameters["rate"] == pytest.approx(7, rel=1e-8)
    with pytest.raises(FitError, match="guesses: .* not finite at any"):
        several_starts(predict, {"size": jnp.ones(2), "rate": jnp.array([9.5, 9.6])}, WAVE)


def test_interrupted_starts():
    guesses = {"size": jnp.ones(5), "rate": RATES}
    found = several_starts(wave, guesses, WAVE, progress=interrupting(2))
    assert found.best.result == FitResult.INTERRUPTED
    assert found.best.chi_squared == pytest.approx(np.min(found.costs), rel=1e-12)


@pytest.mark.parametrize(
    "guesses", [{"size": 1.0, "rate": 2.0}, {"size": jnp.ones(2), "rate": RATES}]
)
def test_bad_starts(guesses):
    with pytest.raises(ValueError, match="guesses: every array needs the same number"):
        several_starts(wave, guesses, WAVE)


# Any loss, along its gradient


def valley(p):
    return (1 - p["x"]) ** 2 + 10 * (p["y"] - p["x"] ** 2) ** 2


def test_minimize_a_curved_valley():
    found = minimize(valley, {"x": -1.0, "y": 0.5}, max_steps=2000, tolerance=1e-7)
    assert found.result == FitResult.CONVERGED
    np.testing.assert_allclose(numbers(found.parameters), 1, atol=1e-3)
    assert found.loss == min(found.history) and found.steps == len(found.history) - 1


def test_minimize_within_bounds_and_with_another_optimizer():
    """The smallest loss lies beyond the bound of x; the curvature is used by L-BFGS."""
    seen = []
    found = minimize(
        valley,
        {"x": 0.3, "y": 1.0},
        bounds={"x": Interval(0.0, 0.8), "y": Positive()},
        optimizer=optax.chain(optax.clip_by_global_norm(0.1), optax.sgd(0.05)),
        max_steps=1000,
        progress=lambda *now: seen.append(now),
    )
    assert found.parameters["x"] == pytest.approx(0.8, abs=5e-3) and found.parameters["x"] <= 0.8
    assert found.parameters["y"] == pytest.approx(0.64, abs=1e-2)
    assert [now[0] for now in seen] == list(range(len(seen)))
    assert seen[-1][1] == found.loss


def test_minimize_halves_steps_that_fail():
    """A logarithm that the first step of 2 would leave."""
    loss = lambda x: x - jnp.log(x)
    found = minimize(loss, 1.5, optimizer=optax.sgd(6.0), max_steps=1, bounds=Unbounded())
    assert found.history[1] == pytest.approx(0.5 - np.log(0.5), rel=1e-12)
    assert found.evaluations == 3 and found.result == FitResult.MAX_STEPS
    walled = lambda x: jnp.where(x < 1.5, jnp.nan, x)
    found = minimize(walled, 1.5, optimizer=optax.sgd(1.0), bounds=Unbounded())
    assert found.result == FitResult.NON_FINITE and found.parameters == 1.5
    assert found.evaluations == 10


def test_minimize_names_what_is_not_finite_at_the_guess():
    with pytest.raises(FitError, match="the loss is 1, and its derivative .* with respect to y$"):
        minimize(lambda p: p["x"] + jnp.sqrt(p["y"]), {"x": 1.0, "y": 0.0})
    with pytest.raises(FitError, match="the loss is nan"):
        minimize(lambda p: p["x"] * jnp.nan, {"x": 1.0})


def test_an_interruption_of_minimize_keeps_the_best():
    found = minimize(valley, {"x": -1.0, "y": 0.5}, progress=interrupting(5))
    assert found.result == FitResult.INTERRUPTED and found.steps == 5
    assert valley(found.parameters) == pytest.approx(found.loss, rel=1e-12)


def test_every_result_has_a_message():
    assert set(MESSAGES) == set(FitResult)


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
