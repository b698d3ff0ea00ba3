"""Experiments with strands that touch, in short mode, and what they measure."""

import json
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest
from _plectoneme_scene import LENGTH, RADIUS, rod
from _plectoneme_strands import middle, touching
from _plectoneme_theory import angle_of, closed_form
from experiment_runs import run_experiment


@pytest.mark.slow
def test_knot_in_short_mode(tmp_path):
    run_experiment("knot.py", "--quick", "--out", str(tmp_path))
    (knot,) = json.loads((tmp_path / "summary.json").read_text())["runs"]
    assert knot["result"] == 0 and knot["friction"] == 0.1
    # a coarse braid, drawn for a moment
    np.testing.assert_allclose(knot["over_theory"], 1, atol=0.3)
    assert (tmp_path / "knot.png").exists()


@pytest.mark.slow
def test_pile_in_short_mode(tmp_path):
    run_experiment("pile.py", "--quick", "--out", str(tmp_path))
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["result"] == "SUCCESS" and summary["reached"] == 0.1
    assert summary["ledger_open"] < 0.03
    # the lower layer lies on the floor, the upper on it
    assert 1.2 < summary["height"] < 2.6
    assert (tmp_path / "pile.png").exists()


@pytest.mark.slow
def test_hockle_in_short_mode(tmp_path):
    run_experiment("hockle.py", "--quick", "--out", str(tmp_path))
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["result"] == 0
    # with torsion the cable rises as slack is given, while it has but little
    assert 8 < summary["leaves_the_bed"]["time"] < 9.5
    assert abs(summary["ledger_residual"]) < 0.01 * summary["work"]
    assert (tmp_path / "hockle.png").exists()


@pytest.mark.slow
def test_capstan_in_short_mode(tmp_path):
    text = run_experiment("capstan.py", "--quick", "--out", str(tmp_path))
    summary = json.loads((tmp_path / "summary.json").read_text())
    (run,) = summary["runs"]
    # 8 elements on the drum; 24 are within 1 %
    assert run["ratio"] == pytest.approx(1, abs=0.03) and "theory" in text
    # friction on its surface holds it less than it would a thin belt
    assert run["slips_at"] < run["theory"] < summary["thin_belt_at_0.3"]
    # the light side has risen by what the friction and the heavy side have left
    assert run["ledger_residual"] < 1e-2 * run["friction_loss"]
    stick, speed = summary["creep"].values()
    assert stick < 1e-9 < speed
    assert (tmp_path / "capstan.png").exists()


@pytest.mark.slow
def test_plectoneme_in_short_mode(tmp_path):
    text = run_experiment("plectoneme.py", "--quick", "--out", str(tmp_path))
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["result"] == "SUCCESS" and "over theory" in text
    assert summary["linking_error_max"] < 1e-9
    (hold,) = summary["holds"]
    assert hold["kinetic_over_strain"] < 1e-6
    # without friction the torque of either clamp is that in the rod
    assert hold["torque"] == pytest.approx(hold["torque_of_other_clamp"], rel=3e-3)
    assert 0.9 < hold["ply"]["radius_over_rods"] < 1.0
    # 4 mm long elements, soft contact: 400 elements are within 2 %
    assert hold["ply"]["ratio"]["torque"] == pytest.approx(1, abs=0.12)
    assert hold["ply"]["ratio"]["tension"] == pytest.approx(1, abs=0.1)
    for name in ("snapshots", "ply"):
        assert (tmp_path / f"{name}.png").exists()


def test_ply_of_theory_is_where_its_energy_is_stationary():
    bending, radius, angle, step = 3.0, 0.7, 0.4, 1e-5
    found = closed_form(bending, radius, angle)

    def energy(radius, angle, length):
        bent = 0.5 * bending * np.sin(angle) ** 4 / radius**2
        turned = 0.5 * np.sin(2 * angle) / radius
        return length * (bent + found.tension - found.torque * turned)

    slope = lambda f: (f(step) - f(-step)) / (2 * step)
    size = energy(radius, angle, 1.0) + found.torque
    assert abs(slope(lambda x: energy(radius, angle + x, 1.0))) < 1e-8 * size
    assert abs(slope(lambda x: energy(radius, angle, 1.0 + x))) < 1e-8 * size
    # strands press on each other by what the ply would lose if they came nearer
    pressed = slope(lambda x: energy(radius + x, angle, 1.0))
    assert found.pressure == pytest.approx(pressed, rel=1e-8)
    assert angle_of(bending, radius, found.torque) == pytest.approx(angle, rel=1e-9)


def test_ply_is_measured_as_it_was_made():
    # two helices about z that meet in a corner; the first goes up, so that its frames do not twist
    whole = rod(400)
    step, radius, angle = LENGTH / 400, 0.99 * RADIUS, np.radians(25)
    s = step * (np.arange(401) - 200)
    along = -np.abs(s) * np.cos(angle)
    turned = -np.abs(s) * np.sin(angle) / radius + np.where(s > 0, np.pi, 0.0)
    position = np.stack([radius * np.cos(turned), radius * np.sin(turned), along], -1)
    around = np.stack([-np.sin(turned), np.cos(turned), np.zeros(401)], -1)
    tangent = np.sin(angle) * around + np.cos(angle) * np.array([0, 0, 1])
    tangent = -np.sign(s)[:, None] * tangent
    half = np.stack([1 + tangent[:, 2], -tangent[:, 1], tangent[:, 0], np.zeros(401)], -1)
    half[200] = 1.0, 0.0, 0.0, 0.0
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    state = SimpleNamespace(position=position, quaternion=jnp.asarray(half))
    inner = middle(touching(whole, state))
    assert len(inner.node) > 50
    np.testing.assert_allclose(0.5 * inner.distance, radius, rtol=1e-4)
    for found in (inner.angle, inner.between_lines, inner.between_normals):
        np.testing.assert_allclose(np.degrees(found), 25, atol=0.1)
