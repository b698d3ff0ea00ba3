"""A clamped rod under twist and thrust together: the curve of loads at which it buckles.

Bent a little, u + i v = w across the axis, it obeys A w'''' - i M w''' + P w'' = 0 under the torque
M and the thrust P, w = w' = 0 at both ends. Solutions are 1, s, exp(i k1 s), exp(i k2 s) with
A k^2 - M k - P = 0; their determinant is zero where, with A = L = 1 and b^2 = M^2/4 + P,

    2 b (cos b - cos M/2) + P sin b = 0.

P = 0 is a double root of that for every M, and no buckling.
"""

import numpy as np
from _bifurcations_scenes import (
    COLUMN,
    RATIO,
    TWIST,
    drawn_on,
    finer,
    first_branch,
    pressed,
    rod_of,
)
from scipy.optimize import brentq

import rodjax as rx


def find(elements: int, quick: bool) -> dict:
    """The curve of branch points on two grids, against the exact one."""
    turns = np.linspace(0.0, 2.7, 19 if quick else 55)
    torque = 2 * np.pi * RATIO * turns
    exact = np.array([exact_thrust(moment) for moment in torque])
    grids = [16 if quick else elements // 2, elements]
    curves = drawn(grids, turns)
    off = [float(np.max(np.abs(curve - exact))) / COLUMN for curve in curves]
    limit = drawn_on(*curves, grids[1] / grids[0])
    off.append(float(np.max(np.abs(limit - exact))) / COLUMN)
    free = {
        str(n): float(np.interp(0.0, -curve, torque)) / TWIST - 1
        for n, curve in zip(grids, curves, strict=True)
    }
    print(
        f"compressed: {len(turns)} loads from the column to {torque[-1]:.2f} A/L at a pull of"
        f" {-exact[-1]:.1f} A/L^2; thrust off the exact curve, over the column's, by"
        f" {off[0]:.2e} ({grids[0]} elements), {off[1]:.2e} ({grids[1]}), {off[2]:.1e} (drawn on)",
        flush=True,
    )
    return {
        "turns": turns.tolist(),
        "torque": torque.tolist(),
        "thrust": curves[-1].tolist(),
        "exact": exact.tolist(),
        "grids": grids,
        "off": off,
        "torque_without_thrust_off": free,
    }


def drawn(grids, turns: np.ndarray) -> list[np.ndarray]:
    """Thrusts at which straight rods of so many turns buckle, from neighbour to neighbour."""
    curves, column = [], None
    for elements in grids:
        rod = rod_of(elements)
        state = rx.placing(rx.Scene(rod, rx.Clamped()))
        if column is None:
            column = first_branch(rx.path(pressed(rod), state, 30.0, 45.0, longest_step=0.5))
        point, thrusts = finer(column, state), []
        for number in turns:
            point = rx.critical(pressed(rod, number), point)
            thrusts.append(float(point.parameter))
        curves.append(np.array(thrusts))
    return curves


def determinant(torque: float, thrust: float) -> float:
    """Zero where a rod of unit length and stiffness buckles, without the double root P = 0."""
    b = np.emath.sqrt(torque**2 / 4 + thrust)
    value = 2 * b * (np.cos(b) - np.cos(torque / 2)) + thrust * np.sin(b)
    return float(np.real(value / (b * thrust**2)))


def exact_thrust(torque: float) -> float:
    """The least thrust under which a rod with this torque buckles, negative where it is a pull."""
    thrusts = np.linspace(-(torque**2) / 4 + 1e-6, 1.2 * COLUMN, 400)
    values = np.array([determinant(torque, thrust) for thrust in thrusts])
    first = np.flatnonzero(np.sign(values[:-1]) != np.sign(values[1:]))[0]
    return brentq(lambda thrust: determinant(torque, thrust), thrusts[first], thrusts[first + 1])


def draw(axis, found: dict) -> None:
    """Thrust against torque."""
    axis.plot(found["torque"], found["thrust"], "o", ms=3, label="branch points")
    axis.plot(found["torque"], found["exact"], "k-", lw=1, label="exact")
    axis.axhline(0.0, color="0.7", lw=0.8)
    axis.set(xlabel="torque [A/L]", ylabel="thrust [A/L$^2$]", title="twisted and pressed")
    axis.legend(fontsize=8)
