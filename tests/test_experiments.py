"""The main job, run as a newcomer runs them."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import equinox as eqx
import h5py
import jax.numpy as jnp
import numpy as np
import pytest

from rodjax import storage

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "experiments"))

import example  # noqa: E402
import intertwine  # noqa: E402
import plectoneme  # noqa: E402

KEYS = {
    "preset", "elements", "steps", "rejected", "newton_iterations", "compile_seconds",
    "run_seconds", "turns_end", "twist_end", "writhe_end", "linking_error_max", "stretch_max",
    "energy_balance_error", "buckling_time", "apex_orthogonal_time", "first_contact_time",
    "writhe_at_first_contact", "writhe_at", "min_gap", "contact_settled", "result",
}  # fmt: skip
FIGURES = {"snapshots.png", "energy.png", "topology.png", "reactions.png"}


def _run(script: str, *arguments: str) -> str:
    path = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    run = subprocess.run(
        [sys.executable, str(ROOT / "experiments" / script), *arguments],
        env=os.environ | {"PYTHONPATH": path, "JAX_ENABLE_COMPILATION_CACHE": "0"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 0, run.stderr
    return run.stdout


@pytest.fixture(scope="module")
def quick(tmp_path_factory):
    """Output folder, printed text and summary of the short mode."""
    out = tmp_path_factory.mktemp("quick")
    text = _run("intertwine.py", "--quick", "--out", str(out))
    return out, text, json.loads((out / "summary.json").read_text())


@pytest.mark.slow
def test_quick_run_is_right(quick):
    _, _, summary = quick
    assert set(summary) >= KEYS
    assert (summary["result"], summary["preset"]) == ("SUCCESS", "timeline")
    assert summary["elements"] == 60
    # 4 turns at 14.2 s, all of them twist until the rod buckles
    turns = 4 * 12 / 14.2
    assert summary["turns_end"] == pytest.approx(turns, rel=1e-12)
    assert summary["twist_end"] + summary["writhe_end"] == pytest.approx(turns, abs=1e-9)
    assert 0 < summary["writhe_end"] < 0.01
    assert summary["twist_eq15_end"] == pytest.approx(summary["twist_end"], abs=1e-4)
    assert summary["linking_error_max"] < 1e-9
    assert summary["stretch_max"] < 1e-10
    assert summary["energy_balance_error"] < 1e-3
    assert summary["writhe_at"] == {"20": None, "25": None, "29": None, "32": None}
    for key in ("buckling_time", "first_contact_time", "writhe_at_first_contact", "min_gap"):
        assert summary[key] is None
    assert 20 < summary["steps"] < 400
    assert summary["rejected"] < 0.2 * summary["steps"]
    assert summary["steps"] <= summary["newton_iterations"] < 5 * summary["steps"]
    assert min(summary["compile_seconds"], summary["run_seconds"]) > 0


@pytest.mark.slow
def test_energy_of_the_twisted_rod_is_the_static_one(quick):
    """Before it buckles: torsion energy M^2/2 int ds/C with M = 2 pi turns / int ds/C."""
    out, _, _ = quick
    stored = storage.load(out / "run.h5")
    index = int(np.argmin(np.abs(np.asarray(stored.run.times) - 9.0)))
    time = float(stored.run.times[index])
    compliance = float(np.sum(stored.scene.rod.length / stored.scene.rod.stiffness[:, 2]))
    angle = 2 * np.pi * 4 * time / 14.2
    expected = angle**2 / (2 * compliance)
    assert float(stored.measures["ledger"].torsion[index]) == pytest.approx(expected, rel=1e-4)
    torque = -stored.measures["reactions"].torque[index, 0, 1]
    assert float(torque) == pytest.approx(angle / compliance, rel=1e-3)


@pytest.mark.slow
def test_quick_run_writes_and_prints_everything(quick):
    out, text, summary = quick
    assert {path.name for path in out.iterdir()} == FIGURES | {"run.h5", "summary.json"}
    for name in FIGURES:
        assert (out / name).read_bytes()[:4] == b"\x89PNG"
    for name, value in example.PRESETS["timeline"].assumed.items():
        assert f"ASSUMED  {name}: {value}" in text
        assert summary["assumed_inputs"][name] == value
    for milestone in ("buckling", "shallow helix", "loop", "first contact", "intertwined"):
        assert milestone in text
    assert "turns added after buckling" not in text  # it has not buckled yet
    with h5py.File(out / "run.h5") as file:
        assert file["run/states/position"].shape == (summary["steps"] + 1, 61, 3)


@pytest.mark.slow
def test_file_holds_the_scene_and_can_be_resumed(quick):
    out, _, summary = quick
    stored = storage.load(out / "run.h5")
    whole = example.scene(example.PRESETS["timeline"], 60)
    assert eqx.tree_equal(stored.scene, whole, typematch=True)
    assert stored.steps_done == summary["steps"]
    assert stored.run.control is not None  # what `Stored.resume` needs


@pytest.mark.slow
def test_fixed_steps_without_contact(tmp_path):
    _run("intertwine.py", "--quick", "--until", "2.05", "--step", "0.1", "--no-contact", "--out",
         str(tmp_path))  # fmt: skip
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert (summary["result"], summary["steps"]) == ("SUCCESS", 21)
    assert summary["end_time"] == pytest.approx(2.05, rel=1e-12)
    assert summary["turns_end"] == pytest.approx(4 * 2.05 / 14.2, rel=1e-12)
    assert summary["contact"] is False
    assert summary["contact_settled"] is None
    assert summary["linking_error_max"] < 1e-9


def test_fixed_times_end_on_switches_and_at_the_end():
    np.testing.assert_allclose(intertwine.fixed_times(0.5, 2.0, ()), [0.5, 1.0, 1.5, 2.0])
    np.testing.assert_allclose(
        intertwine.fixed_times(0.5, 2.2, (1.0, 1.3, 9.0)), [0.5, 1.0, 1.3, 1.5, 2.0, 2.2]
    )
    times = intertwine.fixed_times(0.1, 36.0, (30.0,))
    assert len(times) == 360
    assert 30.0 in times  # to the last bit, although 300 * 0.1 is not


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--elements", "-3"], "--elements: must be positive"),
        (["--until", "0"], "--until: must be positive"),
        (["--preset", "thick"], "timeline"),
    ],
)
def test_bad_options_are_refused(capsys, arguments, message):
    with pytest.raises(SystemExit):
        intertwine.arguments(arguments)
    assert message in capsys.readouterr().err


@pytest.mark.parametrize(
    ("name", "turns"),
    [("timeline", {0: 0, 7.1: 2, 14.2: 4, 32: 4.4094}), ("stout", {8: 2, 16: 4, 32: 4.5})],
)
def test_presets_turn_as_described(name, turns):
    preset = example.PRESETS[name]
    drive = example.drive(preset)
    for time, expected in turns.items():
        assert float(drive.angle(time)) == pytest.approx(-2 * np.pi * expected, abs=1e-12)
    scene = example.scene(preset, 40, contact=False)
    assert [float(t) for t in scene.switch_times] == ([30.0] if name == "timeline" else [])
    necked = (scene.rod.midpoints > 0.375) & (scene.rod.midpoints < 0.625)
    thick = preset.diameter
    np.testing.assert_allclose(scene.rod.diameter, np.where(necked, 0.9 * thick, thick))
    # Table 1: A/C = E/(2G) for any diameter
    np.testing.assert_allclose(scene.rod.stiffness[:, 0] / scene.rod.stiffness[:, 2], 1.25)


@pytest.mark.slow
def test_speed_report_in_short_mode(tmp_path):
    text = _run("speed.py", "--quick", "--out", str(tmp_path))
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
@pytest.mark.parametrize("block", (1, 2), ids=("use", "fit"))
def test_readme_runs_when_pasted(tmp_path, block):
    text = (ROOT / "README.md").read_text()
    script = tmp_path / "pasted.py"
    script.write_text(re.findall(r"```python\n(.*?)```", text, re.S)[block])
    said = _run(str(script))
    if block == 1:
        assert "steps; the slider moved by 0." in said
    else:
        values = dict(re.findall(r"(youngs_modulus|drag) +(\S+)", said))
        assert float(values["youngs_modulus"]) == pytest.approx(1.2e7, rel=0.02)
        assert float(values["drag"]) == pytest.approx(1.1, rel=0.05)


@pytest.mark.slow
def test_gradient_check_in_short_mode(tmp_path):
    text = _run("gradient_check.py", "--quick", "--out", str(tmp_path))
    found = json.loads(text.splitlines()[-1])
    assert found["worst_modes_disagree"] < 1e-8
    assert found["worst_differences_disagree"] < 1e-6
    assert all(found["memory"][what]["finite"] for what in ("value", "gradient"))
    assert (tmp_path / "gradients.png").exists()


@pytest.mark.slow
@pytest.mark.parametrize("name", ("drag", "contact_law"))
def test_fits_in_short_mode(tmp_path, name):
    _run(f"fit_{name}.py", "--quick", "--out", str(tmp_path))
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert set(summary["fits"]) == {"without noise", "with noise"}
    if name == "drag":
        fit = summary["fits"]["without noise"]["parameters"]["normal_coefficient"]
        assert fit["relative_error"] < 1e-2
    assert (tmp_path / "fit.png").exists()


@pytest.mark.slow
def test_inference_in_short_mode(tmp_path):
    text = _run("infer_unpublished.py", "--quick", "--out", str(tmp_path))
    assert "writhe_at_first_contact" in text
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["score"] <= summary["score_of_guess"]


@pytest.mark.slow
def test_design_in_short_mode(tmp_path):
    _run("design_rod.py", "--quick", "--out", str(tmp_path))
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["results"] == ["SUCCESS", "SUCCESS"]
    assert summary["first_contact_after"] > summary["first_contact_before"]
    assert abs(summary["mass_change"]) < 1e-12
    assert (tmp_path / "design.png").exists()


@pytest.mark.slow
def test_soft_arm_in_short_mode(tmp_path):
    _run("soft_arm.py", "--quick", "--out", str(tmp_path))
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
    _run("sweep.py", "--quick", "--devices", "2", "--out", str(tmp_path))
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["scenes"] == 64 and summary["failed"] == 0
    with h5py.File(tmp_path / "sweep.h5") as file:
        assert np.all(file["done"]) and file["results/writhe"].shape == (64,)


@pytest.mark.slow
def test_sensitivity_in_short_mode(tmp_path):
    _run("sensitivity.py", "--quick", "--out", str(tmp_path))
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
    _run("ladder.py", "--quick", "--out", str(tmp_path))
    summary = json.loads((tmp_path / "summary.json").read_text())
    static, plain, rotary = summary["rows"]
    assert static["iterations_per_step"] > 0 and plain["operations"] < rotary["operations"]
    held = summary["held_derivative"]
    assert held["failed"] == 0 and held["apart"]["ratio"] > 0
    assert (tmp_path / "ladder.png").exists()


@pytest.mark.slow
def test_accelerator_in_short_mode(tmp_path):
    text = _run("accelerator.py", "--quick", "--batches", "1", "--out", str(tmp_path))
    found = json.loads((tmp_path / "summary.json").read_text())["cpu"]
    for name in ("without_contact", "nothing_touches", "strands_touch"):
        assert found[f"{name} x1"]["failed"] == 0 and name in text
        assert 0 < found[f"{name} x1"]["seconds_of_a_step"] < 1
    assert 0 < found["empty_loop"]["microseconds"] < found["block_solve"]["microseconds"]


@pytest.mark.slow
def test_bifurcations_in_short_mode(tmp_path):
    _run("bifurcations.py", "--quick", "--out", str(tmp_path))
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
    _run("example_path.py", "--quick", "--out", str(tmp_path))
    found = json.loads((tmp_path / "summary.json").read_text())
    # straight until the critical turns of the neck, back to a loop that contact holds
    assert found["straight_until"] == pytest.approx(7.531815 / (2 * np.pi * 0.8 * 0.884), rel=5e-3)
    assert found["not_quite_straight_until"][0] < found["straight_until"]
    assert 0 < found["loop_stable_from"] < found["first_contact_at"] < 0.5
    assert found["ends_by"] == "STOP"
    assert (tmp_path / "example_path.png").exists()


@pytest.mark.slow
def test_ring_in_short_mode(tmp_path):
    text = _run("ring.py", "--quick", "--out", str(tmp_path))
    summary = json.loads((tmp_path / "summary.json").read_text())
    (ring,) = summary["rings"]
    assert summary["thresholds"]["30"] == pytest.approx(1, abs=0.006) and "sqrt(3)" in text
    assert ring["linking_error"] < 1e-6 and ring["gap_of_the_weld"] < 1e-9
    # a figure 8 of strands that touch
    assert ring["writhe"] == pytest.approx(1.1, abs=0.05)
    assert 0.9 < ring["nearest"] < 1
    assert (tmp_path / "ring.png").exists()


@pytest.mark.slow
def test_knot_in_short_mode(tmp_path):
    _run("knot.py", "--quick", "--out", str(tmp_path))
    (knot,) = json.loads((tmp_path / "summary.json").read_text())["runs"]
    assert knot["result"] == 0 and knot["friction"] == 0.1
    # a coarse braid, drawn for a moment
    np.testing.assert_allclose(knot["over_theory"], 1, atol=0.3)
    assert (tmp_path / "knot.png").exists()


@pytest.mark.slow
def test_hockle_in_short_mode(tmp_path):
    _run("hockle.py", "--quick", "--out", str(tmp_path))
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["result"] == 0
    # with torsion the cable rises as slack is given, while it has but little
    assert 8 < summary["leaves_the_bed"]["time"] < 9.5
    assert abs(summary["ledger_residual"]) < 0.01 * summary["work"]
    assert (tmp_path / "hockle.png").exists()


@pytest.mark.slow
def test_capstan_in_short_mode(tmp_path):
    text = _run("capstan.py", "--quick", "--out", str(tmp_path))
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
    text = _run("plectoneme.py", "--quick", "--out", str(tmp_path))
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
    found = plectoneme.closed_form(bending, radius, angle)

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
    assert plectoneme.angle_of(bending, radius, found.torque) == pytest.approx(angle, rel=1e-9)


def test_ply_is_measured_as_it_was_made():
    # two helices about z that meet in a corner; the first goes up, so that its frames do not twist
    whole = plectoneme.rod(400)
    step, radius, angle = plectoneme.LENGTH / 400, 0.99 * plectoneme.RADIUS, np.radians(25)
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
    inner = plectoneme.middle(plectoneme.touching(whole, state))
    assert len(inner.node) > 50
    np.testing.assert_allclose(0.5 * inner.distance, radius, rtol=1e-4)
    for found in (inner.angle, inner.between_lines, inner.between_normals):
        np.testing.assert_allclose(np.degrees(found), 25, atol=0.1)
