"""What comes of a run of the paper's example: its measures, numbers, milestones and figures."""

import argparse
import io
from concurrent.futures import Future
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from example import FROM_PAPER, LOADING_AXIS, Preset

from rodjax import energy, measures, plot
from rodjax.dynamics.adaptive import placeholder
from rodjax.dynamics.run import Run, of_no_steps
from rodjax.measuring.blocks import over_states
from rodjax.numerics.results import MESSAGES, Result
from rodjax.scenes.scene import Scene

SNAPSHOT_TIMES = (20.0, 25.0, 29.0, 32.0)


class Outcome(NamedTuple):
    """A run and how long it took."""

    run: Run
    compile_seconds: float
    run_seconds: float
    prepared: Future | None = None  # when what measures and draws it is compiled


class Measured(NamedTuple):
    """Everything measured on a run, over its saved times."""

    ledger: energy.Ledger
    linking: measures.Linking
    stretch: np.ndarray
    apex_angle: np.ndarray
    reactions: energy.Reactions
    contact_force: np.ndarray | None  # sum of the magnitudes of the pair forces [N]
    gap: np.ndarray | None  # smallest d/D of the pairs that act; infinite without one


MEASURE_UNITS = {"stretch": "1", "apex_angle": "rad", "contact_force": "N", "gap": "1"}
"""Units of the plain arrays of `Measured`, for the file."""


@over_states
def _others(state, scene, axis):
    return (
        measures.stretch_error(scene.rod, state),
        measures.apex_angle(state, axis),
        energy.reactions(scene, state),
    )


def measure(scene: Scene, run: Run) -> Measured:
    """All measures of a run, each once, as arrays of numpy, which compiles nothing."""
    touching = (None, None)
    if scene.contact is not None:
        found = measures.contacts(scene, run)
        touching = found.total, found.smallest
    found = Measured(
        energy.ledger(scene, run),
        measures.linking(scene, run),
        *_others(run.states, scene, np.asarray(LOADING_AXIS)),
        *touching,
    )
    return jax.tree.map(np.asarray, found)


def prepare_measures(scene: Scene) -> None:
    """Compile what `measure` and `draw` will need, and import what draws."""
    run = of_no_steps(placeholder(scene))
    measure(scene, run)
    energy.strain_energy_density(scene.rod, run.final)
    plot.energies(np.arange(2.0), {"nothing": np.zeros(2)}).savefig(io.BytesIO())


def summarise(
    options: argparse.Namespace, preset: Preset, scene: Scene, outcome: Outcome, found: Measured
) -> dict[str, Any]:
    """The numbers of summary.json; None where the run does not reach or have the quantity."""
    run, ledger, linking = outcome.run, found.ledger, found.linking
    times = np.asarray(run.times)
    at = lambda values, t: None if not times[0] <= t <= times[-1] else _at(times, values, t)
    finite = lambda value: float(value) if np.isfinite(value) else None
    linking_error = float(np.max(np.abs(linking.error)))
    code = Result(int(run.result))
    if scene.contact is not None and linking_error > 1 and code == Result.SUCCESS:
        code = Result.STRAND_PASSAGE
    buckled = int(np.argmax(ledger.torsion)) < len(times) - 1
    touch, settled, gap = np.inf, None, None
    if scene.contact is not None:
        force = np.asarray(found.contact_force)
        if force[-1] > 0:
            touch = float(measures.first_crossing(run.times, found.contact_force, 0.01 * force[-1]))
        gap = finite(np.min(found.gap))
        cutoff = float(scene.contact.cutoff)
        settled = {
            "distance_over_diameter": finite(found.gap[-1]),
            "cutoff_m": cutoff,
            "cutoff_over_diameter": cutoff / preset.diameter,
        }
    return {
        "preset": preset.name,
        "assumed_inputs": preset.assumed,
        "elements": options.elements,
        "until": options.until,
        "step": options.step,
        "contact": scene.contact is not None,
        "steps": len(times) - 1,
        "rejected": int(run.rejected),
        "newton_iterations": int(
            np.sum(np.asarray(run.infos.iterations)) + int(run.wasted_iterations)
        ),
        "compile_seconds": outcome.compile_seconds,
        "run_seconds": outcome.run_seconds,
        "end_time": float(times[-1]),
        "turns_end": float(linking.turns[-1]),
        "twist_end": float(linking.twist[-1]),
        "twist_eq15_end": float(linking.twist_eq15[-1]),
        "writhe_end": float(linking.writhe[-1]),
        "linking_error_max": linking_error,
        "stretch_max": float(np.max(found.stretch)),
        "energy_balance_error": finite(ledger.balance_error),
        "buckling_time": float(measures.time_of_maximum(run.times, ledger.torsion))
        if buckled
        else None,
        "apex_orthogonal_time": finite(
            measures.first_crossing(run.times, found.apex_angle, 0.5 * np.pi)
        ),
        "first_contact_time": finite(touch),
        "writhe_at_first_contact": at(linking.writhe, touch),
        "writhe_at": {f"{t:g}": at(linking.writhe, t) for t in SNAPSHOT_TIMES},
        "min_gap": gap,
        "contact_settled": settled,
        "result": code.name,
        "message": MESSAGES[code],
    }


def _at(times, values, t: float) -> float:
    return float(np.interp(t, times, np.asarray(values)))


def print_inputs(preset: Preset, with_contact: bool) -> None:
    """The inputs, those from the paper and those assumed apart."""
    print(f"preset {preset.name}")
    given = {k: v for k, v in FROM_PAPER.items() if with_contact or k != "contact law"}
    if preset.hold_at is not None:
        given["left end"] = f"held from {preset.hold_at:g} s on"
    for title, inputs in (("from the paper", given), ("ASSUMED", preset.assumed)):
        for name, value in inputs.items():
            print(f"  {title:>14}  {name}: {value}")


def print_milestones(summary: dict[str, Any], found: Measured) -> None:
    """The paper's milestones beside those of the run."""
    linking, ledger = found.linking, found.ledger
    times = np.asarray(linking.time)
    columns = (linking.turns, linking.twist, linking.writhe, ledger.bending, ledger.torsion,
               ledger.work)  # fmt: skip
    buckling = summary["buckling_time"]
    rows = [
        ("buckling (largest torsional energy)", "16-18 s, Lk about 4, Wr 0", buckling),
        ("shallow helix", "20 s", 20.0),
        ("loop", "25 s", 25.0),
        ("apex orthogonal to the axis", "25 s (4.2), 29 s (4.3)", summary["apex_orthogonal_time"]),
        ("first contact", "29 s, Wr 1", summary["first_contact_time"]),
        ("collapsed loop", "29 s, Wr 1", 29.0),
        ("intertwined", "32 s, Wr slightly over 2", 32.0),
        ("end of the run", "", float(times[-1])),
    ]
    print(f"\n{'milestone':<36} {'paper':<26} {'here: t [s]':>11} {'Lk':>7} {'Tw':>7} {'Wr':>7}"
          f" {'bending':>10} {'torsion':>10} {'work [J]':>10}")  # fmt: skip
    for name, paper, t in rows:
        if t is None or not times[0] <= t <= times[-1]:
            own = f"{'not reached':>11}"
        else:
            lk, tw, wr, *energies = (_at(times, column, t) for column in columns)
            own = f"{t:11.2f} {lk:7.3f} {tw:7.3f} {wr:7.3f}"
            own += "".join(f" {value:10.3e}" for value in energies)
        print(f"{name:<36} {paper:<26} {own}")
    if buckling is not None:
        added = summary["turns_end"] - _at(times, linking.turns, buckling)
        print(f"{'turns added after buckling':<36} {'less than 1/2':<26} {added:11.3f}")


def print_costs(summary: dict[str, Any]) -> None:
    """Steps, seconds, and how well what is conserved was."""
    balance = summary["energy_balance_error"]
    print(
        f"\n{summary['steps']} steps ({summary['rejected']} rejected),"
        f" {summary['newton_iterations']} Newton iterations in {summary['run_seconds']:.2f} s,"
        f" compiled in {summary['compile_seconds']:.1f} s;"
        f" measures {summary['measure_seconds']:.1f} s, figures {summary['draw_seconds']:.1f} s\n"
        f"|Tw + Wr - turns| at most {summary['linking_error_max']:.1e}, stretch at most"
        f" {summary['stretch_max']:.1e}, energy balance error"
        f" {'undefined' if balance is None else format(balance, '.2%')}"
    )


def draw(
    out: Path, preset: Preset, scene: Scene, run: Run, found: Measured, summary: dict[str, Any]
) -> None:
    """Figs. 7, 8 and 9 of the paper, and the reactions."""
    ledger, linking, times = found.ledger, found.linking, np.asarray(run.times)
    events = {
        "buckling": summary["buckling_time"],
        "first contact": summary["first_contact_time"],
        "left end held": preset.hold_at,
    }
    marks = {name: t for name, t in events.items() if t is not None and t < times[-1]}
    assumed = f"preset {preset.name}: D = {1e3 * preset.diameter:g} mm (assumed)"
    wanted = [t for t in SNAPSHOT_TIMES if t <= times[-1]] or [float(times[-1])]
    states = [run.nearest(t) for t in wanted]
    plot.snapshots(
        scene.rod,
        states,
        [energy.strain_energy_density(scene.rod, state) for state in states],
        magnify=max(1.0, round(0.006 / preset.diameter)),
        title=assumed,
    ).savefig(out / "snapshots.png", dpi=150)
    plot.energies(
        times,
        {
            "bending": ledger.bending,
            "torsion": ledger.torsion,
            "total strain": ledger.strain,
            "work of the drive": ledger.work,
            "lost to drag": ledger.drag_loss,
            "kinetic": ledger.kinetic,
        },
        marks=marks,
        title=f"Energy; {assumed}",
    ).savefig(out / "energy.png", dpi=150)
    plot.topology(
        times,
        linking.twist,
        linking.writhe,
        linking.turns,
        marks=marks,
        title=f"Conversion of twist to writhe; {assumed}",
    ).savefig(out / "topology.png", dpi=150)
    axis = np.asarray(LOADING_AXIS)
    force, torque = np.asarray(found.reactions.force), np.asarray(found.reactions.torque)
    plot.reactions(
        times,
        {
            "right end, along e2": force[:, 0] @ axis,
            "left end, along e2": force[:, 1] @ axis,
            "right end, across e2": np.linalg.norm(np.delete(force[:, 0], 1, axis=1), axis=1),
        },
        # both in the sense of positive twist: -e2 at the right end, e2 at the left
        {"right end": -torque[:, 0] @ axis, "left end": torque[:, 1] @ axis},
        turns=linking.turns,
        title=f"Reactions of the ends; {assumed}",
    ).savefig(out / "reactions.png", dpi=150)
