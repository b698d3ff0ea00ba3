"""The diameter profile that delays first contact longest, at fixed mass and under the same drive.

    python experiments/design_rod.py [--elements N] [--steps K] [--quick] [--out DIR]

One gradient, in reverse mode through buckling and the growth of the loop, moves the diameters of
all elements of `timeline` at once; each stays within 5 % of the example's and the mass is kept.
The left end is never held.
Writes DIR/summary.json, DIR/profile.npz and DIR/design.png.
"""

import argparse
import dataclasses
import json
import sys
import time
from pathlib import Path

import _settings  # noqa: F401 (first)
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import optax
from example import FIRST_CONTACT, PRESETS, resized, scene
from jax import lax

import rodjax as rx
from rodjax import measures

PRESET = dataclasses.replace(PRESETS["timeline"], hold_at=None)
RANGE = 0.05  # largest relative change of a diameter


def arguments(argv=None) -> argparse.Namespace:
    """Options of the command line."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--elements", type=int, metavar="N", help="default 100 (20 with --quick)")
    parser.add_argument("--steps", type=int, metavar="K", help="of the descent; default 15 (2)")
    parser.add_argument("--quick", action="store_true", help="coarse and short, to try it out")
    parser.add_argument("--out", type=Path, default=Path("results/design_rod"), metavar="DIR")
    options = parser.parse_args(argv)
    options.elements = options.elements or (20 if options.quick else 100)
    options.steps = options.steps or (2 if options.quick else 15)
    return options


def shaped(base: rx.Scene, factors) -> rx.Scene:
    """The scene whose diameters are changed by these factors, then all scaled to the same mass."""
    rod = base.rod
    mass = rod.mass * rod.length
    factors = factors * jnp.sqrt(jnp.sum(mass) / jnp.sum(mass * factors**2))
    return dataclasses.replace(base, rod=resized(rod, factors))


def first_contact(base: rx.Scene, times, factors):
    """Time of first contact [s], and the run."""
    new = shaped(base, factors)
    run = rx.rollout(new, rx.start(new), times, throw=False)
    force = measures.contacts(new, run).total
    # the force grows through orders of magnitude: its logarithm is nearly linear in a step
    level = jnp.log(FIRST_CONTACT)
    time = measures.first_crossing(run.times, jnp.log(force + 1e-3 * FIRST_CONTACT), level)
    # strands that pass each other within one step have touched as well: no way out for the descent
    passed = jnp.abs(lax.stop_gradient(measures.linking(new, run).error))
    time = jnp.minimum(time, measures.first_crossing(run.times, passed, 0.5))
    return jnp.where(run.result == 0, time, jnp.nan), run


def draw(out: Path, base, before, after, history) -> None:
    """Profiles, the descent, and the rod before and after at the first's contact."""
    figure, axes = plt.subplots(1, 3, figsize=(12, 3.8), layout="constrained")
    middle = np.asarray(base.rod.midpoints)
    for (name, run, new), style in zip((before, after), ("k:", "C0-"), strict=True):
        axes[0].step(middle, 1e3 * np.asarray(new.rod.diameter), style, where="mid", label=name)
        state = run.nearest(history[0])
        x = np.asarray(state.position)
        axes[2].plot(np.hypot(x[:, 0], x[:, 2]), x[:, 1], style, label=name)
    axes[0].set(xlabel="s [m]", ylabel="diameter [mm]")
    axes[1].plot(history, "o-", ms=3)
    axes[1].set(xlabel="step of the descent", ylabel="first contact [s]")
    axes[2].set(xlabel="distance from the axis [m]", ylabel="e2 [m]", aspect="equal")
    axes[2].set_title(f"t = {history[0]:.2f} s")
    for one in axes:
        one.grid(alpha=0.3)
    axes[0].legend()
    figure.savefig(out / "design.png", dpi=130)
    plt.close(figure)


def main(argv=None) -> int:
    """Optimise and report."""
    options = arguments(argv)
    rx.keep_compiled()
    options.out.mkdir(parents=True, exist_ok=True)
    base = scene(PRESET, options.elements)
    if options.quick:
        base = dataclasses.replace(
            base, contact=dataclasses.replace(base.contact, segments=40, points_per_segment=8)
        )
    last, count = (40.0, 160) if options.quick else (45.0, 300)
    times = np.linspace(0.0, last, count + 1)[1:]
    # a rod that is never in contact has a loss without slope: the end of the run stands for it
    loss = lambda factors: -jnp.minimum(first_contact(base, times, factors)[0], last)
    began = time.perf_counter()
    found = rx.minimize(
        loss,
        jnp.ones(options.elements),
        bounds=rx.Interval(1 - RANGE, 1 + RANGE),
        optimizer=optax.adam(0.1),
        max_steps=options.steps,
        progress=True,
    )
    seconds = time.perf_counter() - began
    ones = jnp.ones(options.elements)
    runs = [first_contact(base, times, factors)[1] for factors in (ones, found.parameters)]
    scenes = [shaped(base, factors) for factors in (ones, found.parameters)]
    history = [-value for value in found.history]
    mass = [float(jnp.sum(one.rod.mass * one.rod.length)) for one in scenes]
    summary = {
        "elements": options.elements,
        "parameters": options.elements,
        "result": found.result.name,
        "steps": found.steps,
        "gradients": found.evaluations,
        "seconds_with_compilation": seconds,
        "first_contact_before": history[0],
        "first_contact_after": max(history),
        "first_contact_history": history,
        "run_ended": last,
        "mass_change": mass[1] / mass[0] - 1,
        "results": [rx.Result(int(run.result)).name for run in runs],
    }
    np.savez(options.out / "profile.npz", factors=np.asarray(found.parameters))
    (options.out / "summary.json").write_text(json.dumps(summary, indent=2) + "\n")
    draw(
        options.out,
        base,
        ("example", runs[0], scenes[0]),
        ("optimised", runs[1], scenes[1]),
        history,
    )
    print(
        f"first contact: {history[0]:.3f} s before, {max(history):.3f} s after {found.steps} steps"
        f" ({found.evaluations} gradients by {options.elements} diameters, {seconds:.0f} s);"
        f" mass changed by {summary['mass_change']:.1e}"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
