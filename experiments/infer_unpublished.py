"""What the paper did not publish, inferred from the milestones that it did.

    python experiments/infer_unpublished.py [--elements N] [--quick] [--out DIR]

Diameter, drive (when four turns are reached, and the rate after that) and seed curvature of the
illustrative example, by least squares over the milestones in sections 4.2 to 4.4 of Goyal, Perkins
& Lee, starting from a guess made by trial. The score is fixed below, before any fit: the sum over
the milestones of ((found - published) / tolerance)^2, a tolerance being half of the range that the
text leaves. The preset `timeline` is what this found, rounded. Writes DIR/summary.json.
"""

import argparse
import dataclasses
import json
import sys
import time
from pathlib import Path
from typing import NamedTuple

import _settings  # noqa: F401 (first)
import jax
import jax.numpy as jnp
import numpy as np
from example import LAST_TIME, LOADING_AXIS, PRESETS, resized, scene

import rodjax as rx
from rodjax import measures

PRESET = PRESETS["timeline"]
TURNS = 4.0  # reached at the end of the first ramp


class Milestone(NamedTuple):
    """A published number and how far off it may be."""

    published: float
    tolerance: float
    text: str


SCORE = {
    "buckling_time": Milestone(17.0, 1.0, "buckles at 16 to 18 s"),
    "turns_at_buckling": Milestone(4.0, 0.1, "with about four turns"),
    "apex_orthogonal_time": Milestone(27.0, 2.0, "apex orthogonal at 25 s (4.2) or 29 s (4.3)"),
    "first_contact_time": Milestone(29.0, 1.0, "collapsed by 29 s"),
    "writhe_at_first_contact": Milestone(1.0, 0.1, "one loop's writhe"),
    "writhe_at_32": Milestone(2.1, 0.3, "slightly over 2"),
    "turns_added": Milestone(0.4, 0.1, "less than half a turn added after buckling"),
}


def arguments(argv=None) -> argparse.Namespace:
    """Options of the command line."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--elements", type=int, metavar="N", help="default 100 (20 with --quick)")
    parser.add_argument("--quick", action="store_true", help="coarse, two trials")
    parser.add_argument("--out", type=Path, default=Path("results/infer_unpublished"),
                        metavar="DIR")  # fmt: skip
    options = parser.parse_args(argv)
    options.elements = options.elements or (20 if options.quick else 100)
    return options


GUESS = {"diameter": 3e-4, "ramp_end": 6.0, "rate_after": 0.02, "seed_curvature": 1e-3}


def of_preset() -> dict[str, float]:
    """The preset's values."""
    return {
        "diameter": PRESET.diameter,
        "ramp_end": PRESET.drive[1][0],
        "rate_after": PRESET.rate_after,
        "seed_curvature": PRESET.seed_curvature,
    }


def built(base: rx.Scene, p) -> rx.Scene:
    """The example with these inputs."""
    rod = resized(base.rod, p["diameter"] / PRESET.diameter)
    seed = p["seed_curvature"] / PRESET.seed_curvature
    rod = dataclasses.replace(rod, natural_curvature=seed * rod.natural_curvature)
    times = jnp.stack([jnp.zeros(()), p["ramp_end"], jnp.asarray(LAST_TIME)])
    turns = jnp.stack(
        [
            jnp.zeros(()),
            jnp.asarray(TURNS),
            TURNS + p["rate_after"] * (LAST_TIME - p["ramp_end"]),
        ]
    )
    drive = rx.Turn(LOADING_AXIS, rx.PiecewiseLinear(times, -2 * jnp.pi * turns))
    return dataclasses.replace(base, rod=rod, first_end=rx.Clamped(rotation=drive))


def milestones(new: rx.Scene, run: rx.Run):
    """The milestones of a run to 32 s, in the order of the score."""
    buckling = measures.buckling_time(new, run)
    force = measures.contacts(new, run).total
    touch = measures.first_crossing(run.times, jnp.log(force + 1e-12), jnp.log(0.01 * force[-1]))
    writhe = measures.linking(new, run).writhe
    at_touch = jnp.interp(touch, run.times, writhe)
    turns = lambda t: measures.turns(new, t)
    return jnp.stack(
        [
            buckling,
            turns(buckling),
            measures.apex_orthogonal_time(run, jnp.asarray(LOADING_AXIS)),
            touch,
            at_touch,
            writhe[-1],
            turns(run.times[-1]) - turns(buckling),
        ]
    )


def main(argv=None) -> int:
    """Fit and report."""
    options = arguments(argv)
    rx.keep_compiled()
    options.out.mkdir(parents=True, exist_ok=True)
    base = scene(PRESET, options.elements)
    if options.quick:
        contact = dataclasses.replace(base.contact, segments=40, points_per_segment=8)
        base = dataclasses.replace(base, contact=contact)
    steps = np.linspace(0.0, 32.0, 161 if options.quick else 321)[1:]

    def predict(p):
        new = built(base, p)
        run = rx.rollout(new, rx.start(new), steps, throw=False)
        return jnp.where(run.result == 0, milestones(new, run), jnp.nan)

    goals = list(SCORE.values())
    data = rx.Observations(
        np.arange(len(goals)),
        np.array([goal.published for goal in goals]),
        np.array([goal.tolerance for goal in goals]),
    )
    began = time.perf_counter()
    fit = rx.least_squares(
        predict, GUESS, data, bounds=rx.Positive(), tolerance=1e-3, progress=True,
        max_steps=2 if options.quick else 20,
    )  # fmt: skip
    seconds = time.perf_counter() - began
    found = np.asarray(data.values) + fit.residuals
    of = lambda values: float(np.sum(((values - data.values) / data.deviation) ** 2))
    preset = of(np.asarray(jax.jit(predict)(of_preset())))
    print(f"\n{fit}\nscore {fit.history[0]:.3g} for the guess, {fit.chi_squared:.3g} for the fit,"
          f" {preset:.3g} for the preset")  # fmt: skip
    print(f"\n{'milestone':<26}{'published':>10}{'tolerance':>10}{'here':>10}  text")
    for name, goal, value in zip(SCORE, goals, found, strict=True):
        print(f"{name:<26}{goal.published:10.3g}{goal.tolerance:10.3g}{value:10.4g}  {goal.text}")
    summary = {
        "elements": options.elements,
        "seconds_with_compilation": seconds,
        "result": fit.result.name,
        "score_of_guess": fit.history[0],
        "score_of_preset": preset,
        "score": fit.chi_squared,
        "history": fit.history,
        "guess": GUESS,
        "preset": of_preset(),
        "parameters": {key: float(value) for key, value in fit.parameters.items()},
        "deviations": {key: float(value) for key, value in fit.deviations.items()},
        "undetermined": fit.combinations()[1],
        "strengths": [c.strength for c in (*fit.determined, *fit.undetermined)],
        "milestones": dict(zip(SCORE, found.tolist(), strict=True)),
    }
    (options.out / "summary.json").write_text(json.dumps(summary, indent=2) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
