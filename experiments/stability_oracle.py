"""What a cell of the stability map is judged by: measures of a run, thresholds, and the verdict.

The thresholds were written before any cell was run.
"""

import enum
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from rodjax import energy, measures
from rodjax.dynamics.run import Run
from rodjax.dynamics.stepping import StepInfo
from rodjax.numerics.compilation import compiled
from rodjax.scenes.scene import Scene, projectors

AGREEMENT = 0.05  # accurate: the final shape with half the step, over the largest displacement
BALANCE = 0.05  # accurate: |residual of the energy ledger| over the largest energy in play
CREATED = 0.05  # wrong: energy from nowhere, over the same (the ledger's own quadrature is finer)
LINKING = 0.5  # wrong: a strand passage changes Tw + Wr - turns by 2, rounding by 1e-3 at most
STRETCH = {"float64": 1e-6, "float32": 1e-3}  # accurate: constraint error [-]; a step solves it
STRETCHED = 1e-2  # wrong: the rod is visibly longer than it is
STATES = 64  # of the energy ledger in one go: runs are cut and padded to it, for one program
LOOKS = 16  # states of a run at which Tw + Wr is taken: a passage stays


class Verdict(enum.StrEnum):
    """What can be said of a cell, the best first."""

    ACCURATE = "converged and accurate"
    CONVERGED = "converged"
    FAILED = "clean failure"
    WRONG = "wrong"


def verdict(row: dict[str, Any]) -> tuple[Verdict, str]:
    """Verdict on a row and its reason in a few words.

    A row has `code`: "SUCCESS", the name of a `Result`, "ValueError" (a named refusal), or how
    the process ended ("HANG", "CRASH", another exception's name). Of runs that ended it has
    `finite` and the measures `linking`, `created`, `balance`, `stretch`, `agreement`, each None
    where the scene does not have the quantity.
    """
    code = row["code"]
    if code != "SUCCESS":
        if row.get("mend"):
            return Verdict.FAILED, code
        return Verdict.WRONG, code.lower()
    if not row["finite"]:
        return Verdict.WRONG, "not finite"
    for name, limit, text in (
        ("linking", LINKING, "strand passage"),
        ("created", CREATED, "energy created"),
        ("stretch", STRETCHED, "stretched"),
    ):
        if not _within(row[name], limit):
            return Verdict.WRONG, f"{text} ({row[name]:.2g})"
    if row["agreement"] is None:
        return Verdict.CONVERGED, f"half the step: {row.get('half_code')}"
    limits = {"agreement": AGREEMENT, "balance": BALANCE, "stretch": STRETCH[row["precision"]]}
    for name, limit in limits.items():
        if not _within(row[name], limit):
            return Verdict.CONVERGED, f"{name} {row[name]:.2g}"
    return Verdict.ACCURATE, ""


def _within(value: float | None, limit: float) -> bool:
    """Whether a measure is absent or within its limit; what is not a number is not."""
    return value is None or (math.isfinite(value) and abs(value) <= limit)


def measure(scene: Scene, run: Run) -> dict[str, Any]:
    """The row's measures of one run."""
    names = ("linking", "created", "balance", "stretch")
    if not all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(run.states)):
        return {"finite": False} | dict.fromkeys(names)
    parts, count = [], len(run.times)
    for begin in range(0, max(count - 1, 1), STATES - 1):
        chosen = np.minimum(begin + np.arange(STATES), count - 1)
        ledger, stretch = _energies(scene, _choose(run, chosen))
        parts.append((jax.tree.map(np.asarray, ledger), float(stretch)))
    residual, largest = _joined([ledger for ledger, _ in parts])
    linking = None
    if turning_is_prescribed(scene, run.times):
        chosen = np.linspace(0, count - 1, LOOKS).astype(int)
        linking = float(jnp.max(jnp.abs(_linking_error(scene, _choose(run, chosen)))))
    rod = scene.rod
    rounding = 1e4 * float(jnp.finfo(rod.position.dtype).eps)
    largest += rounding * float(jnp.max(rod.stiffness) / jnp.sum(rod.length))
    values = (
        linking,
        max(0.0, -float(np.min(residual))) / largest,
        float(np.max(np.abs(residual))) / largest,
        max(stretch for _, stretch in parts),
    )
    return {"finite": True} | dict(zip(names, values, strict=True))


def turning_is_prescribed(scene: Scene, times) -> bool:
    """Whether both ends prescribe their rotation throughout, and so Tw + Wr."""
    return all(
        np.allclose(np.asarray(projectors(scene, jnp.asarray(t)))[:, 3:, 3:], np.eye(3))
        for t in (times[0], times[-1])
    )


def agreement(first: Run, second: Run) -> float:
    """Largest difference of the final positions over the largest displacement of the run."""
    start = np.asarray(first.states.position[0])
    moved = np.max(np.abs(np.asarray(first.states.position) - start))
    floor = 1e4 * float(jnp.finfo(first.states.position.dtype).eps) * np.ptp(start, axis=0).max()
    difference = np.max(np.abs(np.asarray(first.final.position - second.final.position)))
    return float(difference / max(moved, floor))


@compiled
def _energies(scene, run):
    stretch = lax.map(lambda s: measures.stretch_error(scene.rod, s), run.states)
    return energy.ledger(scene, run), jnp.max(stretch)


@compiled
def _linking_error(scene, run):
    return measures.linking(scene, run).error


def _choose(run: Run, chosen: np.ndarray) -> Run:
    """The run with these of its states, and what was lost between them."""
    states = jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf)[chosen]), run.states)
    lost = np.cumsum(np.concatenate([[0.0], np.asarray(run.infos.projection_loss)]))
    lost = jnp.asarray(np.diff(lost[chosen]), states.position.dtype)
    infos = StepInfo(*(lost,) * len(StepInfo._fields))
    return Run(states, infos, *(jnp.asarray(0, jnp.int32),) * 3)


def _joined(ledgers: list[energy.Ledger]) -> tuple[np.ndarray, float]:
    """Residual over the run from the ledgers of its parts, and the largest energy in play.

    In play are work, kinetic energy, and what strain, weight, contact and drag took up.
    """
    stored = lambda name: np.concatenate([getattr(part, name) for part in ledgers])

    def counted(name):  # from the run's start, where each part counts from its own
        values, total = [], 0.0
        for part in ledgers:
            values.append(total + getattr(part, name))
            total = values[-1][-1]
        return np.concatenate(values)

    swing = lambda values: float(np.max(values) - np.min(values))
    passed = ("work", "contact_work", "drag_loss")
    taken = [swing(counted(name)) for name in passed]
    taken += [swing(stored(name)) for name in ("strain", "gravity")]
    return counted("residual"), max(*taken, float(np.max(stored("kinetic"))))
