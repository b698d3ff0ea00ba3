"""The stability map: its verdicts, and what it does when a cell hangs, dies or is interrupted."""

import json
import sys

import pytest
import stability_map
from stability_cells import AXES, PAIRS, Cell, cells
from stability_oracle import Verdict, verdict

GOOD = {
    "code": "SUCCESS", "mend": None, "finite": True, "linking": 1e-12, "created": 0.0,
    "balance": 1e-3, "stretch": 1e-12, "agreement": 1e-3, "precision": "float64",
}  # fmt: skip
NAN = float("nan")


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({}, Verdict.ACCURATE),
        ({"linking": None}, Verdict.ACCURATE),
        ({"stretch": 1e-4, "precision": "float32"}, Verdict.ACCURATE),
        ({"stretch": 1e-4}, Verdict.CONVERGED),
        ({"agreement": 0.06}, Verdict.CONVERGED),
        ({"agreement": NAN}, Verdict.CONVERGED),
        ({"agreement": None, "half_code": "MAX_STEPS"}, Verdict.CONVERGED),
        ({"balance": 0.3}, Verdict.CONVERGED),
        ({"code": "NEWTON_FAILED", "mend": "use a smaller step"}, Verdict.FAILED),
        ({"code": "ValueError", "mend": "elements: at least 2"}, Verdict.FAILED),
        ({"code": "ValueError"}, Verdict.WRONG),
        ({"code": "TypeError"}, Verdict.WRONG),
        ({"code": "HANG"}, Verdict.WRONG),
        ({"code": "CRASH"}, Verdict.WRONG),
        ({"finite": False}, Verdict.WRONG),
        ({"linking": 2.0}, Verdict.WRONG),
        ({"linking": NAN}, Verdict.WRONG),
        ({"created": 0.2}, Verdict.WRONG),
        ({"stretch": 0.05}, Verdict.WRONG),
    ],
)
def test_verdicts(change, expected):
    found, why = verdict(GOOD | change)
    assert found is expected
    assert bool(why) == (expected is not Verdict.ACCURATE)


def test_cells_cover_the_axes_and_have_names_of_their_own():
    found = cells()
    assert len({cell.name for cell in found}) == len(found)
    assert {cell.axis for cell in found} >= set(AXES)
    assert len(PAIRS) >= 20
    for _, changes in PAIRS:
        assert len(changes) == 2


# Answers as stability_worker.py does, by the cell's label.
FAKE = """
import json, os, sys, time
for line in sys.stdin:
    label = line.strip().split()[-1]
    print("# noise on stderr", file=sys.stderr)
    if label == "crash":
        os._exit(3)
    if label == "slow":
        time.sleep(60)
    print(json.dumps({"event": "prepared"}), flush=True)
    if label == "hang":
        time.sleep(60)
    row = dict(ROW, seconds=0.1, pid=os.getpid())
    print(json.dumps({"event": "done", "row": row}), flush=True)
"""


@pytest.fixture
def command(tmp_path):
    """A worker that can hang and crash."""
    script = tmp_path / "fake.py"
    script.write_text(f"ROW = {GOOD!r}\n" + FAKE)
    return [sys.executable, str(script)]


def some(*labels):
    return [Cell("fake", "axis", label, ()) for label in labels]


def test_hang_and_crash_are_rows_and_the_map_goes_on(tmp_path, command):
    chosen = some("good", "same", "crash", "after", "hang", "slow", "last")
    rows = stability_map.run_cells(chosen, command, tmp_path, preparing=3.0, running=1.0)
    by = {name.split()[-1]: row for name, row in rows.items()}
    for label in ("good", "same", "after", "last"):
        assert by[label]["verdict"] == Verdict.ACCURATE
    assert by["good"]["pid"] == by["same"]["pid"] != by["after"]["pid"] != by["last"]["pid"]
    assert (by["crash"]["code"], by["crash"]["text"]) == ("CRASH", "exit code 3")
    assert by["hang"]["code"] == by["slow"]["code"] == "HANG"
    assert by["hang"]["seconds"] < 3 < by["slow"]["seconds"] < 20
    for label in ("crash", "hang", "slow"):
        assert by[label]["verdict"] == Verdict.WRONG


def test_interrupted_map_goes_on(tmp_path, command):
    first = stability_map.run_cells(some("one", "two"), command, tmp_path)
    path = tmp_path / stability_map.ROWS
    whole = path.read_text()
    path.write_text(whole[:-20])  # the second row is cut off
    assert set(stability_map.read(path)) == {"fake: axis one"}
    again = stability_map.run_cells(some("one", "two", "three"), command, tmp_path)
    assert again["fake: axis one"] == first["fake: axis one"]
    assert set(stability_map.read(path)) == {f"fake: axis {x}" for x in ("one", "two", "three")}


def test_map_and_table_are_drawn(tmp_path):
    chosen = [*some("a", "b"), Cell("fake", "pair", "a, b", ())]
    rows = {}
    for cell, change in zip(chosen, ({}, {"agreement": 0.5}, {"code": "CRASH"}), strict=True):
        row = GOOD | change | {"cell": cell.name, "seconds": 1.0}
        row["verdict"], row["why"] = verdict(row)
        rows[cell.name] = row
    stability_map.draw(chosen, {"before": {}, "now": rows}, tmp_path)
    assert (tmp_path / "map.png").read_bytes()[:4] == b"\x89PNG"
    text = stability_map.table(chosen, rows, {chosen[0].name: {"verdict": "wrong", "why": "x"}})
    assert text.count("\n") == 5
    assert "| wrong x | converged and accurate |" in text
    assert list(stability_map.counts(rows.values()).values()) == [1, 1, 0, 1]


@pytest.mark.slow
def test_map_in_short_mode(tmp_path):
    assert stability_map.main(["--quick", "--out", str(tmp_path)]) == 0
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["cells"] == len(cells(quick=True))
    assert summary["wrong"] == []
    assert summary["verdicts"][Verdict.ACCURATE] >= 3
    assert (tmp_path / "map.png").exists() and (tmp_path / "map.md").exists()
