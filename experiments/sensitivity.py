"""What the example's milestones owe to the numbers that were chosen or assumed.

    python experiments/sensitivity.py [--elements N ...] [--until T] [--quick] [--out DIR]

Runs `timeline` with the contact strength k1 ten times larger and smaller (the paper, section 4.4,
claims that the result hardly depends on it), with the largest step halved, and on finer grids.
Writes DIR/summary.json and DIR/sensitivity.png.
"""

import argparse
import dataclasses
import json
import time
from pathlib import Path
from typing import Any, NamedTuple

import _settings  # noqa: F401 (first)
import equinox as eqx
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from example import PRESETS, Preset, scene

from rodjax import energy, measures
from rodjax.dynamics.adaptive import adaptive_rollout
from rodjax.dynamics.consistency import start
from rodjax.dynamics.step_control import StepControl
from rodjax.numerics.kept_programs import keep_compiled
from rodjax.numerics.results import Result

# closer strands need closer points (see `Contact.points_per_segment`)
POINTS = {0.1: 12, 1.0: 4, 10.0: 4}
TIMES = (20.0, 25.0, 29.0, 32.0)


class Case(NamedTuple):
    """One run."""

    name: str
    elements: int
    strength: float = 1.0  # factor on k1
    max_step: float = 1.0  # factor on the preset's largest step


def arguments(argv=None) -> argparse.Namespace:
    """Options of the command line."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--elements", type=int, nargs="+", metavar="N", help="default 200 400 1000")
    parser.add_argument("--until", type=float, metavar="T", help="end [s]; default 36 (16)")
    parser.add_argument("--quick", action="store_true", help="coarse and short, to try it out")
    parser.add_argument("--out", type=Path, default=Path("results/sensitivity"), metavar="DIR")
    options = parser.parse_args(argv)
    options.elements = options.elements or ([40] if options.quick else [200, 400, 1000])
    options.until = options.until or (16.0 if options.quick else 36.0)
    return options


def cases(elements: list[int]) -> list[Case]:
    """The run as shipped first, then what differs from it in one number."""
    first, *finer = elements
    return [
        Case("as shipped", first),
        Case("k1 x 10", first, strength=10.0),
        Case("k1 / 10", first, strength=0.1),
        Case("largest step halved", first, max_step=0.5),
        *(Case(f"{n} elements", n) for n in finer),
    ]


def run_case(preset: Preset, case: Case, until: float, quick: bool) -> dict[str, Any]:
    """Times, writhe and milestones of one run; `quick` runs end before points matter."""
    whole = scene(preset, case.elements)
    contact = whole.contact
    assert contact is not None
    law = eqx.tree_at(lambda law: law.k1, contact.law, case.strength * contact.law.k1)
    points = preset.points_per_segment if quick else POINTS[case.strength]
    contact = dataclasses.replace(contact, law=law, points_per_segment=points)
    whole = dataclasses.replace(whole, contact=contact)
    control = StepControl(*preset.tolerances, case.max_step * preset.max_step)
    began = time.perf_counter()
    run = adaptive_rollout(whole, start(whole), until, control=control, throw=False)
    seconds = time.perf_counter() - began
    linking = measures.linking(whole, run)
    times = np.asarray(run.times)
    torsion = energy.ledger(whole, run).torsion

    top = int(np.argmax(torsion))
    buckled = top < len(times) - 1
    code = Result(int(run.result))
    return {
        "case": case._asdict(),
        "result": code.name,
        "steps": len(times) - 1,
        "newton_iterations": int(np.sum(run.infos.iterations)),
        "seconds_with_compilation": seconds,
        "linking_error_max": float(jnp.max(jnp.abs(linking.error))),
        "smallest_gap": float(jnp.min(measures.contacts(whole, run).smallest)),
        "buckling_time": float(measures.time_of_maximum(run.times, torsion)) if buckled else None,
        "writhe_at": {
            f"{t:g}": float(np.interp(t, times, linking.writhe)) if t <= times[-1] else None
            for t in TIMES
        },
        "times": times.tolist(),
        "writhe": np.asarray(linking.writhe).tolist(),
    }


def draw(found: list[dict[str, Any]], out: Path) -> None:
    """Writhe over time for all runs, and enlarged where they part."""
    figure, both = plt.subplots(1, 2, figsize=(11, 4.2), layout="constrained")
    for axes in both:
        for one in found:
            name = one["case"]["name"]
            style = "k-" if name == "as shipped" else "-" if "k1" in name else "--"
            axes.plot(one["times"], one["writhe"], style, lw=1.2, label=name)
        axes.set(xlabel="time [s]", ylabel="writhe Wr")
        axes.grid(alpha=0.3)
    both[0].legend()
    last = max(one["times"][-1] for one in found)
    if last > 26:
        both[1].set_xlim(26, min(last, 33))
        both[1].set_title("through first contact and intertwining")
    figure.savefig(out / "sensitivity.png", dpi=150)


def main(argv=None) -> None:
    """Run, print, draw and write."""
    options = arguments(argv)
    keep_compiled()
    options.out.mkdir(parents=True, exist_ok=True)
    preset = PRESETS["timeline"]
    found = []
    print(
        f"{'case':22} {'steps':>5} {'its':>5} {'buckling':>9} "
        + " ".join(f"{f'Wr({t:g})':>8}" for t in TIMES)
        + f" {'linking':>8} {'d/D':>6}  result"
    )
    for case in cases(options.elements):
        one = run_case(preset, case, options.until, options.quick)
        found.append(one)
        number = lambda v, f: f"{'-':>8}" if v is None else f"{v:8.{f}f}"
        print(
            f"{case.name:22} {one['steps']:5d} {one['newton_iterations']:5d}"
            f"  {number(one['buckling_time'], 3)} "
            + " ".join(number(v, 3) for v in one["writhe_at"].values())
            + f" {one['linking_error_max']:8.1e} {one['smallest_gap']:6.2f}  {one['result']}",
            flush=True,
        )
    draw(found, options.out)
    reference, halved = found[0], found[3]
    summary = {"preset": preset.name, "until": options.until, "runs": found}
    if reference["buckling_time"] is not None and halved["buckling_time"] is not None:
        shift = halved["buckling_time"] / reference["buckling_time"] - 1
        summary["buckling_time_change_with_half_the_largest_step"] = shift
        print(f"half the largest step moves buckling by {100 * shift:.3f} %")
    if reference["writhe_at"]["32"] is not None:
        finest = found[-1]["writhe_at"]["32"]
        change = None if finest is None else finest - reference["writhe_at"]["32"]
        summary["writhe_at_32_change_on_the_finest_grid"] = change
        print(f"the finest grid changes Wr(32 s) by {change:+.4f}")
    (options.out / "summary.json").write_text(json.dumps(summary, indent=2) + "\n")
    print(f"results in {options.out}")


if __name__ == "__main__":
    main()
