"""The main job, run as a newcomer runs it."""

import json
import re

import equinox as eqx
import example
import h5py
import intertwine
import numpy as np
import pytest
from experiment_runs import ROOT, run_experiment, run_script

from rodjax import storage

KEYS = {
    "preset", "elements", "steps", "rejected", "newton_iterations", "compile_seconds",
    "run_seconds", "turns_end", "twist_end", "writhe_end", "linking_error_max", "stretch_max",
    "energy_balance_error", "buckling_time", "apex_orthogonal_time", "first_contact_time",
    "writhe_at_first_contact", "writhe_at", "min_gap", "contact_settled", "result",
}  # fmt: skip
FIGURES = {"snapshots.png", "energy.png", "topology.png", "reactions.png"}


@pytest.fixture(scope="module")
def quick(tmp_path_factory):
    """Output folder, printed text and summary of the short mode."""
    out = tmp_path_factory.mktemp("quick")
    text = run_experiment("intertwine.py", "--quick", "--out", str(out))
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
    steps = ("--until", "2.05", "--step", "0.1", "--no-contact")
    run_experiment("intertwine.py", "--quick", *steps, "--out", str(tmp_path))
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
@pytest.mark.parametrize("block", (1, 2), ids=("use", "fit"))
def test_readme_runs_when_pasted(tmp_path, block):
    text = (ROOT / "README.md").read_text()
    script = tmp_path / "pasted.py"
    script.write_text(re.findall(r"```python\n(.*?)```", text, re.S)[block])
    said = run_script(script)
    if block == 1:
        assert "steps; the slider moved by 0." in said
    else:
        values = dict(re.findall(r"(youngs_modulus|drag) +(\S+)", said))
        assert float(values["youngs_modulus"]) == pytest.approx(1.2e7, rel=0.02)
        assert float(values["drag"]) == pytest.approx(1.1, rel=0.05)
