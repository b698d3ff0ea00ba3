"""Derivatives through the whole example: reverse mode, forward mode and differences.

    python experiments/gradient_check.py [--preset timeline|stout] [--elements N]
                                         [--inputs NAME ...] [--no-memory] [--quick] [--out DIR]

An adaptive run is recorded and its steps are replayed. The derivatives of the writhe at four times
(before buckling, in the loop, at first contact, intertwined) by the logarithms of a dozen inputs
are taken in both modes and compared with central differences over the same steps, extrapolated
with an estimate of their own error (Ridders 1982). Errors are relative to max(|g|, |value|), since
the inputs are factors of about 1. Writes DIR/summary.json and DIR/gradients.png; the last line
printed is a JSON object with the worst errors and the cost of the gradient.
"""

import argparse
import json
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import _settings  # noqa: F401 (first)
import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from _gradient_factors import NAMES, Factors, varied
from _memory import peak_mib
from example import PRESETS, Preset, scene
from jax import lax
from jaxtyping import Array, Float
from tqdm import tqdm

from rodjax import measures
from rodjax.dynamics.adaptive import adaptive_rollout
from rodjax.dynamics.fixed_rollout import rollout
from rodjax.dynamics.run import Run
from rodjax.dynamics.step_control import StepControl
from rodjax.numerics.compilation import compiled
from rodjax.scenes.scene import Scene

# before buckling, in the loop, at first contact, intertwined [s]
TIMES = {"timeline": (15.0, 25.0, 29.2, 32.0), "stout": (8.0, 10.0, 10.6, 11.0)}
QUICK_TIMES = (1.0, 2.0)
WIDTHS = tuple(1e-3 * 0.5**k for k in range(4))  # less where the writhe changes more
MEMORY_ELEMENTS, MEMORY_STEPS, MEMORY_SAVES = 1000, 2000, 20


def recorded(preset: Preset, base: Scene, until: float) -> Run:
    """The adaptive run whose steps are replayed."""
    new, state, method = varied(base, Factors.ones())
    control = StepControl(*preset.tolerances, preset.max_step)
    return adaptive_rollout(new, state, until, method, control)


def writhes(
    base: Scene, by: Factors, times: Float[Array, " k"], saves: tuple[int, ...], every: int = 1
) -> Float[Array, " m"]:
    """Writhe after the given numbers of steps."""
    new, state, method = varied(base, by)
    run = rollout(new, state, times, method, save_every=every, throw=False)
    wanted = jnp.asarray(saves) // every
    found = lax.map(measures.writhe, jax.tree.map(lambda leaf: leaf[wanted], run.states))
    return jnp.where(run.result == 0, found, jnp.nan)


class Programs(NamedTuple):
    """The compiled functions, all of the factors."""

    value: Callable  # writhes
    gradient: Callable  # weights . writhes and its gradient
    slope: Callable  # derivative of the writhes along a direction
    compile_seconds: dict[str, float]


def build(base: Scene, times, saves) -> Programs:
    """Compile value, gradient and slope, timing each."""
    value = lambda by: writhes(base, by, times, saves)
    weighted = lambda by, weights: weights @ value(by)
    functions = {
        "value": (compiled(value), ()),
        "gradient": (compiled(jax.value_and_grad(weighted)), (jnp.ones(len(saves)),)),
        "slope": (compiled(lambda by, d: jax.jvp(value, (by,), (d,))[1]), (Factors.ones(),)),
    }
    seconds = {}
    for name, (function, more) in functions.items():
        began = time.perf_counter()
        jax.block_until_ready(function(Factors.ones(), *more))
        first = time.perf_counter() - began
        seconds[name] = first - timed(function, more, 1)[0]
        print(f"{name}: compiled in {seconds[name]:.1f} s", flush=True)
    return Programs(*(function for function, _ in functions.values()), seconds)


def timed(function, more, repeats: int) -> list[float]:
    """Seconds of calls at the run recorded."""
    found = []
    for _ in range(repeats):
        began = time.perf_counter()
        jax.block_until_ready(function(Factors.ones(), *more))
        found.append(time.perf_counter() - began)
    return found


def direction(name: str) -> Factors:
    """The unit vector of one factor."""
    zero = jax.tree.map(jnp.zeros_like, Factors.ones())
    return eqx.tree_at(lambda by: getattr(by, name), zero, jnp.ones(()))


def differences(value, name: str, slope: float) -> tuple[np.ndarray, np.ndarray]:
    """Central difference by Ridders' extrapolation over halved widths, and its error estimate.

    The widths are those that change the writhe by 1e-3 at most, judged by the largest slope.
    """
    step, table = direction(name), []
    best, error = None, None
    for k, widest in enumerate(WIDTHS):
        width = widest / max(1.0, slope)
        at = lambda sign, w=width: value(
            jax.tree.map(lambda x, d: x + sign * w * d, Factors.ones(), step)
        )
        row = [np.asarray(at(1) - at(-1)) / (2 * width)]
        for j in range(k):
            row.append(row[j] + (row[j] - table[k - 1][j]) / (4.0 ** (j + 1) - 1))
            estimate = np.maximum(np.abs(row[-1] - row[-2]), np.abs(row[-1] - table[k - 1][j]))
            if best is None:
                best, error = row[-1], estimate
            better = estimate < error
            best, error = np.where(better, row[-1], best), np.where(better, estimate, error)
        table.append(row)
    return best, error


def compare(
    programs: Programs, marks: tuple[float, ...], names: Sequence[str], partial: Path
) -> list[dict[str, Any]]:
    """All derivatives, one row for each input and time; written to `partial` as they come."""
    one = Factors.ones()
    value = np.asarray(programs.value(one))
    eye = np.eye(len(marks))
    reverse = [programs.gradient(one, jnp.asarray(row))[1] for row in eye]
    rows = []
    for name in tqdm(names, desc="differences", disable=None):
        forward = np.asarray(programs.slope(one, direction(name)))
        central, error = differences(programs.value, name, float(np.max(np.abs(forward))))
        for i, t in enumerate(marks):
            back = float(getattr(reverse[i], name))
            size = max(abs(back), abs(value[i]))
            rows.append(
                {
                    "input": name,
                    "time": t,
                    "writhe": float(value[i]),
                    "reverse": back,
                    "forward": float(forward[i]),
                    "difference": float(central[i]),
                    "modes_disagree": abs(back - float(forward[i])) / size,
                    "differences_disagree": abs(back - float(central[i])) / size,
                    "differences_own_error": float(error[i]) / size,
                }
            )
        whole = partial.with_suffix(".new")
        whole.write_text(json.dumps(rows, indent=2))
        whole.replace(partial)
    return rows


def memory(preset: Preset, what: str, quick: bool) -> dict[str, float]:
    """Peak resident memory [MiB] of the value or the gradient of a long, fine run.

    To be called in a process of its own; the peak includes compilation.
    """
    elements, steps, every = (40, 20, 5) if quick else (MEMORY_ELEMENTS, MEMORY_STEPS, MEMORY_SAVES)
    until = QUICK_TIMES[-1] if quick else TIMES[preset.name][-1]
    times = jnp.linspace(0.0, until, steps + 1)[1:]
    base = scene(preset, elements)
    value = lambda by: writhes(base, by, times, (steps,), every)[0]
    function = compiled(value if what == "value" else jax.value_and_grad(value))
    found = jax.block_until_ready(function(Factors.ones()))
    began = time.perf_counter()
    jax.block_until_ready(function(Factors.ones()))
    leaves = np.asarray([np.asarray(leaf) for leaf in jax.tree.leaves(found)])
    return {
        "peak_mib": peak_mib(),
        "seconds": time.perf_counter() - began,
        "finite": bool(np.all(np.isfinite(leaves))),
    }


def measure_memory(options) -> dict[str, Any]:
    """Peak memory of value and gradient, each in a process of its own."""
    found = {}
    for what in ("value", "gradient"):
        command = [sys.executable, __file__, "--preset", options.preset, "--memory-of", what]
        done = subprocess.run(
            command + ["--quick"] * options.quick, stdout=subprocess.PIPE, text=True, check=True
        )
        found[what] = json.loads(done.stdout.splitlines()[-1])
        print(f"memory of the {what}: {found[what]}", flush=True)
    added = found["gradient"]["peak_mib"] - found["value"]["peak_mib"]
    return found | {"added_mib": added}


def draw(rows, marks, out: Path) -> None:
    """Derivatives, and by how much they disagree."""
    found = list(dict.fromkeys(row["input"] for row in rows))
    figure, both = plt.subplots(1, 2, figsize=(12, 0.32 * len(found) + 1.5), layout="constrained")
    place = np.arange(len(found))
    floor = 1e-17
    for i, t in enumerate(marks):
        chosen = [row for row in rows if row["time"] == t]
        shift = 0.18 * (i - 0.5 * (len(marks) - 1))
        pick = lambda key, chosen=chosen: np.array([row[key] for row in chosen])
        color = f"C{i}"
        both[0].barh(
            place + shift, np.abs(pick("reverse")), 0.16, color=color, label=f"t = {t:g} s"
        )
        disagree = np.maximum(pick("differences_disagree"), floor)
        both[1].plot(disagree, place + shift, "o", ms=5, color=color)
        both[1].plot(np.maximum(pick("modes_disagree"), floor), place + shift, "x", color=color)
        own = np.maximum(pick("differences_own_error"), floor)
        both[1].plot(own, place + shift, "|", ms=9, color=color)
    names = [name.replace("_", " ") for name in found]
    both[0].set_yticks(place, names)
    both[1].set_yticks(place, [])
    for axes in both:
        axes.set_xscale("log")
        axes.set_ylim(len(found) - 0.5, -0.5)
        axes.grid(axis="x", alpha=0.3)
    both[0].set_xlabel("|d writhe / d log input|")
    both[0].legend(loc="upper center", bbox_to_anchor=(0.5, 1.1), ncols=len(marks), fontsize=8)
    for mark, label in (
        ("ko", "reverse against differences"),
        ("k|", "own error of the differences"),
        ("kx", "reverse against forward"),
    ):
        both[1].plot([], [], mark, label=label)
    both[1].legend(loc="upper center", bbox_to_anchor=(0.5, 1.1), ncols=3, fontsize=8)
    both[1].set_xlabel("relative disagreement")
    figure.savefig(out / "gradients.png", dpi=130)
    plt.close(figure)


def arguments(argv=None) -> argparse.Namespace:
    """Options of the command line."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--preset", choices=PRESETS, default="timeline")
    parser.add_argument("--elements", type=int, metavar="N", help="default 200 (20 with --quick)")
    parser.add_argument("--inputs", nargs="+", choices=NAMES, default=NAMES, metavar="NAME",
                        help="compare the derivatives by these only")  # fmt: skip
    parser.add_argument("--no-memory", action="store_true", help="leave the memory report out")
    parser.add_argument("--memory-of", choices=("value", "gradient"), help=argparse.SUPPRESS)
    parser.add_argument("--quick", action="store_true", help="coarse and short, to try it out")
    parser.add_argument("--out", type=Path, default=Path("results/gradient_check"), metavar="DIR")
    options = parser.parse_args(argv)
    options.elements = options.elements or (20 if options.quick else 200)
    return options


def main(argv=None) -> int:
    """Print and write the report."""
    options = arguments(argv)
    preset = PRESETS[options.preset]
    if options.memory_of:
        print(json.dumps(memory(preset, options.memory_of, options.quick)))
        return 0
    options.out.mkdir(parents=True, exist_ok=True)
    marks = QUICK_TIMES if options.quick else TIMES[preset.name]
    base = scene(preset, options.elements)
    run = recorded(preset, base, marks[-1])
    times = run.times[1:]
    saves = tuple(int(np.argmin(np.abs(np.asarray(run.times) - t))) for t in marks)
    marks = tuple(round(float(run.times[k]), 3) for k in saves)
    programs = build(base, times, saves)
    weights = (jnp.asarray(np.eye(len(marks))[-1]),)
    repeats = 3 if options.quick else 5
    values = timed(programs.value, (), repeats)
    gradients = timed(programs.gradient, weights, repeats)
    print(f"value {statistics.median(values):.2f} s, with gradient"
          f" {statistics.median(gradients):.2f} s")  # fmt: skip
    rows = compare(programs, marks, options.inputs, options.out / "derivatives.json")
    print(f"\n{'input':<18} {'t [s]':>7} {'writhe':>10} {'reverse':>12} {'forward':>12}"
          f" {'difference':>12} {'modes':>8} {'differ.':>8} {'own err.':>8}")  # fmt: skip
    for row in rows:
        derivatives = (row[key] for key in ("reverse", "forward", "difference"))
        errors = (row[key] for key in row if "disagree" in key or "error" in key)
        print(
            f"{row['input']:<18} {row['time']:7.2f} {row['writhe']:10.3e} "
            + " ".join(f"{value:12.5e}" for value in derivatives)
            + " "
            + " ".join(f"{value:8.1e}" for value in errors)
        )
    beyond = [max(row["differences_disagree"] - row["differences_own_error"], 0.0) for row in rows]
    short = {
        "worst_modes_disagree": max(row["modes_disagree"] for row in rows),
        "worst_differences_disagree": max(row["differences_disagree"] for row in rows),
        "worst_beyond_own_error": max(beyond),
        "value_seconds": statistics.median(values),
        "gradient_seconds": statistics.median(gradients),
        "cost_ratio": statistics.median(gradients) / statistics.median(values),
        "compile_seconds": programs.compile_seconds,
    }
    more = {
        "preset": preset.name,
        "elements": options.elements,
        "steps": len(times),
        "newton_iterations": int(np.sum(run.infos.iterations)),
        "times": marks,
        "value_seconds_all": values,
        "gradient_seconds_all": gradients,
        "derivatives": rows,
    }
    write = lambda: (options.out / "summary.json").write_text(json.dumps(short | more, indent=2))
    write()  # kept, should the memory's long runs be interrupted
    draw(rows, marks, options.out)
    if not options.no_memory:
        short["memory"] = measure_memory(options)
        write()
    print(json.dumps(short))
    return 0


if __name__ == "__main__":
    sys.exit(main())
