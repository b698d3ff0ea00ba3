"""Experiments that time, fit, design and sweep, in short mode."""

import json
import subprocess
import sys

import h5py
import numpy as np
import pytest
from experiment_runs import ROOT, run_experiment


@pytest.mark.slow
def test_speed_report_in_short_mode(tmp_path):
    text = run_experiment("speed.py", "--quick", "--out", str(tmp_path))
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert (tmp_path / "speed.png").exists()
    rows = summary["iteration_seconds"]
    for name in ("without_contact", "plectoneme_in_contact"):
        row = rows[name]["60"]
        assert row["solve_difference"] < 1e-6  # the block solve and SciPy's agree
        assert all(row[part] > 0 for part in ("residual", "jacobian", "newton", "banded_solve"))
        # wound without stress, and without contact it stays so: one increment, of nothing
        assert (1 if name == "without_contact" else 2) <= row["iterations"] <= 12
        # an iteration is a share of a step's whole solve, as steps take it
        assert row["iteration"] == pytest.approx(row["newton"] / row["iterations"], rel=1e-9)
    row = rows["plectoneme_in_contact"]["60"]
    # held: a correction costs less than an elimination, and there are fewer of these
    assert 0 < row["correction"] < row["elimination"]
    assert row["pairs"] > 0
    assert 0 < row["joints"] <= row["joints_near"] <= row["segments"] + 1
    # where the legs part to their clamps and round the loop nothing acts
    assert row["joints"] < row["segments"] + 1
    assert summary["compilation"][0]["step_operations"] > 100
    assert summary["peak_resident_mebibytes"] > 100
    assert "SciPy" in text


def test_peak_memory_is_that_of_the_process_itself():
    # 600 MB of the parent's, which getrusage would hand on to the child
    code = (
        "import subprocess, sys; block = bytearray(600 * 2**20); block[::4096] = block[::4096];"
        "print(subprocess.run([sys.executable, '-c',"
        " 'from _memory import peak_mib; x = bytearray(100 * 2**20); print(peak_mib())'],"
        " capture_output=True, text=True, check=True).stdout)"
    )
    child = subprocess.run(
        [sys.executable, "-c", code],
        cwd=ROOT / "experiments",
        capture_output=True,
        text=True,
        check=True,
    )
    assert 100 < float(child.stdout) < 300


@pytest.mark.slow
def test_gradient_check_in_short_mode(tmp_path):
    text = run_experiment("gradient_check.py", "--quick", "--out", str(tmp_path))
    found = json.loads(text.splitlines()[-1])
    assert found["worst_modes_disagree"] < 1e-8
    assert found["worst_differences_disagree"] < 1e-6
    assert all(found["memory"][what]["finite"] for what in ("value", "gradient"))
    assert (tmp_path / "gradients.png").exists()


@pytest.mark.slow
@pytest.mark.parametrize("name", ("drag", "contact_law"))
def test_fits_in_short_mode(tmp_path, name):
    run_experiment(f"fit_{name}.py", "--quick", "--out", str(tmp_path))
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert set(summary["fits"]) == {"without noise", "with noise"}
    if name == "drag":
        fit = summary["fits"]["without noise"]["parameters"]["normal_coefficient"]
        assert fit["relative_error"] < 1e-2
    assert (tmp_path / "fit.png").exists()


@pytest.mark.slow
def test_inference_in_short_mode(tmp_path):
    text = run_experiment("infer_unpublished.py", "--quick", "--out", str(tmp_path))
    assert "writhe_at_first_contact" in text
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["score"] <= summary["score_of_guess"]


@pytest.mark.slow
def test_design_in_short_mode(tmp_path):
    run_experiment("design_rod.py", "--quick", "--out", str(tmp_path))
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["results"] == ["SUCCESS", "SUCCESS"]
    assert summary["first_contact_after"] > summary["first_contact_before"]
    assert abs(summary["mass_change"]) < 1e-12
    assert (tmp_path / "design.png").exists()


@pytest.mark.slow
def test_soft_arm_in_short_mode(tmp_path):
    run_experiment("soft_arm.py", "--quick", "--out", str(tmp_path))
    summary = json.loads((tmp_path / "summary.json").read_text())
    fitted, reached = summary["fit"], summary["reach"]
    # eight elements are 6 % too stiff beside the sixteen of the data
    assert fitted["parameters"]["youngs_modulus"] == pytest.approx(4e5, rel=0.1)
    assert fitted["parameters"]["retardation"] == pytest.approx(0.01, rel=0.2)
    assert reached["result"] == "SUCCESS"
    assert reached["mean_miss_after"] < 0.5 * reached["mean_miss_before"]
    assert reached["gradient_against_difference"] < 1e-3  # of a difference, in contact
    assert reached["balance_error"] < 0.1  # of eight elements that swing at random
    assert (tmp_path / "soft_arm.png").exists() and (tmp_path / "amplitudes.npz").exists()


@pytest.mark.slow
def test_sweep_in_short_mode(tmp_path):
    run_experiment("sweep.py", "--quick", "--devices", "2", "--out", str(tmp_path))
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["scenes"] == 64 and summary["failed"] == 0
    with h5py.File(tmp_path / "sweep.h5") as file:
        assert np.all(file["done"]) and file["results/writhe"].shape == (64,)


@pytest.mark.slow
def test_sensitivity_in_short_mode(tmp_path):
    run_experiment("sensitivity.py", "--quick", "--out", str(tmp_path))
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert (tmp_path / "sensitivity.png").exists()
    names = [one["case"]["name"] for one in summary["runs"]]
    assert names == ["as shipped", "k1 x 10", "k1 / 10", "largest step halved"]
    for one in summary["runs"]:
        assert one["result"] == "SUCCESS" and one["linking_error_max"] < 1e-9
    # nothing touches before 16 s, so the strength of contact decides nothing yet
    writhe = [one["writhe"][-1] for one in summary["runs"]]
    assert writhe[0] > 0 and writhe[1] == pytest.approx(writhe[0], rel=1e-9)


@pytest.mark.slow
def test_ladder_in_short_mode(tmp_path):
    run_experiment("ladder.py", "--quick", "--out", str(tmp_path))
    summary = json.loads((tmp_path / "summary.json").read_text())
    static, plain, rotary = summary["rows"]
    assert static["iterations_per_step"] > 0 and plain["operations"] < rotary["operations"]
    held = summary["held_derivative"]
    assert held["failed"] == 0 and held["apart"]["ratio"] > 0
    assert (tmp_path / "ladder.png").exists()


@pytest.mark.slow
def test_accelerator_in_short_mode(tmp_path):
    text = run_experiment("accelerator.py", "--quick", "--batches", "1", "--out", str(tmp_path))
    found = json.loads((tmp_path / "summary.json").read_text())["cpu"]
    for name in ("without_contact", "nothing_touches", "strands_touch"):
        assert found[f"{name} x1"]["failed"] == 0 and name in text
        assert 0 < found[f"{name} x1"]["seconds_of_a_step"] < 1
    assert 0 < found["empty_loop"]["microseconds"] < found["block_solve"]["microseconds"]
