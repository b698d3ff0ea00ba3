"""A heavy rope over a fixed drum, which holds by friction up to a length of its heavy side.

    python experiments/capstan.py [--elements N] [--quick] [--out DIR]

A rope (radius 1 mm, 1000 kg/m^3, E = 0.3 MPa) lies over half of a drum of 50 mm. Its light side is
0.15 m long; to its heavy side weight is added slowly until it slips. That is compared with the
balance of a rope on a drum, for several coefficients of friction and grids. A rope a little lighter
must hold for 100 s without creep, by the elastic stick of `Friction`; by `SlidingFriction`,
smoothed by speed, it creeps. Writes DIR/capstan.png and DIR/summary.json.

The theory, with the angle p from where the light side leaves the drum, w the weight per length, a
the radius of the rope's centreline and R that of the drum:

    dT/dp = w a cos p + mu (R/a) (T + w a sin p).

Friction acts on the rope's surface, a rope's radius from its centreline. The couple that it so
exerts is carried by a shear force, which on a curved rope takes a part r/a of the friction: hence
R/a, which formulas for thin belts leave out (they say 0.48507 m at mu = 0.3, this one 0.47508 m).
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
from scipy.integrate import solve_ivp

import rodjax as rx
from rodjax.measuring import energy

DRUM, ROPE = 0.05, 1e-3  # radii [m]
CENTRE = DRUM + ROPE
YOUNG, DENSITY, GRAVITY = 3e5, 1000.0, 9.81
LIGHT = 0.15  # length of the light side [m]
WEIGHT = DENSITY * np.pi * ROPE**2 * GRAVITY  # of the rope per length [N/m]
STIFFNESS, DRAG = 2e4, 0.05  # of the drum [N/m^2], of the air [N s/m^2]
BEGUN, NEAR = 1.0, 3.0  # the rope has settled, weight has been added quickly [s]
METHOD = rx.GeneralizedAlpha(0.0)
SLIPS = 1e-5  # speed of a rope that slips [m/s]; one that holds is below 1e-6


def theory(mu: float, couple: bool = True) -> float:
    """Length of the heavy side at which the rope slips [m]."""
    part = mu * (DRUM / CENTRE if couple else 1.0)
    rate = lambda p, t: CENTRE * np.cos(p) + part * (t + CENTRE * np.sin(p))
    return float(solve_ivp(rate, (0, np.pi), [LIGHT], rtol=1e-10, atol=1e-12).y[0, -1])


def rope(elements: int, heavy: float) -> rx.Rod:
    """The rope with so many elements on the drum."""
    arc = np.pi * CENTRE
    total = LIGHT + arc + heavy

    def curve(s):
        angle = jnp.clip((s - LIGHT) / CENTRE, 0, np.pi)
        below = jnp.minimum(s - LIGHT, 0.0) + jnp.minimum(LIGHT + arc - s, 0.0)
        across, up = -CENTRE * jnp.cos(angle), CENTRE * jnp.sin(angle)
        return jnp.stack([across, jnp.zeros_like(s), up + below])

    section = rx.circular_section(2 * ROPE, YOUNG, YOUNG / 3, density=DENSITY)
    count = round(total / (arc / elements))
    return rx.curved_rod(curve, total, count, section, first_director=(0, 1, 0), stress_free=False)


def scene(friction, elements: int, heavy: float, added: rx.AbstractSchedule) -> rx.Scene:
    """The rope over the drum, and weight that is added to its heavy end."""
    drum = rx.Cylinder((0, 0, 0), (0, 1, 0), DRUM)
    loads = (
        rx.Gravity((0, 0, -GRAVITY)),
        rx.LinearDrag(DRAG, DRAG),
        rx.Obstacle(drum, STIFFNESS, friction, relaxation=1e-3),
        rx.PointLoad(-1, force=added),
    )
    return rx.Scene(rope(elements, heavy), loads=loads)


def weight(times, lengths) -> rx.AbstractSchedule:
    """The weight of these lengths of rope."""
    force = WEIGHT * np.asarray(lengths)
    return rx.PiecewiseLinear(np.asarray(times), np.stack([0 * force, 0 * force, -force], 1))


def settled(one: rx.Scene) -> rx.Run:
    """The run in which the rope comes to rest on the drum."""
    control = rx.StepControl(1e-2, 1e-4)
    return rx.adaptive_rollout(one, rx.start(one), BEGUN, METHOD, control)


def slips_at(mu: float, elements: int) -> dict:
    """The length of the heavy side at which it slips, by adding weight until it does."""
    expected = theory(mu)
    heavy, slow = 0.83 * expected, 0.97 * expected
    seconds = 2000 * (1.03 * expected - slow)  # half a millimetre a second
    knots, lengths = (
        [0.0, BEGUN, NEAR, NEAR + seconds],
        [0.0, 0.0, slow - heavy, 1.03 * expected - heavy],
    )
    one = scene(rx.Friction(mu), elements, heavy, weight(knots, lengths))
    began = time.perf_counter()
    before = settled(one)
    times = np.linspace(BEGUN, NEAR + seconds, 1 + round((NEAR - BEGUN + seconds) / 0.02))
    run = rx.rollout(one, before.final, times[1:], METHOD, throw=False)
    speed = np.asarray(run.states.velocity[:, 0, 2])
    at = int(np.argmax((speed > SLIPS) & (times > NEAR - 0.5)))
    length = heavy + float(np.interp(times[at], knots, lengths))
    ledger = energy.ledger(one, _until(run, at + 1))
    return {
        "mu": mu,
        "elements_on_drum": elements,
        "slips_at": length,
        "theory": expected,
        "ratio": length / expected,
        "iterations": float(np.mean(np.asarray(run.infos.iterations[:at]))),
        "ledger_residual": float(np.max(np.abs(ledger.residual))),
        "work": float(ledger.work[-1]),
        "friction_loss": float(ledger.contact_loss[-1]),
        "seconds": time.perf_counter() - began,
        "shape": np.asarray(run.states.position[at]),
        "rod": one,
        "state": run.state(at),
    }


def _until(run: rx.Run, count: int) -> rx.Run:
    """The first states of a run of which every step was saved."""
    import jax

    cut = lambda tree, size: jax.tree.map(lambda leaf: leaf[:size], tree)
    return dataclasses.replace(run, states=cut(run.states, count), infos=cut(run.infos, count - 1))


def creep(friction, elements: int, part: float, seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """Times, and the way of the light end since it settled, of a heavy side that should hold."""
    heavy = part * theory(0.3)
    one = scene(friction, elements, heavy, weight([0.0, 1.0], [0.0, 0.0]))
    one = dataclasses.replace(one, loads=one.loads[:-1])
    before = settled(one)
    control = rx.StepControl(1e-2, 1e-4, max_step=0.1)
    run = rx.adaptive_rollout(one, before.final, BEGUN + seconds, METHOD, control)
    times = np.asarray(run.times)
    return times, np.asarray(run.states.position[:, 0, 2] - run.states.position[0, 0, 2])


def figure(path: Path, runs: list[dict], held: dict) -> None:
    """Where it slips, what holds, and the rope at the moment of slip."""
    fig, axes = plt.subplots(
        1, 3, figsize=(12, 4.2), layout="constrained", width_ratios=(0.55, 1, 1)
    )
    finest = max(runs, key=lambda run: (run["mu"] == 0.3, run["elements_on_drum"]))
    x, z = 1e3 * finest["shape"][:, 0], 1e3 * finest["shape"][:, 2]
    tension = 1e3 * np.asarray(finest["state"].force[:, 2])
    axes[0].add_patch(plt.Circle((0, 0), 1e3 * DRUM, color="0.85"))
    shown = axes[0].scatter(0.5 * (x[1:] + x[:-1]), 0.5 * (z[1:] + z[:-1]), 12, tension)
    fig.colorbar(shown, ax=axes[0], label="tension [mN]")
    axes[0].set(aspect="equal", xlabel="x [mm]", ylabel="z [mm]", title="as it begins to slip")
    mu = np.linspace(0, 0.42, 60)
    axes[1].plot(mu, [theory(m) for m in mu], "k-", label="theory")
    axes[1].plot(mu, [theory(m, False) for m in mu], "k:", label="theory of a thin belt")
    for i, elements in enumerate(sorted({run["elements_on_drum"] for run in runs})):
        some = [run for run in runs if run["elements_on_drum"] == elements]
        label = f"{elements} elements on the drum"
        axes[1].plot(
            [r["mu"] for r in some],
            [r["slips_at"] for r in some],
            "osd"[i],
            ms=9 - 2 * i,
            mfc="none",
            label=label,
        )
    axes[1].set(xlabel="coefficient of friction", ylabel="heavy side at slip [m]")
    axes[1].legend(fontsize=8)
    for name, (times, way) in held.items():
        axes[2].semilogy(times[1:] - times[0], 1e3 * np.maximum(np.abs(way[1:]), 1e-13), label=name)
    axes[2].set(xlabel="time [s]", ylabel="way of the light end [mm]", title="90 % of what slips")
    axes[2].legend(fontsize=8)
    fig.savefig(path, dpi=150)
    plt.close(fig)


def main(argv=None) -> int:
    """Run the experiment."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument(
        "--elements", type=int, metavar="N", help="on the drum; 24 (8 with --quick)"
    )
    parser.add_argument("--quick", action="store_true", help="coarse and short, to try it out")
    parser.add_argument("--out", type=Path, default=Path("results/capstan"), metavar="DIR")
    options = parser.parse_args(argv)
    elements = options.elements or (8 if options.quick else 24)
    cases = [(0.3, elements)]
    if not options.quick:
        cases = [
            (0.3, elements // 2),
            *cases,
            (0.3, 2 * elements),
            (0.1, elements),
            (0.2, elements),
            (0.4, elements),
        ]
    runs = []
    for mu, count in cases:
        runs.append(slips_at(mu, count))
        last = runs[-1]
        print(
            f"mu = {mu}, {count} elements on the drum: slips at {last['slips_at']:.5f} m, theory"
            f" {last['theory']:.5f} m, ratio {last['ratio']:.4f}; {last['seconds']:.0f} s",
            flush=True,
        )
    seconds = 5.0 if options.quick else 100.0
    laws = {
        "Friction": rx.Friction(0.3),
        "SlidingFriction, 0.01 mm/s": rx.SlidingFriction(0.3, 1e-5),
    }
    held = {name: creep(law, elements, 0.9, seconds) for name, law in laws.items()}
    settling = slice(len(held["Friction"][0]) // 2, None)
    crept = {name: float(np.ptp(way[settling])) for name, (_, way) in held.items()}
    for name, way in crept.items():
        print(f"{name}: creeps by {way:.3g} m in the last {0.5 * seconds:g} of {seconds:g} s")
    options.out.mkdir(parents=True, exist_ok=True)
    figure(options.out / "capstan.png", runs, held)
    kept = [{k: v for k, v in run.items() if k not in ("shape", "rod", "state")} for run in runs]
    belt = theory(0.3, couple=False)
    summary = {"runs": kept, "creep": crept, "held_for": seconds, "thin_belt_at_0.3": belt}
    (options.out / "summary.json").write_text(json.dumps(summary, indent=1))
    print(f"written to {options.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
