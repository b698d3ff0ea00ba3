"""A hockle: an armoured cable with torsion in it grows slack on a seabed, and is pulled straight.

    python experiments/hockle.py [--elements N] [--turns X] [--quick] [--out DIR]

A cable of 10 m (EI = 15 N m^2, GJ = 12 N m^2, EA = 1 MN, 30 mm thick, 8 N/m in water, laid of
strands: under tension it twists) lies on a seabed with friction. One end is turned, then comes
nearer: the cable leaves the bed in an arch, throws a loop, which falls on its side and touches
itself, and shrinks when the cable is pulled again, until it pops out. Beside the tensions stand
those of theory for long cables without weight and friction: T = M^2/4A, below which a straight one
is unstable (Greenhill), and T = 16 A/d^2, by which a loop pops out, d the slack in it (Coyne). The
smallest bend radius is what a cable must bear that is not to kink. Writes DIR/hockle.png and
DIR/summary.json.
"""

import argparse
import json
import time
from pathlib import Path

import _settings  # noqa: F401 (first)
import jax
import matplotlib.pyplot as plt
import numpy as np

import rodjax as rx
from rodjax.dynamics.coarseness import turns_of_elements

LENGTH, DIAMETER = 10.0, 0.03  # [m]
EI, GJ, EA = 15.0, 12.0, 1e6  # [N m^2, N m^2, N]
MASS, WEIGHT = 2.0, 8.0  # [kg/m], submerged [N/m]
COUPLING = 2e-4  # torque over tension [m]
BED, FRICTION = 2e4, 0.4  # stiffness of the bed [N/m^2], and mu, of strands as well
TENSION = 150.0  # at first [N]
SLACK = 1.4  # [m]
STRETCHING, TURNING, LETTING, RESTING, PULLING = 1.0, 6.0, 14.0, 4.0, 20.0  # [s]
TIMES = np.cumsum([0.0, STRETCHING, TURNING, LETTING, RESTING, PULLING])


def cable(elements: int) -> rx.Rod:
    """The cable, straight, as deep in the bed at z = 0 as its weight presses it."""
    inertia = MASS * DIAMETER**2 / 16
    section = rx.Section(
        stiffness=(EI, EI, GJ),
        mass=MASS,
        rotary_inertia=(inertia, inertia, 2 * inertia),
        compliance=(0.0, 0.0, 1 / EA),
        diameter=DIAMETER,
        torque_per_tension=COUPLING,
        material=rx.KelvinVoigt(0.01, stretch=0.01),
    )
    sunk = np.sqrt(2 * 0.05 * DIAMETER * WEIGHT / BED)
    origin = (0.0, 0.0, 0.5 * DIAMETER - sunk)
    rod = rx.straight_rod(LENGTH, elements, section, direction=(1, 0, 0), origin=origin)
    return rx.imperfect(rod, fraction=1e-3)  # slack must choose a side


def scene_of(turns: float, elements: int, slack: float) -> rx.Scene:
    """The cable between its ends, the last of which turns, comes nearer and is pulled back."""
    rod = cable(elements)
    stretch = TENSION * LENGTH / EA
    way = np.array([0.0, stretch, stretch, -slack, -slack, 2 * stretch])
    turned = 2 * np.pi * turns * np.array([0.0, 0.0, 1.0, 1.0, 1.0, 1.0])
    axis = np.array([1.0, 0.0, 0.0])
    last = rx.Clamped(
        rx.Smooth(TIMES, np.outer(way, axis)), rx.Turn(axis, rx.Smooth(TIMES, turned))
    )
    bed = rx.Obstacle(
        rx.Plane(), BED, friction=rx.Friction(FRICTION), relaxation=0.4 * np.sqrt(MASS / BED)
    )
    water = rx.MorisonDrag(1025.0, 1.2, 0.02)
    loads = (rx.Gravity((0.0, 0.0, -WEIGHT / MASS)), water, bed)
    friction = rx.SlidingFriction(FRICTION, 1e-3)
    contact = rx.Contact.solid(rod, 300.0, indentation=0.1, friction=friction, relaxation=1e-3)
    return rx.Scene(rod, rx.Clamped(), last, loads, contact)


def story(turns: float, elements: int, slack: float, until: float) -> dict:
    """The run and its measures at the saved times."""
    scene, began = scene_of(turns, elements, slack), time.perf_counter()
    control = rx.StepControl(relative=3e-3, absolute=1e-3)  # snaps are to keep their energy
    run = rx.simulate(scene, until, control=control)
    seconds = time.perf_counter() - began
    of_ends = rx.jit(
        lambda scene, states: jax.lax.map(lambda state: rx.energy.reactions(scene, state), states)
    )
    found = of_ends(scene, run.states)
    turns_of = turns_of_elements(np.asarray(run.states.quaternion))
    bend = np.linalg.norm(turns_of[..., :2], axis=2) * elements / LENGTH
    ledger = rx.energy.ledger(scene, run)
    return {
        "result": int(run.result),
        "steps": len(run.infos.result),
        "seconds": seconds,
        "time": np.asarray(run.times),
        "tension": np.asarray(found.force)[:, 1, 0],
        "torque": np.asarray(found.torque)[:, 1, 0],
        "height": np.max(np.asarray(run.states.position)[:, :, 2], 1),
        "bend": np.max(bend, 1),
        "strands": np.asarray(rx.measures.contacts(scene, run).total),
        "shapes": np.asarray(run.states.position),
        "ledger_residual": float(np.asarray(ledger.residual)[-1]),
        "work": float(np.asarray(ledger.work)[-1]),
    }


def milestones(told: dict) -> dict:
    """What happened when, beside theory."""
    t, tension, torque = told["time"], told["tension"], told["torque"]
    found: dict = {"smallest_bend_radius": 1 / float(np.max(told["bend"]))}
    risen = np.flatnonzero(told["height"] > 2 * DIAMETER)
    if len(risen):
        # the last state that lay on the bed
        i = max(int(risen[0]) - 1, 0)
        found["leaves_the_bed"] = {
            "time": float(t[i]),
            "tension": float(tension[i]),
            "greenhill": float(torque[i] ** 2 / (4 * EI)),
        }
    pulled = (t > TIMES[4]) & (told["strands"] > 1.0)
    if np.any(pulled):
        i = int(np.flatnonzero(pulled)[-1])
        # how much longer the cable is than its ends are apart
        ends = np.linalg.norm(told["shapes"][i][-1] - told["shapes"][i][0])
        slack = float(LENGTH * (1 + tension[i] / EA) - ends)
        found["pops_out"] = {
            "time": float(t[i]),
            "tension": float(tension[i]),
            "slack": slack,
            "coyne": 16 * EI / slack**2,
        }
    return found


def figure(path: Path, told: dict) -> None:
    """Tension, torque, height and bend radius over time, and the cable from above and aside."""
    fig = plt.figure(figsize=(13, 8), layout="constrained")
    top, bottom = fig.subfigures(2, 1, height_ratios=(2, 3))
    axes = top.subplots(1, 4)
    t = told["time"]
    axes[0].plot(t, told["tension"], label="tension")
    axes[0].plot(t, told["torque"] ** 2 / (4 * EI), "--", label="M^2/4A")
    axes[0].set(ylabel="[N]", yscale="symlog")
    axes[0].legend(fontsize=8)
    axes[1].plot(t, told["torque"])
    axes[1].set(ylabel="torque at the end [N m]")
    axes[2].plot(t, told["height"])
    axes[2].set(ylabel="highest point [m]")
    axes[3].semilogy(t, 1 / np.maximum(told["bend"], 1e-3))
    axes[3].axhline(DIAMETER, color="0.6", lw=1)
    axes[3].set(ylabel="smallest bend radius [m]", title="grey: the diameter")
    for axis in axes:
        axis.set(xlabel="time [s]")
    chosen = np.linspace(TIMES[2] + 0.1 * LETTING, t[-1], 8)
    frames = bottom.subplots(4, 4)
    for k, time_ in enumerate(chosen):
        x = told["shapes"][int(np.argmin(np.abs(t - time_)))]
        above, aside = frames[2 * (k // 4)][k % 4], frames[2 * (k // 4) + 1][k % 4]
        above.plot(x[:, 0], x[:, 1], lw=1.5)
        aside.plot(x[:, 0], x[:, 2], lw=1.5, color="C1")
        above.set(aspect="equal", xlim=(4.5, 10.1), ylim=(-0.8, 0.8), title=f"t = {time_:.0f} s")
        aside.set(aspect="equal", xlim=(4.5, 10.1), ylim=(-0.1, 1.0))
        if k % 4 == 0:
            above.set(ylabel="above")
            aside.set(ylabel="aside")
    fig.savefig(path, dpi=110)
    plt.close(fig)


def main(argv=None) -> int:
    """Run the experiment."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--elements", type=int, metavar="N", help="300 (60 with --quick)")
    parser.add_argument("--turns", type=float, default=6.0, metavar="X", help="6")
    parser.add_argument("--quick", action="store_true", help="coarse and short, to try it out")
    parser.add_argument("--out", type=Path, default=Path("results/hockle"), metavar="DIR")
    options = parser.parse_args(argv)
    elements = options.elements or (60 if options.quick else 300)
    options.out.mkdir(parents=True, exist_ok=True)
    told = story(options.turns, elements, SLACK, 12.0 if options.quick else float(TIMES[-1]))
    found = milestones(told)
    figure(options.out / "hockle.png", told)
    if "leaves_the_bed" in found:
        one = found["leaves_the_bed"]
        print(
            f"{one['time']:.1f} s: leaves the bed at a tension of {one['tension']:.1f} N"
            f" (M^2/4A {one['greenhill']:.1f} N)"
        )
    if "pops_out" in found:
        one = found["pops_out"]
        print(
            f"{one['time']:.1f} s: pops out at a tension of {one['tension']:.0f} N with a slack"
            f" of {one['slack']:.3f} m (16 A/d^2 {one['coyne']:.0f} N)"
        )
    print(
        f"smallest bend radius {found['smallest_bend_radius']:.3f} m; {told['steps']} steps,"
        f" {told['seconds']:.0f} s; ledger off by {told['ledger_residual']:.2g} of"
        f" {told['work']:.3g} J; result {told['result']}"
    )
    kept = {k: v for k, v in told.items() if not isinstance(v, np.ndarray)}
    summary = {"elements": elements, "turns": options.turns, **kept, **found}
    (options.out / "summary.json").write_text(json.dumps(summary, indent=1))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
