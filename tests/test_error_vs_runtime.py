"""The measurement of error against run time: its measures, and its short mode."""

import json

import error_vs_runtime
import numpy as np
import pytest
import runtime_methods
from experiment_runs import run_experiment
from runtime_report import extrapolation_gain, seconds_at
from runtime_scenes import PROBLEMS, Record, at_points, errors


def row(seconds, error, method="plain"):
    return {
        "scene": "one",
        "method": method,
        "result": "SUCCESS",
        "cpu_seconds": seconds,
        "errors": {"positions": error},
    }


def test_seconds_at_an_error_follow_the_best_rows():
    # error = seconds^-2, and a costly row that is no better
    rows = [row(s, s**-2.0) for s in (1.0, 10.0, 100.0)] + [row(50.0, 0.5)]
    assert seconds_at(rows, 1e-3) == pytest.approx(1000**0.5, rel=1e-12)
    assert seconds_at(rows, 1e-4) == pytest.approx(100.0, rel=1e-12)
    assert seconds_at(rows, 1e-5) is None
    assert seconds_at(rows, 3.0) == 1.0  # even the cheapest is better


def test_gain_of_extrapolation_is_at_equal_error():
    rows = [row(s, s**-2.0) for s in (1.0, 10.0, 100.0)]
    rows += [row(5.0, 1e-3, "plain_extrapolated"), row(9.0, 1e-6, "plain_extrapolated")]
    first, second = extrapolation_gain(rows, "one", "plain")
    assert first["plain_over_extrapolated"] == pytest.approx(1000**0.5 / 5, rel=1e-12)
    assert second["plain_over_extrapolated"] is None


def test_errors_are_relative_to_what_moved():
    start = np.zeros((11, 3))
    reference = Record(np.full((4, 11, 3), 2.0), {"writhe": np.array([1.0, 2.0, 2.0, 1.0])})
    found = Record(np.full((4, 11, 3), 2.1), {"writhe": 1.5 * reference.scalars["writhe"]})
    assert errors(found, reference, start) == {
        "positions": pytest.approx(0.05),
        "writhe": pytest.approx(0.5),
    }


@pytest.mark.parametrize("name", PROBLEMS)
def test_every_grid_has_the_recorded_points(name):
    problem = PROBLEMS[name]
    grids = problem.grids if problem.static or problem.steps is None else problem.grids[:2]
    points = [at_points(np.asarray(problem.build(n).rod.position)) for n in grids]
    assert points[0].shape == (11, 3)
    far = 2e-4 * np.max(np.abs(points[0]))  # the bend's nodes follow its arc to second order
    np.testing.assert_allclose(points[0], points[1], atol=far if problem.static else 1e-12)
    # a run's recorded times and the corners of its drives are ends of its fixed steps
    for _, steps in problem.ladder:
        assert steps % len(problem.times) == 0


@pytest.mark.slow
def test_methods_run_what_they_can():
    compliant, stiff = PROBLEMS["cantilever"], PROBLEMS["cantilever_inextensible"]
    static, contact = PROBLEMS["bend"], PROBLEMS["example"]
    runs = lambda problem: {k for k, m in runtime_methods.METHODS.items() if m.cases(problem)}
    assert runs(static) == {"static"} and runs(contact) == {"adaptive"}
    assert {"ode_explicit", "ode_stiff"} <= runs(compliant)
    assert not {"ode_explicit", "ode_stiff", "static"} & runs(stiff)
    with pytest.raises(SystemExit):
        error_vs_runtime.main(["--quick", "--method", "nonsense"])


@pytest.mark.slow
def test_short_mode(tmp_path):
    text = run_experiment("error_vs_runtime.py", "--quick", "--out", str(tmp_path))
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["rows"] == json.loads((tmp_path / "results.json").read_text())
    assert all(one["result"] == "SUCCESS" for one in summary["rows"])
    errors_of = lambda method: [
        one["errors"]["positions"] for one in summary["rows"] if one["method"] == method
    ]
    coarse, fine = errors_of("fixed")
    assert coarse == pytest.approx(5.4e-3, rel=0.1)
    assert 3 < coarse / fine < 5  # second order
    assert errors_of("fixed_extrapolated")[0] < 0.6 * fine
    # another time integration on the same grid
    assert errors_of("ode_explicit")[-1] == pytest.approx(1e-3, rel=0.3)
    assert summary["references"]["cantilever"]["error"]["positions"] < 3e-4
    assert (tmp_path / "cantilever.png").exists() and (tmp_path / "table.txt").exists()
    assert "warm CPU seconds at a relative error" in text
