"""Experiments with paths of equilibria, in short mode."""

import json

import numpy as np
import pytest
from experiment_runs import run_experiment


@pytest.mark.slow
def test_bifurcations_in_short_mode(tmp_path):
    run_experiment("bifurcations.py", "--quick", "--out", str(tmp_path))
    found = json.loads((tmp_path / "summary.json").read_text())
    # second order: 6.7/n^2 and 0.77/n^2 above the continuous rod's
    off = found["thresholds"]["24"]
    assert off["column"] == pytest.approx(6.7 / 24**2, rel=0.05)
    assert off["twist"] == pytest.approx(0.77 / 24**2, rel=0.05)
    # the exact curve of torque and thrust, in second order
    coarse, fine, drawn_on = found["compressed"]["off"]
    assert coarse / fine == pytest.approx((24 / 16) ** 2, rel=0.03) and drawn_on < 5e-4
    assert (tmp_path / "bifurcations.png").exists()


@pytest.mark.slow
def test_example_path_in_short_mode(tmp_path):
    run_experiment("example_path.py", "--quick", "--out", str(tmp_path))
    found = json.loads((tmp_path / "summary.json").read_text())
    # straight until the critical turns of the neck, back to a loop that contact holds
    assert found["straight_until"] == pytest.approx(7.531815 / (2 * np.pi * 0.8 * 0.884), rel=5e-3)
    assert found["not_quite_straight_until"][0] < found["straight_until"]
    assert 0 < found["loop_stable_from"] < found["first_contact_at"] < 0.5
    assert found["ends_by"] == "STOP"
    assert (tmp_path / "example_path.png").exists()


@pytest.mark.slow
def test_ring_in_short_mode(tmp_path):
    text = run_experiment("ring.py", "--quick", "--out", str(tmp_path))
    summary = json.loads((tmp_path / "summary.json").read_text())
    (ring,) = summary["rings"]
    assert summary["thresholds"]["30"] == pytest.approx(1, abs=0.006) and "sqrt(3)" in text
    assert ring["linking_error"] < 1e-6 and ring["gap_of_the_weld"] < 1e-9
    # a figure 8 of strands that touch
    assert ring["writhe"] == pytest.approx(1.1, abs=0.05)
    assert 0.9 < ring["nearest"] < 1
    assert (tmp_path / "ring.png").exists()


@pytest.mark.slow
def test_path_rate_in_short_mode(tmp_path):
    run_experiment("path_rate.py", "--quick", "--out", str(tmp_path))
    for line in json.loads((tmp_path / "summary.json").read_text()):
        assert (line["points"], line["result"]) == (12, "SUCCESS")
        # back, from where the straight rod loses stability
        assert line["turns"] < 1.7 and line["shortening"] > 0
        (again,) = line["seconds"]
        assert again < line["first_call_seconds"]
