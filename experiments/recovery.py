"""Parameters recovered from observed centrelines: what the fitting experiments share.

Synthetic data are the positions of markers along the rod. Without noise they come from the fit's
own grid and steps (the inverse problem alone); with noise from a finer grid and steps chosen by
the local error, plus normal noise of 1 % of the rms displacement.
"""

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import _settings  # noqa: F401 (first)
import jax
import matplotlib.pyplot as plt
import numpy as np

import rodjax as rx
from rodjax.dynamics.run import Run
from rodjax.dynamics.step_control import StepControl
from rodjax.rods.state import State
from rodjax.scenes.scene import Scene

MARKERS = 10  # elements of the fit's grid must be a multiple
NOISE = 0.01  # standard deviation over the rms displacement


class Setting(NamedTuple):
    """A scene on one grid, where its run begins, and the times at which markers are seen."""

    scene: Scene
    first: State
    observed: np.ndarray


class Task(NamedTuple):
    """What is to be recovered, and from where.

    A parameter named `delay` [s] shifts the times of observation: between grids the collapse comes
    at slightly different times, as it would between a model and an experiment.
    """

    truth: dict[str, float]
    guess: dict[str, float]
    bounds: Any
    replaced: Callable[[Scene, dict], Scene]
    fit: Setting
    fine: Setting
    steps: np.ndarray  # ends of the fit's steps
    held_first: tuple[str, ...] = ()  # parameters that a first fit of the others leaves alone


def markers(run: Run, times) -> jax.Array:
    """Markers at the observed times, (k, MARKERS, 3); that at s = 0 does not move."""
    found = rx.positions_at(run, times)
    return found[:, (found.shape[1] - 1) // MARKERS :: (found.shape[1] - 1) // MARKERS]


def predictor(task: Task) -> Callable[[dict], jax.Array]:
    """What the fit's grid and steps predict for the parameters."""

    def predict(parameters):
        scene, first, observed = task.fit
        new = task.replaced(scene, parameters)
        run = rx.rollout(new, first, task.steps, save_every=1, throw=False)
        return markers(run, observed + parameters.get("delay", 0.0))

    return predict


def fitted(task: Task, predict, data: rx.Observations) -> rx.Fit:
    """All parameters fitted, if need be after a first fit of those not held."""
    guess = dict(task.guess)
    if task.held_first:
        held = {key: guess.pop(key) for key in task.held_first}
        bounds = {key: task.bounds[key] for key in guess}
        first = rx.least_squares(
            lambda free: predict(free | held), guess, data, bounds=bounds, max_steps=25,
            tolerance=1e-3, progress=True,
        )  # fmt: skip
        print(f"\nfirst, with {', '.join(held)} held: {first}")
        guess = first.parameters | held
    return rx.least_squares(predict, guess, data, bounds=task.bounds, max_steps=25, progress=True)


def compared(fit: rx.Fit, task: Task, key: str) -> dict[str, float]:
    """One parameter beside what was put in (a delay has no right value: the grids differ in it)."""
    found, deviation = float(fit.parameters[key]), float(fit.deviations[key])
    row = {"guess": task.guess[key], "fit": found, "deviation": deviation}
    if key == "delay":
        return row
    true = task.truth[key]
    return row | {
        "truth": true,
        "relative_error": abs(found / true - 1),
        "error_over_deviation": abs(found - true) / deviation,
    }


def fine_data(task: Task, seed: int) -> tuple[np.ndarray, float]:
    """Markers of the finer grid with noise, and the noise's standard deviation [m]."""
    scene, first, observed = task.fine
    new = task.replaced(scene, task.truth)
    control = StepControl(relative=2e-3, absolute=5e-4, max_step=float(np.max(np.diff(task.steps))))
    run = rx.adaptive_rollout(new, first, float(task.steps[-1]), control=control)
    exact = np.asarray(markers(run, observed))
    straight = np.asarray(scene.rod.position)[:: scene.rod.elements // MARKERS][1:]
    deviation = NOISE * float(np.sqrt(np.mean(np.sum((exact - straight) ** 2, -1))))
    return exact + deviation * np.random.default_rng(seed).normal(size=exact.shape), deviation


def arguments(name: str, doc: str, elements: tuple[int, int], argv=None) -> argparse.Namespace:
    """Options of the command line; `elements` are those of the full and the quick run."""
    parser = argparse.ArgumentParser(description=doc.split("\n", maxsplit=1)[0])
    parser.add_argument("--elements", type=int, metavar="N", help=f"of the fit ({elements[0]})")
    parser.add_argument("--seed", type=int, default=0, help="of the noise")
    parser.add_argument("--quick", action="store_true", help="coarse and short, to try it out")
    parser.add_argument("--out", type=Path, default=Path("results") / name, metavar="DIR")
    options = parser.parse_args(argv)
    options.elements = options.elements or elements[options.quick]
    if options.elements % MARKERS:
        parser.error(f"--elements: must be a multiple of {MARKERS}")
    return options


def recover(task: Task, options: argparse.Namespace) -> dict[str, Any]:
    """Fit without and with noise; print, draw and return what was found."""
    options.out.mkdir(parents=True, exist_ok=True)
    predict = predictor(task)
    began = time.perf_counter()
    own = np.asarray(jax.jit(predict)(task.truth))
    observed = task.fit.observed
    noisy, deviation = fine_data(task, options.seed)
    sets = {
        "without noise": rx.Observations(observed, own),
        "with noise": rx.Observations(observed, noisy, deviation),
    }
    print(f"data made in {time.perf_counter() - began:.1f} s, noise {1e3 * deviation:.3g} mm")
    found, fits = {}, {}
    for name, data in sets.items():
        began = time.perf_counter()
        fit = fitted(task, predict, data)
        seconds = time.perf_counter() - began
        fits[name] = fit
        print(f"\n{name} ({seconds:.1f} s): {fit}")
        found[name] = {
            "result": fit.result.name,
            "seconds_with_compilation": seconds,
            "steps": fit.steps,
            "evaluations": fit.evaluations,
            "reduced_chi_squared": fit.reduced,
            "residual_deviation": fit.residual_deviation,
            "parameters": {key: compared(fit, task, key) for key in task.truth},
        }
    draw(task, noisy, predict, fits["with noise"], options.out)
    scored = lambda fit, key: [p[key] for p in found[fit]["parameters"].values() if key in p]
    summary = {
        "elements": options.elements,
        "fine_elements": task.fine.scene.rod.elements,
        "steps": len(task.steps),
        "noise_deviation": deviation,
        "worst_relative_error_without_noise": max(scored("without noise", "relative_error")),
        "worst_error_over_deviation_with_noise": max(scored("with noise", "error_over_deviation")),
        "fits": found,
    }
    (options.out / "summary.json").write_text(json.dumps(summary, indent=2) + "\n")
    print(
        f"\nwithout noise: off by {summary['worst_relative_error_without_noise']:.1e} at most;"
        f" with noise: by {summary['worst_error_over_deviation_with_noise']:.2f} deviations at most"
    )
    return summary


def draw(task: Task, data, predict, fit, out: Path) -> None:
    """Markers and the fitted centreline at a few times, from two sides."""
    fitted = np.asarray(jax.jit(predict)(fit.parameters))
    guessed = np.asarray(jax.jit(predict)(task.guess))
    observed = task.fit.observed
    chosen = np.unique(np.linspace(0, len(observed) - 1, 4).astype(int))
    figure, axes = plt.subplots(
        2, len(chosen), figsize=(3 * len(chosen), 7), layout="constrained", squeeze=False
    )
    for column, k in enumerate(chosen):
        for row, across in enumerate((0, 2)):
            one = axes[row, column]
            one.plot(guessed[k, :, across], guessed[k, :, 1], ":", color="0.6", label="first guess")
            one.plot(fitted[k, :, across], fitted[k, :, 1], "-", lw=1, label="fit")
            one.plot(data[k, :, across], data[k, :, 1], "k.", ms=4, label="data")
            one.set_aspect("equal", adjustable="datalim")
            one.set_xlabel(f"e{across + 1} [m]")
            one.grid(alpha=0.3)
        axes[0, column].set_title(f"t = {observed[k]:g} s")
        axes[0, 0].set_ylabel("e2 [m]")
        axes[1, 0].set_ylabel("e2 [m]")
    axes[0, 0].legend(fontsize=8)
    figure.savefig(out / "fit.png", dpi=130)
    plt.close(figure)


def to_time(scene: Scene, end: float, max_step: float = 0.1) -> State:
    """State of a motion from the scene's start, at a time."""
    control = StepControl(relative=2e-3, absolute=5e-4, max_step=max_step)
    return rx.adaptive_rollout(scene, rx.start(scene), end, control=control).final
