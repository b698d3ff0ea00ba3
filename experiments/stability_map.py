"""A map of where the simulator holds: one verdict for every extreme of every number.

    python experiments/stability_map.py [--only REGEX] [--before ROWS] [--quick] [--out DIR]

Three scenes (both presets of example.py, a cantilever let go under its weight) and a rod bent
almost on itself, with one number at a time, or two, driven to extremes. Each cell runs twice, with
whole and half steps, in a process of its own that is stopped when it hangs and replaced when it
dies. A cell is converged and accurate; converged (the physics holds, but half the step gives
another answer); a clean failure with its code; or wrong: a strand passed, energy created, not a
number, a hang or a crash without an error. Rows are kept in DIR/rows.jsonl as they finish, and
an interrupted map goes on from there (`--before` shows the rows of an earlier map beside). Writes
DIR/map.png, DIR/map.md and DIR/summary.json; ends with 1 if a cell is wrong.
"""

import argparse
import collections
import contextlib
import json
import os
import queue
import re
import subprocess
import sys
import threading
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import _settings  # noqa: F401 (first)
import matplotlib.pyplot as plt
from stability_cells import Cell, cells
from stability_oracle import Verdict, verdict
from tqdm import tqdm

COLOURS = {
    Verdict.ACCURATE: "#2e8b57",
    Verdict.CONVERGED: "#a8d5a2",
    Verdict.FAILED: "#f2c14e",
    Verdict.WRONG: "#c0392b",
}
PREPARING = 240.0  # a cell's programs must compile within this [s]
RUNNING = 60.0  # and its runs end within this: twice what they are given, on a busy machine
ROWS = "rows.jsonl"


class Worker:
    """A process that answers names of cells with rows, see stability_worker.py."""

    def __init__(self, command: Sequence[str], log: Path):
        self.command, self.log = command, log
        self.process: subprocess.Popen | None = None
        self.lines: queue.Queue[str | None] = queue.Queue()
        self.reader: threading.Thread | None = None

    def start(self) -> subprocess.Popen:
        """The running process, begun anew if there is none."""
        if self.process is None:
            with self.log.open("a") as log:
                self.process = subprocess.Popen(
                    self.command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log,
                    text=True,
                )  # fmt: skip
            self.lines = queue.Queue()
            self.reader = threading.Thread(
                target=self._read, args=(self.process, self.lines), daemon=True
            )
            self.reader.start()
        return self.process

    @staticmethod
    def _read(process, lines) -> None:
        for line in process.stdout:
            lines.put(line)
        lines.put(None)

    def stop(self) -> int | None:
        """Kill the process; its exit code."""
        if self.process is None:
            return None
        self.process.kill()
        code = self.process.wait()
        if self.reader is not None:
            self.reader.join()  # to the end of what the process had said
        for pipe in (self.process.stdin, self.process.stdout):
            if pipe is not None:
                with contextlib.suppress(BrokenPipeError):
                    pipe.close()
        self.process = None
        return code

    def run(self, cell: Cell, preparing: float, running: float) -> dict[str, Any]:
        """The row of a cell, whatever becomes of the process."""
        process, began = self.start(), time.monotonic()
        assert process.stdin is not None
        end = began + preparing
        try:
            process.stdin.write(cell.name + "\n")
            process.stdin.flush()
            while True:
                line = self.lines.get(timeout=max(0.0, end - time.monotonic()))
                if line is None:
                    raise BrokenPipeError
                message = json.loads(line)
                if message["event"] == "done":
                    return message["row"]
                end = time.monotonic() + running
        except queue.Empty:
            self.stop()
            return {"code": "HANG", "mend": None, "seconds": time.monotonic() - began}
        except BrokenPipeError:
            process.wait()
            code = self.stop()
            text = f"exit code {code}"
            seconds = time.monotonic() - began
            return {"code": "CRASH", "mend": None, "text": text, "seconds": seconds}


def read(path: Path) -> dict[str, dict[str, Any]]:
    """Rows of an earlier map by cell; a last line cut off by an interruption is left out."""
    found = {}
    for line in path.read_text().splitlines() if path.exists() else ():
        try:
            row = json.loads(line)
        except json.JSONDecodeError:
            continue
        found[row["cell"]] = row
    return found


def run_cells(
    chosen: Iterable[Cell],
    command: Sequence[str],
    out: Path,
    preparing: float = PREPARING,
    running: float = RUNNING,
) -> dict[str, dict[str, Any]]:
    """Rows of all cells; those that DIR/rows.jsonl has are not run again."""
    path, worker = out / ROWS, Worker(command, out / "worker.log")
    rows = read(path)
    missing = [cell for cell in chosen if cell.name not in rows]
    try:
        for cell in tqdm(missing, desc="cells", disable=None):
            row = {"cell": cell.name, **worker.run(cell, preparing, running)}
            row["verdict"], row["why"] = verdict(row)
            rows[cell.name] = row
            with path.open("a") as file:  # a cut line of an interrupted map is ended first
                file.write(("\n" if _cut(path) else "") + json.dumps(row) + "\n")
            print(f"{cell.name}: {row['verdict']} {row['why']}", flush=True)
    finally:
        worker.stop()
    return rows


def _cut(path: Path) -> bool:
    data = path.read_bytes()
    return bool(data) and not data.endswith(b"\n")


def draw(chosen: list[Cell], maps: dict[str, dict[str, Any]], out: Path) -> None:
    """A row of squares for each axis of each scene, one panel for each map."""
    axes_of = collections.defaultdict(list)
    for cell in chosen:
        axes_of[(cell.scene, cell.axis)].append(cell)
    pairs = {key: found for key, found in axes_of.items() if key[1] == "pair"}
    single = {key: found for key, found in axes_of.items() if key[1] != "pair"}
    count = sum(len(found) for found in pairs.values())
    height = 0.34 * (len(single) + count) + 1.5
    figure, panels = plt.subplots(
        1, len(maps), figsize=(10 * len(maps), height), layout="constrained", squeeze=False
    )
    for panel, (title, rows) in zip(panels[0], maps.items(), strict=True):
        names, y = [], 0
        for (scene, axis), found in single.items():
            names.append(f"{scene}: {axis}")
            for x, cell in enumerate(found):
                _square(panel, x, y, 1.0, cell.label, rows.get(cell.name))
            y += 1
        for (scene, _), found in pairs.items():
            for cell in found:
                names.append(f"{scene}: pair")
                _square(panel, 0, y, 5.0, cell.label, rows.get(cell.name))
                y += 1
        longest = max([len(found) for found in single.values()] + [5 if pairs else 1])
        panel.set(xlim=(-0.05, longest), ylim=(y, -0.05), title=title, xticks=[])
        panel.set_yticks([k + 0.5 for k in range(y)], names)
        panel.tick_params(length=0)
        panel.spines[:].set_visible(False)
        counted = counts(rows[cell.name] for cell in chosen if cell.name in rows)
        for name, colour in COLOURS.items():
            panel.plot([], [], "s", color=colour, label=f"{name}: {counted[name]}")
        panel.legend(loc="upper center", bbox_to_anchor=(0.5, 0.0), ncols=4, frameon=False)
    figure.savefig(out / "map.png", dpi=110)
    plt.close(figure)


def _square(panel, x, y, width, label, row) -> None:
    colour = "#e0e0e0" if row is None else COLOURS[Verdict(row["verdict"])]
    panel.add_patch(plt.Rectangle((x + 0.03, y + 0.06), width - 0.06, 0.88, color=colour))
    text = label
    if row is not None and row["verdict"] in (Verdict.FAILED, Verdict.WRONG):
        text += ("\n" if width == 1 else ": ") + row["why"].replace("_", " ").lower()
    panel.text(
        x + 0.5 * width, y + 0.5, text, ha="center", va="center", fontsize=6.5, linespacing=0.95
    )


def counts(rows: Iterable[dict[str, Any]]) -> dict[str, int]:
    """Number of cells of each verdict."""
    found = collections.Counter(row["verdict"] for row in rows)
    return {name: found[name] for name in Verdict}


def table(chosen: list[Cell], rows, before) -> str:
    """All cells in Markdown."""
    fields = ("agreement", "balance", "created", "linking", "stretch", "steps", "seconds")
    head = ["cell", *(["before"] if before else []), "verdict", "why", *fields, "mend"]
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    number = lambda value: "" if value is None else f"{value:.3g}"
    for cell in chosen:
        row = rows.get(cell.name)
        if row is None:
            continue
        earlier = before.get(cell.name, {})
        was = [f"{earlier.get('verdict', '')} {earlier.get('why', '')}".strip()] if before else []
        values = [number(row.get(field)) for field in fields]
        mend = (row.get("mend") or row.get("text") or "").replace("\n", " ").replace("|", "/")
        columns = [cell.name, *was, row["verdict"], row["why"], *values, mend]
        lines.append("| " + " | ".join(columns) + " |")
    return "\n".join(lines) + "\n"


def arguments(argv=None) -> argparse.Namespace:
    """Options of the command line."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--only", metavar="REGEX", default="", help="cells whose name it is in")
    parser.add_argument("--before", type=Path, metavar="ROWS", help="rows.jsonl of an earlier map")
    parser.add_argument("--quick", action="store_true", help="a few cells of the cantilever")
    parser.add_argument("--out", type=Path, default=Path("results/stability"), metavar="DIR")
    return parser.parse_args(argv)


def main(argv=None) -> int:
    """Run what is missing and report."""
    options = arguments(argv)
    options.out.mkdir(parents=True, exist_ok=True)
    began = time.monotonic()
    every = cells(options.quick)
    chosen = [cell for cell in every if re.search(options.only, cell.name)]
    worker = Path(__file__).with_name("stability_worker.py")
    command = [sys.executable, str(worker), os.fspath((options.out / "cache").resolve())]
    rows = run_cells(chosen, command, options.out)
    before = read(options.before) if options.before else {}
    drawn = [cell for cell in every if cell.name in rows]
    draw(drawn, ({"before": before} if before else {}) | {"now": rows}, options.out)
    (options.out / "map.md").write_text(table(drawn, rows, before))
    known = [rows[cell.name] for cell in drawn]
    summary = {
        "cells": len(known),
        "verdicts": counts(known),
        "verdicts_before": counts(before.values()) if before else None,
        "codes": dict(collections.Counter(row["code"] for row in known)),
        "wrong": [row["cell"] for row in known if row["verdict"] == Verdict.WRONG],
        "longest_seconds": max(row["seconds"] for row in known),
        "seconds": sum(row["seconds"] for row in known),
        "seconds_preparing": sum(row.get("preparing", 0.0) for row in known),
        "seconds_of_this_call": time.monotonic() - began,
    }
    (options.out / "summary.json").write_text(json.dumps(summary, indent=2) + "\n")
    for name, count in summary["verdicts"].items():
        print(f"{count:4d} {name}")
    return 1 if summary["wrong"] else 0


if __name__ == "__main__":
    sys.exit(main())
