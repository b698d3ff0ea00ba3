"""Paths of equilibria against theory: thresholds, the elastica, localised buckles.

    python experiments/bifurcations.py [--elements N] [--parts NAME ...] [--quick] [--out DIR]

Parts:
    thresholds  clamped column, clamped rod under torsion, the paper's necked rod, refined grids
    elastica    the buckled column against the closed form, far beyond its threshold
    localised   a long rod under tension and torque against Coyne's localised buckle
    profile     diameters that raise the critical turns at fixed mass, by gradients of `rx.critical`

Writes DIR/bifurcations.png and DIR/summary.json.
"""

import argparse
import dataclasses
import json
from pathlib import Path

import _settings  # noqa: F401 (first)
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from example import NECK
from scipy.special import ellipe, ellipk

import rodjax as rx

TWIST = 8.986819  # M L/A of clamped ends without tension, tan x = x with x = M L/2A
NECKED = 7.531815  # of the example's neck
COLUMN = 4 * np.pi**2  # P L^2/A of clamped ends
RATIO = 0.8  # torsional over bending stiffness
AXIS = (0.0, 0.0, 1.0)


def rod_of(elements: int, necked: bool = False, length: float = 1.0) -> rx.Rod:
    """A rod of bending stiffness 1 (of its thick part) and torsional stiffness `RATIO`."""

    def section(s):
        inside = necked & (s > NECK[0] * length) & (s < NECK[1] * length)
        fourth = np.where(inside, 0.9, 1.0) ** 4
        return rx.Section((fourth, fourth, RATIO * fourth), mass=1.0)

    return rx.straight_rod(length, elements, section)


def turned(rod: rx.Rod, loads=()) -> rx.Scene:
    """A clamped rod whose other end is turned by 2 pi p at time p, and may slide along the axis."""
    far = 20.0
    turn = rx.PiecewiseLinear([-far, far], [-2 * np.pi * far, 2 * np.pi * far])
    return rx.Scene(rod, rx.Clamped(), rx.Slider(AXIS, rotation=rx.Turn(AXIS, turn)), loads=loads)


def torque(scene, state):
    """The torque about the axis that the turned end feels."""
    return rx.energy.reactions(scene, state).torque[1, 2]


def shortening(scene, state):
    """How far the ends have come together."""
    return jnp.sum(scene.rod.length) - state.position[-1, 2] + state.position[0, 2]


MEASURES = {"torque": torque, "shortening": shortening}


def pressed(rod: rx.Rod):
    """Scenes of a clamped column under a thrust."""

    return jax.tree_util.Partial(_pressed, rod)


def _pressed(rod, thrust):
    force = rx.Constant(jnp.stack([0.0 * thrust, 0.0 * thrust, -thrust]))
    load = rx.PointLoad(-1, force=force)
    return rx.Scene(rod, rx.Clamped(), rx.Slider(AXIS), loads=(load,))


def first_branch(found: rx.EquilibriumPath) -> rx.CriticalPoint:
    """The first branch point of a path."""
    return next(one for one in found.critical if one.kind == "branch")


def thresholds(grids, out: dict) -> None:
    """Critical loads against the continuous theory, on refined grids."""
    for elements in grids:
        rod, necked = rod_of(elements), rod_of(elements, necked=True)
        state = rx.placing(rx.Scene(rod, rx.Clamped()))
        column = rx.path(pressed(rod), state, 30.0, 45.0, longest_step=0.5)
        found = {"column": float(first_branch(column).parameter) / COLUMN - 1}
        for name, one, reference in (("twist", rod, TWIST), ("neck", necked, NECKED)):
            scene = turned(one)
            walked = rx.path(scene, state, 0.0, 2.2, longest_step=0.4)
            point = first_branch(walked)
            moment = float(rx.energy.reactions(scene, point.state).torque[1, 2])
            found[name] = abs(moment) / reference - 1
        out[str(elements)] = found
        print(
            f"{elements:4d} elements: off theory by"
            + ",".join(f" {value:.2e} ({name})" for name, value in found.items()),
            flush=True,
        )
    n = np.array(sorted(map(int, out))[-2:], float)
    coarse, fine = (out[str(int(one))] for one in n)
    # in second order
    ratio = (n[1] / n[0]) ** 2
    found = {name: (ratio * fine[name] - coarse[name]) / (ratio - 1) for name in fine}
    print(
        "drawn on to no element length, off theory by"
        + ",".join(f" {value:.1e} ({name})" for name, value in found.items()),
        flush=True,
    )
    out["extrapolated"] = found


def elastica(elements: int) -> dict:
    """The buckled column against the clamped elastica, P = 16 K(m)^2 A/L^2 (Love 1927).

    Past the branch point at which it loses stability to shapes out of its plane, and on.
    """
    rod = rod_of(elements)
    scene_of = pressed(rod)
    state = rx.placing(rx.Scene(rod, rx.Clamped()))
    straight = rx.path(scene_of, state, 30.0, 45.0, longest_step=0.5)
    point = first_branch(straight)
    buckled = rx.branch(scene_of, point, (30.0, 80.0), measures={"shortening": shortening})
    load, short = buckled.parameters, np.asarray(buckled.measures["shortening"])
    m = np.array([_modulus(value) for value in load])
    # of the continuous rod at the same shortening: the load that bends it so far
    exact = 2 - 2 * ellipe(m) / ellipk(m)
    error = np.max(np.abs(short - exact))
    leaves = [float(one.parameter) for one in buckled.critical]
    print(
        f"elastica: {len(buckled)} points to {load[-1]:.1f} A/L^2, shortened by {short[-1]:.4f} L;"
        f" off the closed form by {error:.1e} L at most;"
        + "".join(f" out of its plane from {value:.4f} A/L^2" for value in leaves),
        flush=True,
    )
    return {
        "load": load.tolist(),
        "shortening": short.tolist(),
        "largest_error": float(error),
        "out_of_plane_from": leaves,
    }


def _modulus(load: float) -> float:
    """m of 16 K(m)^2 = load."""
    low, high = 0.0, 1 - 1e-12
    for _ in range(200):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if 16 * ellipk(middle) ** 2 < load else (low, middle)
    return low


def _curves(found: rx.EquilibriumPath) -> dict:
    curves = {
        "parameter": found.parameters.tolist(),
        "unstable": found.unstable.tolist(),
        "energy": found.energy.tolist(),
        "critical": [(one.kind, float(one.parameter)) for one in found.critical],
        "end": found.end.name,
    }
    return curves | {name: np.asarray(values).tolist() for name, values in found.measures.items()}


def localised(elements: int, length: float = 20.0) -> dict:
    """A long rod of unit tension and stiffness against Coyne's localised buckle."""
    rod = rod_of(elements, length=length)
    pull = rx.PointLoad(-1, force=rx.Constant((0.0, 0.0, 1.0)))
    scene = turned(rod, (pull,))
    state = rx.equilibrium(scene, rx.placing(scene))[0]
    straight = rx.path(scene, state, 0.0, 12.0, longest_step=0.5)
    found = rx.branch(
        scene, first_branch(straight), (0.0, 12.0), measures=MEASURES, longest_step=0.1
    )
    moment = np.abs(np.asarray(found.measures["torque"]))
    short = np.asarray(found.measures["shortening"])
    # where the buckle is away from the ends and the ends are straight
    cosine = np.minimum(moment / 2, 1.0)
    exact_short = 4 * np.sqrt(1 - cosine**2)
    exact_turns = (moment * length / RATIO + 4 * np.arccos(cosine)) / (2 * np.pi)
    inside = (cosine < 0.9) & (cosine > 0.1)
    off = {
        "shortening": float(np.max(np.abs(short / np.maximum(exact_short, 1e-9) - 1)[inside])),
        "turns": float(np.max(np.abs(found.parameters / exact_turns - 1)[inside])),
    }
    print(
        f"localised: L/sqrt(A/T) = {length:g}, buckles at {float(found.parameters[0]):.4f} turns;"
        f" off Coyne's shortening by {off['shortening']:.1e}, his turns by {off['turns']:.1e}",
        flush=True,
    )
    exact = {"exact_turns": exact_turns.tolist(), "exact_shortening": exact_short.tolist()}
    return _curves(found) | exact | {"off": off}


def profile(elements: int, rounds: int) -> dict:
    """Diameters of the same mass that raise the critical turns of a clamped rod most."""
    rod = rod_of(elements)
    state = rx.placing(rx.Scene(rod, rx.Clamped()))
    waves = np.cos(2 * np.pi * np.arange(1, 5)[:, None] * (np.arange(elements) + 0.5) / elements)

    def scenes(amplitudes):
        """Diameters d(s), the integral of d^2 kept."""
        shape = 1.0 + amplitudes @ jnp.asarray(waves)
        fourth = (shape / jnp.sqrt(jnp.mean(shape**2))) ** 4
        own = dataclasses.replace(rod, stiffness=jnp.stack([fourth, fourth, RATIO * fourth], 1))
        return lambda turns: (turned(own), turns)

    at = jnp.zeros(len(waves))
    point = first_branch(rx.path(scenes(at), state, 0.0, 2.2, longest_step=0.4))

    @jax.jit
    def moment(amplitudes, point):
        found = rx.critical(scenes(amplitudes), point)
        scene = scenes(amplitudes)(found.parameter)[0]
        return jnp.abs(rx.energy.reactions(scene, found.state).torque[1, 2]), found

    step = jax.jit(jax.value_and_grad(moment, has_aux=True))
    history, best, reach = [], None, 0.02
    for _ in range(rounds):
        (value, found), slope = step(at, point)
        if best is None or value > best[0]:
            best, point = (value, at, slope), found
        else:
            reach *= 0.5
        history.append(float(best[0]))
        at = best[1] + reach * best[2] / jnp.linalg.norm(best[2])
    at = best[1]
    print(f"profile: critical torque {history[0]:.4f} to {history[-1]:.4f} A/L", flush=True)
    return {"torque": history, "amplitudes": at.tolist()}


def figure(path: Path, found: dict) -> None:
    """What was found, a panel each."""
    drawn = [draw for name, draw in PANELS.items() if name in found]
    if not drawn:
        return
    columns = min(2, len(drawn))
    rows = -(-len(drawn) // columns)
    size = 4.7 * columns, 4.0 * rows
    fig, axes = plt.subplots(rows, columns, figsize=size, layout="constrained", squeeze=False)
    for axis, draw in zip(axes.ravel(), drawn, strict=False):
        draw(axis, found)
    for axis in axes.ravel()[len(drawn) :]:
        axis.remove()
    fig.savefig(path, dpi=100)
    plt.close(fig)


def _draw_thresholds(axis, found: dict) -> None:
    n = np.array([int(key) for key in found["thresholds"] if key.isdigit()])
    for name in ("column", "twist", "neck"):
        axis.loglog(n, [abs(found["thresholds"][str(i)][name]) for i in n], "o-", label=name)
    axis.loglog(n, 1.0 / n**2.0, "k:", label="second order")
    axis.set_xticks(n, [str(one) for one in n], minor=False)
    axis.set_xticks([], minor=True)
    axis.set(xlabel="elements", ylabel="critical load off theory, relative")
    axis.legend(fontsize=8)


def _draw_elastica(axis, found: dict) -> None:
    load, short = (np.array(found["elastica"][name]) for name in ("load", "shortening"))
    m = np.array([_modulus(value) for value in load])
    axis.plot(short, load, "o", ms=3, label="path")
    axis.plot(2 - 2 * ellipe(m) / ellipk(m), load, "k-", lw=1, label="elastica")
    axis.set(xlabel="shortening [L]", ylabel="thrust [A/L$^2$]")
    axis.legend(fontsize=8)


def _draw_localised(axis, found: dict) -> None:
    one = found["localised"]
    exact = np.array(one["exact_shortening"])
    bent = exact > 0  # with a torque below 2 sqrt(A T)
    axis.plot(one["parameter"], one["shortening"], "o", ms=2, label="path")
    axis.plot(np.array(one["exact_turns"])[bent], exact[bent], "k-", lw=1, label="Coyne")
    axis.set(xlabel="turns", ylabel="shortening [sqrt(A/T)]", title="localised buckle")
    axis.legend(fontsize=8)


def _draw_profile(axis, found: dict) -> None:
    axis.plot(found["profile"]["torque"], "o-")
    axis.set(xlabel="round", ylabel="best critical torque [A/L]", title="profile of fixed mass")


PANELS = {
    "thresholds": _draw_thresholds,
    "elastica": _draw_elastica,
    "localised": _draw_localised,
    "profile": _draw_profile,
}


PARTS = ("thresholds", "elastica", "localised", "profile")


def main(argv=None) -> int:
    """Run the experiment."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--elements", type=int, metavar="N", help="128 (24 with --quick)")
    parser.add_argument("--parts", nargs="+", choices=PARTS, help="all of them")
    parser.add_argument("--quick", action="store_true", help="coarse and short, to try it out")
    parser.add_argument("--out", type=Path, default=Path("results/bifurcations"), metavar="DIR")
    options = parser.parse_args(argv)
    elements = options.elements or (24 if options.quick else 128)
    parts = options.parts or (("thresholds", "localised") if options.quick else PARTS)
    options.out.mkdir(parents=True, exist_ok=True)
    found: dict = {"elements": elements}

    def keep():
        (options.out / "summary.json").write_text(json.dumps(found, indent=1))

    for part in parts:
        if part == "thresholds":
            grids = (16, elements) if options.quick else (32, 64, 128, 256, 512)
            thresholds(grids, found.setdefault("thresholds", {}))
        elif part == "elastica":
            found[part] = elastica(elements)
        elif part == "localised":
            found[part] = localised(2 * elements)
        else:
            found[part] = profile(min(elements, 64), 20)
        keep()
    figure(options.out / "bifurcations.png", found)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
