"""Error against run time: rodjax's schemes, the rod as an ODE, and other codes on equal terms.

    python experiments/error_vs_runtime.py [--scene NAME ...] [--method NAME ...] [--peers]
                                           [--repeats K] [--quick] [--out DIR]

Problems, recorded points and errors: runtime_scenes.py. Methods and what is timed:
runtime_methods.py. References and their own errors: runtime_references.py. Writes a figure a scene
(error against warm CPU seconds and against steps), table.txt, results.json (row by row, as they
come) and summary.json; references are kept in DIR and used again.
"""

import argparse
import dataclasses
import importlib.metadata
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
import traceback
from pathlib import Path

import _settings  # noqa: F401 (first)
import jax
import numpy as np
from runtime_methods import EXTRAPOLATED, METHODS, CannotRun, Case, Measured
from runtime_references import Reference, load_or_compute
from runtime_report import (
    HEADER,
    LEVELS,
    Row,
    draw,
    extrapolation_gain,
    levels,
    line,
)
from runtime_scenes import PROBLEMS, Problem, errors

from rodjax.measuring.extrapolation import extrapolate

BEGAN = time.perf_counter()
QUICK_SCENES = ("cantilever",)
QUICK_METHODS = ("fixed", "fixed_rho_08", "adaptive", "static", "ode_explicit")


def arguments(argv=None) -> argparse.Namespace:
    """Options of the command line."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--scene", nargs="+", choices=PROBLEMS, metavar="NAME")
    parser.add_argument("--method", nargs="+", metavar="NAME", help=", ".join(METHODS))
    parser.add_argument("--peers", action="store_true", help="also the codes of peers.py")
    parser.add_argument("--repeats", type=int, help="warm runs of a case; default 5 (3)")
    parser.add_argument("--quick", action="store_true", help="one scene on coarse grids")
    parser.add_argument("--out", type=Path, default=Path("results/error_vs_runtime"), metavar="DIR")
    parser.add_argument("--once", nargs=4, help=argparse.SUPPRESS)  # see whole_process
    options = parser.parse_args(argv)
    options.scene = options.scene or list(QUICK_SCENES if options.quick else PROBLEMS)
    options.repeats = options.repeats or (3 if options.quick else 5)
    return options


def shortened(problem: Problem) -> Problem:
    """The problem of the short mode: two grids, and a reference to suit."""
    grids = problem.grids[:2]
    each = 1 if problem.steps is None else 8 * problem.steps
    return dataclasses.replace(problem, grids=grids, reference=(4 * grids[0], each))


def row_of(
    scene: str, method: str, label: str, case: Case, found: Measured | CannotRun, family: int
) -> Row:
    """A result without its errors."""
    row = {
        "scene": scene,
        "method": method,
        "label": label,
        "elements": case.elements,
        "steps_asked": case.steps,
        "tolerance": case.tolerance,
        "family": family,
    }
    if isinstance(found, CannotRun):
        return row | {"result": f"cannot run: {found.reason}"}
    return row | {
        "result": found.outcome.result,
        "cpu_seconds": float(np.median(found.cpu_seconds)),
        "cpu_seconds_all": list(found.cpu_seconds),
        "wall_seconds": float(np.median(found.wall_seconds)),
        "wall_seconds_all": list(found.wall_seconds),
        "compile_seconds": found.compile_seconds,
        "steps": found.outcome.steps,
        "iterations": found.outcome.iterations,
    }


def family_of(problem: Problem, case: Case) -> int:
    """Cases in which grid and step (or tolerance) are refined together have the same number."""
    ratio = case.elements / problem.grids[0]
    if case.steps is not None:
        return round(10 * case.steps / ratio)
    return 0 if case.tolerance is None else round(1e9 * case.tolerance * ratio**2)


class Results:
    """Rows, written as they come."""

    def __init__(self, out: Path):
        self.out, self.rows = out, []

    def add(self, row: Row) -> None:
        """Print and store one row."""
        self.rows.append(row)
        print(line(row), flush=True)
        temporary = self.out / ".results.json.partial"
        temporary.write_text(json.dumps(self.rows, indent=1) + "\n")
        temporary.replace(self.out / "results.json")


def extrapolated(
    scene: str,
    method: str,
    problem: Problem,
    measured: dict[Case, Measured],
    reference: Reference,
) -> list[Row]:
    """Rows of Richardson's extrapolation from every two runs, one refined twofold in both."""
    rows = []
    for coarse, a in measured.items():
        steps = None if coarse.steps is None else 2 * coarse.steps
        fine = Case(2 * coarse.elements, steps, coarse.tolerance)
        b = measured.get(fine)
        if b is None or a.outcome.result != "SUCCESS" or b.outcome.result != "SUCCESS":
            continue
        both = lambda name, a=a, b=b: [float(np.median(getattr(x, name))) for x in (a, b)]
        iterations = (a.outcome.iterations or 0) + (b.outcome.iterations or 0)
        outcome = b.outcome._replace(
            record=extrapolate(a.outcome.record, b.outcome.record),
            steps=a.outcome.steps + b.outcome.steps,
            iterations=iterations,
        )
        found = Measured(outcome, [sum(both("cpu_seconds"))], [sum(both("wall_seconds"))], None)
        label = f"{METHODS[method].label}, extrapolated"
        row = row_of(scene, f"{method}_extrapolated", label, fine, found, family_of(problem, fine))
        row["errors"] = errors(outcome.record, reference.record, reference.start)
        rows.append(row)
    return rows


def measure_scene(name: str, problem: Problem, methods: dict, options, results: Results) -> dict:
    """All methods on one problem; the summary of its reference."""
    began = time.perf_counter()
    reference = load_or_compute(name, problem, problem.reference, options.out)
    own = ", ".join(f"{k} {v:.1e}" for k, v in sorted(reference.error.items()))
    print(
        f"\n{problem.title}: reference from {reference.made_of}"
        f" ({time.perf_counter() - began:.0f} s); its own relative error: {own}\n{HEADER}",
        flush=True,
    )
    for method, how in methods.items():
        cases = how.cases(problem)
        measured = {}
        for case in cases[:2] if options.quick else cases:
            try:
                found = how.measure(problem, case, options.repeats)
            except Exception as problem_met:  # one case must not end the others
                traceback.print_exc()
                found = CannotRun(f"{type(problem_met).__name__}, see the log")
                options.failed = True
            row = row_of(name, method, how.label, case, found, family_of(problem, case))
            if isinstance(found, Measured) and row["result"] == "SUCCESS":
                row["errors"] = errors(found.outcome.record, reference.record, reference.start)
                measured[case] = found
            results.add(row)
        if method in EXTRAPOLATED:
            for row in extrapolated(name, method, problem, measured, reference):
                results.add(row)
    jax.clear_caches()
    return {"made_of": reference.made_of, "error": reference.error}


def run_once(scene: str, method: str, elements: str, steps: str) -> None:
    """What a child of `whole_process` does: one run from nothing."""
    case = Case(int(elements), None if steps == "-" else int(steps))
    how, problem = METHODS[method], PROBLEMS[scene]
    if case.steps is None and not problem.static:
        case = case._replace(tolerance=1.0)
    job = how.job(problem, case)
    outcome = job.read(jax.block_until_ready(job.run()))
    print(json.dumps({"result": outcome.result}))


def whole_process(scene: str, problem: Problem) -> Row | None:
    """Wall seconds of a process that does one default run, with an empty and a full cache.

    From the interpreter's start to its end: imports, compilation, start, run and record.
    """
    method = "static" if problem.static else "adaptive"
    case = [scene, method, str(problem.grids[1]), "-"]
    seconds = []
    with tempfile.TemporaryDirectory() as cache:
        environment = os.environ | {
            "JAX_COMPILATION_CACHE_DIR": cache,
            "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.2",
        }
        for _ in range(2):
            began = time.perf_counter()
            child = subprocess.run(
                [sys.executable, __file__, "--once", *case],
                env=environment,
                capture_output=True,
                text=True,
                check=False,
            )
            if child.returncode:
                print(f"whole process of {scene}: {child.stderr[-300:]}", file=sys.stderr)
                return None
            seconds.append(time.perf_counter() - began)
    return {
        "scene": scene,
        "method": method,
        "elements": problem.grids[1],
        "without_cache_seconds": seconds[0],
        "with_cache_seconds": seconds[1],
    }


def machine() -> dict:
    """What was measured on, with versions."""
    names = ("rodjax", "jax", "jaxlib", "diffrax", "numpy", "scipy", "pyelastica", "dismech")
    versions = {}
    for name in names:
        try:
            versions[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    model = platform.processor()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        models = [
            x.split(":")[1].strip() for x in cpuinfo.read_text().split("\n") if "model name" in x
        ]
        model = models[0] if models else model
    return {
        "processor": model or platform.machine(),
        "cores": os.cpu_count(),
        "system": platform.platform(),
        "python": platform.python_version(),
        "load_average": os.getloadavg() if hasattr(os, "getloadavg") else None,
        "versions": versions,
        "seconds": "CPU: time.process_time of the warm run, all threads; wall: until ready",
    }


def summarise(results: Results, problems: dict[str, Problem], references, whole, options) -> dict:
    """The numbers of summary.json."""
    rows = results.rows
    return {
        "machine": machine(),
        "quick": options.quick,
        "repeats": options.repeats,
        "references": references,
        "cpu_seconds_at_error": {name: levels(rows, name) for name in problems},
        "extrapolation": {
            name: {m: extrapolation_gain(rows, name, m) for m in EXTRAPOLATED} for name in problems
        },
        "whole_process": whole,
        "rows": rows,
    }


def conclusions(summary: dict) -> str:
    """Seconds at equal error, whether extrapolation pays, and whole processes, in words."""
    text = ["", "warm CPU seconds at a relative error of " + ", ".join(f"{x:g}" for x in LEVELS)]
    for scene, methods in summary["cpu_seconds_at_error"].items():
        for method, found in methods.items():
            cells = ["       -" if s is None else f"{s:8.3f}" for s in found.values()]
            text.append(f"{scene[:24]:24} {method:24} {' '.join(cells)}")
    text.append("\nRichardson's extrapolation: seconds of refinement at its error over its own")
    for scene, methods in summary["extrapolation"].items():
        for method, gains in methods.items():
            cells = [
                f"{g['error']:.1e}: "
                + ("never so exact" if (r := g["plain_over_extrapolated"]) is None else f"{r:.2f}")
                for g in gains
            ]
            if cells:
                text.append(f"{scene[:24]:24} {method:24} {'; '.join(cells)}")
    if summary["whole_process"]:
        text.append("\nwhole process [s]: without the compilation cache, with it")
        for row in summary["whole_process"]:
            text.append(
                f"{row['scene'][:24]:24} {row['method']:12} {row['elements']:5d} elements"
                f" {row['without_cache_seconds']:8.1f} {row['with_cache_seconds']:8.1f}"
            )
    return "\n".join(text)


def main(argv=None) -> None:
    """Measure, print, draw and write."""
    options = arguments(argv)
    if options.once is not None:
        run_once(*options.once)
        return
    options.out.mkdir(parents=True, exist_ok=True)
    problems = {name: PROBLEMS[name] for name in options.scene}
    if options.quick:
        problems = {name: shortened(problem) for name, problem in problems.items()}
    methods = dict(METHODS)
    if options.quick:
        methods = {name: METHODS[name] for name in QUICK_METHODS}
    if options.peers:
        from runtime_peers import peer_methods

        methods |= peer_methods(problems)
    if options.method:
        unknown = set(options.method) - methods.keys()
        if unknown:
            raise SystemExit(f"--method: unknown {sorted(unknown)}; there are {sorted(methods)}")
        methods = {name: methods[name] for name in options.method}
    options.failed = False
    results, references, whole = Results(options.out), {}, []
    try:
        for name, problem in problems.items():
            references[name] = measure_scene(name, problem, methods, options, results)
            draw(results.rows, name, problem.title, references[name]["error"], options.out)
            if not options.quick:
                whole.append(whole_process(name, problem))
    finally:
        found = [row for row in whole if row is not None]
        summary = summarise(results, problems, references, found, options)
        table = "\n".join([HEADER, *map(line, results.rows), conclusions(summary)])
        (options.out / "table.txt").write_text(table + "\n")
        (options.out / "summary.json").write_text(json.dumps(summary, indent=2) + "\n")
        print(conclusions(summary))
        print(f"\nresults in {options.out} after {time.perf_counter() - BEGAN:.0f} s")
    if options.failed:
        raise SystemExit("a case ended in an error, see above")


if __name__ == "__main__":
    main()
