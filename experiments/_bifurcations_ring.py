"""A closed ring whose natural twist grows: Michell's threshold, the branch there, the figure 8.

A ring of an isotropic, naturally straight rod whose natural twist lies p turns below its linking
number is one that was cut, twisted by p turns and rejoined. Twist strain is the same all along it,
and of its equilibria the torque M is, whatever C/A, a function of the writhe alone: with
mu = M L/(2 pi A) they obey

    p = mu(Wr) A/C + Wr,     mu(0) = sqrt(3),     mu'(0) = -11/8,     mu(1) = 0.

of which -11/8 is what the grids tend to. The branch so begins at p = sqrt(3) A/C (Michell), turns
back there where C/A < 11/8, and passes the figure 8, Wr = 1, at one turn.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from _bifurcations_scenes import RATIO, curves, drawn_on, finer, first_branch

import rodjax as rx

MICHELL = np.sqrt(3)  # turns, times A/C
SLOPE = -11 / 8  # d mu/d Wr of the ring that has just left its plane, as grids tend to
STIFF = 2.0  # torsional over bending stiffness of a ring that leaves its plane gently (DNA's)
DIAMETER = 1 / 57  # of the strands, over the length: a DNA minicircle of 336 base pairs
FORCE = 100.0  # that contact is made for [A/L^2]


def find(elements: int, quick: bool) -> dict:
    """The threshold on two grids, and what leaves there: free to the figure 8, and in contact."""
    grids = (elements // 2, elements) if quick else (elements // 2, 3 * elements)
    points = thresholds(grids)
    off = [float(point.parameter) * RATIO / MICHELL - 1 for point in points]
    limit = drawn_on(*off, grids[1] / grids[0])
    slopes = [slope(n, point) for n, point in zip(grids, points, strict=True)]
    found: dict = {"grids": grids, "off": off, "off_drawn_on": limit, "slopes": slopes}
    print(
        f"ring: threshold off sqrt(3) A/C by {off[0]:.2e} ({grids[0]} elements), {off[1]:.2e}"
        f" ({grids[1]}), {limit:.0e} (drawn on); d mu/d Wr there {slopes[0]:.4f}, {slopes[1]:.4f},"
        f" towards {SLOPE:g}",
        flush=True,
    )
    found["branches"] = {
        str(ratio): past(grids[0], points[0], ratio, quick)
        for ratio in ((RATIO,) if quick else (RATIO, STIFF))
    }
    return found


def ring_of(elements: int, ratio: float) -> rx.Rod:
    """A ring of unit length and bending stiffness."""
    return rx.ring(1.0, elements, rx.Section((1.0, 1.0, ratio), diameter=DIAMETER, mass=1.0))


def wound(rod: rx.Rod, contact: rx.Contact | None = None):
    """Scenes of a ring along the turns by which its natural twist lies below none."""
    return jax.tree_util.Partial(_wound, rod, contact)


def _wound(rod, contact, turns):
    """One node is held, or the ring would move as a whole; what holds it feels no force."""
    natural = rod.natural_curvature.at[:, 2].set(-2 * jnp.pi * turns / jnp.sum(rod.length))
    twisted = dataclasses.replace(rod, natural_curvature=natural)
    weld = rx.Weld(rx.Point(0), rx.Point(-1))
    return rx.Scene(twisted, rx.Clamped(), contact=contact, joints=(weld,))


def writhe(scene, state):
    """Of the closed line, for which twist makes up."""
    return rx.measures.writhe_of(scene.closed, state)


def torque(scene, state):
    """The same all along it, over 2 pi A/L."""
    twist = rx.measures.curvature(scene.rod, state.quaternion) - scene.rod.natural_curvature
    return jnp.mean(scene.rod.stiffness[:, 2] * twist[:, 2]) / (2 * jnp.pi)


def nearest(scene, state):
    """Least distance of nodes that lie a fifth of the ring or more apart along it."""
    nodes = state.position[:-1]
    count = len(nodes)
    apart = np.abs(np.arange(count)[:, None] - np.arange(count))
    apart = np.minimum(apart, count - apart)
    squares = jnp.sum((nodes[:, None] - nodes[None]) ** 2, -1)
    return jnp.sqrt(jnp.min(jnp.where(apart >= count // 5, squares, 1.0)))


MEASURES = {"writhe": writhe, "torque": torque, "nearest": nearest}


def thresholds(grids) -> list[rx.CriticalPoint]:
    """Where the plane ring becomes unstable, of each grid from the one before."""
    points: list[rx.CriticalPoint] = []
    for elements in grids:
        rod = ring_of(elements, RATIO)
        state = rx.placing(wound(rod)(0.0))
        if not points:
            past = 1.2 * MICHELL / RATIO
            plane = rx.path(wound(rod), state, 0.0, past, longest_step=0.5)
            points.append(first_branch(plane))
            continue
        points.append(rx.critical(wound(rod), finer(points[-1], state)))
    return points


def slope(elements: int, point: rx.CriticalPoint) -> float:
    """d mu/d Wr where the ring leaves its plane."""
    rod = ring_of(elements, RATIO)
    limits = {"targets": {"writhe": 0.15}, "longest_step": 0.1}
    found = rx.branch(wound(rod), point, (0.0, 3.0), measures=MEASURES, **limits)
    bent = np.asarray(found.measures["writhe"]), np.asarray(found.measures["torque"])
    return float(np.polyfit(*bent, 4)[-2])


def past(elements: int, point: rx.CriticalPoint, ratio: float, quick: bool) -> dict:
    """The branch of a ring of this torsional stiffness."""
    rod = ring_of(elements, ratio)
    guess = dataclasses.replace(point, parameter=point.parameter * RATIO / ratio)
    point = rx.critical(wound(rod), guess)
    limits = {"measures": MEASURES, "longest_step": 0.1}
    free = rx.branch(wound(rod), point, (0.0, 3.0), targets={"torque": 0.0}, **limits)
    writhes, torques, nears = (np.asarray(free.measures[name]) for name in MEASURES)
    law = float(np.max(np.abs(torques / ratio + writhes - free.parameters)[:-1]))
    touch = float(np.interp(-DIAMETER, -nears, free.parameters))
    folds = [float(one.parameter) for one in free.critical if one.kind == "fold"]
    print(
        f"ring: C/A = {ratio:g} leaves its plane at {free.parameters[0]:.4f} turns,"
        f" {'un' if free.unstable[1] else ''}stable; touches itself at {touch:.4f}, writhe"
        f" {np.interp(-DIAMETER, -nears, writhes):.4f}; figure 8 at {free.parameters[-1]:.4f};"
        f" off p = mu A/C + Wr by {law:.0e}" + "".join(f"; fold at {one:.4f}" for one in folds),
        flush=True,
    )
    found = {"free": curves(free), "touch": touch, "off_law": law}
    if not quick:
        contact = rx.Contact.solid(rod, FORCE)
        limits = {"measures": MEASURES, "targets": {"writhe": 1.15}}
        found["contact"] = curves(rx.branch(wound(rod, contact), point, (0.0, 3.0), **limits))
    return found


def draw(axis, found: dict) -> None:
    """Writhe against turns."""
    for color, (ratio, one) in zip(("C0", "C1"), found["branches"].items(), strict=False):
        path = one.get("contact", one["free"])
        names = ("parameter", "writhe", "nearest", "unstable")
        turns, writhes, near, unstable = (np.array(path[name]) for name in names)
        touches = near < DIAMETER
        axis.plot([0.0, turns[0]], [0.0, 0.0], color=color, label=f"C/A = {ratio}")
        axis.plot(MICHELL / float(ratio), 0.0, "o", color=color, ms=5, mfc="none")
        for line, there in (("-", unstable == 0), ("--", unstable > 0)):
            axis.plot(turns, np.where(there & ~touches, writhes, np.nan), line, color=color)
        if "contact" in one:
            axis.plot(turns[touches], writhes[touches], ":", color=color, lw=2)
    title = "ring (dashed: unstable, dotted: touches)"
    axis.set(xlabel="turns", ylabel="writhe", title=title)
    axis.legend(fontsize=8)
