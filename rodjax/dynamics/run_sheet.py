"""A run in a few lines: over which times, by which steps, and how it ended."""

from typing import TYPE_CHECKING

import numpy as np

from rodjax.inputs.sheets import Sheet, quantity
from rodjax.inputs.units import used
from rodjax.inputs.validation import all_known, known
from rodjax.numerics.results import MESSAGES, Result

if TYPE_CHECKING:
    from rodjax.dynamics.run import Run


def sheet_of_run(run: "Run") -> Sheet:
    """Of what is traced, or of a batch of runs, the shapes."""
    told = known(run.states.time) and known(run.result) and all_known(run.infos)
    if not told or np.ndim(run.result) != 0:
        return Sheet(repr(run))
    times, unit = np.asarray(run.times), used().time
    code, steps = Result(int(run.result)), len(run.infos.result)
    if not len(times):
        return Sheet(f"Run without states: {code.name}", (("result", MESSAGES[code]),))
    span = f"{times[0]:.6g} to {times[-1]:.6g} {unit}"
    rows = [("saved states", f"{len(times)}, of {run.states.position.shape[-2]} nodes")]
    rejected = int(run.rejected)
    rows.append(("steps", f"{steps}" + (f", {rejected} more taken back" if rejected else "")))
    if steps:
        taken = np.diff(times) / np.maximum(np.diff(np.asarray(run.step_counts)), 1)
        rows.append(("step size", quantity(taken, unit)))
        iterations = float(np.mean(np.asarray(run.infos.iterations)))
        rows.append(("Newton iterations", f"{iterations:.3g} a step"))
    lost = int(np.sum(~np.all(np.isfinite(np.asarray(run.states.position)), (1, 2))))
    if lost:
        rows.append(("no numbers in", f"{lost} states"))
    if code is not Result.SUCCESS:
        rows.append(("result", MESSAGES[code]))
    return Sheet(f"Run over {span}: {code.name}", tuple(rows))
