"""Names of the units of everything that is stored.

Any consistent units may be used; the code never needs to know them. They matter only where a
number leaves the program, in files and on the axes of figures.
"""

from typing import NamedTuple

from rodjax.inputs.validation import shown


class _Names(NamedTuple):
    length: str = "m"
    time: str = "s"
    mass: str = "kg"
    force: str = "N"


class Units(_Names):
    """Names of the base units of a scene, SI by default.

    For nanometres and piconewtons: `Units("nm", "s", "pN s^2/nm", "pN")`.

    Attributes:
        length, time, mass, force: names of these units; energy is force times length.
    """

    __slots__ = ()

    def __new__(cls, length: str = "m", time: str = "s", mass: str = "kg", force: str = "N"):
        units = super().__new__(cls, length, time, mass, force)
        for name, unit in units._asdict().items():
            if not isinstance(unit, str) or not unit.strip():
                raise ValueError(f"{name}: name the unit by a text such as 'm', got {shown(unit)}")
        return units

    @property
    def energy(self) -> str:
        """Unit of energy."""
        return "J" if (self.force, self.length) == ("N", "m") else f"{self.force} {self.length}"


SI = Units()

_USED = [SI]


def use(units: Units) -> Units:
    """Print texts, and show runs for which nothing else is said, with these names from now on.

        rx.units.use(rx.units.Units("nm", "s", "pN s^2/nm", "pN"))

    Args:
        units: the names; SI at first.

    Returns:
        The names used until then.
    """
    if not isinstance(units, Units):
        raise ValueError(f"units: give names such as Units('nm', 's'), got {shown(units)}")
    before, _USED[0] = _USED[0], units
    return before


def used() -> Units:
    """The names that texts are printed with."""
    return _USED[0]


# Templates by class and field. {of} stands for the unit of the field that holds the object: a
# schedule's values have the unit of what it drives.
_TEMPLATES = {
    "Rod.position": "{length}",
    "Rod.quaternion": "1",
    "Rod.length": "{length}",
    "Rod.stiffness": "{force} {length}^2",
    "Rod.natural_curvature": "rad/{length}",
    "Rod.mass": "{mass}/{length}",
    "Rod.rotary_inertia": "{mass} {length}",
    "Rod.compliance": "1/{force}",
    "Rod.diameter": "{length}",
    "Rod.area": "{length}^2",
    "Rod.coupling": "{force} {length}^2",
    "Rod.torque_per_tension": "{length}",
    "Rod.actuation": "rad/{length}",
    "Section.stiffness": "{force} {length}^2",
    "Section.mass": "{mass}/{length}",
    "Section.rotary_inertia": "{mass} {length}",
    "Section.compliance": "1/{force}",
    "Section.diameter": "{length}",
    "Section.area": "{length}^2",
    "Section.coupling": "{force} {length}^2",
    "Section.torque_per_tension": "{length}",
    "ElasticPlastic.yield_moment": "{force} {length}",
    "ElasticPlastic.hardening": "{force} {length}^2",
    "KelvinVoigt.bending": "{time}",
    "KelvinVoigt.torsion": "{time}",
    "KelvinVoigt.stretch": "{time}",
    "Turn.axis": "1",
    "Turn.angle": "rad",
    "Clamped.displacement": "{length}",
    "Pinned.displacement": "{length}",
    "Slider.axis": "1",
    "Slider.displacement": "{length}",
    "Hinge.axis": "1",
    "Hinge.angle": "rad",
    "Slide.axis": "1",
    "Slide.displacement": "{length}",
    "Switched.at": "{time}",
    "Switched.displacement": "{length}",
    "Constant.value": "{of}",
    "PiecewiseLinear.times": "{time}",
    "PiecewiseLinear.values": "{of}",
    "PiecewiseLinearRate.times": "{time}",
    "PiecewiseLinearRate.rates": "{of}/{time}",
    "Smooth.times": "{time}",
    "Function.last": "{time}",
    "Smooth.values": "{of}",
    "Gravity.acceleration": "{length}/{time}^2",
    "Gravity.fluid_density": "{mass}/{length}^3",
    "MorisonDrag.fluid_density": "{mass}/{length}^3",
    "MorisonDrag.normal_coefficient": "1",
    "MorisonDrag.tangential_coefficient": "1",
    "MorisonDrag.current": "{length}/{time}",
    "MorisonDrag.added_mass_coefficient": "1",
    "LinearDrag.normal": "{force} {time}/{length}^2",
    "LinearDrag.tangential": "{force} {time}/{length}^2",
    "LinearDrag.rotational": "{force} {time}",
    "HardMagnetic.moment": "{force}/T",
    "HardMagnetic.field": "T",
    "HardMagnetic.amplitude": "1",
    "PointDrag.linear": "{force} {time}/{length}",
    "PointDrag.quadratic": "{force} {time}^2/{length}^2",
    "PointDrag.rotational": "{force} {length} {time}",
    "PointDrag.current": "{length}/{time}",
    "PointDrag.offset": "{length}",
    "PointLoad.node": "1",
    "Support.node": "1",
    "Body.mass": "{mass}",
    "Body.inertia": "{mass} {length}^2",
    "Body.position": "{length}",
    "Body.quaternion": "1",
    "Body.volume": "{length}^3",
    "Lump.mass": "{mass}",
    "Lump.inertia": "{mass} {length}^2",
    "Lump.offset": "{length}",
    "Lump.volume": "{length}^3",
    "PointLoad.force": "{force}",
    "PointLoad.moment": "{force} {length}",
    "GeneralizedAlpha.spectral_radius": "1",
    "GeneralizedAlpha.tolerance": "1",
    "GeneralizedAlpha.max_iterations": "1",
    "StepControl.relative": "1",
    "StepControl.absolute": "1",
    "StepControl.twisting": "rad",
    "StepControl.max_step": "{time}",
    "StepControl.first_step": "{time}",
    "StepControl.min_step": "{time}",
    "Control.dt": "{time}",
    "Control.growth": "1",
    "Control.max_step": "{time}",
    "Control.min_step": "{time}",
    "Control.landing": "1",
    "Control.next_dt": "{time}",
    "Control.next_growth": "1",
    "State.time": "{time}",
    "State.position": "{length}",
    "State.quaternion": "1",
    "State.velocity": "{length}/{time}",
    "State.angular_velocity": "rad/{time}",
    "State.curvature": "rad/{length}",
    "State.acceleration": "{length}/{time}^2 and rad/{time}^2",
    "State.auxiliary": "{length}/{time}^2 and rad/{time}^2",
    "State.jerk": "{length}/{time}^3 and rad/{time}^3",
    "State.force": "{force}",
    "State.joints": "{force} and {force} {length}",
    "State.settling": "1",
    "Stored.schedule": "{time}",
    "Run.result": "1",
    "Run.rejected": "1",
    "Run.wasted_iterations": "1",
    "Run.steps_before": "1",
    "StepInfo.result": "1",
    "StepInfo.iterations": "1",
    "StepInfo.error_position": "{length}",
    "StepInfo.error_bending": "rad",
    "StepInfo.error_twisting": "rad",
    "StepInfo.growth_position": "{length}",
    "StepInfo.growth_bending": "rad",
    "StepInfo.growth_twisting": "rad",
    "StepInfo.settling": "1",
    "StepInfo.projection_loss": "{energy}",
    "Contact.cutoff": "{length}",
    "Contact.aperture": "rad",
    "Contact.edge": "1",
    "Contact.exclusion": "{length}",
    "DampedInversePower.k1": "{length}^(k2+1)/{time}^2",
    "DampedInversePower.k2": "1",
    "DampedInversePower.k3": "{length}^(1-k4) {time}^(k4-1)",
    "DampedInversePower.k4": "1",
    "DampedInversePower.offset": "1",
    "DampedInversePower.reference_spacing": "{length}",
    "DampedInversePower.gap_floor": "1",
    "InversePower.strength": "{force} {length}^(exponent-2)",
    "InversePower.exponent": "1",
    "InversePower.floor": "1",
    "LennardJones.energy": "{energy}/{length}^2",
    "LennardJones.range": "{length}",
    "DebyeHueckel.strength": "{force}",
    "DebyeHueckel.screening": "{length}",
    "DebyeHueckel.floor": "1",
    "Barrier.stiffness": "{force}/{length}^3",
    "Barrier.reach": "1",
    "Barrier.floor": "1",
    "Penalty.stiffness": "{force}/{length}^3",
    "Penalty.softness": "1",
    "Penalty.relaxation": "{time}",
    "Plane.point": "{length}",
    "Plane.normal": "1",
    "Sphere.centre": "{length}",
    "Sphere.radius": "{length}",
    "Cylinder.point": "{length}",
    "Cylinder.axis": "1",
    "Cylinder.radius": "{length}",
    "HeightField.heights": "{length}",
    "HeightField.origin": "{length}",
    "HeightField.spacing": "{length}",
    "Obstacle.stiffness": "{force}/{length}^2",
    "Obstacle.softness": "1",
    "Obstacle.relaxation": "{time}",
    "Obstacle.displacement": "{length}",
    "Friction.coefficient": "1",
    "Friction.stick_stiffness": "{force}/{length}^2",
    "SlidingFriction.coefficient": "1",
    "SlidingFriction.slip_speed": "{length}/{time}",
    "Anchors.place": "{length}",
    "Anchors.quaternion": "1",
    "Anchors.stretch": "{length}",
    "Anchors.lost": "{energy}",
    "ObstacleContact.gap": "{length}",
    "ObstacleContact.normal_force": "{force}",
    "ObstacleContact.friction": "{force}",
    "ObstacleContact.slip_velocity": "{length}/{time}",
    "ObstacleContact.sticks": "1",
    "ObstacleContact.slides": "1",
    "Linking.time": "{time}",
    "Linking.twist": "turns",
    "Linking.twist_eq15": "turns",
    "Linking.writhe": "turns",
    "Linking.turns": "turns",
    "Reactions.force": "{force}",
    "Reactions.torque": "{force} {length}",
    "Reactions.body_torque": "{force} {length}",
    "Ledger.time": "{time}",
    "Ledger.drive_work": "{energy}",
    "Ledger.load_work": "{energy}",
    "Ledger.bending": "{energy}",
    "Ledger.torsion": "{energy}",
    "Ledger.axial": "{energy}",
    "Ledger.kinetic": "{energy}",
    "Ledger.gravity": "{energy}",
    "Ledger.contact_work": "{energy}",
    "Ledger.contact_energy": "{energy}",
    "Ledger.contact_loss": "{energy}",
    "Ledger.actuation_work": "{energy}",
    "Ledger.material_loss": "{energy}",
    "Ledger.drag_loss": "{energy}",
    "Ledger.damping_loss": "{energy}",
    "Ledger.projection_loss": "{energy}",
}


def unit_of(owner: str, field: str, units: Units, of: str | None = None) -> str | None:
    """Unit of a field of the class named owner, or None if it has none or is not known.

    `units` are those of the scene.

    `of` is the unit of the field that holds the object.
    """
    template = _TEMPLATES.get(f"{owner}.{field}")
    if template is None or ("{of}" in template and of is None):
        return None
    return template.format(of=of, energy=units.energy, **units._asdict())
