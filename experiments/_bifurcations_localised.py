"""A long rod under tension and torque against Coyne's localised buckle."""

import numpy as np
from _bifurcations_scenes import MEASURES, RATIO, curves, first_branch, rod_of, turned

import rodjax as rx


def find(elements: int, quick: bool, length: float = 20.0) -> dict:
    """A long rod of unit tension and stiffness against Coyne's localised buckle."""
    rod = rod_of(2 * elements, length=length)
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
    return curves(found) | exact | {"off": off}


def draw(axis, found: dict) -> None:
    """Shortening against turns."""
    exact = np.array(found["exact_shortening"])
    bent = exact > 0  # with a torque below 2 sqrt(A T)
    axis.plot(found["parameter"], found["shortening"], "o", ms=2, label="path")
    axis.plot(np.array(found["exact_turns"])[bent], exact[bent], "k-", lw=1, label="Coyne")
    axis.set(xlabel="turns", ylabel="shortening [sqrt(A/T)]", title="localised buckle")
    axis.legend(fontsize=8)
