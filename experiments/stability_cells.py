"""The cells of the stability map: scenes, and what is changed in each.

Every cell is one of three scenes with one number (of an axis) or two (a pair of extremes) changed.
Where modulus or diameter changes, drive and duration keep their ratio to the elastic time
L^2 sqrt(m/A).
"""

import dataclasses
import functools
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from example import LENGTH, LOADING_AXIS, NECK, PRESETS

import rodjax as rx

GRAVITY = 9.81  # [m/s^2]
TIMELINE, STOUT, CANTILEVER, HAIRPIN = "timeline", "stout", "cantilever", "hairpin"


class Cell(NamedTuple):
    """One square of the map."""

    scene: str
    axis: str
    label: str
    changes: tuple[tuple[str, Any], ...]

    @property
    def name(self) -> str:
        """Unique in the map."""
        return f"{self.scene}: {self.axis} {self.label}".rstrip()


class Case(NamedTuple):
    """What a cell runs."""

    scene: rx.Scene
    state: rx.State
    duration: float
    step: float | None  # fixed, or None for steps chosen by the local error
    method: rx.GeneralizedAlpha
    control: rx.StepControl
    precision: str


@dataclasses.dataclass(frozen=True)
class Base:
    """A scene before anything is changed. Times in [s], lengths over the rod's."""

    diameter: float
    modulus: float
    elements: int
    duration: float
    developed: float  # when sudden events and fixed steps begin
    afterwards: float  # duration from there
    max_step: float
    tolerances: tuple[float, float]


BASES = {
    CANTILEVER: Base(1e-2, 1e9, 20, 1.0, 0.0, 1.0, 0.01, (0.01, 2.5e-3)),
    # through buckling, loop, first contact and half of the intertwining
    TIMELINE: Base(3e-4, 1.25e7, 60, 30.0, 27.0, 3.0, 0.36, PRESETS[TIMELINE].tolerances),
    # into hard contact, which begins at 9.02 s
    STOUT: Base(1e-2, 1.25e7, 60, 9.06, 9.0, 0.06, 0.36, PRESETS[STOUT].tolerances),
    # two strands side by side, one end turned against the other
    HAIRPIN: Base(1e-2, 1.25e7, 60, 0.3, 0.0, 0.3, 0.01, (0.02, 5e-3)),
}

# changed number -> its values along the axis; None: the number is not of this scene
POWERS = lambda low, high, step=1: [10.0**k for k in range(low, high + 1, step)]
AXES: dict[str, list[float]] = {
    "E [Pa]": POWERS(3, 13),
    "D/L": [1e-5, 1e-4, 1e-3, 1e-2, 0.05, 0.1, 0.2],
    "dt [s]": POWERS(-6, 0),
    "rho_inf": [0.0, 0.25, 0.5, 0.8, 0.9, 0.99],
    "N": [2, 5, 20, 200, 1000, 5000],
    "A1/A2": POWERS(0, 4),
    "neck d/D": [1.0, 0.9, 0.7, 0.5, 0.3, 0.1],
    "drag x": [0.0, *POWERS(-1, 4)],
    "turns/s": [0.1, 1.0, 10.0, 100.0],
    "contact force x": POWERS(-6, 6),
    "k2": [1.0, 2.0, 3.0, 6.0, 9.0, 12.0],
    "compliance x": [0.0, 1.0, 1e2, 1e4, 1e6],
    "gravity [g]": [0.0, 1.0, 10.0, 100.0, 1000.0],
    "end": ["held", "released", "reversed"],
    "precision": ["float64", "float32"],
}
OF_PRESETS_ONLY = ("turns/s", "contact force x", "k2", "end")

PAIRS: list[tuple[str, tuple[tuple[str, Any], ...]]] = [
    (TIMELINE, (("E [Pa]", 1e13), ("dt [s]", 1.0))),
    (TIMELINE, (("E [Pa]", 1e3), ("dt [s]", 1e-6))),
    (TIMELINE, (("turns/s", 100.0), ("drag x", 1e4))),
    (TIMELINE, (("turns/s", 100.0), ("drag x", 0.0))),
    (TIMELINE, (("contact force x", 1e6), ("drag x", 0.0))),
    (TIMELINE, (("contact force x", 1e-6), ("drag x", 1e4))),
    (TIMELINE, (("k2", 12.0), ("contact force x", 1e6))),
    (TIMELINE, (("k2", 1.0), ("contact force x", 1e-6))),
    (TIMELINE, (("gravity [g]", 1e3), ("drag x", 0.0))),
    (TIMELINE, (("gravity [g]", 1e3), ("E [Pa]", 1e3))),
    (TIMELINE, (("precision", "float32"), ("E [Pa]", 1e13))),
    (TIMELINE, (("precision", "float32"), ("D/L", 1e-5))),
    (TIMELINE, (("end", "reversed"), ("drag x", 0.0))),
    (STOUT, (("D/L", 0.2), ("contact force x", 1e6))),
    (STOUT, (("neck d/D", 0.1), ("A1/A2", 1e4))),
    (STOUT, (("rho_inf", 0.99), ("dt [s]", 1e-2))),
    (STOUT, (("rho_inf", 0.0), ("dt [s]", 1.0))),
    (STOUT, (("precision", "float32"), ("contact force x", 1e6))),
    (STOUT, (("end", "released"), ("drag x", 0.0))),
    (CANTILEVER, (("E [Pa]", 1e3), ("gravity [g]", 1e3))),
    (CANTILEVER, (("E [Pa]", 1e13), ("dt [s]", 1.0))),
    (CANTILEVER, (("N", 5000), ("dt [s]", 1e-6))),
    (CANTILEVER, (("N", 2), ("gravity [g]", 1e3))),
    (CANTILEVER, (("compliance x", 1e6), ("gravity [g]", 1e3))),
    (CANTILEVER, (("rho_inf", 0.99), ("dt [s]", 0.1))),
    (CANTILEVER, (("precision", "float32"), ("dt [s]", 1e-6))),
    (CANTILEVER, (("A1/A2", 1e4), ("neck d/D", 0.1))),
]

QUICK = {"E [Pa]": [1e3, 1e13], "dt [s]": [1e-6, 1.0], "N": [2], "precision": ["float32"]}


def cells(quick: bool = False) -> list[Cell]:
    """All cells, in the order in which they are drawn; a few of the cantilever's when `quick`."""

    def along(scene, axis, values):
        return [Cell(scene, axis, _text(v), ((axis, v),)) for v in values]

    if quick:
        return [cell for axis in QUICK for cell in along(CANTILEVER, axis, QUICK[axis])]
    found = []
    for scene in (CANTILEVER, TIMELINE, STOUT):
        for axis, values in AXES.items():
            if scene != CANTILEVER or axis not in OF_PRESETS_ONLY:
                found += along(scene, axis, values)
    found.append(Cell(TIMELINE, "20 turns", "", (("plectoneme", 20.0),)))
    for gap in (4.0, 2.0, 1.1, 0.7):
        found.append(Cell(HAIRPIN, "gap [D]", _text(gap), (("gap", gap),)))
    for scene, changes in PAIRS:
        label = ", ".join(f"{axis} {_text(value)}" for axis, value in changes)
        found.append(Cell(scene, "pair", label, changes))
    return found


def _text(value) -> str:
    return value if isinstance(value, str) else f"{value:g}"


def build(cell: Cell) -> Case:
    """Scene, state, duration and settings of a cell, in the precision that jax is set to."""
    changed, base = dict(cell.changes), BASES[cell.scene]
    get = changed.get
    # elastic time over that of the base
    ratio = base.diameter / get("D/L", base.diameter)
    slower = float(np.sqrt(base.modulus / get("E [Pa]", base.modulus)) * ratio)
    step, rate, precision = get("dt [s]"), get("turns/s"), get("precision", "float64")
    duration, state = slower * base.duration, None
    if cell.scene == CANTILEVER:  # a rod softer than its weight swings in the time of a pendulum
        duration = min(duration, base.duration)
    if rate is not None:
        duration = min(duration, 6 / rate)
    if get("N", 0) >= 1000 and step is None:
        step = 1e-3 * duration
    whole = scene(cell.scene, changed, slower)
    developed = base.developed > 0 and slower == 1 and "N" not in changed
    if developed and not {"dt [s]", "end", "gravity [g]"}.isdisjoint(changed):
        state, duration = _developed(cell.scene, precision), base.afterwards
    if "plectoneme" in changed:
        duration = 31.0
    moving = {}
    if state is not None:
        moving = {
            "position": state.position,
            "quaternion": state.quaternion,
            "velocity": state.velocity,
            "angular_velocity": state.angular_velocity,
            "time": state.time,
        }
    elif cell.scene == HAIRPIN:
        s = whole.rod.arc_length  # the half beyond the bend swings in
        moving = {"velocity": jnp.outer(jnp.maximum(s - 0.5, 0.0), jnp.asarray([-4.0, 0, 0]))}
    control = rx.StepControl(*base.tolerances, max_step=slower * base.max_step)
    method = rx.GeneralizedAlpha(get("rho_inf", 0.5))
    return Case(whole, rx.start(whole, **moving), duration, step, method, control, precision)


def scene(name: str, changed: dict[str, Any], slower: float = 1.0) -> rx.Scene:
    """One of the scenes with some numbers changed, its drive slowed down."""
    get, base = changed.get, BASES[name]
    preset = name in (TIMELINE, STOUT)
    gravity = get("gravity [g]", 1.0 if name == CANTILEVER else 0.0) * GRAVITY
    drag = get("drag x", 1.0 if preset else 0.0)
    loads = (rx.Gravity((0.0, 0.0, -gravity)), rx.MorisonDrag(1000.0, 0.1 * drag, 0.01 * drag))
    if name == CANTILEVER:
        return rx.Scene(_rod(name, changed), rx.Clamped(), loads=loads)
    if name == HAIRPIN:
        return rx.Scene(_rod(name, changed), rx.Clamped(), loads=loads, contact=_contact(changed))
    event, at = get("end"), base.developed + 0.2 * base.afterwards
    end = slider = rx.Slider(LOADING_AXIS)
    if event == "held":
        end = rx.Switched(slider, rx.Clamped(), at)
    elif event == "released":
        end = rx.Switched(slider, rx.Free(), at)
    first = rx.Clamped(rotation=_drive(name, changed, slower, at))
    contact = _contact(changed, base.diameter)
    return rx.Scene(_rod(name, changed), first, end, loads, contact)


def _rod(name: str, changed: dict[str, Any]) -> rx.Rod:
    """The rod, its middle quarter necked."""
    get, base = changed.get, BASES[name]
    diameter, modulus = get("D/L", base.diameter) * LENGTH, get("E [Pa]", base.modulus)
    neck = get("neck d/D", 1.0 if name in (CANTILEVER, HAIRPIN) else 0.9)
    compliance = get("compliance x")
    section = rx.circular_section(
        lambda s: np.where((s > NECK[0]) & (s < NECK[1]), neck, 1.0) * diameter,
        modulus,
        0.4 * modulus,
        1500.0,
        extensible=compliance is not None,
    )
    elements = get("N", 200 if "plectoneme" in changed else base.elements)
    if name == HAIRPIN:
        rod = rx.curved_rod(_almost_closed(get("gap") * diameter), LENGTH, elements, section)
    else:
        rod = rx.straight_rod(
            LENGTH,
            elements,
            section,
            direction=(1.0, 0.0, 0.0) if name == CANTILEVER else LOADING_AXIS,
            natural_curvature=(0.0 if name == CANTILEVER else 1e-3, 0.0, 0.0),
            jumps=NECK if neck != 1 else (),
        )
    weaker = jnp.asarray([1.0, 1 / get("A1/A2", 1.0), 1.0])
    rod = eqx.tree_at(lambda r: r.stiffness, rod, rod.stiffness * weaker)
    if compliance is not None:
        rod = eqx.tree_at(lambda r: r.compliance, rod, compliance * rod.compliance)
    return rod


def _drive(name: str, changed: dict[str, Any], slower: float, at: float) -> rx.Turn:
    """The preset's drive; a steady rate; one that turns back at once; or 20 turns."""
    preset = PRESETS[name]
    times, turns = (np.array(x) for x in zip(*preset.drive, strict=True))
    times = slower * np.append(times, times[-1] + 1000.0)
    turns = np.append(turns, turns[-1] + 1000.0 * preset.rate_after)
    if "turns/s" in changed:
        times, turns = times[[0, -1]], changed["turns/s"] * times[[0, -1]]
    if changed.get("end") == "reversed":
        before = np.interp(at, times, turns)
        times = np.array([0.0, times[1], at, times[-1]])
        turns = np.array([0.0, turns[1], before, before - (times[-1] - at)])
    if "plectoneme" in changed:
        times = np.array([0.0, 6.0, 27.0, 31.0, 32.0])
        turns = np.array([0.0, 4.0, 4.42, 1.0, 1.0])
        turns[3:] *= changed["plectoneme"]
    return rx.Turn(LOADING_AXIS, rx.PiecewiseLinear(times, -2 * np.pi * turns))


def _contact(changed: dict[str, Any], base_diameter: float = 1e-2) -> rx.Contact:
    """Eq. (13) with the force at d = D scaled, and with another exponent that keeps it there."""
    diameter, exponent = changed.get("D/L", base_diameter) * LENGTH, changed.get("k2", 3.0)
    strength = 1e-7 * changed.get("contact force x", 1.0)
    strength *= (0.5 * diameter) ** (exponent - 3.0)
    law = rx.DampedInversePower(k1=strength, k2=exponent, k3=1e-6, reference_spacing=1e-3)
    cutoff = max(15e-3 if base_diameter < 1e-3 else 12e-3, 1.2 * diameter)
    segments = 125
    # so that four pairs a segment hold all within the cut-off
    while cutoff * np.sin(np.pi / 3) * segments / LENGTH + 1 > 4:
        segments //= 2
    return rx.Contact(law, segments, cutoff, points_per_segment=5, aperture=2 * np.pi / 3)


def _almost_closed(gap: float):
    """A loop between two straight legs whose tips come within the gap of each other."""
    radius, low, high = 0.04 * LENGTH, 0.0, 0.5
    leg = lambda a: 0.5 * (LENGTH - (np.pi + 2 * a) * radius)
    for _ in range(60):  # the angle by which the legs lean together
        lean = 0.5 * (low + high)
        wide = 2 * radius * np.cos(lean) - 2 * leg(lean) * np.sin(lean) > gap
        low, high = (lean, high) if wide else (low, lean)
    straight, along = leg(lean), np.array([np.sin(lean), np.cos(lean), 0.0])
    centre = straight * along + radius * np.array([np.cos(lean), -np.sin(lean), 0.0])

    def curve(s):
        s = float(s)
        if s < straight:
            return s * along
        turned = min((s - straight) / radius, np.pi + 2 * lean) - lean
        place = centre + radius * np.array([-np.cos(turned), np.sin(turned), 0.0])
        beyond = max(s - straight - (np.pi + 2 * lean) * radius, 0.0)
        return place + beyond * np.array([along[0], -along[1], 0.0])

    return curve


@functools.cache
def _developed(name: str, precision: str) -> rx.State:
    """State of an unchanged preset when something is about to happen (kept for each precision)."""
    base, whole = BASES[name], scene(name, {})
    control = rx.StepControl(*base.tolerances, max_step=base.max_step)
    return rx.adaptive_rollout(whole, rx.start(whole), base.developed, control=control).final
