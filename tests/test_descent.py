"""Minima of any loss, along its gradient."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from linear_fits import bare
from toy_fits import interrupting, numbers, valley

from rodjax.fitting.bounds import Interval, Positive, Unbounded
from rodjax.fitting.descent import minimize
from rodjax.fitting.fit_results import FitError, FitResult


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


def test_minimize_halves_steps_that_a_check_stops():
    walled = lambda x: x - jnp.log(eqx.error_if(x, x < 0, "a check of the simulation"))
    found = minimize(walled, 1.5, optimizer=optax.sgd(6.0), max_steps=1, bounds=Unbounded())
    assert found.history[1] == pytest.approx(0.5 - np.log(0.5), rel=1e-12)
    with pytest.raises(eqx.EquinoxRuntimeError, match="a check"):
        minimize(walled, -1.0, bounds=Unbounded())


def test_minimize_names_what_is_not_finite_at_the_guess():
    with pytest.raises(FitError, match="the loss is 1, and its derivative .* with respect to y$"):
        minimize(lambda p: p["x"] + jnp.sqrt(p["y"]), {"x": 1.0, "y": 0.0})
    with pytest.raises(FitError, match="the loss is nan"):
        minimize(lambda p: p["x"] * jnp.nan, {"x": 1.0})


def test_an_interruption_of_minimize_keeps_the_best():
    found = minimize(valley, {"x": -1.0, "y": 0.5}, progress=interrupting(5))
    assert found.result == FitResult.INTERRUPTED and found.steps == 5
    assert valley(found.parameters) == pytest.approx(found.loss, rel=1e-12)


def test_repeated_minimizations_share_a_program():
    traces = []

    def loss(p):
        traces.append(1)
        return valley(p)

    for x in (-1.0, 0.3):
        minimize(loss, {"x": x, "y": 0.5}, max_steps=3)
    assert len(traces) == 1


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
