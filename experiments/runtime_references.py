"""Converged references of `error_vs_runtime.py`, with an estimate of their own error.

A motion is run on three grids, each with half the element length and half the step of the one
before. With a second-order scheme the two finer runs give the reference by Richardson's
extrapolation, (4 fine - coarse) / 3, the two coarser ones another; the difference of the two is
the estimate, a bound as long as the extrapolation converges at all, and several times too large
where it gains its two orders.

The run through intertwining is different: strands that come into contact do so a little sooner or
later, and positions there are only as good as that time. Its reference is the finest run itself,
without extrapolation, its error the difference to the next coarser one.
"""

import json
from pathlib import Path
from typing import NamedTuple

import _settings  # noqa: F401 (first)
import jax
import numpy as np
from runtime_methods import Case, Outcome, chosen_steps, fixed_steps, static
from runtime_scenes import Problem, Record, at_points, errors

from rodjax.measuring.extrapolation import extrapolate


class Reference(NamedTuple):
    """What errors are measured against."""

    record: Record
    start: np.ndarray  # (POINTS, 3): the positions at the start
    error: dict[str, float]  # its own, relative, estimated
    made_of: str


def _solved(job) -> Outcome:
    outcome = job.read(jax.block_until_ready(job.run()))
    if outcome.result != "SUCCESS":
        raise RuntimeError(f"the reference failed: {outcome.result}")
    return outcome


def compute(problem: Problem, finest: tuple[int, int]) -> Reference:
    """The reference of a problem from runs up to `finest` (see `Problem.reference`)."""
    elements, each = finest
    start = at_points(np.asarray(problem.build(elements).rod.position))
    if problem.static:
        cases = [Case(elements // k) for k in (4, 2, 1)]
        solve = lambda case: _solved(static(problem, case)).record
        text = "equilibria"
    elif problem.steps is None:
        cases = [Case(elements // k, None, 1 / 8) for k in (2, 1)]
        coarse, fine = (_solved(chosen_steps(problem, case)).record for case in cases)
        own = errors(coarse, fine, start)
        return Reference(fine, start, own, f"adaptive run, {elements} elements, tolerances / 8")
    else:
        steps = each * len(problem.times)
        cases = [Case(elements // k, steps // k) for k in (4, 2, 1)]
        solve = lambda case: _solved(fixed_steps(problem, case, 0.8)).record
        text = f"{steps // 2} and {steps} steps"
    runs = [solve(case) for case in cases]
    coarse, fine = (extrapolate(a, b) for a, b in zip(runs[:-1], runs[1:], strict=True))
    own = errors(coarse, fine, start)
    return Reference(fine, start, own, f"{elements // 2} and {elements} elements, {text}")


def load_or_compute(name: str, problem: Problem, finest: tuple[int, int], out: Path) -> Reference:
    """The reference kept in `out` if it was made of the same runs, else a new one, kept there."""
    path = out / f"reference_{name}.npz"
    key = json.dumps([name, finest, problem.times])
    if path.exists():
        with np.load(path) as kept:
            if str(kept["key"]) == key:
                scalars = {k[7:]: kept[k] for k in kept if k.startswith("scalar_")}
                own = json.loads(str(kept["error"]))
                record = Record(kept["positions"], scalars)
                return Reference(record, kept["start"], own, str(kept["made_of"]))
    found = compute(problem, finest)
    out.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{name}.partial.npz")
    np.savez(
        temporary,
        key=key,
        positions=found.record.positions,
        start=found.start,
        error=json.dumps(found.error),
        made_of=found.made_of,
        **{f"scalar_{k}": v for k, v in found.record.scalars.items()},
    )
    temporary.replace(path)
    return found
