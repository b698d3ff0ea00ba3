"""The paper's example on an accelerator and on the CPU beside it: one run, and batches of runs.

    python experiments/accelerator.py [--elements N] [--batches K ...] [--quick] [--out DIR]

Without contact, with contact while nothing touches, and from a state in which strands touch:
seconds of a step of one run and of vmapped runs of different drag, in double precision, of the
parts of a step alone, and on the accelerator how many kernels a step launches and how long they
keep it busy. Each platform is measured in a process of its own, both at the same time; each figure
is printed and written as soon as it is known. Writes DIR/cpu.json, DIR/accelerator.json and
DIR/summary.json.
"""

import argparse
import dataclasses
import json
import os
import pickle
import subprocess
import sys
import time
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import _settings  # noqa: F401 (first)
import jax
import jax.numpy as jnp
import numpy as np
from _kernels import kernels, seconds
from example import PRESETS, scene

import rodjax as rx
from rodjax.dynamics.stepping import prepare
from rodjax.equations.equations import step_equations
from rodjax.numerics.compilation import compiled
from rodjax.rods.state import State
from rodjax.scenes.scene import Scene

jax.config.update("jax_enable_compilation_cache", False)

PRESET = PRESETS["timeline"]
LAUNCHES = 2000  # passes of the loops that measure what a pass costs
STEPS = {"without_contact": 0.1, "nothing_touches": 0.1, "strands_touch": 0.02}  # [s]
TOUCHING_AT = 34.0  # strands of the example lie on each other by then [s]
MOST_VERTICES = 128  # in contact; of one size, since all sizes are evaluated under `vmap`
WORKERS = ("cpu", "accelerator")


def arguments(argv=None) -> argparse.Namespace:
    """Options of the command line."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--elements", type=int, metavar="N", help="default 100 (40 with --quick)")
    parser.add_argument("--batches", type=int, nargs="+", metavar="K", help="default 1 16 64 256")
    parser.add_argument("--steps", type=int, metavar="K", help="of a run; default 10 (2)")
    parser.add_argument("--patience", type=float, default=270.0, help="for compiling [s]")
    parser.add_argument("--quick", action="store_true", help="coarse and short, to try it out")
    parser.add_argument("--out", type=Path, default=Path("results/accelerator"), metavar="DIR")
    parser.add_argument("--worker", choices=WORKERS, help="measure one platform, here")
    options = parser.parse_args(argv)
    options.elements = options.elements or (40 if options.quick else 100)
    options.batches = options.batches or ([1, 2] if options.quick else [1, 16, 64, 256])
    options.steps = options.steps or (2 if options.quick else 10)
    return options


class Notebook:
    """Figures of a platform, on disk and on the screen as soon as they are known."""

    def __init__(self, path: Path):
        self.path, self.found, self.began = path, {}, time.perf_counter()

    def note(self, name: str, **values: Any) -> None:
        """Keep these values under a name."""
        self.found.setdefault(name, {}).update(values)
        self.path.write_text(json.dumps(self.found, indent=2) + "\n")
        digits = lambda v: f"{v:.4g}" if isinstance(v, float) else f"{v}"
        shown = ", ".join(f"{key} {digits(value)}" for key, value in values.items())
        print(f"[{self.path.stem} {self.elapsed:5.0f} s] {name}: {shown}", flush=True)

    @property
    def elapsed(self) -> float:
        """Since the start [s]."""
        return time.perf_counter() - self.began


def whole(elements: int, contact: bool) -> Scene:
    """The example, with room for so many vertices in contact."""
    found = scene(PRESET, elements, contact)
    if found.contact is None:
        return found
    roomy = dataclasses.replace(found.contact, capacities=(MOST_VERTICES,))
    return dataclasses.replace(found, contact=roomy)


def touching(elements: int, path: Path, quick: bool) -> None:
    """Write the example's state at TOUCHING_AT (an early one with `quick`), for both platforms."""
    base = scene(PRESET, elements)
    control = rx.StepControl(*PRESET.tolerances, PRESET.max_step)
    until = 1.0 if quick else TOUCHING_AT
    run = rx.adaptive_rollout(base, rx.start(base), until, control=control)
    jerk = jnp.zeros_like(run.final.rate) if run.final.jerk is None else run.final.jerk
    state = dataclasses.replace(run.final, settling=jnp.asarray(0, jnp.int32), jerk=jerk)
    near = base.find(state.position).contact
    assert near is not None
    print(f"touching at {until:g} s: {int(near[1].count)} pairs of segments near", flush=True)
    beside = path.with_suffix(".part")
    beside.write_bytes(pickle.dumps(jax.tree.map(np.asarray, state)))
    beside.rename(path)


def runs(base: Scene, state: State, times: jax.Array, factors: jax.Array | None):
    """What is timed: (the program's function, its arguments); a factor on drag a lane."""

    def one(base, state, times, factor):
        varied = dataclasses.replace(
            base,
            loads=tuple(
                dataclasses.replace(
                    load,
                    normal_coefficient=factor * load.normal_coefficient,
                    tangential_coefficient=factor * load.tangential_coefficient,
                )
                for load in base.loads
            ),
        )
        run = rx.rollout(varied, state, times, save_every=len(times), throw=False)
        return run.final.position, run.infos.iterations, run.result

    if factors is None:
        return one, (base, state, times, jnp.asarray(1.0))
    return jax.vmap(one, (None, None, None, 0)), (base, state, times, factors)


def parts_alone(options, state: State) -> dict[str, tuple]:
    """Parts of a step from a state in which strands touch: (function, arguments, lanes)."""
    most = options.batches[-1]
    base = whole(options.elements, contact=True)
    bare = dataclasses.replace(base, contact=None)
    stop = state.time + STEPS["strands_touch"]
    near = compiled(lambda base, s: base.find(s.position))
    equations = step_equations(base, state, stop, jnp.asarray(0.5), near(base, state))
    smooth = step_equations(bare, state, stop, jnp.asarray(0.5), bare.find(state.position))
    guess = smooth.guess(state.force)
    blocks = compiled(lambda e, x: e.linearize(x).blocks)(smooth, guess)
    right = jnp.ones_like(guess)
    batch = lambda tree: jax.tree.map(lambda leaf: jnp.stack([leaf] * most), tree)
    element = blocks.diagonal[1] + 0.0
    columns = jnp.ones((element.shape[0], element.shape[0] + 1))
    scan = lambda body: (
        lambda x, *rest: jax.lax.scan(lambda x, _: (body(x, *rest), None), x, None, LAUNCHES)[0]
    )
    solve = lambda a, b: a.solve(b)
    found = {
        "empty_loop": (scan(lambda x: 1.0 + 0.5 * x), (jnp.ones(9),)),
        "loop_of_products": (scan(lambda x, a: 1e-9 * (a @ x)), (columns, element)),
        "loop_of_small_solves": (scan(lambda x, a: jnp.linalg.solve(a, x)), (columns, element)),
        "block_solve": (solve, (blocks, right)),
        "increment_without_contact": (lambda e, x: e.newton_increment(x), (smooth, guess)),
        "search": (lambda base, s: base.find(s.position), (base, state)),
        "residual_touching": (lambda e, x: e.residual(x), (equations, guess)),
        "increment_touching": (lambda e, x: e.newton_increment(x), (equations, guess)),
    }
    if most > 1:
        found[f"block_solve_x{most}"] = (jax.vmap(solve), (batch(blocks), batch(right)))
        find = jax.vmap(lambda base, s: base.find(s.position), (None, 0))
        found[f"search_x{most}"] = (find, (base, batch(state)))
    return found


def lowered(function, arguments):
    """Ready for the backend's compiler, which needs no lock of Python."""
    return compiled(function).lower(*arguments)


def compile_all(pool, programs: dict[str, tuple]) -> dict[str, tuple[Future, tuple]]:
    """Compilations under way, in the order given."""
    under_way = {}
    for name, (function, arguments) in programs.items():
        under_way[name] = pool.submit(lowered(function, arguments).compile), arguments
    return under_way


def measure(book: Notebook, name: str, program, arguments, steps: int, lanes: int, trace: bool):
    """Time a program and count what it launches."""
    best, (_, iterations, result) = seconds(program, arguments)
    book.note(
        name,
        seconds_of_a_step=best / steps,
        milliseconds_of_a_step_and_lane=1e3 * best / steps / lanes,
        iterations_of_a_step=float(np.mean(np.asarray(iterations))),
        failed=int(np.sum(np.asarray(result) != 0)),
    )
    if not trace:
        return
    try:
        found = kernels(program, arguments)
    except Exception as error:  # the figures above are kept whatever the profiler can do
        book.note(name, trace=repr(error)[:200])
        return
    book.note(
        name,
        kernels_of_a_step=found["kernels"] / steps,
        copies_of_a_step=found["copies"] / steps,
        to_host_of_a_step=found["to_host"] / steps,
        busy_seconds_of_a_step=found["busy_seconds"] / steps,
        busy_share=found["busy_seconds"] / best,
        longest=found["longest"],
    )


def note_parts(book: Notebook, parts: dict[str, tuple[Future, tuple]]) -> None:
    """Time parts of a step alone; of a loop, a pass."""
    for name, (future, given) in parts.items():
        passes = LAUNCHES if "loop" in name else 1
        best, _ = seconds(future.result(), given, 0.5)
        book.note(name, microseconds=1e6 * best / passes)


def work(options) -> None:
    """Measure the platform of this process."""
    book = Notebook(options.out / f"{options.worker}.json")
    device, on_cpu = jax.devices()[0], jax.default_backend() == "cpu"
    if on_cpu and options.worker != "cpu":
        return print("no accelerator here: the CPU alone is measured", flush=True)
    book.note("machine", device=device.device_kind, jax=jax.__version__, cores=os.cpu_count())
    pool = ThreadPoolExecutor(4)
    path = options.out / "touching.pickle"
    times = lambda name, begin: begin + STEPS[name] * jnp.arange(1.0, options.steps + 1)
    factors = lambda lanes: None if lanes == 1 else jnp.linspace(0.9, 1.1, lanes)

    def programs(contact: bool):
        base, name = whole(options.elements, contact), "without_contact"
        state = prepare(base, rx.start(base))
        for lanes in options.batches:
            yield str(lanes), runs(base, state, times(name, state.time), factors(lanes))

    bare = compile_all(pool, dict(programs(contact=False)))
    if on_cpu:
        touching(options.elements, path, options.quick)
        book.note("touching", until=book.elapsed)
    for lanes, (future, given) in bare.items():
        name = f"without_contact x{lanes}"
        measure(book, name, future.result(), given, options.steps, int(lanes), not on_cpu)
    while not path.exists():
        time.sleep(0.2)
    state = jax.tree.map(jnp.asarray, pickle.loads(path.read_bytes()))
    small = compile_all(pool, parts_alone(options, state))
    full = compile_all(pool, dict(programs(contact=True)))
    note_parts(book, small)
    for lanes, (future, (base, start, at_rest, factor)) in full.items():
        left = options.patience - book.elapsed
        try:
            program = future.result(timeout=max(left, 1.0))
        except TimeoutError:
            book.note(f"strands_touch x{lanes}", compiled=False)
            continue
        later = times("strands_touch", state.time)
        for name, given in (
            ("strands_touch", (base, state, later, factor)),
            ("nothing_touches", (base, start, at_rest, factor)),
        ):
            traced = not on_cpu and book.elapsed < options.patience
            label = f"{name} x{lanes}"
            measure(book, label, program, given, options.steps, int(lanes), traced)
    # again, now that nothing is compiled beside
    note_parts(book, small)
    for lanes, (future, given) in () if on_cpu else bare.items():
        name = f"without_contact x{lanes}"
        measure(book, name, future.result(), given, options.steps, int(lanes), trace=True)
    book.note("all", seconds=book.elapsed)
    os._exit(0)  # compilations that came too late are not waited for


def table(found: dict[str, dict]) -> str:
    """Milliseconds of a step of a whole batch, and of a step and lane."""
    rows = sorted({name for one in found.values() for name in one if " x" in name})
    lines = [f"{'':24}" + "".join(f"{name + ' [ms]':>18}{'of a lane':>11}" for name in found)]
    for row in sorted(rows, key=lambda name: (name.split(" x")[0], int(name.split(" x")[1]))):
        line = f"{row:24}"
        for one in found.values():
            took = one.get(row, {}).get("seconds_of_a_step")
            lanes = int(row.split(" x")[1])
            line += (
                f"{'-':>18}{'-':>11}"
                if took is None
                else (f"{1e3 * took:18.2f}{1e3 * took / lanes:11.3f}")
            )
        lines.append(line)
    return "\n".join(lines)


def main(argv=None) -> None:
    """Start a process for each platform, wait, print and write."""
    options = arguments(argv)
    options.out.mkdir(parents=True, exist_ok=True)
    if options.worker:
        return work(options)
    for name in (*(f"{worker}.json" for worker in WORKERS), "touching.pickle"):
        (options.out / name).unlink(missing_ok=True)
    given = [sys.executable, __file__, *(sys.argv[1:] if argv is None else argv)]
    started = []
    for worker in WORKERS:
        platforms = {"JAX_PLATFORMS": "cpu"} if worker == "cpu" else {}
        started.append(subprocess.Popen([*given, "--worker", worker], env=os.environ | platforms))
    codes = [one.wait() for one in started]
    found = {
        worker: json.loads((options.out / f"{worker}.json").read_text())
        for worker in WORKERS
        if (options.out / f"{worker}.json").exists()
    }
    print(table(found))
    (options.out / "summary.json").write_text(json.dumps(found, indent=2) + "\n")
    print(f"results in {options.out}")
    if any(codes):
        raise SystemExit(f"a process ended with {codes}")


if __name__ == "__main__":
    main()
