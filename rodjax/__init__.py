"""Differentiable dynamics of slender rods in self-contact.

Data flows one way: a `Rod` with ends, loads and contact makes a `Scene`; `start` gives a consistent
`State`; `step`, `rollout`, `adaptive_rollout` advance it and `equilibrium` rests it; the modules
`energy`, `measures` and `topology` measure it, `storage` keeps it in files, `plot` shows it, in the
names of `units`; `least_squares` and `minimize` fit what was given to what was observed, over
`windows` where a motion forks; `sweep` maps a function over many scenes. `rotations` holds the
quaternions that all of them speak in; `paper_scheme` and `semidiscrete` solve the same scene in two
other ways, to check the first by. `jit` compiles a caller's own function as the library compiles
its own.

Double precision is the caller's choice: `jax.config.update("jax_enable_x64", True)`.
"""

import importlib
from typing import TYPE_CHECKING

from rodjax.adaptive import adaptive_rollout as adaptive_rollout
from rodjax.bounds import Fixed as Fixed
from rodjax.bounds import Interval as Interval
from rodjax.bounds import Positive as Positive
from rodjax.bounds import Unbounded as Unbounded
from rodjax.compilation import jit as jit
from rodjax.consistency import start as start
from rodjax.contact import Contact as Contact
from rodjax.contact_laws import AbstractLaw as AbstractLaw
from rodjax.contact_laws import Barrier as Barrier
from rodjax.contact_laws import DampedInversePower as DampedInversePower
from rodjax.contact_laws import DebyeHueckel as DebyeHueckel
from rodjax.contact_laws import InversePower as InversePower
from rodjax.contact_laws import LennardJones as LennardJones
from rodjax.contact_laws import Penalty as Penalty
from rodjax.descent import minimize as minimize
from rodjax.ends import AbstractEnd as AbstractEnd
from rodjax.ends import Clamped as Clamped
from rodjax.ends import Free as Free
from rodjax.ends import Pinned as Pinned
from rodjax.ends import Slider as Slider
from rodjax.ends import Switched as Switched
from rodjax.ends import Turn as Turn
from rodjax.extrapolation import extrapolate as extrapolate
from rodjax.fit import least_squares as least_squares
from rodjax.fit import several_starts as several_starts
from rodjax.fit_results import Fit as Fit
from rodjax.fit_results import FitError as FitError
from rodjax.fit_results import FitResult as FitResult
from rodjax.fixed_rollout import rollout as rollout
from rodjax.generalized_alpha import GeneralizedAlpha as GeneralizedAlpha
from rodjax.imperfection import imperfect as imperfect
from rodjax.linear_stability import stability as stability
from rodjax.load_path import equilibrium as equilibrium
from rodjax.loads import AbstractLoad as AbstractLoad
from rodjax.loads import DistributedLoad as DistributedLoad
from rodjax.loads import Gravity as Gravity
from rodjax.loads import LinearDrag as LinearDrag
from rodjax.loads import MorisonDrag as MorisonDrag
from rodjax.loads import PointLoad as PointLoad
from rodjax.observations import Observations as Observations
from rodjax.observations import positions_at as positions_at
from rodjax.placing import placing as placing
from rodjax.priors import LogNormalPrior as LogNormalPrior
from rodjax.priors import NormalPrior as NormalPrior
from rodjax.regridding import regrid as regrid
from rodjax.results import Interrupted as Interrupted
from rodjax.results import ModelWarning as ModelWarning
from rodjax.results import Result as Result
from rodjax.results import SimulationError as SimulationError
from rodjax.robust import Huber as Huber
from rodjax.robust import SoftL1 as SoftL1
from rodjax.rod import Rod as Rod
from rodjax.rod import Section as Section
from rodjax.rod import circular_section as circular_section
from rodjax.rod import curved_rod as curved_rod
from rodjax.rod import straight_rod as straight_rod
from rodjax.run import Run as Run
from rodjax.run_check import check as check
from rodjax.scene import Scene as Scene
from rodjax.schedules import AbstractSchedule as AbstractSchedule
from rodjax.schedules import Constant as Constant
from rodjax.schedules import Function as Function
from rodjax.schedules import PiecewiseLinear as PiecewiseLinear
from rodjax.schedules import PiecewiseLinearRate as PiecewiseLinearRate
from rodjax.schedules import Smooth as Smooth
from rodjax.small_vibration import vibration as vibration
from rodjax.state import State as State
from rodjax.step_control import StepControl as StepControl
from rodjax.stepping import step as step

if TYPE_CHECKING:
    from rodjax import energy as energy
    from rodjax import measures as measures
    from rodjax import paper_scheme as paper_scheme
    from rodjax import plot as plot
    from rodjax import rotations as rotations
    from rodjax import semidiscrete as semidiscrete
    from rodjax import storage as storage
    from rodjax import sweep as sweep
    from rodjax import topology as topology
    from rodjax import units as units
    from rodjax import windows as windows

__version__ = "0.1.0"

__all__ = [
    "AbstractEnd",
    "AbstractLaw",
    "AbstractLoad",
    "AbstractSchedule",
    "Barrier",
    "Clamped",
    "Constant",
    "Contact",
    "DampedInversePower",
    "DebyeHueckel",
    "DistributedLoad",
    "Fit",
    "FitError",
    "FitResult",
    "Fixed",
    "Free",
    "Function",
    "GeneralizedAlpha",
    "Gravity",
    "Huber",
    "Interrupted",
    "Interval",
    "InversePower",
    "LennardJones",
    "LinearDrag",
    "LogNormalPrior",
    "ModelWarning",
    "MorisonDrag",
    "NormalPrior",
    "Observations",
    "Penalty",
    "PiecewiseLinear",
    "PiecewiseLinearRate",
    "Pinned",
    "PointLoad",
    "Positive",
    "Result",
    "Rod",
    "Run",
    "Scene",
    "Section",
    "SimulationError",
    "Slider",
    "Smooth",
    "SoftL1",
    "State",
    "StepControl",
    "Switched",
    "Turn",
    "Unbounded",
    "adaptive_rollout",
    "check",
    "circular_section",
    "curved_rod",
    "energy",
    "equilibrium",
    "extrapolate",
    "imperfect",
    "jit",
    "least_squares",
    "measures",
    "minimize",
    "paper_scheme",
    "placing",
    "plot",
    "positions_at",
    "regrid",
    "rollout",
    "rotations",
    "semidiscrete",
    "several_starts",
    "stability",
    "start",
    "step",
    "storage",
    "straight_rod",
    "sweep",
    "topology",
    "units",
    "vibration",
    "windows",
]


def __getattr__(name: str):
    """Public modules that the import of the package leaves out (HDF5 alone takes a tenth of it)."""
    if name in __all__:
        return importlib.import_module(f"rodjax.{name}")
    raise AttributeError(f"module 'rodjax' has no attribute {name!r}")


def __dir__() -> list[str]:
    return list(__all__)
