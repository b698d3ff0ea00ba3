"""Fits whose predictions fail, of bad input, interrupted, and on a machine at fault."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from jax import lax
from toy_fits import (
    BOUNDS,
    EXACT,
    GUESS,
    RATES,
    TIMES,
    WAVE,
    decay,
    interrupting,
    noisy,
    numbers,
    relative,
    valley,
    wave,
)

from rodjax.fitting import descent, fit
from rodjax.fitting.bounds import Positive
from rodjax.fitting.descent import minimize
from rodjax.fitting.fit import least_squares, several_starts
from rodjax.fitting.fit_results import FitError, FitResult
from rodjax.fitting.observations import Observations

# Failing predictions


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


# Progress and interruption


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


# Faults of the machine


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
