"""Settings of a fit that make no sense, and how its results are printed."""

import jax.numpy as jnp
import numpy as np
import pytest
from linear_fits import GUESS, TIMES, bare, line, measured
from toy_fits import valley

from rodjax.fitting.bounds import Interval, Positive
from rodjax.fitting.descent import minimize
from rodjax.fitting.fit import least_squares, several_starts
from rodjax.fitting.observations import Observations
from rodjax.fitting.robust import Huber


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
