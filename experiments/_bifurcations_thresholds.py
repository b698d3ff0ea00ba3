"""Thresholds of a column, of a rod under torsion and of the paper's necked rod, refined grids."""

import numpy as np
from _bifurcations_scenes import COLUMN, TWIST, drawn_on, first_branch, pressed, rod_of, turned

import rodjax as rx

NECKED = 7.531815  # M L/A of the example's neck


def find(elements: int, quick: bool) -> dict:
    """Critical loads against the continuous theory, on refined grids."""
    grids = (16, elements) if quick else (64, 128, 256, 512, 1024)
    out: dict = {}
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
    found = {name: drawn_on(coarse[name], fine[name], n[1] / n[0]) for name in fine}
    print(
        "drawn on to no element length, off theory by"
        + ",".join(f" {value:.1e} ({name})" for name, value in found.items()),
        flush=True,
    )
    return out | {"extrapolated": found}


def draw(axis, found: dict) -> None:
    """How far off they are, against the grid."""
    n = np.array([int(key) for key in found if key.isdigit()])
    for name in ("column", "twist", "neck"):
        axis.loglog(n, [abs(found[str(i)][name]) for i in n], "o-", label=name)
    axis.loglog(n, 1.0 / n**2.0, "k:", label="second order")
    axis.set_xticks(n, [str(one) for one in n], minor=False)
    axis.set_xticks([], minor=True)
    axis.set(xlabel="elements", ylabel="critical load off theory, relative")
    axis.legend(fontsize=8)
