"""What each part of a scene costs: a ladder from a static rod to the whole example.

    python experiments/ladder.py [--elements N] [--repeats K] [--quick] [--out DIR]

Each rung adds one part to the rung before. For each, the operations in the traced program of a
step, the time to compile a rollout and the time of a warm step are measured. Below the ladder: what
it saves to leave inertia out, and to hold Newton's derivative within a step. Writes
DIR/ladder.md, DIR/ladder.png and DIR/summary.json.
"""

import argparse
import dataclasses
import json
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import _settings  # noqa: F401 (first)
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from example import PRESETS, contact_law, drive, rod, scene

import rodjax as rx
from rodjax.equations.equations import Equations, step_equations
from rodjax.numerics import newton
from rodjax.numerics.compilation import compiled
from rodjax.scenes.placing import placing

jax.config.update("jax_enable_compilation_cache", False)

PRESET = PRESETS["timeline"]
AXIS = (0.0, 1.0, 0.0)
STEP = 0.02  # [s]
TOUCHING = 30.5  # when the rod of the last rung has intertwined [s]


class Rung(NamedTuple):
    """A scene, and the state its steps begin from (None: its own start)."""

    name: str
    scene: rx.Scene
    state: rx.State | None = None


def rungs(elements: int, quick: bool) -> list[Rung]:
    """The ladder, each with one part more than the one before; the first is static."""
    slender = rod(PRESET, elements)
    plain = dataclasses.replace(slender, rotary_inertia=None)
    driven, slider = rx.Clamped(rotation=drive(PRESET)), rx.Slider(AXIS)
    drag = rx.MorisonDrag(1000.0, normal_coefficient=0.1, tangential_coefficient=0.01)
    gravity = rx.Gravity((0.0, 0.0, -1e-4))
    held = rx.Switched(slider, rx.Clamped(), 30.0)
    contact = contact_law(PRESET)
    whole = scene(PRESET, elements)
    touching = None
    if not quick:
        control = rx.StepControl(*PRESET.tolerances, PRESET.max_step)
        touching = rx.adaptive_rollout(whole, rx.start(whole), TOUCHING, control=control).final
    ladder = [
        Rung("statics of a cantilever", rx.Scene(plain, rx.Clamped(), loads=(gravity,))),
        Rung("clamped and sliding rod", rx.Scene(plain, rx.Clamped(), slider)),
        Rung("+ rotary inertia", rx.Scene(slender, rx.Clamped(), slider)),
        Rung("+ drive", rx.Scene(slender, driven, slider)),
        Rung("+ gravity", rx.Scene(slender, driven, slider, (gravity,))),
        Rung("+ drag", rx.Scene(slender, driven, slider, (gravity, drag))),
        Rung("+ an end held later", rx.Scene(slender, driven, held, (gravity, drag))),
        Rung("+ contact, nothing near", rx.Scene(slender, driven, held, (gravity, drag), contact)),
    ]
    return [*ladder, Rung("the example, touching", whole, touching)] if touching else ladder


def lighter(elements: int) -> list[Rung]:
    """The same twisted rod in linear drag, with less and less inertia."""
    slender = rod(PRESET, elements)
    ends = rx.Clamped(rotation=drive(PRESET)), rx.Slider(AXIS)
    drag = rx.LinearDrag(normal=1e-3, tangential=1e-3, rotational=1e-9)
    rods = {
        "linear drag, all inertia": slender,
        "without rotary inertia": dataclasses.replace(slender, rotary_inertia=None),
        "without inertia": dataclasses.replace(slender, rotary_inertia=None, mass=None),
    }
    return [Rung(name, rx.Scene(one, *ends, (drag,))) for name, one in rods.items()]


def operations(jaxpr) -> int:
    """Equations of a traced program, those of its inner programs counted once each."""
    total = 0
    for equation in jaxpr.eqns:
        total += 1
        for parameter in jax.tree.leaves(
            list(equation.params.values()), is_leaf=lambda x: hasattr(x, "eqns")
        ):
            inner = getattr(parameter, "jaxpr", parameter)
            if hasattr(inner, "eqns"):
                total += operations(inner)
    return total


@compiled
def _steps(scene: rx.Scene, state: rx.State, count: int):
    """So many equal steps: the worst result and all iterations."""
    stops = state.time + STEP * jnp.arange(1, count + 1)
    run = rx.rollout(scene, state, stops, save_every=count, throw=False)
    return run.result, jnp.sum(run.infos.iterations)


@compiled
def _static(scene: rx.Scene, state: rx.State, count: int):
    """A static load path in so many steps."""
    _, info = rx.equilibrium(scene, state, load_steps=count, throw=False)
    return info.result, info.iterations


class Prepared(NamedTuple):
    """A rung compiled: what remains to be timed, and its row but for that."""

    call: Callable
    row: dict[str, Any]


def prepared(rung: Rung, count: int, static: bool = False) -> Prepared:
    """Compile the program of `count` steps of a rung, and count its operations."""
    if static:
        state, program = placing(rung.scene), _static
        traced = lambda scene, state: rx.equilibrium(scene, state, throw=False)
    else:
        state = rx.start(rung.scene) if rung.state is None else rung.state
        program, traced = _steps, lambda scene, state: rx.step(scene, state, state.time + STEP)
    call = lambda: jax.block_until_ready(program(rung.scene, state, count))
    began = time.perf_counter()
    result, iterations = call()
    first = time.perf_counter() - began
    if int(result) != 0:
        raise RuntimeError(f"a rung failed: {rx.Result(int(result)).name}")
    row = {
        "name": rung.name,
        "operations": operations(jax.make_jaxpr(traced)(rung.scene, state).jaxpr),
        "compile_seconds": first - _seconds(call),
        "iterations_per_step": float(iterations) / count,
    }
    return Prepared(call, row)


def measured(rungs: list[Prepared], count: int, repeats: int) -> list[dict[str, Any]]:
    """The rows of the table. Warm runs in turn, so that a busy spell slows all rungs alike."""
    rounds = [[_seconds(rung.call) for rung in rungs] for _ in range(repeats)]
    medians = map(statistics.median, zip(*rounds, strict=True))
    return [
        rung.row | {"step_milliseconds": 1e3 * median / count}
        for rung, median in zip(rungs, medians, strict=True)
    ]


def _seconds(call: Callable, *given) -> float:
    began = time.perf_counter()
    jax.block_until_ready(call(*given))
    return time.perf_counter() - began


@compiled
def _equations(scene: rx.Scene, state: rx.State, stop, near: bool) -> Equations:
    """The equations of a step, with the pairs near each other or without contact."""
    radius = rx.GeneralizedAlpha().spectral_radius
    equations = step_equations(scene, state, stop, radius)
    if not near:
        return equations.without_contact()
    expected = equations.increment(equations.guess(state.force))[:, :3]
    return dataclasses.replace(equations, found=scene.find(state.position, expected))


def _iteration(by):
    """A step's iteration by a function of `newton`."""

    def root(equations):
        method, force = rx.GeneralizedAlpha(), equations.scheme.state.force
        guess = equations.limited(equations.guess(force))
        return by(equations, guess, method.newton_tolerance(guess.dtype), method.max_iterations)[1]

    return compiled(root)


def held_derivative(elements: int, until: float, sample: int, repeats: int) -> dict[str, Any]:
    """What it costs to hold the derivative within a step, over that of a new one each iteration.

    Over every so many steps of the example, those with pairs near each other apart from the rest.
    """
    whole = scene(PRESET, elements)
    control = rx.StepControl(*PRESET.tolerances, PRESET.max_step)
    run = rx.adaptive_rollout(whole, rx.start(whole), until, control=control)
    ways = {"new": _iteration(newton.iterate), "held": _iteration(newton.iterate_held)}
    counts = {near: {way: [] for way in ways} for near in (False, True)}
    seconds = {near: dict.fromkeys(ways, 0.0) for near in (False, True)}
    failed = 0
    for k in range(1, len(run.times) - 1, sample):
        state, stop = run.state(k), run.times[k + 1]
        equations = _equations(whole, state, stop, True)
        nearby = equations.found_contact
        assert nearby is not None
        near = bool(nearby.near.count > 0)
        if not near:
            equations = _equations(whole, state, stop, False)
        infos = {way: jax.block_until_ready(solve(equations)) for way, solve in ways.items()}
        if any(int(info.result) for info in infos.values()):
            failed += 1
            continue
        trials = {way: [] for way in ways}
        for _ in range(repeats):
            for way, solve in ways.items():
                trials[way].append(_seconds(solve, equations))
        for way, info in infos.items():
            counts[near][way].append(int(info.iterations))
            seconds[near][way] += statistics.median(trials[way])
    found: dict[str, Any] = {"failed": failed}
    for near, name in ((False, "apart"), (True, "near")):
        steps = len(counts[near]["new"])
        found[name] = {"steps": steps}
        if steps:
            found[name] |= {f"iterations_{way}": float(np.mean(counts[near][way])) for way in ways}
            found[name]["ratio"] = seconds[near]["held"] / seconds[near]["new"]
    return found


def table(rows: list[dict[str, Any]]) -> str:
    """The rows in Markdown."""
    lines = [
        "| scene | operations traced | compilation [s] | a step [ms] | iterations a step |",
        "|---|---:|---:|---:|---:|",
    ]
    for row in rows:
        lines.append(
            f"| {row['name']} | {row['operations']} | {row['compile_seconds']:.1f}"
            f" | {row['step_milliseconds']:.2f} | {row['iterations_per_step']:.2f} |"
        )
    return "\n".join(lines) + "\n"


def draw(rows: list[dict[str, Any]], out: Path) -> None:
    """The three costs of every rung."""
    names = [row["name"] for row in rows]
    figure, axes = plt.subplots(
        1, 3, figsize=(11, 0.34 * len(rows) + 1.2), sharey=True, layout="constrained"
    )
    kinds = {
        "operations": "operations traced for a step",
        "compile_seconds": "compilation of a rollout [s]",
        "step_milliseconds": "a warm step [ms]",
    }
    for one, (key, label) in zip(axes, kinds.items(), strict=True):
        values = [row[key] for row in rows]
        bars = one.barh(range(len(rows)), values, color="C0")
        one.bar_label(bars, [f"{v:.3g}" if v < 1000 else f"{v:.0f}" for v in values], padding=3)
        one.set_xlim(0, 1.3 * max(values))
        one.set_xlabel(label)
    axes[0].set_yticks(range(len(rows)), names)
    axes[0].invert_yaxis()
    figure.savefig(out / "ladder.png", dpi=130)
    plt.close(figure)


def arguments(argv=None) -> argparse.Namespace:
    """Options of the command line."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--elements", type=int, metavar="N", help="default 100 (10 with --quick)")
    parser.add_argument("--repeats", type=int, metavar="K", help="default 9 (2 with --quick)")
    parser.add_argument("--quick", action="store_true", help="coarse, without the last rungs")
    parser.add_argument("--out", type=Path, default=Path("results/ladder"), metavar="DIR")
    options = parser.parse_args(argv)
    options.elements = options.elements or (10 if options.quick else 100)
    options.repeats = options.repeats or (2 if options.quick else 9)
    return options


def main(argv=None) -> int:
    """Measure, print and write."""
    options = arguments(argv)
    options.out.mkdir(parents=True, exist_ok=True)
    count = 5 if options.quick else 50
    ladder = rungs(options.elements, options.quick)
    jobs = ladder[:3] if options.quick else [*ladder, *lighter(options.elements)]
    compiled_rungs = []
    for rung in jobs:
        compiled_rungs.append(prepared(rung, count, static=rung is ladder[0]))
        row = compiled_rungs[-1].row
        print(f"{rung.name}: compiled in {row['compile_seconds']:.1f} s", flush=True)
    rows = measured(compiled_rungs, count, options.repeats)
    print(table(rows))
    until = 1.0 if options.quick else 32.0
    held = held_derivative(options.elements, until, 4, options.repeats)
    for name in ("apart", "near"):
        found = held[name]
        if found["steps"]:
            print(
                f"derivative held, {found['steps']} steps with pairs {name}:"
                f" {found['iterations_held']:.1f} iterations for {found['iterations_new']:.1f},"
                f" {found['ratio']:.2f} of the time"
            )
    print(f"{held['failed']} of the steps sampled failed by either")
    summary = {
        "elements": options.elements,
        "steps_timed": count,
        "repeats": options.repeats,
        "rows": rows,
        "held_derivative": held,
    }
    (options.out / "ladder.md").write_text(table(rows))
    (options.out / "summary.json").write_text(json.dumps(summary, indent=2) + "\n")
    draw(rows, options.out)
    return 0


if __name__ == "__main__":
    sys.exit(main())
