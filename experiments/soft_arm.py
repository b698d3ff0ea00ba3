"""A tapered arm of silicone that reaches a target, driven by its rest shape; its damping fitted.

    python experiments/soft_arm.py [--elements N] [--steps K] [--quick] [--out DIR]

The arm hangs; bundles of its upper and its lower half bend it either way (its natural curvature is
a schedule). First its modulus and damping are recovered from the tip, seen with noise after a step
of the actuation; the data come from a grid and steps twice as fine, which shows in the modulus.
Then the amplitudes of the bundles at four times are found by one gradient through the motion, with
gravity, damping and contact with a ball in the way, so that the tip comes to a target and stays
(first as if there were no ball). Writes DIR/summary.json,
DIR/amplitudes.npz and DIR/soft_arm.png.
"""

import argparse
import json
import sys
import time
from pathlib import Path

import _settings  # noqa: F401 (first)
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import optax

import rodjax as rx
from rodjax.measuring.energy import ledger

LENGTH = 0.25  # [m]
DENSITY = 1100.0  # [kg/m^3]
DOWN = (0.0, 0.0, -1.0)
TRUTH = {"youngs_modulus": 4e5, "retardation": 0.01}  # [Pa], [s]
NOISE = 5e-4  # of the tip's place as seen [m]
TARGET = np.array([0.13, -0.05, -0.13])  # [m]
BALL = np.array([0.1, -0.02, -0.205]), 0.04  # in the way: its centre and radius [m]
KNOTS = np.array([0.0, 0.3, 0.6, 0.9, 1.2])  # of the amplitudes [s]
END, HOLD = 1.2, 0.9  # of the motion; from when on the tip counts [s]
LARGEST = 14.0  # curvature that a bundle makes [1/m]


def arguments(argv=None) -> argparse.Namespace:
    """Options of the command line."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--elements", type=int, metavar="N", help="default 24 (8 with --quick)")
    parser.add_argument(
        "--steps", type=int, metavar="K", help="of each of two descents; default 60 (8)"
    )
    parser.add_argument("--quick", action="store_true", help="coarse and short, to try it out")
    parser.add_argument("--out", type=Path, default=Path("results/soft_arm"), metavar="DIR")
    options = parser.parse_args(argv)
    options.elements = options.elements or (8 if options.quick else 24)
    options.steps = options.steps or (8 if options.quick else 60)
    return options


def bundles(elements: int) -> np.ndarray:
    """Curvature that each of the four bundles makes in every element at amplitude one."""
    upper = (np.arange(elements) + 0.5 < 0.5 * elements)[:, None]
    across = np.eye(3)[:2, None]  # about a_1, about a_2
    return np.concatenate([across * upper, across * ~upper])


def arm(elements: int, parameters, amplitudes: rx.AbstractSchedule, ball=False) -> rx.Scene:
    """The arm, held at its top; amplitudes are a schedule of (n, 3)."""
    section = rx.circular_section(
        lambda s: 0.030 - 0.018 * s / LENGTH,
        parameters["youngs_modulus"],
        parameters["youngs_modulus"] / 3,
        DENSITY,
        material=rx.KelvinVoigt(parameters["retardation"]),
    )
    rod = rx.straight_rod(
        LENGTH, elements, section, direction=DOWN, first_director=(0, 1, 0), actuation=amplitudes
    )
    loads = (rx.Gravity((0.0, 0.0, -9.81)),)
    if ball:
        # gives way by a millimetre under ten times the arm's weight
        loads = (*loads, rx.Obstacle(rx.Sphere(*BALL), stiffness=3e4, relaxation=2e-3))
    return rx.Scene(rod, rx.Clamped(), loads=loads)


def driven(elements: int, times, values) -> rx.Smooth:
    """Schedule of what the bundles make with these amplitudes (k, 4) at these times."""
    made = jnp.einsum("kb,bni->kni", jnp.asarray(values), jnp.asarray(bundles(elements)))
    return rx.Smooth(jnp.asarray(times), made)


def fit(elements: int, quick: bool) -> dict:
    """Modulus and damping from the tip after a step of the actuation."""
    kick = [[0.0, 0.0, 0.0, 0.0], [3.0, 0.0, 6.0, 2.0], [3.0, 0.0, 6.0, 2.0]]
    end, seen = (0.4, 8) if quick else (1.0, 25)
    observed = np.linspace(0.1, end, seen)

    def seen_on(grid, steps_a_second):
        steps = np.linspace(0.0, end, round(steps_a_second * end) + 1)[1:]
        actuation = driven(grid, [0.0, 0.1, 2.0], kick)
        begun = rx.start(arm(grid, TRUTH, actuation))  # hangs at rest, whatever it is made of

        def predict(parameters):
            scene = arm(grid, parameters, actuation)
            run = rx.rollout(scene, begun, steps, throw=False)
            return rx.positions_at(run, observed)[:, -1]

        return predict

    predict = seen_on(elements, 100)
    exact = jax.jit(seen_on(2 * elements, 200))(TRUTH)
    noise = NOISE * np.random.default_rng(0).normal(size=exact.shape)
    guess = {"youngs_modulus": 2e5, "retardation": 0.03}
    data = rx.Observations(observed, np.asarray(exact) + noise, deviation=NOISE)
    found = rx.least_squares(predict, guess, data, bounds=rx.Positive())
    return {
        "observed": observed,
        "data": np.asarray(data.values),
        "first": np.asarray(jax.jit(predict)(guess)),
        "fitted": np.asarray(jax.jit(predict)(found.parameters)),
        "result": found.result.name,
        "guess": guess,
        "parameters": {name: float(value) for name, value in found.parameters.items()},
        "deviations": {name: float(value) for name, value in found.deviations.items()},
    }


def gaps(scene: rx.Scene, positions) -> np.ndarray:
    """Between the ball and the arm at every node, negative where they touch [m]."""
    diameter = np.asarray(scene.rod.diameter)
    thick = np.concatenate([diameter[:1], 0.5 * (diameter[1:] + diameter[:-1]), diameter[-1:]])
    centre, radius = BALL
    return np.linalg.norm(positions - centre, axis=-1) - radius - 0.5 * thick


def reach(elements: int, steps: int, parameters) -> dict:
    """Amplitudes at the knots that bring the tip to the target and hold it there."""
    times = np.linspace(0.0, END, 241)[1:]
    begun = rx.start(arm(elements, parameters, driven(elements, KNOTS, np.zeros((5, 4))), True))
    holding = jnp.asarray(times >= HOLD)

    def moved(amplitudes, ball=True):
        values = LARGEST * jnp.concatenate([jnp.zeros((1, 4)), amplitudes])
        scene = arm(elements, parameters, driven(elements, KNOTS, values), ball)
        return scene, rx.rollout(scene, begun, times, throw=False)

    def loss(amplitudes, ball=True):
        _, run = moved(amplitudes, ball)
        miss = jnp.sum((run.states.position[1:, -1] - TARGET) ** 2, 1) / LENGTH**2
        # the effort keeps the bundles from working against each other
        effort = 1e-5 * jnp.mean(amplitudes**2)
        return jnp.sum(jnp.where(holding, miss, 0.0)) / jnp.sum(holding) + effort

    def descent(loss, guess, rate):
        bounds, optimizer = rx.Interval(-1.0, 1.0), optax.adam(rate)
        settings = {"bounds": bounds, "optimizer": optimizer, "max_steps": steps}
        return rx.minimize(loss, guess, progress=True, **settings)

    guess = jnp.zeros((len(KNOTS) - 1, 4))
    began = time.perf_counter()
    # as if nothing were in the way, then in contact
    free = descent(lambda amplitudes: loss(amplitudes, ball=False), guess, 0.1)
    found = descent(loss, free.parameters, 0.02)
    seconds = time.perf_counter() - began
    # where the arm leans on the ball
    both, step = jax.jit(jax.value_and_grad(loss)), 2e-5
    direction = jnp.asarray(np.random.default_rng(1).normal(size=guess.shape))
    ahead, behind = (both(free.parameters + sign * step * direction)[0] for sign in (1, -1))
    difference = (ahead - behind) / (2 * step)
    along = jnp.sum(both(free.parameters)[1] * direction)
    compiled, runs = jax.jit(moved), []
    for amplitudes in (guess, found.parameters):
        scene, run = compiled(amplitudes)
        runs.append((scene, run, np.asarray(run.states.position)))
    scene, run, _ = runs[1]
    booked = ledger(scene, run)
    return {
        "times": np.concatenate([[0.0], times]),
        "amplitudes": LARGEST * np.concatenate([np.zeros((1, 4)), found.parameters]),
        "history": [float(value) for value in found.history],
        "free_history": [float(value) for value in free.history],
        "positions": [one[2] for one in runs],
        "gradient_error": abs(float(difference / along) - 1),
        "result": rx.Result(int(run.result)).name,
        "seconds": seconds,
        "evaluations": free.evaluations + found.evaluations,
        "work": float(booked.actuation_work[-1]),
        "lost": float(booked.material_loss[-1]),
        "contact_work": float(np.max(np.abs(booked.contact_work))),
        "gap": float(np.min(gaps(scene, runs[1][2]))),
        "touching": float(np.mean(np.min(gaps(scene, runs[1][2]), axis=1) < 0)),
        "balance_error": float(booked.balance_error),
    }


def draw(out: Path, fitting: dict, found: dict) -> None:
    """The arm on its way, its tip and bundles in time, and the fit of its damping."""
    figure, axes = plt.subplots(1, 3, figsize=(13, 4.2), layout="constrained")
    times, whole = found["times"], found["positions"][1]
    for k in np.linspace(0, len(times) - 1, 9).astype(int):
        shade = str(0.8 - 0.8 * k / (len(times) - 1))
        for column, offset in ((0, 0.0), (1, 0.3)):
            axes[0].plot(whole[k, :, column] + offset, whole[k, :, 2], color=shade, lw=2)
    for column, offset in ((0, 0.0), (1, 0.3)):
        axes[0].plot(TARGET[column] + offset, TARGET[2], "C3x", ms=9, mew=2)
        circle = plt.Circle((BALL[0][column] + offset, BALL[0][2]), BALL[1], color="C1", alpha=0.4)
        axes[0].add_patch(circle)
        axes[0].text(offset + 0.02, -0.01, "xy"[column] + " - z")
    axes[0].set(aspect="equal", xlabel="x, and y + 0.3 [m]", ylabel="z [m]")
    axes[0].set_title("projections at nine times, dark last")
    for name, positions, style in zip(("at first", "found"), found["positions"], ("k:", "C0"),
                                      strict=True):  # fmt: skip
        miss = np.linalg.norm(positions[:, -1] - TARGET, axis=1)
        axes[1].semilogy(times, 1e3 * miss, style, label=f"tip to target, {name} [mm]")
    axes[1].axvspan(HOLD, END, color="0.9", zorder=0)
    axes[1].set(xlabel="t [s]", ylabel="distance of the tip [mm]")
    right = axes[1].twinx()
    right.plot(KNOTS, found["amplitudes"], "o", ms=3)
    right.set_ylabel("amplitudes at their knots [1/m]")
    axes[1].legend(loc="lower left", fontsize=8)
    observed = fitting["observed"]
    for i, label in enumerate("xyz"):
        axes[2].plot(observed, 1e3 * fitting["data"][:, i], f"C{i}.", label=label)
        axes[2].plot(observed, 1e3 * fitting["fitted"][:, i], f"C{i}-", lw=1)
        axes[2].plot(observed, 1e3 * fitting["first"][:, i], f"C{i}:", lw=1)
    axes[2].set(xlabel="t [s]", ylabel="tip [mm]", title="seen, fitted (line), guessed (dots)")
    axes[2].legend(fontsize=8)
    for one in axes:
        one.grid(alpha=0.3)
    figure.savefig(out / "soft_arm.png", dpi=130)
    plt.close(figure)


def main(argv=None) -> int:
    """Fit, reach and report."""
    options = arguments(argv)
    rx.keep_compiled()
    options.out.mkdir(parents=True, exist_ok=True)
    fitting = fit(options.elements, options.quick)
    found = reach(options.elements, options.steps, fitting["parameters"])
    held = found["times"] >= HOLD
    miss = [
        float(np.mean(np.linalg.norm(x[held, -1] - TARGET, axis=1))) for x in found["positions"]
    ]
    summary = {
        "elements": options.elements,
        "fit": {name: fitting[name] for name in ("result", "guess", "parameters", "deviations")}
        | {"truth": TRUTH},
        "reach": {
            "result": found["result"],
            "loss_without_ball": found["free_history"],
            "loss": found["history"],
            "gradients": found["evaluations"],
            "seconds_with_compilation": found["seconds"],
            "gradient_against_difference": found["gradient_error"],
            "mean_miss_before": miss[0],
            "mean_miss_after": miss[1],
            "actuation_work": found["work"],
            "material_loss": found["lost"],
            "largest_contact_work": found["contact_work"],
            "least_gap": found["gap"],
            "part_of_time_touching": found["touching"],
            "balance_error": found["balance_error"],
        },
    }
    (options.out / "summary.json").write_text(json.dumps(summary, indent=2) + "\n")
    np.savez(options.out / "amplitudes.npz", times=KNOTS, amplitudes=found["amplitudes"])
    draw(options.out, fitting, found)
    for name, value in fitting["parameters"].items():
        print(f"{name}: {value:.4g} +- {fitting['deviations'][name]:.2g}, truth {TRUTH[name]:g}")
    print(
        f"tip from {HOLD} s on: {1e3 * miss[0]:.1f} mm from the target at first,"
        f" {1e3 * miss[1]:.2f} mm after {options.steps} steps of the descent"
        f" ({found['seconds']:.0f} s); the gradient differs from a difference by"
        f" {found['gradient_error']:.1e}, the energy balance by {found['balance_error']:.1e}"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
