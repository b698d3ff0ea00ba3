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

import _settings  # noqa: F401 (first)
import jax
import jax.numpy as jnp
import numpy as np
from example import PRESETS, scene
from intertwine_results import (
    MEASURE_UNITS,
    Outcome,
    draw,
    measure,
    prepare_measures,
    print_costs,
    print_inputs,
    print_milestones,
    summarise,
)
from tqdm import tqdm

from rodjax import storage
from rodjax.dynamics.adaptive import adaptive_rollout, compile_adaptive_rollout
from rodjax.dynamics.consistency import start
from rodjax.dynamics.fixed_rollout import rollout
from rodjax.dynamics.run import Run, join_runs
from rodjax.dynamics.step_control import StepControl
from rodjax.equations.generalized_alpha import GeneralizedAlpha
from rodjax.numerics.kept_programs import keep_compiled
from rodjax.numerics.results import MESSAGES, Result
from rodjax.rods.state import State
from rodjax.scenes.scene import Scene

CHUNK = 20  # accepted steps between two looks at the progress


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
    """Run the example, by the schedule if there is one; what has been computed is always stored.

    The measures are compiled meanwhile.
    """
    began, prepared = time.perf_counter(), None
    if schedule is None:
        later = partial(prepare_measures, scene)
        prepared = compile_adaptive_rollout(scene, method=method, chunk=CHUNK, meanwhile=later)
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
    compiling = outcome.compile_seconds + starting
    return outcome._replace(compile_seconds=compiling, prepared=prepared)


def main(argv=None) -> int:
    """Run the example; the exit status is 0 if it succeeded."""
    options = arguments(argv)
    keep_compiled()
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
    if outcome.prepared is not None:
        outcome.prepared.result()
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
