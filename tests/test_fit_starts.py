"""Fits from several starts: the best of local minima, starts that fail."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from toy_fits import RATES, WAVE, interrupting, numbers, relative, wave

from rodjax.fitting.bounds import Positive
from rodjax.fitting.fit import least_squares, several_starts
from rodjax.fitting.fit_results import FitError, FitResult


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


def test_starts_that_fail_by_a_check_lose():
    """Like those that are not finite."""
    predict = lambda p: eqx.error_if(wave(p), p["rate"] > 9, "a check of the simulation")
    guesses = {"size": jnp.ones(3), "rate": jnp.array([9.5, 6.5, 2.0])}
    found = several_starts(predict, guesses, WAVE)
    assert np.isinf(found.costs[0]) and np.all(np.isfinite(found.costs[1:]))
    assert found.best.parameters["rate"] == pytest.approx(7, rel=1e-8)


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
