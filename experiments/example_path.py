"""The paper's example as a path of equilibria, through self-contact, with its run drawn over it.

    python experiments/example_path.py [--elements N] [--preset NAME] [--quick] [--out DIR]

The rod of the example is turned at one end while the other slides along the axis. Its equilibria
are followed from straight through the branch point at which it loses stability, back round the fold
at which a loop becomes stable, into contact, round the fold at which the loop collapses, and along
the ply. The same with the natural curvature that the example starts buckling by, until it has
buckled. The run of `intertwine.py`, its end left free to slide, is drawn over both: what of the
paper's story is equilibrium, and what is delay. Writes DIR/example_path.png and DIR/summary.json.
"""

import argparse
import dataclasses
import json
import time
from pathlib import Path

import _settings  # noqa: F401 (first)
import example
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import rodjax as rx

AXIS = example.LOADING_AXIS
FAR = 20.0  # turns that the drive of the path goes to


def at_rest(preset: example.Preset, elements: int, crooked: bool) -> rx.Scene:
    """The example without water, one end turned by p turns at time p, the other free to slide."""
    rod = example.rod(preset, elements)
    if not crooked:
        straight = jnp.zeros_like(rod.natural_curvature)
        rod = dataclasses.replace(rod, natural_curvature=straight)
    turn = rx.Turn(AXIS, rx.PiecewiseLinear([-FAR, FAR], [2 * np.pi * FAR, -2 * np.pi * FAR]))
    contact = example.contact_law(preset)
    return rx.Scene(rod, rx.Clamped(rotation=turn), rx.Slider(AXIS), contact=contact)


def torque(scene, state):
    """Twisting moment in the first element, over A/L of the thick part."""
    rod = scene.rod
    twist = rx.measures.curvature(rod, state.quaternion)[0] - rod.natural_curvature[0]
    return rod.stiffness[0, 2] * twist[2] / rod.stiffness[0, 0] * example.LENGTH


def shortening(scene, state):
    """How far the ends have come together, over L."""
    span = jnp.linalg.norm(state.position[-1] - state.position[0])
    return 1 - span / example.LENGTH


def apex(scene, state):
    """Angle between the axis and the tangent farthest from it [degrees]."""
    return jnp.rad2deg(rx.measures.apex_angle(state, jnp.asarray(AXIS)))


def writhe(scene, state):
    """Turns of the line about itself, counted as the drive counts its own."""
    return rx.measures.writhe(state)


def touching(scene, state):
    """Sum of all contact forces, over A/L^2."""
    forces = rx.energy.contact_wrench(scene, state)[:, :3]
    unit = scene.rod.stiffness[0, 0] / example.LENGTH**2
    return jnp.sum(jnp.linalg.norm(forces, axis=1)) / unit


MEASURES = {
    "torque": torque,
    "shortening": shortening,
    "writhe": writhe,
    "apex": apex,
    "touching": touching,
}


def follow(preset: example.Preset, elements: int, until: float) -> dict[str, rx.EquilibriumPath]:
    """The straight rod, the buckled one, and the one that is not quite straight."""
    scene = at_rest(preset, elements, crooked=False)
    state = rx.placing(scene)
    straight = rx.path(scene, state, 0.0, 2.2, measures=MEASURES, longest_step=0.5)
    point = next(one for one in straight.critical if one.kind == "branch")
    buckled = rx.branch(scene, point, (0.0, until), measures=MEASURES, points=600, throw=False)
    crooked = at_rest(preset, elements, crooked=True)
    imperfect = rx.path(
        crooked,
        rx.equilibrium(crooked, state)[0],
        0.0,
        until,
        measures=MEASURES,
        targets={"shortening": 0.5},
        longest_step=0.4,
    )
    return {"straight": straight, "buckled": buckled, "imperfect": imperfect}


def run(preset: example.Preset, elements: int, until: float) -> dict:
    """The motion, the sliding end never held."""
    scene = example.scene(dataclasses.replace(preset, hold_at=None), elements)
    control = rx.StepControl(*preset.tolerances, max_step=preset.max_step)
    moved = rx.adaptive_rollout(scene, rx.start(scene), until, control=control)
    curves = {"time": np.asarray(moved.times)}
    curves["turns"] = np.asarray(rx.measures.linking(scene, moved).turns)
    for name in ("torque", "shortening", "writhe"):
        measure = jax.jit(jax.vmap(lambda state, of=MEASURES[name]: of(scene, state)))
        curves[name] = np.asarray(measure(moved.states))
    return curves


def crossing(path: rx.EquilibriumPath, name: str, value: float) -> float | None:
    """Turns at which a measure first passes a value along a path, between its points."""
    values = np.asarray(path.measures[name]) - value
    passed = np.flatnonzero(values[:-1] * values[1:] <= 0)
    if len(passed) == 0:
        return None
    i = passed[0]
    part = values[i] / (values[i] - values[i + 1])
    return float(path.parameters[i] + part * (path.parameters[i + 1] - path.parameters[i]))


def milestones(paths: dict[str, rx.EquilibriumPath], moved: dict) -> dict:
    """What happens at how many turns, at rest and in motion."""
    straight, buckled, imperfect = (paths[name] for name in ("straight", "buckled", "imperfect"))
    folds = [float(one.parameter) for one in buckled.critical if one.kind == "fold"]
    stable = np.asarray(buckled.unstable) == 0
    last = float(moved["turns"][-1])
    near = np.argmin(np.where(stable[1:], np.abs(buckled.parameters[1:] - last), np.inf)) + 1
    fall = int(np.argmax(moved["torque"]))
    return {
        "straight_until": float(straight.critical[0].parameter),
        "not_quite_straight_until": [float(one.parameter) for one in imperfect.critical],
        "apex_orthogonal_at": crossing(buckled, "apex", 90.0),
        "first_contact_at": crossing(buckled, "touching", 1e-6),
        "loop_stable_from": folds[0] if folds else None,
        "loop_collapses_at": folds[1] if len(folds) > 1 else None,
        "ply_stable_from": folds[2] if len(folds) > 2 else None,
        "folds": folds,
        "ends_by": buckled.end.name,
        "last_turns": float(buckled.parameters[-1]),
        "run_largest_torque_at_turns": float(moved["turns"][fall]),
        "run_last": {name: float(moved[name][-1]) for name in ("turns", "writhe", "shortening")},
        "equilibrium_at_last_turns": {
            name: float(buckled.measures[name][near]) for name in ("writhe", "shortening")
        },
    }


def figure(target: Path, paths: dict[str, rx.EquilibriumPath], moved: dict) -> None:
    """Diagrams against turns, and shapes along the buckled path."""
    fig = plt.figure(figsize=(14, 6.2), layout="constrained")
    grid = fig.add_gridspec(2, 6, height_ratios=(2.4, 1))
    names = {"torque": "torque [A/L]", "shortening": "shortening [L]", "writhe": "writhe [turns]"}
    buckled = paths["buckled"]
    marks = _marked(buckled)
    for i, (name, label) in enumerate(names.items()):
        axis = fig.add_subplot(grid[0, 2 * i : 2 * i + 2])
        axis.plot(moved["turns"], moved[name], color="0.6", lw=1, label="run")
        for color, (kind, path) in zip(("k", "C0", "C1"), paths.items(), strict=True):
            _stable_dashed(axis, path, name, kind, color)
        for letter, index in marks.items():
            at = buckled.parameters[index], float(buckled.measures[name][index])
            axis.plot(*at, "C3o", ms=4)
            axis.annotate(letter, at, xytext=(4, 4), textcoords="offset points", color="C3")
        axis.set(xlabel="turns", ylabel=label)
        if i == 0:
            axis.set_title("dashed: unstable", fontsize=9)
            axis.legend(fontsize=8)
    for i, (letter, index) in enumerate(marks.items()):
        axis = fig.add_subplot(grid[1, i])
        _shape(axis, np.asarray(buckled.states.position[index]))
        turns, unstable = buckled.parameters[index], buckled.unstable[index]
        axis.set_title(f"{letter}: {turns:.2f} turns{', unstable' if unstable else ''}", fontsize=9)
    fig.savefig(target, dpi=100)
    plt.close(fig)


def _marked(path: rx.EquilibriumPath) -> dict[str, int]:
    """Six points of a path: where the parameter turns, midway between, and the last."""
    turning = np.flatnonzero(np.diff(np.sign(np.diff(path.parameters))) != 0) + 1
    ends = [0, *turning[:3].tolist(), len(path) - 1]
    middle = [int(np.argmin(np.abs(path.arc - path.arc[[a, b]].mean()))) for a, b in
              zip(ends[:-1], ends[1:], strict=True)]  # fmt: skip
    chosen = sorted({*ends[1:], *middle[:2]})[:6]
    return dict(zip("ABCDEF", chosen, strict=False))


def _shape(axis, position: np.ndarray) -> None:
    """The line seen across its plane of largest extent."""
    centred = position - position.mean(0)
    flat = centred @ np.linalg.svd(centred)[2].T
    axis.plot(flat[:, 0], flat[:, 1], "k-", lw=1.5)
    axis.set_aspect("equal")
    axis.axis("off")


def _stable_dashed(axis, path: rx.EquilibriumPath, name: str, label: str, color: str) -> None:
    """A curve, dashed where it is unstable."""
    values, unstable = np.asarray(path.measures[name]), np.asarray(path.unstable) > 0
    axis.plot(path.parameters, np.where(unstable, np.nan, values), color=color, label=label)
    axis.plot(path.parameters, np.where(unstable, values, np.nan), "--", color=color)


def main(argv=None) -> int:
    """Run the experiment."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--elements", type=int, metavar="N", help="100 (40 with --quick)")
    parser.add_argument("--preset", default="timeline", choices=example.PRESETS)
    parser.add_argument("--quick", action="store_true", help="coarse and short, to try it out")
    parser.add_argument("--out", type=Path, default=Path("results/example_path"), metavar="DIR")
    options = parser.parse_args(argv)
    options.out.mkdir(parents=True, exist_ok=True)
    rx.keep_compiled()
    elements = options.elements or (40 if options.quick else 100)
    preset = example.PRESETS[options.preset]
    began = time.perf_counter()
    paths = follow(preset, elements, 1.8 if options.quick else 4.6)
    seconds = time.perf_counter() - began
    moved = run(preset, elements, 18.0 if options.quick else 36.0)
    found = {"elements": elements, "preset": preset.name, "seconds_of_paths": seconds}
    found |= milestones(paths, moved)
    for name, path in paths.items():
        print(f"{name}: {path}")
    for name, value in found.items():
        print(f"{name}: {value}")
    (options.out / "summary.json").write_text(json.dumps(found, indent=1))
    figure(options.out / "example_path.png", paths, moved)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
