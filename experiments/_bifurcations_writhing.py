"""A clamped rod, one end turned and then brought nearer: paths along the shortening, and jumps.

The rigid loading of van der Heijden, Neukirch, Goss & Thompson, Int. J. Mech. Sci. 45 (2003): turns
and shortening are given, torque and thrust are what the rod answers. Each rod is turned straight,
buckles under its thrust, and is then held; what it does free of contact is compared with shooting
(`_bifurcations_kirchhoff.py`), and what touches itself is followed on.
"""

import dataclasses

import jax.numpy as jnp
import numpy as np
from _bifurcations_kirchhoff import Clamped
from _bifurcations_scenes import (
    AXIS,
    COLUMN,
    DIAMETER,
    RATIO,
    TWIST,
    curves,
    drawn_on,
    finer,
    first_branch,
    pressed,
    rod_of,
    shortening,
    torque,
)

import rodjax as rx

TURNS = (0.0, 0.5, 1.0, 1.5)
BEGUN = 0.02  # shortening at which a buckled rod is held [L]
LAST = 0.95  # to which it is followed
CHAIN = 0.125  # turns between neighbours whose critical thrusts lead to each other
FORCE = 100.0  # that contact is made for [A/L^2]
TURNING = 0.01  # how far from the largest shortening of a path rods are shot for [L]
COMPARED = 6  # points of a path that are shot for


def thrust(scene, state):
    """By which the ends are pressed together."""
    return -rx.energy.reactions(scene, state).force[1, 2]


def middle(scene, state):
    """The middle's distance from the axis, and its height over the first end."""
    at = state.position[scene.rod.elements // 2]
    return jnp.stack([jnp.linalg.norm(at[:2]), at[2]])


def nearest(scene, state):
    """Least distance of nodes that lie a sixth of the rod or more apart along it."""
    nodes, count = state.position, scene.rod.elements + 1
    apart = np.abs(np.arange(count)[:, None] - np.arange(count))
    squares = jnp.sum((nodes[:, None] - nodes[None]) ** 2, -1)
    return jnp.sqrt(jnp.min(jnp.where(apart >= count // 6, squares, 1.0)))


MEASURES = {"torque": torque, "thrust": thrust, "middle": middle, "nearest": nearest}


def find(elements: int, quick: bool) -> dict:
    """Paths of rods of several turns on two grids, against shooting, and on in contact."""
    turns = TURNS[::3] if quick else TURNS
    grids = (16, elements) if quick else (elements // 2, elements)
    found: dict = {"grids": grids, "off": [], "leaves_plane": [], "jumps": []}
    column = None
    for n in grids:
        rod = rod_of(n)
        points = buckling(rod, turns, column)
        column = points[0]
        starts = [begun(rod, number, one) for number, one in zip(turns, points, strict=True)]
        free = {number: held(rod, start) for number, start in zip(turns, starts, strict=True)}
        found["off"].append(compared(free))
        found["leaves_plane"].append(float(first_branch(free[0.0]).parameter))
        found["jumps"].append({str(number): _folds(path) for number, path in free.items()})
        if n == grids[0]:
            found["contact"] = {} if quick else touching(rod, starts, free)
    found["free"] = {str(number): curves(path) for number, path in free.items()}
    found["leaves_plane_exact"] = Clamped(RATIO, 0.0).out_of_plane(0.5, 0.7)
    _tell(found)
    return found


def _folds(path: rx.EquilibriumPath) -> list[float]:
    return [float(one.parameter) for one in path.critical if one.kind == "fold"]


def _tell(found: dict) -> None:
    """What was found, in lines."""
    grids, planes, exact = (found[name] for name in ("grids", "leaves_plane", "leaves_plane_exact"))
    ratio = grids[1] / grids[0]
    limit = drawn_on(*planes, ratio)
    print(
        f"writhing: without turns out of its plane from {planes[0]:.5f} L ({grids[0]} elements),"
        f" {planes[1]:.5f} ({grids[1]}), {limit:.5f} (drawn on), {exact:.5f} by shooting"
    )
    for n, off in zip(grids, found["off"], strict=True):
        print(
            f"writhing: {n} elements off shooting by {off['torque']:.1e} of 8.99 A/L,"
            f" {off['thrust']:.1e} of 39.5 A/L^2, {off['middle']:.1e} L (the middle)"
        )
    for number, path in found["free"].items():
        folds = [one[number] for one in found["jumps"]]
        print(
            f"writhing: {number} turns, thrust {path['thrust'][0]:.2f} A/L^2 at first; ends at"
            f" {path['parameter'][-1]:.4f} L ({path['end']}), {path['unstable'][-1]} unstable"
            + "".join(
                f"; jumps at {a:.5f} ({grids[0]} elements), {b:.5f}, {drawn_on(a, b, ratio):.5f}"
                for a, b in zip(*folds, strict=False)
            )
        )
    for number, path in found["contact"].items():
        turning = [f"{kind} at {at:.4f}" for kind, at in path["critical"]]
        print(
            f"writhing: {number} turns with contact to {path['parameter'][-1]:.4f} L"
            f" ({path['end']}), {path['unstable'][-1]} unstable; {', '.join(turning)}",
            flush=True,
        )


def touching(rod: rx.Rod, starts, free: dict[float, rx.EquilibriumPath]) -> dict:
    """Paths with contact; of the rod without turns that which leaves its plane."""
    contact = rx.Contact.solid(rod, FORCE)
    limits: dict = {"measures": MEASURES, "throw": False}
    found = {}
    for number, start in zip(free, starts, strict=True):
        if number:
            path = held(rod, start, contact)
        else:
            point, scene = first_branch(free[number]), drawn_near(rod, contact)
            path = rx.branch(scene, point, (BEGUN, LAST), **limits)
        found[str(number)] = curves(path)
    return found


def buckling(rod: rx.Rod, turns, column) -> list[rx.CriticalPoint]:
    """Where straight rods of so many turns buckle under thrust, from neighbour to neighbour."""
    state = rx.placing(rx.Scene(rod, rx.Clamped()))
    if column is None:
        column = first_branch(rx.path(pressed(rod), state, 30.0, 45.0, longest_step=0.5))
    point, at, points = finer(column, state), 0.0, []
    for number in turns:
        for between in np.linspace(at, number, 1 + int(np.ceil((number - at) / CHAIN)))[1:]:
            point = rx.critical(pressed(rod, between), point)
        at = number
        points.append(rx.critical(pressed(rod, number), point))
    return points


def begun(rod: rx.Rod, turns: float, point: rx.CriticalPoint) -> rx.State:
    """The buckled rod, just shortened; its time says by how much."""
    found = rx.branch(
        pressed(rod, turns),
        point,
        (-2 * COLUMN, 2 * COLUMN),
        measures={"shortening": shortening},
        targets={"shortening": BEGUN},
    )
    return dataclasses.replace(found.state(-1), time=jnp.asarray(BEGUN))


def drawn_near(rod: rx.Rod, contact: rx.Contact | None = None) -> rx.Scene:
    """Both ends clamped, one of them shortening the distance by the time."""
    far = 2.0
    way = rx.PiecewiseLinear([-far, far], np.outer([far, -far], AXIS))
    return rx.Scene(rod, rx.Clamped(), rx.Clamped(displacement=way), contact=contact)


def held(rod: rx.Rod, start: rx.State, contact: rx.Contact | None = None) -> rx.EquilibriumPath:
    """The path along the shortening: until it touches itself, or on with contact."""
    limits: dict = {"measures": MEASURES, "unit": 1.0, "throw": False}
    if contact is None:
        limits["targets"] = {"nearest": DIAMETER}
    return rx.path(drawn_near(rod, contact), start, BEGUN, LAST, **limits)


def compared(free: dict[float, rx.EquilibriumPath]) -> dict:
    """How far torque, thrust and middle are from those that shooting finds."""
    off = {"torque": 0.0, "thrust": 0.0, "middle": 0.0}
    for turns, path in free.items():
        rod = Clamped(RATIO, turns)
        # a rod pulled harder is too bent, at its loop, for shooting; one shortened as far as rods
        # of its turns can be is on another grid not there
        inside = path.parameters < np.max(path.parameters) - TURNING
        known = np.flatnonzero(inside & (np.asarray(path.measures["thrust"]) > -COLUMN))
        for i in known[np.unique(np.linspace(0, len(known) - 1, COMPARED).astype(int))]:
            # what the first end exerts on the rod, with the other sign
            guess = -np.concatenate([path.reactions.force[i, 0], path.reactions.torque[i, 0]])
            ends = rod.solve(guess, float(path.parameters[i]))
            last, half = rod.shape(ends), rod.shape(ends, 0.5)
            shot = {
                "torque": last[9] / TWIST,
                "thrust": -ends[2] / COLUMN,
                "middle": np.array([np.hypot(*half[:2]), half[2]]),
            }
            for name, unit in (("torque", TWIST), ("thrust", COLUMN), ("middle", 1.0)):
                gap = np.max(np.abs(path.measures[name][i] / unit - shot[name]))
                off[name] = max(off[name], float(gap))
    return off


def draw(axis, found: dict) -> None:
    """Torque against shortening."""
    for color, number in zip(("k", "C0", "C1", "C2"), found["free"], strict=False):
        _lines(axis, found["free"][number], color, f"{float(number):g} turns")
        if number in found["contact"]:
            _lines(axis, found["contact"][number], color, None)
    title = "held (dashed: unstable, dotted: touches)"
    axis.set(xlabel="shortening [L]", ylabel="torque [A/L]", title=title)
    axis.legend(fontsize=8)


def _lines(axis, path: dict, color: str, label: str | None) -> None:
    """A path, by how it is."""
    names = ("parameter", "torque", "nearest", "unstable")
    near, torques, nearby, unstable = (np.array(path[name]) for name in names)
    # distances are those of nodes
    touches = nearby < 1.1 * DIAMETER
    shaky = ~touches & (unstable > 0)
    # from the point before to the point behind
    wide = shaky.copy()
    wide[:-1] |= shaky[1:]
    wide[1:] |= shaky[:-1]
    kinds = ("-", ~touches & (unstable == 0)), ("--", wide), (":", touches)
    for line, there in kinds:
        shown = np.where(there, torques, np.nan)
        axis.plot(near, shown, line, color=color, label=label if line == "-" else None)
