"""An overhand knot, pulled tight: its force against friction and the size of its loop.

    python experiments/knot.py [--elements N] [--quick] [--out DIR]

A rope with a loose trefoil knot in it is pulled at both ends, slowly. The strands of its braid rub
on each other. Of a loose knot, h the radius of the rope's section, R that of the loop where it
leaves the braid, and B the bending stiffness, the force is

    F h^2/B = e^4/2 + 0.492 mu e^3,  e = sqrt(h/R)

(Audoly, Clauvelin & Neukirch, Phys. Rev. Lett. 99, 164301, 2007). Without friction and with
mu = 0.1. Writes DIR/knot.png and DIR/summary.json.
"""

import argparse
import dataclasses
import json
import time
from pathlib import Path
from typing import NamedTuple

import _settings  # noqa: F401 (first)
import jax
import matplotlib.pyplot as plt
import numpy as np
from _drawing import draw_tube

import rodjax as rx

H = 1e-3  # radius of the section [m]
MODULUS, DENSITY = 1e7, 1200.0
SECTION = rx.circular_section(2 * H, MODULUS, MODULUS / 3, density=DENSITY)
B = MODULUS * np.pi * H**4 / 4  # [N m^2]
UNIT = np.sqrt(DENSITY * np.pi * H**2 / B) * H**2  # of time [s]

# In radii of the section, and units of time: the loop, the braid and the tails at first, the
# braid's half width; how fast the ends part, how long the knot is left to settle.
LOOP, BRAID, TAILS, WIDE = 14.0, 24.0, 25.0, 1.6
SPEED, SETTLING = 3e-3, 3000.0


def trefoil(count: int = 1500) -> np.ndarray:
    """Points of an open trefoil [h]: a braid of three half turns and a loop."""
    many = 4000
    x = np.linspace(-BRAID / 2, BRAID / 2, many)
    turn = 3 * np.pi * (x / BRAID + 0.5)
    first = np.stack([x, WIDE * np.sin(turn), -WIDE * np.cos(turn)], 1)
    second = first * np.array([1.0, -1.0, -1.0])
    # the loop leaves the first strand on the right and comes back to the second on the left
    gap = np.arcsin(min(1.0, 0.5 * BRAID / LOOP))
    angle = np.linspace(gap - np.pi / 2, 1.5 * np.pi - gap, many)
    middle = WIDE + LOOP * np.cos(gap)
    loop = np.stack([LOOP * np.cos(angle), 0 * angle, middle + LOOP * np.sin(angle)], 1)
    along = np.linspace(-BRAID / 2 - TAILS, -BRAID / 2, many)
    tail = np.stack([along, 0 * along, 0 * along - WIDE], 1)
    mirror = np.array([-1.0, 1.0, 1.0])
    points = np.concatenate([tail, first[1:], loop[1:-1], second[1:], tail[::-1] * mirror])
    points = _even(points, 500)
    for _ in range(60):  # corners rounded
        points[1:-1] = 0.25 * points[:-2] + 0.5 * points[1:-1] + 0.25 * points[2:]
    return _even(points, count)


def _even(points: np.ndarray, count: int) -> np.ndarray:
    """So many points at equal distances along a line through these."""
    step = np.linalg.norm(np.diff(points, axis=0), axis=1)
    along = np.concatenate([[0.0], np.cumsum(step)])
    even = np.linspace(0.0, along[-1], count)
    return np.stack([np.interp(even, along, points[:, k]) for k in range(3)], 1)


class Pulled(NamedTuple):
    """What a knot did while it was pulled."""

    friction: float
    slack: np.ndarray  # drawn out of the knot [h]
    radius: np.ndarray  # of the loop where it leaves the braid [h]
    force: np.ndarray  # [B/h^2]
    shapes: np.ndarray  # [h]
    result: int
    seconds: float

    @property
    def slender(self) -> np.ndarray:
        """e = sqrt(h/R)."""
        return self.radius**-0.5

    @property
    def ratio(self) -> np.ndarray:
        """Force over that of theory."""
        return self.force / theory(self.slender, self.friction)


def theory(e: np.ndarray, mu: float) -> np.ndarray:
    """Force of a loose trefoil knot [B/h^2]."""
    return e**4 / 2 + 0.492 * mu * e**3


def pulled(mu: float, elements: int, slack: float) -> Pulled:
    """The knot drawn together until the rope between its ends is longer by so much [h]."""
    times = np.array([0.0, SETTLING, SETTLING + slack / SPEED]) * UNIT
    moved = 0.5 * H * np.array([0.0, 0.0, slack])
    ends = [
        rx.Clamped(rx.PiecewiseLinear(times, np.outer(sign * moved, (1.0, 0.0, 0.0))))
        for sign in (-1, 1)
    ]
    friction = rx.SlidingFriction(mu, 0.02 * SPEED * H / UNIT) if mu > 0 else None

    def scene(damping):
        rod = rx.curved_rod(H * trefoil(), None, elements, SECTION, stress_free=False)
        rod = dataclasses.replace(rod, material=rx.KelvinVoigt(damping * UNIT))
        contact = rx.Contact.solid(rod, 0.02 * B / H**2, friction=friction, relaxation=20 * UNIT)
        # chords short beside the braid's curvature, or strands catch on each other's corners
        contact = dataclasses.replace(contact, segments=elements, points_per_segment=4)
        return rx.Scene(rod, *ends, contact=contact)

    began = time.perf_counter()
    # what is let go of is bent; damped strongly until it rests, then so that it costs no force
    run = rx.simulate(scene(60.0), 100 * UNIT, dt=UNIT, every=50 * UNIT)
    run = rx.simulate(scene(60.0), times[1], run, dt=8 * UNIT, every=500 * UNIT)
    last = scene(10.0)
    run = rx.simulate(last, times[-1], run.final, dt=10 * UNIT, every=120 * UNIT)
    of_ends = rx.jit(
        lambda scene, states: jax.lax.map(
            lambda state: rx.energy.reactions(scene, state).force[:, 0], states
        )
    )
    force = np.asarray(of_ends(last, run.states)) @ np.array([-0.5, 0.5])
    shapes = np.asarray(run.states.position) / H
    drawn = SPEED * (np.asarray(run.times) / UNIT - SETTLING)
    radius = np.array([_radius(shape) for shape in shapes])
    seconds = time.perf_counter() - began
    return Pulled(mu, drawn, radius, force * H**2 / B, shapes, int(run.result), seconds)


def _radius(shape: np.ndarray) -> float:
    """Of the loop where it leaves the braid, where it bends most, on both sides."""
    edge = np.diff(shape, axis=0)
    size = np.linalg.norm(edge, axis=1)
    cosine = np.sum(edge[1:] * edge[:-1], 1) / (size[1:] * size[:-1])
    bend = np.arccos(np.clip(cosine, -1, 1)) / (0.5 * (size[1:] + size[:-1]))
    quarter = len(bend) // 4
    return 2 / (np.max(bend[quarter : 2 * quarter]) + np.max(bend[2 * quarter : 3 * quarter]))


def figure(path: Path, runs: list[Pulled]) -> None:
    """The force against the loop, and the knot at first and at last."""
    fig, axes = plt.subplots(1, 3, figsize=(14, 4.5), layout="constrained")
    for k, run in enumerate(runs):
        moving = run.slack > 1.0
        e = run.slender[moving]
        axes[0].plot(e, run.force[moving], f"C{k}o", ms=3, label=f"mu = {run.friction:g}")
        line = np.linspace(np.min(e), np.max(e))
        axes[0].plot(line, theory(line, run.friction), f"C{k}", lw=1)
    axes[0].set(xlabel="sqrt(h/R)", ylabel="F h^2/B", title="lines: theory of loose knots")
    axes[0].legend(fontsize=8)
    last = runs[-1]
    for axis, k in zip(axes[1:], (0, -1), strict=True):
        shape = last.shapes[k]
        draw_tube(axis, shape[:, [0, 2]], -shape[:, 1], 7.0, "C1")
        axis.set(aspect="equal", xlim=(-30, 30), xlabel="[h]")
        axis.set_title(f"mu = {last.friction:g}, slack drawn out {last.slack[k]:.1f} h")
    fig.savefig(path, dpi=130)
    plt.close(fig)


def main(argv=None) -> int:
    """Run the experiment."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--elements", type=int, metavar="N", help="240 (120 with --quick)")
    parser.add_argument("--quick", action="store_true", help="coarse and short, to try it out")
    parser.add_argument("--out", type=Path, default=Path("results/knot"), metavar="DIR")
    options = parser.parse_args(argv)
    elements = options.elements or (120 if options.quick else 240)
    options.out.mkdir(parents=True, exist_ok=True)
    runs = []
    for mu in (0.1,) if options.quick else (0.0, 0.1):
        run = pulled(mu, elements, 1.5 if options.quick else 16.0)
        runs.append(run)
        late = run.ratio[run.slack > 0.3 * run.slack[-1]]
        print(
            f"mu {mu:g}: sqrt(h/R) {run.slender[0]:.3f} to {run.slender[-1]:.3f}, force over that"
            f" of theory {np.mean(late):.3f} (from {np.min(late):.3f} to {np.max(late):.3f});"
            f" result {run.result}, {run.seconds:.0f} s"
        )
    figure(options.out / "knot.png", runs)
    kept = []
    for run in runs:
        late = run.slack > 0.3 * run.slack[-1]
        kept.append(
            {
                "friction": run.friction,
                "result": run.result,
                "slender": run.slender[late].tolist(),
                "force": run.force[late].tolist(),
                "over_theory": run.ratio[late].tolist(),
                "seconds": run.seconds,
            }
        )
    summary = {"elements": elements, "runs": kept}
    (options.out / "summary.json").write_text(json.dumps(summary, indent=1))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
