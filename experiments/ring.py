"""A DNA minicircle: a naturally straight rod closed to a ring, with its linking number swept.

    python experiments/ring.py [--elements N] [--quick] [--out DIR]

The ring (336 base pairs, A = 50 nm kT, C = 100 nm kT, diameter 2 nm) is cut, twisted by a number of
turns and rejoined. In its plane it is an exact equilibrium of the discrete rod; beyond sqrt(3) A/C
turns (Michell) it is unstable. Without inertia, in a viscous fluid, slightly crooked, it then moves
until it rests: a figure 8 that touches itself, and with more turns a ply. Twist and writhe are
printed, and their sum, which no motion without a passage may change. Charges and heat are left out.
Writes DIR/ring.png and DIR/summary.json.
"""

import argparse
import json
import time
from pathlib import Path

import _settings  # noqa: F401 (first)
import matplotlib.pyplot as plt
import numpy as np
from _drawing import draw_tube

import rodjax as rx

KT = 4.114  # [pN nm]
LENGTH, DIAMETER = 114.0, 2.0  # [nm]
A, C = 50 * KT, 100 * KT  # [pN nm^2]
MICHELL = np.sqrt(3) * A / C  # [turns]
DRAG = 2.5e-3  # of the fluid on the rod [pN us/nm^2]; half of it along, D^2 of it on its spin
REST = 30.0  # [us]
SECTION = rx.Section(stiffness=(A, A, C), diameter=DIAMETER)
WELD = (rx.Weld(rx.Point(0), rx.Point(-1)),)


def threshold(elements: int) -> float:
    """Turns at which the plane ring becomes unstable, over Michell's."""
    at = []
    for factor in (0.98, 1.02):
        rod = rx.ring(LENGTH, elements, SECTION, turns=factor * MICHELL)
        scene = rx.Scene(rod, rx.Clamped(), loads=(_fluid(),), joints=WELD)
        values = rx.stability(scene, rx.start(scene), count=3).eigenvalues
        # the ring everts without energy, which is an eigenvalue that is zero
        at.append(float(sorted(np.asarray(values), key=abs)[1]))
    return 0.98 + 0.04 * at[0] / (at[0] - at[1])


def _fluid() -> rx.LinearDrag:
    return rx.LinearDrag(DRAG, 0.5 * DRAG, DRAG * DIAMETER**2)


def relaxed(turns: float, elements: int, contact: bool = True) -> dict:
    """The ring of so many turns, let go, with its twist and writhe until it rests."""
    # whose crookedness starts what is unstable
    rod = rx.imperfect(rx.ring(LENGTH, elements, SECTION, turns=turns), fraction=1e-3)
    solid = rx.Contact.solid(rod, 5.0) if contact else None
    scene = rx.Scene(rod, loads=(_fluid(),), contact=solid, joints=WELD)
    began = time.perf_counter()
    run = rx.adaptive_rollout(scene, rx.start(scene), REST)
    linking = rx.measures.linking(scene, run)
    ends = np.asarray(run.states.position)
    return {
        "turns": turns,
        "times": np.asarray(run.times),
        "twist": np.asarray(linking.twist),
        "writhe": np.asarray(linking.writhe),
        "linking_error": float(np.max(np.abs(linking.twist + linking.writhe - turns))),
        "gap_of_the_weld": float(np.max(np.abs(ends[:, 0] - ends[:, -1]))),
        "nearest": _nearest(scene, run) if contact else None,
        "steps": len(run.times) - 1,
        "seconds": time.perf_counter() - began,
        "shape": ends[-1],
    }


def _nearest(scene: rx.Scene, run: rx.Run) -> float | None:
    """Least distance of strands that push each other, in diameters, as it rests."""
    smallest = float(np.asarray(rx.measures.contacts(scene, run).smallest[-1]))
    return smallest if np.isfinite(smallest) else None


def figure(path: Path, thresholds: dict[int, float], runs: list[dict]) -> None:
    """The threshold against the grid, writhe in time and at rest, and the shapes."""
    fig = plt.figure(figsize=(12, 7), layout="constrained")
    top, bottom = fig.subfigures(2, 1, height_ratios=(1, 1))
    axes = top.subplots(1, 3)
    n = np.array(list(thresholds))
    error = np.abs(np.array(list(thresholds.values())) - 1)
    axes[0].loglog(n, error, "o-", label="measured")
    axes[0].loglog(n, error[0] * (n[0] / n) ** 2, "k:", label="second order")
    axes[0].set(xlabel="elements", ylabel="threshold off Michell's, relative")
    axes[0].legend(fontsize=8)
    for run in runs:
        axes[1].plot(run["times"], run["writhe"], label=f"{run['turns']:.2f} turns")
    axes[1].set(xlabel="time [us]", ylabel="writhe", xscale="symlog")
    axes[1].legend(fontsize=8)
    turns = [run["turns"] for run in runs]
    axes[2].plot(turns, [run["writhe"][-1] for run in runs], "o-", label="writhe")
    axes[2].plot(turns, [run["twist"][-1] for run in runs], "s-", label="twist [turns]")
    axes[2].axvline(MICHELL, color="0.6", lw=1, label="Michell")
    axes[2].set(xlabel="linking number", ylabel="at rest")
    axes[2].legend(fontsize=8)
    frames = bottom.subplots(1, len(runs), squeeze=False)[0]
    for one, run in zip(frames, runs, strict=True):
        shape = run["shape"] - np.mean(run["shape"], 0)
        page = shape @ np.linalg.svd(shape, full_matrices=False)[2].T
        span = np.ptp(page[:, 0]) + 2 * DIAMETER
        points = 160.0 / span  # to a nanometre, of a panel
        draw_tube(one, page[:, :2], page[:, 2], DIAMETER * points, "C0")
        one.set(aspect="equal", title=f"{run['turns']:.2f} turns", xlabel="[nm]")
    fig.savefig(path, dpi=150)
    plt.close(fig)


def main(argv=None) -> int:
    """Run the experiment."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--elements", type=int, metavar="N", help="72 (36 with --quick)")
    parser.add_argument("--quick", action="store_true", help="coarse and short, to try it out")
    parser.add_argument("--out", type=Path, default=Path("results/ring"), metavar="DIR")
    options = parser.parse_args(argv)
    elements = options.elements or (30 if options.quick else 72)
    grids = (20, elements) if options.quick else (20, 40, 80, 160)
    options.out.mkdir(parents=True, exist_ok=True)
    thresholds = {n: threshold(n) for n in grids}
    for n, ratio in thresholds.items():
        print(f"{n:4d} elements: unstable beyond {ratio:.5f} of sqrt(3) A/C turns")
    runs = []
    for turns in (1.5,) if options.quick else (0.8, 1.0, 1.5, 2.0, 3.0):
        run = relaxed(turns, elements)
        runs.append(run)
        near = "" if run["nearest"] is None else f", strands {run['nearest']:.3f} D apart"
        print(
            f"{turns:.2f} turns: Tw {run['twist'][-1]:.4f}, Wr {run['writhe'][-1]:.4f} at rest,"
            f" Tw + Wr off by {run['linking_error']:.1e}{near}; {run['steps']} steps,"
            f" {run['seconds']:.1f} s"
        )
    figure(options.out / "ring.png", thresholds, runs)
    kept = [{k: v for k, v in run.items() if not isinstance(v, np.ndarray)} for run in runs]
    for one, run in zip(kept, runs, strict=True):
        one |= {"twist": float(run["twist"][-1]), "writhe": float(run["writhe"][-1])}
    summary = {"elements": elements, "thresholds": thresholds, "rings": kept}
    (options.out / "summary.json").write_text(json.dumps(summary, indent=1))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
