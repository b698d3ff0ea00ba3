"""The buckled column against the closed form, far beyond its threshold."""

import numpy as np
from _bifurcations_scenes import first_branch, pressed, rod_of, shortening
from scipy.special import ellipe, ellipk

import rodjax as rx


def find(elements: int, quick: bool) -> dict:
    """The buckled column against the clamped elastica, P = 16 K(m)^2 A/L^2 (Love 1927).

    Past the branch point at which it loses stability to shapes out of its plane, and on.
    """
    elements = elements if quick else 3 * elements
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
        f"elastica of {elements}: {len(buckled)} points to {load[-1]:.1f} A/L^2, shortened by"
        f" {short[-1]:.4f} L; off the closed form by {error:.1e} L at most;"
        + "".join(f" out of its plane from {value:.4f} A/L^2" for value in leaves),
        flush=True,
    )
    return {
        "elements": elements,
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


def draw(axis, found: dict) -> None:
    """Thrust against shortening."""
    load, short = (np.array(found[name]) for name in ("load", "shortening"))
    m = np.array([_modulus(value) for value in load])
    axis.plot(short, load, "o", ms=3, label="path")
    axis.plot(2 - 2 * ellipe(m) / ellipk(m), load, "k-", lw=1, label="elastica")
    axis.set(xlabel="shortening [L]", ylabel="thrust [A/L$^2$]")
    axis.legend(fontsize=8)
