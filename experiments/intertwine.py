"""The paper's example: a straight rod, twisted at one end, buckles, loops and intertwines.

    python experiments/intertwine.py [--preset timeline|stout] [--elements N] [--until T]
                                     [--step DT] [--no-contact] [--quick] [--out DIR]

Writes run.h5, snapshots.png, energy.png, topology.png, reactions.png (Figs. 7, 8 and 9 of Goyal,
Perkins & Lee, and the reactions of the ends) and summary.json, and prints the paper's milestones
beside its own.
"""

import argparse
import json
import signal
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import _settings  # noqa: F401 (first)
import jax
import jax.numpy as jnp
import numpy as np
from example import FROM_PAPER, LOADING_AXIS, PRESETS, Preset, scene
from jax import lax
from tqdm import tqdm

from rodjax import energy, measures, plot, storage
from rodjax.adaptive import adaptive_rollout, compile_adaptive_rollout
from rodjax.compilation import compiled
from rodjax.consistency import start
from rodjax.fixed_rollout import rollout
from rodjax.generalized_alpha import GeneralizedAlpha
from rodjax.results import MESSAGES, Result
from rodjax.run import Run, join_runs
from rodjax.scene import Scene
from rodjax.state import State
from rodjax.step_control import StepControl

CHUNK = 20  # accepted steps between two looks at the progress
SNAPSHOT_TIMES = (20.0, 25.0, 29.0, 32.0)


def arguments(argv=None) -> argparse.Namespace:
    """Options of the command line, with the defaults that --quick changes."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--preset", choices=PRESETS, default="timeline")
    parser.add_argument("--elements", type=int, metavar="N", help="default 200 (60 with --quick)")
    parser.add_argument("--until", type=float, metavar="T", help="end [s]; default 36 (12)")
    parser.add_argument("--step", type=float, metavar="DT", help="fixed step [s]; default adaptive")
    parser.add_argument("--no-contact", action="store_true", help="let strands pass")
    parser.add_argument("--quick", action="store_true", help="coarse and short, to try it out")
    parser.add_argument("--out", type=Path, default=Path("results/intertwine"), metavar="DIR")
    options = parser.parse_args(argv)
    if options.elements is None:
        options.elements = 60 if options.quick else 200
    if options.until is None:
        options.until = 12.0 if options.quick else 36.0
    for name in ("elements", "until", "step"):
        value = getattr(options, name)
        if value is not None and not value > 0:
            parser.error(f"--{name}: must be positive, got {value}")
    return options


class Outcome(NamedTuple):
    """A run and how long it took."""

    run: Run
    compile_seconds: float
    run_seconds: float


class Recorder:
    """Keeps the parts of a run as they come, for the progress bar and for an interrupted run."""

    def __init__(self, first: State, until: float):
        self.first, self.parts = first, []
        self.bar = tqdm(
            total=until,
            unit="s",
            disable=None,
            bar_format="{l_bar}{bar}| {n:.2f} of {total:g} s simulated [{elapsed}{postfix}]",
        )

    def __call__(self, part: Run) -> None:
        self.parts.append(part)
        if len(part.times):
            steps = sum(len(p.times) for p in self.parts)
            self.bar.set_postfix_str(f"{steps} steps", refresh=False)
            self.bar.update(float(part.times[-1]) - self.bar.n)

    @property
    def run(self) -> Run | None:
        """The run so far."""
        return join_runs(self.first, self.parts) if self.parts else None


def run_adaptive(
    scene: Scene, first: State, until: float, method, control: StepControl, recorder: Recorder
) -> Outcome:
    """Steps chosen by the local error; the loop has been compiled before."""
    began = time.perf_counter()
    run = adaptive_rollout(
        scene, first, until, method, control, chunk=CHUNK, on_chunk=recorder, throw=False
    )
    return Outcome(run, 0.0, time.perf_counter() - began)


def fixed_times(step: float, until: float, switches) -> np.ndarray:
    """Ends of equal steps, and of shorter ones where a constraint changes and at the end."""
    times = step * np.arange(1, int(np.ceil(until / step - 1e-6)))
    for mark in (*(float(t) for t in switches), until):
        if 0 < mark <= until:
            times = np.append(times[np.abs(times - mark) > 1e-6 * step], mark)
    return np.sort(times)


def run_fixed(
    scene: Scene, first: State, times: np.ndarray, method: GeneralizedAlpha, recorder: Recorder
) -> Outcome:
    """Given steps, a block at a time; what the first call takes longer than when repeated is
    compilation."""
    size = max(n for n in range(1, 61) if len(times) % n == 0)
    began = time.perf_counter()
    jax.block_until_ready(rollout(scene, first, times[:size], method, throw=False))
    before, state, first_block = time.perf_counter(), first, 0.0
    for index in range(0, len(times), size):
        run = rollout(scene, state, times[index : index + size], method, throw=False)
        codes = np.asarray(run.infos.result)
        good = size if codes.max() == Result.SUCCESS else int(np.argmax(codes > 0))
        states = jax.tree.map(lambda leaf, n=good: np.asarray(leaf[1 : n + 1]), run.states)
        infos = jax.tree.map(lambda leaf, n=good: np.asarray(leaf[:n]), run.infos)
        code = Result(int(codes[good])) if good < size else Result.SUCCESS
        none = jnp.asarray(0, jnp.int32)
        recorder(Run(states, infos, jnp.asarray(int(code), jnp.int32), none, none))
        if index == 0:
            first_block = time.perf_counter() - before
        if code != Result.SUCCESS:
            break
        state = run.final
    compiling = before - began - first_block
    return Outcome(recorder.run, compiling, time.perf_counter() - before)


def simulate_and_store(
    scene: Scene, until: float, method, control: StepControl, schedule, store: Callable[[Run], None]
) -> Outcome:
    """Run the example, by the schedule if there is one; what has been computed is always stored."""
    began = time.perf_counter()
    if schedule is None:
        compile_adaptive_rollout(scene, method=method, chunk=CHUNK)
    first = start(scene)
    starting = time.perf_counter() - began
    recorder = Recorder(first, until)
    run = None
    try:
        if schedule is None:
            outcome = run_adaptive(scene, first, until, method, control, recorder)
        else:
            outcome = run_fixed(scene, first, schedule, method, recorder)
        run = outcome.run
    except BaseException as problem:
        run = recorder.run
        reached = float(first.time if run is None else run.times[-1])
        print(f"stopped at t = {reached:g} s by {type(problem).__name__}", file=sys.stderr)
        raise
    finally:
        recorder.bar.close()
        if run is not None:
            store(run)
    return outcome._replace(compile_seconds=outcome.compile_seconds + starting)


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


def measure(scene: Scene, run: Run) -> Measured:
    """All measures of a run, each once."""
    axis = jnp.asarray(LOADING_AXIS)

    @compiled
    def over_states(scene, states):
        def one(state):
            return (
                measures.stretch_error(scene.rod, state),
                measures.apex_angle(state, axis),
                energy.reactions(scene, state),
            )

        return lax.map(one, states)

    touching = (None, None)
    if scene.contact is not None:
        found = measures.contacts(scene, run)
        touching = found.total, found.smallest
    return Measured(
        energy.ledger(scene, run),
        measures.linking(scene, run),
        *over_states(scene, run.states),
        *touching,
    )


def summarise(
    options: argparse.Namespace, preset: Preset, scene: Scene, outcome: Outcome, found: Measured
) -> dict[str, Any]:
    """The numbers of summary.json; None where the run does not reach or have the quantity."""
    run, ledger, linking = outcome.run, found.ledger, found.linking
    times = np.asarray(run.times)
    at = lambda values, t: None if not times[0] <= t <= times[-1] else _at(times, values, t)
    finite = lambda value: float(value) if np.isfinite(value) else None
    linking_error = float(jnp.max(jnp.abs(linking.error)))
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
        "newton_iterations": int(run.infos.iterations.sum() + run.wasted_iterations),
        "compile_seconds": outcome.compile_seconds,
        "run_seconds": outcome.run_seconds,
        "end_time": float(times[-1]),
        "turns_end": float(linking.turns[-1]),
        "twist_end": float(linking.twist[-1]),
        "twist_eq15_end": float(linking.twist_eq15[-1]),
        "writhe_end": float(linking.writhe[-1]),
        "linking_error_max": linking_error,
        "stretch_max": float(jnp.max(found.stretch)),
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


def main(argv=None) -> int:
    """Run the example; the exit status is 0 if it succeeded."""
    options = arguments(argv)
    preset = PRESETS[options.preset]
    options.out.mkdir(parents=True, exist_ok=True)
    whole = scene(preset, options.elements, contact=not options.no_contact)
    print_inputs(preset, whole.contact is not None)
    method, control = GeneralizedAlpha(), StepControl(*preset.tolerances, preset.max_step)
    schedule = None
    if options.step is not None:
        schedule = fixed_times(options.step, options.until, whole.switch_times)
    path = options.out / "run.h5"
    store = partial(storage.save, path, whole, method=method, control=control, schedule=schedule)
    outcome = simulate_and_store(whole, options.until, method, control, schedule, store)
    run = outcome.run
    if len(run.times) < 3:
        code = Result(int(run.result))
        print(f"FAILED after t = {float(run.times[-1]):g} s: {MESSAGES[code]}", file=sys.stderr)
        return 1
    began = time.perf_counter()
    found = measure(whole, run)
    summary = summarise(options, preset, whole, outcome, found)
    summary["measure_seconds"] = time.perf_counter() - began
    store(run, measures=found._asdict(), measure_units=MEASURE_UNITS)
    began = time.perf_counter()
    draw(options.out, preset, whole, run, found, summary)
    summary["draw_seconds"] = time.perf_counter() - began
    (options.out / "summary.json").write_text(json.dumps(summary, indent=2) + "\n")
    print_milestones(summary, found)
    print_costs(summary)
    if summary["result"] != "SUCCESS":
        print(f"FAILED after t = {summary['end_time']:g} s: {summary['message']}", file=sys.stderr)
        return 1
    print(f"results in {options.out}")
    return 0


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that what there is gets stored
    sys.exit(main())
