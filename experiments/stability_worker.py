"""The process that runs cells of the stability map, started by stability_map.py.

Reads names of cells, one a line, and answers each with lines of JSON: {"event": "prepared"} when
its programs are compiled, then {"event": "done", "row": ...}.
"""

import json
import os
import sys
import time
from typing import Any

import _settings  # noqa: F401 (first)
import jax
import jax.numpy as jnp
import numpy as np
from stability_cells import Case, Cell, build, cells
from stability_oracle import agreement, measure

import rodjax as rx
from rodjax.dynamics.adaptive import compile_adaptive_rollout
from rodjax.dynamics.given_steps import until_failure
from rodjax.dynamics.run import Run, join_runs
from rodjax.dynamics.stepping import no_info
from rodjax.numerics.results import MESSAGES

BLOCK = 20  # fixed steps of a cell
CHUNK = 50
MAX_STEPS = 2000
SECONDS = 12.0  # for one run of the two (or, for the second, what the first left of 30)


def fixed(case: Case, halves: int) -> Run:
    """`BLOCK` steps, each in so many equal parts."""
    parts, state = [], case.state
    assert case.step is not None
    for k in range(halves):
        ends = (np.arange(BLOCK) + 1 + k * BLOCK) * case.step / halves
        run = rx.rollout(case.scene, state, case.state.time + ends, case.method, throw=False)
        rest = lambda leaf: leaf[1:]
        parts.append(Run(jax.tree.map(rest, run.states), run.infos, *run_counts(run)))
        state = run.final
        if int(run.result) != 0:
            break
    return join_runs(case.state, parts)


def run_counts(run: Run) -> tuple:
    """Result and counts of a run, as those of its part."""
    return run.result, run.rejected, run.wasted_iterations


class _OutOfTime(Exception):
    pass


def adaptive(case: Case, halves: int, seconds: float) -> Run:
    """To the end, with the step's error tolerances cut by the cube of `halves`."""
    c, parts, began = case.control, [], time.perf_counter()

    def watch(part):
        parts.append(part)
        if time.perf_counter() - began > seconds:
            raise _OutOfTime

    control = rx.StepControl(
        c.relative / halves**3, c.absolute / halves**3, c.max_step / halves,
        twisting=c.twisting / halves**3,
    )  # fmt: skip
    end = float(case.state.time) + case.duration
    try:
        return rx.adaptive_rollout(
            case.scene, case.state, end, case.method, control, max_steps=halves * MAX_STEPS,
            chunk=CHUNK, on_chunk=watch, throw=False,
        )  # fmt: skip
    except _OutOfTime:
        code = jnp.asarray(int(rx.Result.MAX_STEPS), jnp.int32)
        return join_runs(case.state, [*parts[:-1], _ended(parts[-1], code)])


def _ended(part: Run, code) -> Run:
    return Run(part.states, part.infos, code, part.rejected, part.wasted_iterations)


def advance(case: Case, halves: int, seconds: float) -> Run:
    """One run of a case."""
    return adaptive(case, halves, seconds) if case.step is None else fixed(case, halves)


def prepare(case: Case) -> None:
    """Compile what the case needs."""
    if case.step is None:
        compile_adaptive_rollout(case.scene, case.state, case.method, chunk=CHUNK)
        nothing = no_info(case.state.position.dtype)
        states, infos = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], (case.state, nothing))
        one = Run(states, infos, *(jnp.asarray(0, jnp.int32),) * 3)
        run = join_runs(case.state, [one])
    else:
        run = fixed(case, 1)
    measure(case.scene, run)


def evaluate(case: Case) -> dict[str, Any]:
    """Both runs of a case and the measures of the first."""
    began = time.perf_counter()
    run = advance(case, 1, SECONDS)
    code = rx.Result(int(run.result))
    kept = until_failure(run)
    span = case.duration if case.step is None else BLOCK * case.step
    row = {
        "code": code.name,
        "mend": None if code == rx.Result.SUCCESS else MESSAGES[code],
        "steps": len(run.times) - 1,
        "rejected": int(run.rejected),
        "iterations": int(np.sum(run.infos.iterations)),
        "reached": float((kept.times[-1] - case.state.time) / span),
        "precision": case.precision,
        "agreement": None,
    }
    row |= measure(case.scene, kept)
    if code == rx.Result.SUCCESS:
        half = advance(case, 2, 26.0 - (time.perf_counter() - began))
        row["half_code"] = rx.Result(int(half.result)).name
        if row["half_code"] == "SUCCESS":
            row["agreement"] = agreement(run, half)
    return row


def answer(cell: Cell) -> None:
    """Run one cell and print what came of it."""
    say = lambda **message: print(json.dumps(message), flush=True)
    began = time.perf_counter()
    prepared = None
    row: dict[str, Any]
    double = dict(cell.changes).get("precision") != "float32"
    try:
        with jax.enable_x64(double):
            case = build(cell)
            prepare(case)
            prepared = time.perf_counter()
            say(event="prepared")
            row = evaluate(case)
    except rx.SimulationError as problem:
        row = {"code": problem.result.name, "mend": str(problem)}
    except ValueError as problem:
        # the library's own begin with the argument's name and say the mend
        text = str(problem)
        named = ": " in text and " " not in text.split(": ", maxsplit=1)[0].replace(", ", "")
        row = {"code": "ValueError", "mend": text if named else None, "text": text}
    except Exception as problem:
        row = {"code": type(problem).__name__, "mend": None, "text": str(problem)[:500]}
    now = time.perf_counter()
    row["preparing"] = (prepared or now) - began
    row["seconds"] = now - (prepared or now)
    say(event="done", row=row)


def main() -> None:
    """Answer until the input ends."""
    cache = os.environ.get("JAX_COMPILATION_CACHE_DIR") or sys.argv[1]
    jax.config.update("jax_compilation_cache_dir", cache)
    known = {cell.name: cell for quick in (True, False) for cell in cells(quick)}
    for line in sys.stdin:
        answer(known[line.strip()])


if __name__ == "__main__":
    main()
