"""The scenes that `speed.py` measures."""

import dataclasses
from typing import NamedTuple

import _settings  # noqa: F401 (first)
import equinox as eqx
import numpy as np
import scipy.interpolate
from example import PRESETS, contact_law, scene

from rodjax.constraints.ends import Clamped
from rodjax.interactions.loads import MorisonDrag
from rodjax.rods.builders import curved_rod, straight_rod
from rodjax.rods.section import circular_section
from rodjax.scenes.scene import Scene


def plectoneme(elements: int, contact: bool, radius: float = 3e-3, turns: float = 2.0) -> Scene:
    """Two strands wound around each other and closed by a loop, at rest so.

    Args:
        radius: half the distance between the strands' middles [m].
        turns: of one strand around the other.

    Drag, contact law and section are those of the example's `timeline`.
    """
    z = np.linspace(0, 1, 20001)
    wound = 2 * np.pi * turns * 0.5 * (1 - np.cos(np.pi * z))
    height = 0.49

    def leg(height):
        return np.stack([radius * np.cos(wound), radius * np.sin(wound), height * z], 1)

    length = lambda curve: np.sum(np.linalg.norm(np.diff(curve, axis=0), axis=1))
    for _ in range(20):  # fixed point: the whole curve is 1 m long
        height *= 0.5 * (1 - np.pi * radius) / length(leg(height))
    up = leg(height)
    angle = np.linspace(0, np.pi, 1001)[1:, None]
    outward = up[-1] * np.array([1.0, 1.0, 0.0])
    ahead = np.array([0.0, 0.0, radius])
    over = np.cos(angle) * outward + np.sin(angle) * ahead + np.array([0, 0, height])
    down = (up * np.array([-1.0, -1.0, 1.0]))[::-1][1:]
    points = np.concatenate([up, over, down])
    arc = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    curve = scipy.interpolate.CubicSpline(arc[::20], points[::20])
    preset = PRESETS["timeline"]
    section = circular_section(preset.diameter, 1.25e7, 5e6, 1500.0)
    rod = curved_rod(curve, 1.0, elements, section)
    return Scene(
        rod,
        Clamped(),
        Clamped(),
        (MorisonDrag(1000.0, 0.1, 0.01),),
        contact_law(preset) if contact else None,
    )


def ply(elements: int) -> Scene:
    """The same, so much thinner on a finer grid that every element has as many others near it.

    There are as many contact segments as elements.
    """
    whole = plectoneme(elements, True, 0.6 / elements, elements / 100)
    assert whole.contact is not None
    contact = dataclasses.replace(whole.contact, segments=elements, cutoff=3.0 / elements)
    return dataclasses.replace(whole, contact=contact)


class Rung(NamedTuple):
    """A scene of the ladder of what a scene can need."""

    name: str
    scene: Scene


def ladder(elements: int) -> list[Rung]:
    """From a clamped straight rod without anything to the full example."""
    preset = PRESETS["timeline"]
    whole = scene(preset, elements)
    section = circular_section(preset.diameter, 1.25e7, 5e6, 1500.0)
    bare = straight_rod(1.0, elements, section, direction=(0.0, 1.0, 0.0))
    no_rotary = eqx.tree_at(
        lambda r: r.rotary_inertia, bare, None, is_leaf=lambda leaf: leaf is None
    )
    return [
        Rung("clamped-free rod, no rotary inertia", Scene(no_rotary, Clamped())),
        Rung("with rotary inertia", Scene(bare, Clamped())),
        Rung("with drag", Scene(bare, Clamped(), loads=whole.loads)),
        Rung("with drive, slider and neck", scene(preset, elements, contact=False)),
        Rung("with contact", whole),
    ]
