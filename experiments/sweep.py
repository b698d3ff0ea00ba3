"""A map of first contact and final writhe over twist rate, drag and contact strength.

    python experiments/sweep.py [--elements N] [--devices K] [--compare] [--quick] [--out DIR]
                                [--coordinator HOST:PORT --processes P --process I]

All scenes take the same steps: at every time the shortest of those that adaptive runs of the
corners of the map took. Scenes go through `vmap` in batches on all local devices (`--devices` makes
so many of the CPU), in several processes or machines if each is started with a coordinator's
address and its own number. An interrupted sweep continues where it stopped; a scene that fails is
marked. Writes DIR/sweep.h5, DIR/sweep.png and DIR/summary.json.
"""

import argparse
import dataclasses
import itertools
import json
import sys
import time
from pathlib import Path

import _settings  # noqa: F401 (first)
import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from example import FIRST_CONTACT, PRESETS, scene
from tqdm import tqdm

import rodjax as rx
from rodjax import measures
from rodjax.files.sweep import sweep
from rodjax.numerics.compilation import compiled

PRESET = PRESETS["timeline"]
FACTORS = {  # on the preset's values
    "twist": (1.0, 1.1, 1.2, 1.3),
    "drag": (0.3, 1.0, 3.0, 10.0),
    "strength": (0.5, 1.0, 3.0, 10.0),
}


def arguments(argv=None) -> argparse.Namespace:
    """Options of the command line."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--elements", type=int, metavar="N", help="default 100 (10 with --quick)")
    parser.add_argument("--devices", type=int, default=1, metavar="K", help="of the CPU")
    parser.add_argument("--per-device", type=int, metavar="B", help="scenes at once; 8 (2)")
    parser.add_argument("--compare", action="store_true", help="time scenes alone as well")
    parser.add_argument("--coordinator", metavar="HOST:PORT", help="of several processes")
    parser.add_argument("--processes", type=int, default=1, metavar="P")
    parser.add_argument("--process", type=int, default=0, metavar="I")
    parser.add_argument("--quick", action="store_true", help="coarse and short, to try it out")
    parser.add_argument("--out", type=Path, default=Path("results/sweep"), metavar="DIR")
    options = parser.parse_args(argv)
    options.elements = options.elements or (10 if options.quick else 100)
    options.per_device = options.per_device or (2 if options.quick else 8)
    return options


def varied(base: rx.Scene, factors) -> rx.Scene:
    """The scene with these factors on its inputs."""
    drag = base.loads[0]
    return eqx.tree_at(
        lambda s: (
            s.first_end.rotation.angle.values,
            s.loads[0].normal_coefficient,
            s.loads[0].tangential_coefficient,
            s.contact.law.k1,
        ),
        base,
        (
            factors["twist"] * base.first_end.rotation.angle.values,
            factors["drag"] * drag.normal_coefficient,
            factors["drag"] * drag.tangential_coefficient,
            factors["strength"] * base.contact.law.k1,
        ),
    )


def common_steps(base: rx.Scene, until: float) -> np.ndarray:
    """Ends of steps that suit the corners of the map."""
    runs = []
    for corner in itertools.product(*((v[0], v[-1]) for v in FACTORS.values())):
        new = varied(base, dict(zip(FACTORS, corner, strict=True)))
        control = rx.StepControl(*PRESET.tolerances, PRESET.max_step)
        run = rx.adaptive_rollout(new, rx.start(new), until, control=control, throw=False)
        runs.append(np.asarray(run.times))
    return merged(runs, until, [float(t) for t in base.switch_times])


def merged(runs: list[np.ndarray], until: float, marks: list[float]) -> np.ndarray:
    """From each time on the shortest step that any run takes there; steps end on the marks."""
    now, times = 0.0, []
    marks = sorted({*(m for m in marks if m < until), until})
    while now < until:
        mark = next(m for m in marks if m > now)
        dt = min(_step_at(run, now) for run in runs)
        # an even division of what is left to the mark
        left = mark - now
        now = mark if left <= 1.01 * dt else now + left / np.ceil(left / dt)
        times.append(now)
    return np.asarray(times)


def _step_at(times, now):
    i = int(np.clip(np.searchsorted(times, now, side="right") - 1, 0, len(times) - 2))
    return times[i + 1] - times[i]


class Clock:
    """Seconds of every round of a sweep and, if `alone`, of every fifth of its scenes by itself.

    The two are timed in turn, so that a machine that slows down slows both. Scenes differ: those
    that intertwine early cost several times those that never touch.
    """

    def __init__(self, one, parameters, alone: bool):
        self.program = compiled(one) if alone else None
        self.parameters = parameters
        self.rounds: list[tuple[float, int]] = []
        self.alone: list[float] = []
        self.done = 0
        if alone:
            self._seconds(0)
        self.began = time.perf_counter()

    def _seconds(self, i: int) -> float:
        chosen = {name: jnp.asarray(values[i]) for name, values in self.parameters.items()}
        began = time.perf_counter()
        jax.block_until_ready(self.program(chosen))
        return time.perf_counter() - began

    def round(self, done: int) -> None:
        """Note a round that ended with so many scenes done."""
        count = done - self.done
        self.rounds.append((time.perf_counter() - self.began, count))
        # the first round compiled
        if self.program is not None and len(self.rounds) > 1:
            self.alone += [self._seconds(i) for i in range(self.done, done, 5)]
        self.done, self.began = done, time.perf_counter()

    def seconds_a_scene(self) -> float | None:
        """Of all rounds but the first."""
        warm = self.rounds[1:]
        return sum(s for s, _ in warm) / sum(n for _, n in warm) if warm else None

    def seconds_alone(self) -> float | None:
        """Mean of those timed."""
        return float(np.mean(self.alone)) if self.alone else None


def draw(found, out: Path) -> None:
    """First contact and final writhe: drag against strength, one panel a twist rate."""
    shape = tuple(len(v) for v in FACTORS.values())
    rows = {"first_contact": "first contact [s]", "writhe": "writhe at the end"}
    figure, axes = plt.subplots(
        2, shape[0], figsize=(3 * shape[0], 5.6), layout="constrained", squeeze=False
    )
    for row, (name, label) in enumerate(rows.items()):
        failed = (found["result"] != 0).reshape(shape)
        values = found[name].reshape(shape)
        values = np.where(failed | ~np.isfinite(values), np.nan, values)  # no contact: infinite
        low, high = np.nanmin(values), np.nanmax(values)
        for column in range(shape[0]):
            one = axes[row, column]
            image = one.imshow(values[column], vmin=low, vmax=high, origin="lower", aspect="auto")
            one.set_xticks(range(shape[2]), [f"{f:g}" for f in FACTORS["strength"]])
            one.set_yticks(range(shape[1]), [f"{f:g}" for f in FACTORS["drag"]])
            one.set_xlabel("k1 / preset's")
            for i, j in itertools.product(range(shape[1]), range(shape[2])):
                value = values[column, i, j]
                text = "none" if np.isnan(value) else f"{value:.2f}"
                text = "failed" if failed[column, i, j] else text
                light = value < 0.5 * (low + high)
                one.text(j, i, text, ha="center", va="center", color="w" if light else "k")
        axes[0, 0].set_ylabel("drag / preset's")
        axes[1, 0].set_ylabel("drag / preset's")
        figure.colorbar(image, ax=axes[row], label=label)
    for column, factor in enumerate(FACTORS["twist"]):
        axes[0, column].set_title(f"twist x {factor:g}")
    figure.savefig(out / "sweep.png", dpi=130)
    plt.close(figure)


def main(argv=None) -> int:
    """Sweep and report."""
    options = arguments(argv)
    if options.devices > 1:
        jax.config.update("jax_num_cpu_devices", options.devices)
    if options.coordinator:
        jax.config.update("jax_cpu_collectives_implementation", "gloo")
        jax.distributed.initialize(options.coordinator, options.processes, options.process)
    options.out.mkdir(parents=True, exist_ok=True)
    until = 1.0 if options.quick else 32.0
    base = scene(PRESET, options.elements)
    if options.quick:
        contact = dataclasses.replace(base.contact, segments=20, points_per_segment=2)
        base = dataclasses.replace(base, contact=contact)
    steps = np.linspace(0, until, 6)[1:] if options.quick else common_steps(base, until)
    grid = np.asarray(list(itertools.product(*FACTORS.values())))
    parameters = {name: grid[:, i] for i, name in enumerate(FACTORS)}

    def one(factors):
        new = varied(base, factors)
        run = rx.rollout(new, rx.start(new), steps, throw=False)
        force = measures.contacts(new, run).total
        return {
            "first_contact": measures.first_crossing(run.times, force, FIRST_CONTACT),
            "writhe": measures.writhe(run.final),
            "end_time": run.times[-1],
            "result": jnp.max(run.result),
        }

    bar = tqdm(total=len(grid), desc="scenes", disable=None)
    clock = Clock(one, parameters, options.compare)

    def progress(done, _):
        bar.update(done - clock.done)
        clock.round(done)

    found = sweep(one, parameters, options.out / "sweep.h5", per_device=options.per_device,
                  progress=progress)  # fmt: skip
    bar.close()
    if options.process != 0:
        return 0
    each, alone = clock.seconds_a_scene(), clock.seconds_alone()
    failed = int(np.sum(found["result"] != 0))
    summary = {
        "elements": options.elements,
        "steps": len(steps),
        "scenes": len(grid),
        "failed": failed,
        "devices": options.devices,
        "processes": options.processes,
        "per_device": options.per_device,
        "seconds_of_rounds": clock.rounds,
        "seconds_a_scene": each,
        "seconds_alone": alone,
        "ratio": None if not (each and alone) else each / alone,
        "factors": FACTORS,
        "first_contact": found["first_contact"].tolist(),
        "writhe": found["writhe"].tolist(),
        "result": [rx.Result(int(code)).name for code in found["result"]],
    }
    (options.out / "summary.json").write_text(json.dumps(summary, indent=2) + "\n")
    draw(found, options.out)
    text = lambda value: "-" if value is None else f"{value:.2f} s"
    print(f"{len(grid)} scenes, {failed} failed, {len(steps)} steps; a scene takes {text(each)} in"
          f" its batch, {text(alone)} alone (mean of every fifth)")  # fmt: skip
    return 0


if __name__ == "__main__":
    sys.exit(main())
