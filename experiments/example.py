"""The illustrative example of Goyal, Perkins & Lee (section 4): its scene, in two presets.

What the paper's text gives is fixed here; what it leaves to figures that cannot be read off
(the diameter, the twist rate, the imperfection) is assumed, and differs between the presets.
"""

import dataclasses

import jax.numpy as jnp
import numpy as np

from rodjax.constraints.ends import Clamped, Slider, Switched, Turn
from rodjax.inputs.schedules import PiecewiseLinear
from rodjax.interactions.contact import Contact
from rodjax.interactions.contact_laws import DampedInversePower
from rodjax.interactions.loads import MorisonDrag
from rodjax.rods.builders import straight_rod
from rodjax.rods.rod import Rod
from rodjax.rods.section import circular_section
from rodjax.scenes.scene import Scene

LOADING_AXIS = (0.0, 1.0, 0.0)  # e2; the rod lies along it, its right end s = 0 at the origin
LENGTH = 1.0  # [m]
NECK = (0.375, 0.625)  # the middle quarter [m]
LAST_TIME = 1000.0  # the drives are given until then [s]
FIRST_CONTACT = 1e-6  # counts from this sum of all contact forces on [N]

# Table 1 and section 4 of the paper
FROM_PAPER = {
    "length": "1 m",
    "Young's modulus": "1.25e7 Pa",
    "shear modulus": "5e6 Pa",
    "rod density": "1500 kg/m^3",
    "neck": "0.9 of the diameter over the middle quarter",
    "fluid density": "1000 kg/m^3",
    "drag coefficients": "normal 0.1, tangential 0.01",
    "contact law": "Eq. (13) with k1 = 1e-7 m^4/s^2, k2 = 3, k3 = 1e-6, k4 = 1",
    "ends": "right end s = 0 turned about e2, left end s = L slides along e2",
}


@dataclasses.dataclass(frozen=True)
class Preset:
    """The assumed inputs of the example.

    Args:
        diameter: D of the thick part [m].
        drive: knots (time [s], turns) of the right end's rotation, linear between them.
        rate_after: its rate after the last knot [turns/s].
        seed_curvature: natural curvature about a_1, which starts buckling [1/m].
        hold_at: time from which the left end is held [s] (in the paper: 30 s), None for never.
        cutoff: distance tolerance of the contact search [m].
        contact_segments, points_per_segment: quadrature of the contact law along the rod.
        max_step: longest step of the adaptive run [s].
        tolerances: relative and absolute, of the adaptive run.
    """

    name: str
    diameter: float
    drive: tuple[tuple[float, float], ...]
    rate_after: float
    seed_curvature: float
    hold_at: float | None
    cutoff: float
    contact_segments: int
    points_per_segment: int
    max_step: float = 0.36
    tolerances: tuple[float, float] = (0.01, 2.5e-3)

    @property
    def assumed(self) -> dict[str, str]:
        """The inputs that the paper's text does not give, in words."""
        knots = ", ".join(f"{turns:g} turns at {time:g} s" for time, turns in self.drive[1:])
        held = "never held" if self.hold_at is None else None
        inputs = {
            "diameter": f"{1e3 * self.diameter:g} mm",
            "twist": f"linear to {knots}, then {self.rate_after:.6g} turns/s",
            "contact search": f"within {1e3 * self.cutoff:g} mm, aperture 120 degrees",
            "imperfection": f"natural curvature {self.seed_curvature:g} /m about a_1",
        }
        return inputs | ({"left end": held} if held else {})


PRESETS = {
    preset.name: preset
    for preset in (
        # inferred from the paper's milestones by infer_unpublished.py, and rounded
        Preset("timeline", 3.14e-4, ((0.0, 0.0), (14.2, 4.0)), 0.023, 0.05, 30.0, 15e-3, 200, 4),
        # the stress case: strands collapse within a second into hard contact
        Preset(
            "stout",
            1e-2,
            ((0.0, 0.0), (16.0, 4.0)),
            1 / 32,
            1e-3,
            None,
            12e-3,
            200,
            7,
            tolerances=(0.02, 5e-3),
        ),
    )
}


def rod(preset: Preset, elements: int) -> Rod:
    """The necked rod, straight along e2."""
    section = circular_section(
        lambda s: np.where((s > NECK[0]) & (s < NECK[1]), 0.9, 1.0) * preset.diameter,
        youngs_modulus=1.25e7,
        shear_modulus=5e6,
        density=1500.0,
    )
    return straight_rod(
        LENGTH,
        elements,
        section,
        direction=LOADING_AXIS,
        natural_curvature=(preset.seed_curvature, 0.0, 0.0),
        jumps=NECK,
    )


def resized(rod: Rod, factor) -> Rod:
    """The rod with its diameter times a factor, or one for each element, of the same material."""
    factor = jnp.broadcast_to(factor, rod.diameter.shape)
    return dataclasses.replace(
        rod,
        diameter=factor * rod.diameter,
        mass=factor**2 * rod.mass,
        area=factor**2 * rod.area,
        stiffness=factor[:, None] ** 4 * rod.stiffness,
        rotary_inertia=factor[:, None] ** 4 * rod.rotary_inertia,
    )


def drive(preset: Preset) -> Turn:
    """Rotation of the right end, by minus the turns about e2, so that Lk comes out positive."""
    times, turns = (np.array(x) for x in zip(*preset.drive, strict=True))
    last = turns[-1] + preset.rate_after * (LAST_TIME - times[-1])
    turns = np.append(turns, last)
    return Turn(LOADING_AXIS, PiecewiseLinear(np.append(times, LAST_TIME), -2 * np.pi * turns))


def contact_law(preset: Preset) -> Contact:
    """Self-contact by Eq. (13) with the paper's coefficients.

    The paper gives neither the distance tolerance nor the screening aperture: both are assumed
    (`Preset.cutoff`, 120 degrees), as is the spacing of the contact points, fine enough for a force
    ripple under 2 % at the distance where the strands settle.
    """
    return Contact(
        DampedInversePower(k1=1e-7, k2=3.0, k3=1e-6, k4=1.0, reference_spacing=1e-3),
        segments=preset.contact_segments,
        points_per_segment=preset.points_per_segment,
        cutoff=preset.cutoff,
        aperture=2 * np.pi / 3,
    )


def scene(preset: Preset, elements: int, contact: bool = True) -> Scene:
    """The whole example."""
    slider = Slider(LOADING_AXIS)
    held = slider if preset.hold_at is None else Switched(slider, Clamped(), preset.hold_at)
    return Scene(
        rod(preset, elements),
        first_end=Clamped(rotation=drive(preset)),
        last_end=held,
        loads=(MorisonDrag(1000.0, normal_coefficient=0.1, tangential_coefficient=0.01),),
        contact=contact_law(preset) if contact else None,
    )
