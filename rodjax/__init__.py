"""Differentiable dynamics of slender rods in self-contact.

Data flows one way: a `Rod` with ends, loads and contact makes a `Scene`; `simulate` gives its
motion, of which the parts are there as well: `start` gives a consistent `State`; `step`, `rollout`,
`adaptive_rollout` advance it, and `equilibrium` rests it; the modules `energy`, `measures` and
`topology` measure it, `storage` keeps it in files, `plot` and `view` show it, in the names of
`units`; `least_squares` and `minimize` fit what was given to what was observed, over `windows`
where a motion forks; `sweep` maps a function over many scenes. `rotations` holds the quaternions
that all of them speak in; `paper_scheme` and `semidiscrete` solve the same scene in two other ways,
to check the first by. `jit` compiles a caller's own function as the library compiles its own,
`keep_compiled` keeps programs for later processes.

Double precision is the caller's choice: `jax.config.update("jax_enable_x64", True)`.
"""

import importlib
import importlib.abc
import importlib.machinery
import pathlib
import sys
import warnings
from typing import TYPE_CHECKING

from rodjax.constraints.ends import AbstractEnd as AbstractEnd
from rodjax.constraints.ends import Clamped as Clamped
from rodjax.constraints.ends import Free as Free
from rodjax.constraints.ends import Pinned as Pinned
from rodjax.constraints.ends import Slider as Slider
from rodjax.constraints.ends import Switched as Switched
from rodjax.constraints.ends import Turn as Turn
from rodjax.constraints.joints import Ball as Ball
from rodjax.constraints.joints import Hinge as Hinge
from rodjax.constraints.joints import Point as Point
from rodjax.constraints.joints import Slide as Slide
from rodjax.constraints.joints import Weld as Weld
from rodjax.constraints.supports import Support as Support
from rodjax.continuation.critical import critical as critical
from rodjax.continuation.critical_curve import critical_curve as critical_curve
from rodjax.continuation.curve_diagram import CriticalCurve as CriticalCurve
from rodjax.continuation.diagram import CriticalPoint as CriticalPoint
from rodjax.continuation.diagram import EquilibriumPath as EquilibriumPath
from rodjax.continuation.diagram import PathEnd as PathEnd
from rodjax.continuation.equilibrium_path import branch as branch
from rodjax.continuation.equilibrium_path import path as path
from rodjax.dynamics.adaptive import adaptive_rollout as adaptive_rollout
from rodjax.dynamics.bath import Bath as Bath
from rodjax.dynamics.consistency import start as start
from rodjax.dynamics.fixed_rollout import rollout as rollout
from rodjax.dynamics.relaxation import relaxation_times as relaxation_times
from rodjax.dynamics.run import Run as Run
from rodjax.dynamics.simulation import simulate as simulate
from rodjax.dynamics.step_control import StepControl as StepControl
from rodjax.dynamics.stepping import step as step
from rodjax.dynamics.thermal_rollout import ThermalRun as ThermalRun
from rodjax.dynamics.thermal_rollout import thermal_rollout as thermal_rollout
from rodjax.dynamics.thermal_state import ThermalState as ThermalState
from rodjax.dynamics.thermal_state import thermal_start as thermal_start
from rodjax.dynamics.thermal_stepping import thermal_step as thermal_step
from rodjax.equations.generalized_alpha import GeneralizedAlpha as GeneralizedAlpha
from rodjax.equilibria.linear_stability import stability as stability
from rodjax.equilibria.load_path import equilibrium as equilibrium
from rodjax.equilibria.small_vibration import vibration as vibration
from rodjax.inputs.schedules import AbstractSchedule as AbstractSchedule
from rodjax.inputs.schedules import Constant as Constant
from rodjax.inputs.schedules import Function as Function
from rodjax.inputs.schedules import PiecewiseLinear as PiecewiseLinear
from rodjax.inputs.schedules import PiecewiseLinearRate as PiecewiseLinearRate
from rodjax.inputs.schedules import Smooth as Smooth
from rodjax.interactions.contact import Contact as Contact
from rodjax.interactions.contact_law import AbstractLaw as AbstractLaw
from rodjax.interactions.contact_laws import Barrier as Barrier
from rodjax.interactions.contact_laws import DampedInversePower as DampedInversePower
from rodjax.interactions.contact_laws import DebyeHueckel as DebyeHueckel
from rodjax.interactions.contact_laws import InversePower as InversePower
from rodjax.interactions.contact_laws import LennardJones as LennardJones
from rodjax.interactions.contact_laws import Penalty as Penalty
from rodjax.interactions.friction import AbstractFriction as AbstractFriction
from rodjax.interactions.friction import Friction as Friction
from rodjax.interactions.friction import SlidingFriction as SlidingFriction
from rodjax.interactions.hard_magnetic import HardMagnetic as HardMagnetic
from rodjax.interactions.load import AbstractLoad as AbstractLoad
from rodjax.interactions.loads import DistributedLoad as DistributedLoad
from rodjax.interactions.loads import Gravity as Gravity
from rodjax.interactions.loads import LinearDrag as LinearDrag
from rodjax.interactions.loads import MorisonDrag as MorisonDrag
from rodjax.interactions.loads import PointLoad as PointLoad
from rodjax.interactions.obstacles import Obstacle as Obstacle
from rodjax.interactions.point_drag import PointDrag as PointDrag
from rodjax.interactions.roles import Role as Role
from rodjax.interactions.shapes import AbstractShape as AbstractShape
from rodjax.interactions.shapes import Cylinder as Cylinder
from rodjax.interactions.shapes import HeightField as HeightField
from rodjax.interactions.shapes import Plane as Plane
from rodjax.interactions.shapes import SignedDistance as SignedDistance
from rodjax.interactions.shapes import Sphere as Sphere
from rodjax.measuring.extrapolation import extrapolate as extrapolate
from rodjax.measuring.run_check import check as check
from rodjax.numerics.averages import Averages as Averages
from rodjax.numerics.compilation import jit as jit
from rodjax.numerics.kept_programs import keep_compiled as keep_compiled
from rodjax.numerics.results import Interrupted as Interrupted
from rodjax.numerics.results import ModelWarning as ModelWarning
from rodjax.numerics.results import Result as Result
from rodjax.numerics.results import SimulationError as SimulationError
from rodjax.rods.builders import curved_rod as curved_rod
from rodjax.rods.builders import straight_rod as straight_rod
from rodjax.rods.chain import states_of as states_of
from rodjax.rods.elastic_plastic import ElasticPlastic as ElasticPlastic
from rodjax.rods.imperfection import imperfect as imperfect
from rodjax.rods.kelvin_voigt import KelvinVoigt as KelvinVoigt
from rodjax.rods.linear_material import LinearMaterial as LinearMaterial
from rodjax.rods.lump import Lump as Lump
from rodjax.rods.material import AbstractMaterial as AbstractMaterial
from rodjax.rods.material import ElementMotion as ElementMotion
from rodjax.rods.regridding import regrid as regrid
from rodjax.rods.ring import ring as ring
from rodjax.rods.rod import Rod as Rod
from rodjax.rods.section import Section as Section
from rodjax.rods.section import circular_section as circular_section
from rodjax.rods.state import State as State
from rodjax.rods.yielding import yielding as yielding
from rodjax.scenes.body import Body as Body
from rodjax.scenes.placing import placing as placing
from rodjax.scenes.scene import Scene as Scene

if TYPE_CHECKING:
    from rodjax.dynamics import windows as windows
    from rodjax.exchange.centreline import Centreline as Centreline
    from rodjax.exchange.centreline import centreline as centreline
    from rodjax.exchange.labelled import to_xarray as to_xarray
    from rodjax.exchange.paraview import to_paraview as to_paraview
    from rodjax.exchange.pyelastica import Motion as Motion
    from rodjax.exchange.pyelastica import from_pyelastica as from_pyelastica
    from rodjax.exchange.tables import to_csv as to_csv
    from rodjax.files import storage as storage
    from rodjax.files import sweep as sweep
    from rodjax.fitting.bounds import Fixed as Fixed
    from rodjax.fitting.bounds import Interval as Interval
    from rodjax.fitting.bounds import Positive as Positive
    from rodjax.fitting.bounds import Unbounded as Unbounded
    from rodjax.fitting.descent import minimize as minimize
    from rodjax.fitting.fit import least_squares as least_squares
    from rodjax.fitting.fit import several_starts as several_starts
    from rodjax.fitting.fit_results import Fit as Fit
    from rodjax.fitting.fit_results import FitError as FitError
    from rodjax.fitting.fit_results import FitResult as FitResult
    from rodjax.fitting.observations import Observations as Observations
    from rodjax.fitting.observations import positions_at as positions_at
    from rodjax.fitting.priors import LogNormalPrior as LogNormalPrior
    from rodjax.fitting.priors import NormalPrior as NormalPrior
    from rodjax.fitting.robust import Huber as Huber
    from rodjax.fitting.robust import SoftL1 as SoftL1
    from rodjax.inputs import units as units
    from rodjax.measuring import energy as energy
    from rodjax.measuring import measures as measures
    from rodjax.numerics import rotations as rotations
    from rodjax.reference import paper_scheme as paper_scheme
    from rodjax.reference import semidiscrete as semidiscrete
    from rodjax.rods import topology as topology
    from rodjax.viewing import plot as plot
    from rodjax.viewing.animation import animate as animate
    from rodjax.viewing.picture import picture as picture
    from rodjax.viewing.view import RunView as RunView
    from rodjax.viewing.view import view as view

__version__ = "0.2.0"

# where the public modules are
_FOLDERS = {
    "energy": "measuring",
    "measures": "measuring",
    "paper_scheme": "reference",
    "plot": "viewing",
    "rotations": "numerics",
    "semidiscrete": "reference",
    "storage": "files",
    "sweep": "files",
    "topology": "rods",
    "units": "inputs",
    "windows": "dynamics",
}

# where in `fitting` its names are: with its solvers it takes a tenth of the time of the import
_FITTING = {
    "Fixed": "bounds",
    "Interval": "bounds",
    "Positive": "bounds",
    "Unbounded": "bounds",
    "minimize": "descent",
    "least_squares": "fit",
    "several_starts": "fit",
    "Fit": "fit_results",
    "FitError": "fit_results",
    "FitResult": "fit_results",
    "Observations": "observations",
    "positions_at": "observations",
    "LogNormalPrior": "priors",
    "NormalPrior": "priors",
    "Huber": "robust",
    "SoftL1": "robust",
}

# and where in other folders names are that few need
_VIEWING = {"RunView": "view", "animate": "animation", "picture": "picture", "view": "view"}
_EXCHANGE = {
    "Centreline": "centreline",
    "Motion": "pyelastica",
    "centreline": "centreline",
    "from_pyelastica": "pyelastica",
    "to_csv": "tables",
    "to_paraview": "paraview",
    "to_xarray": "labelled",
}

__all__ = [
    "AbstractEnd",
    "AbstractFriction",
    "AbstractLaw",
    "AbstractLoad",
    "AbstractMaterial",
    "AbstractSchedule",
    "AbstractShape",
    "Averages",
    "Ball",
    "Barrier",
    "Bath",
    "Body",
    "Centreline",
    "Clamped",
    "Constant",
    "Contact",
    "CriticalCurve",
    "CriticalPoint",
    "Cylinder",
    "DampedInversePower",
    "DebyeHueckel",
    "DistributedLoad",
    "ElasticPlastic",
    "ElementMotion",
    "EquilibriumPath",
    "Fit",
    "FitError",
    "FitResult",
    "Fixed",
    "Free",
    "Friction",
    "Function",
    "GeneralizedAlpha",
    "Gravity",
    "HardMagnetic",
    "HeightField",
    "Hinge",
    "Huber",
    "Interrupted",
    "Interval",
    "InversePower",
    "KelvinVoigt",
    "LennardJones",
    "LinearDrag",
    "LinearMaterial",
    "LogNormalPrior",
    "Lump",
    "ModelWarning",
    "MorisonDrag",
    "Motion",
    "NormalPrior",
    "Observations",
    "Obstacle",
    "PathEnd",
    "Penalty",
    "PiecewiseLinear",
    "PiecewiseLinearRate",
    "Pinned",
    "Plane",
    "Point",
    "PointDrag",
    "PointLoad",
    "Positive",
    "Result",
    "Rod",
    "Role",
    "Run",
    "RunView",
    "Scene",
    "Section",
    "SignedDistance",
    "SimulationError",
    "Slide",
    "Slider",
    "SlidingFriction",
    "Smooth",
    "SoftL1",
    "Sphere",
    "State",
    "StepControl",
    "Support",
    "Switched",
    "ThermalRun",
    "ThermalState",
    "Turn",
    "Unbounded",
    "Weld",
    "adaptive_rollout",
    "animate",
    "branch",
    "centreline",
    "check",
    "circular_section",
    "critical",
    "critical_curve",
    "curved_rod",
    "energy",
    "equilibrium",
    "extrapolate",
    "from_pyelastica",
    "imperfect",
    "jit",
    "keep_compiled",
    "least_squares",
    "measures",
    "minimize",
    "paper_scheme",
    "path",
    "picture",
    "placing",
    "plot",
    "positions_at",
    "regrid",
    "relaxation_times",
    "ring",
    "rollout",
    "rotations",
    "semidiscrete",
    "several_starts",
    "simulate",
    "stability",
    "start",
    "states_of",
    "step",
    "storage",
    "straight_rod",
    "sweep",
    "thermal_rollout",
    "thermal_start",
    "thermal_step",
    "to_csv",
    "to_paraview",
    "to_xarray",
    "topology",
    "units",
    "vibration",
    "view",
    "windows",
    "yielding",
]


# modules that stood beside this file until 0.1, before there were folders
_FLAT = """
adaptive admissible anchored argument_types arguments balance batching block_tridiagonal bounds
brief coarseness compilation consistency contact contact_checks contact_energy contact_forces
contact_laws corners coupled curves descent drives eigenvalues ends extrapolation failure
fingerprint fit fit_problem fit_results fixed_rollout framing generalized_alpha given_steps
imperfection inertia linear_stability load_path loads marquardt newton numerical_damping
object_reading object_writing observations overlap pace paper_equations paper_solvers passages
path_following plain_trees priors probing recorder records regridding resolution results
rigid_motions robust rod run run_check run_files scene schedules screening sealed_files section
signs small_vibration start_checks state step_control stepping strains sweep_files tubes
unstable_modes user_functions validation versions
""".split()  # noqa: SIM905


def _place(name: str) -> str | None:
    """Where a module is that is imported as `rodjax.NAME`: a public one, or one of `_FLAT`."""
    if name in _FOLDERS:
        return f"{__name__}.{_FOLDERS[name]}.{name}"
    if name not in _FLAT:
        return None
    folder = next(pathlib.Path(__path__[0]).glob(f"*/{name}.py")).parent.name
    place = f"{__name__}.{folder}.{name}"
    warnings.warn(f"rodjax.{name} is {place} now", DeprecationWarning, stacklevel=3)
    return place


class _Alias(importlib.abc.Loader):
    """Loads a module under its second name: the one that there is."""

    def __init__(self, place: str):
        self.place = place

    def create_module(self, spec):
        module = importlib.import_module(self.place)
        self.own = module.__spec__
        return module

    def exec_module(self, module):
        module.__spec__ = self.own  # for which the import has put that of the second name


class _Modules(importlib.abc.MetaPathFinder):
    """Finds modules by the names they are reached by: `import rodjax.storage`."""

    def find_spec(self, fullname, path, target=None):
        package, _, name = fullname.rpartition(".")
        place = _place(name) if package == __name__ else None
        return None if place is None else importlib.machinery.ModuleSpec(fullname, _Alias(place))


if not any(type(finder).__qualname__ == _Modules.__qualname__ for finder in sys.meta_path):
    sys.meta_path.append(_Modules())


def __getattr__(name: str):
    """What the import of the package leaves out: public modules (HDF5 takes a tenth), and fits."""
    later = {"fitting": _FITTING, "viewing": _VIEWING, "exchange": _EXCHANGE}
    for folder, modules in later.items():
        if name in modules:
            module = importlib.import_module(f"{__name__}.{folder}.{modules[name]}")
            globals()[name] = found = getattr(module, name)
            return found
    place = _place(name)
    if place is None:
        raise AttributeError(f"module 'rodjax' has no attribute {name!r}")
    return importlib.import_module(place)


def __dir__() -> list[str]:
    return list(__all__)
