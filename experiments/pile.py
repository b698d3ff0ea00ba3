"""Rods dropped crosswise on a floor: a heap with friction, and what a second of it costs.

    python experiments/pile.py [--rods N] [--elements N] [--quick] [--out DIR]

Layers of two rubber rods each, crosswise but for some random turn, fall 0.02 m and more onto each
other and onto a floor, all with friction. Most come to rest; what rolls off the heap rolls on, as
nothing resists rolling. Steps follow the local error. Written are the steps and Newton iterations,
the seconds they took beside those of compilation, how well the energy ledger closes (of the energy
of the fall), and how fast the fastest node still is: DIR/pile.png and DIR/summary.json.
"""

import argparse
import json
import time
from pathlib import Path

import _settings  # noqa: F401 (first)
import matplotlib.pyplot as plt
import numpy as np

import rodjax as rx
from rodjax.dynamics.adaptive import compile_adaptive_rollout

LENGTH, DIAMETER = 0.3, 0.01  # [m]
MODULUS, DENSITY = 1e6, 1100.0
MU, GRAVITY = 0.4, 9.81
SECTION = rx.circular_section(
    DIAMETER, MODULUS, MODULUS / 3, density=DENSITY, material=rx.KelvinVoigt(2e-3)
)
WEIGHT = DENSITY * np.pi * DIAMETER**2 / 4 * GRAVITY  # [N/m]
GAP, SLIP_SPEED = 0.02, 2e-3  # between layers at first [m]; below it strands creep [m/s]


def heap(count: int, elements: int) -> rx.Scene:
    """So many rods, each of so many elements, above a floor."""
    random = np.random.default_rng(1)
    rods = []
    for i in range(count):
        layer, side = divmod(i, 2)
        angle = 0.5 * np.pi * (layer % 2) + random.uniform(-0.25, 0.25)
        along = np.array([np.cos(angle), np.sin(angle), random.uniform(-0.03, 0.03)])
        along = along / np.linalg.norm(along)
        across = np.array([-along[1], along[0], 0.0])
        middle = (side - 0.5) * 0.35 * LENGTH * across + random.uniform(-0.02, 0.02, 3)
        middle[2] = DIAMETER + GAP + layer * (DIAMETER + GAP)
        begin = middle - 0.5 * LENGTH * along
        rods.append(
            rx.straight_rod(LENGTH, elements, SECTION, direction=tuple(along), origin=tuple(begin))
        )
    carried = count * WEIGHT * LENGTH  # [N]
    stiffness = carried / LENGTH / (0.02 * DIAMETER)
    critical = 2 * np.sqrt(WEIGHT / GRAVITY / stiffness)  # relaxation of a rod on the floor [s]
    floor = rx.Obstacle(rx.Plane(), stiffness, rx.Friction(MU), relaxation=0.5 * critical)
    contact = rx.Contact.solid(
        rods[0],
        carried,
        indentation=0.1,
        friction=rx.SlidingFriction(MU, SLIP_SPEED),
        capacities=(16, 64, 96, 10_000),  # a heap touches in more places than by default, and few
        relaxation=0.5 * critical,
    )
    loads = (rx.Gravity((0, 0, -GRAVITY)), floor)
    return rx.Scene(rods=tuple(rods), contact=contact, loads=loads)


def figure(path: Path, scene: rx.Scene, run: rx.Run) -> None:
    """The heap at some times, from the side and from above, and its energies."""
    fig, axes = plt.subplots(2, 4, figsize=(15, 6.5), layout="constrained")
    times = np.asarray(run.times)
    for column, part in enumerate((0.0, 0.15, 1.0)):
        k = int(np.searchsorted(times, part * times[-1]))
        for i, state in enumerate(rx.states_of(run.states)):
            shape = 1e3 * np.asarray(state.position[k])
            for axis, (across, up) in zip(axes[:, column], ((0, 2), (0, 1)), strict=True):
                axis.plot(shape[:, across], shape[:, up], f"C{i}", lw=3, solid_capstyle="round")
        axes[0, column].set(title=f"t = {times[k]:.3f} s", ylabel="z [mm]", aspect="equal")
        axes[0, column].axhline(0, color="0.5")
        axes[1, column].set(xlabel="x [mm]", ylabel="y [mm]", aspect="equal")
    ledger = rx.energy.ledger(scene, run)
    for name in ("kinetic", "bending", "contact_energy"):
        axes[0, 3].semilogy(times, np.maximum(np.asarray(getattr(ledger, name)), 1e-9), label=name)
    axes[0, 3].set(ylabel="energy [J]")
    axes[0, 3].legend(fontsize=8)
    axes[1, 3].plot(times[1:], 1e3 * np.diff(times))
    axes[1, 3].set(xlabel="time [s]", ylabel="step [ms]", yscale="log")
    fig.savefig(path, dpi=130)
    plt.close(fig)


def main(argv=None) -> int:
    """Run the experiment."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--rods", type=int, metavar="N", help="10 (4 with --quick)")
    parser.add_argument("--elements", type=int, metavar="N", help="a rod; 20 (10 with --quick)")
    parser.add_argument("--until", type=float, metavar="T", help="1 (0.1 with --quick) [s]")
    parser.add_argument("--quick", action="store_true", help="coarse and short, to try it out")
    parser.add_argument("--out", type=Path, default=Path("results/pile"), metavar="DIR")
    options = parser.parse_args(argv)
    count = options.rods or (4 if options.quick else 10)
    elements = options.elements or (10 if options.quick else 20)
    until = options.until or (0.1 if options.quick else 1.0)
    options.out.mkdir(parents=True, exist_ok=True)
    scene = heap(count, elements)
    method = rx.GeneralizedAlpha(0.8, tolerance=1e-8)
    control = rx.StepControl(first_step=1e-4, max_step=0.01)
    began = time.perf_counter()
    state = rx.start(scene)
    compile_adaptive_rollout(scene, state, method).result()
    compiled = time.perf_counter()

    def told(part: rx.Run) -> None:
        iterations = np.mean(np.asarray(part.infos.iterations))
        seconds = time.perf_counter() - compiled
        print(
            f"t = {float(part.times[-1]):.4f} s after {seconds:.0f} s, {iterations:.1f} iterations"
            " a step",
            flush=True,
        )

    run = rx.adaptive_rollout(scene, state, until, method, control, on_chunk=told, throw=False)
    seconds = time.perf_counter() - compiled
    ledger = rx.energy.ledger(scene, run)
    last = np.asarray(run.states.velocity[-1])
    fallen = float(np.ptp(np.asarray(ledger.gravity)))
    found = {
        "rods": count,
        "elements": elements,
        "result": rx.Result(int(run.result)).name,
        "reached": float(run.times[-1]),
        "steps": len(run.times) - 1,
        "rejected": int(run.rejected),
        "iterations": int(np.sum(np.asarray(run.infos.iterations))),
        "seconds": seconds,
        "seconds_of_compilation": compiled - began,
        "fastest_node": float(np.max(np.linalg.norm(last, axis=1))),
        "height": float(np.max(np.asarray(run.states.position)[-1, :, 2])) / DIAMETER,
        "ledger_open": float(np.max(np.abs(np.asarray(ledger.residual)))) / fallen,
    }
    figure(options.out / "pile.png", scene, run)
    (options.out / "summary.json").write_text(json.dumps(found, indent=1))
    print(json.dumps(found, indent=1))
    return int(run.result)


if __name__ == "__main__":
    raise SystemExit(main())
