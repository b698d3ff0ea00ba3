"""The problems of `error_vs_runtime.py`: scenes, what is recorded of a run, and its error.

All are recorded at the same material points and times, whatever the grid and the steps: `POINTS`
nodes that every grid has, at the times of the problem. Codes with shear and extension (PyElastica,
the differential equation of `rodjax.semidiscrete`) solve the compliant problems, with PyElastica's
shear factor for circles; the same without compliance are for rodjax alone, since the static
stretch of the cantilever is 6e-4 by itself.
"""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import _settings  # noqa: F401 (first)
import example
import numpy as np

from rodjax.ends import Clamped, Free, Slider, Turn
from rodjax.loads import Gravity, MorisonDrag, PointLoad
from rodjax.rod import Section, circular_section, curved_rod, straight_rod
from rodjax.scene import Scene
from rodjax.schedules import Constant, PiecewiseLinear

POINTS = 11
SHEAR_FACTOR = 27 / 28  # alpha_c of PyElastica for circular sections


@dataclasses.dataclass(frozen=True)
class Problem:
    """A scene, what is recorded of it, and where its convergence is looked at.

    Args:
        title: for the figures.
        build: the scene on a grid of so many elements.
        times: recorded, equally spaced, the last ending the run; a single 0 for statics.
        grids: numbers of elements of the convergence line, each twice the one before.
        steps: fixed steps between two recorded times on the first grid; None: not run so.
        reference: elements and steps between two recorded times of the finest of the three runs
            from which the reference is made (see `runtime_references`).
        compliant: with shear and extension: for every code.
        writhe: whether Wr and energies are compared too.
    """

    title: str
    build: Callable[[int], Scene]
    times: tuple[float, ...]
    grids: tuple[int, ...]
    steps: int | None
    reference: tuple[int, int]
    compliant: bool = False
    writhe: bool = False

    @property
    def static(self) -> bool:
        """Whether an equilibrium is asked for."""
        return len(self.times) == 1

    @property
    def ladder(self) -> tuple[tuple[int, int], ...]:
        """(elements, steps in all) of the convergence line, halved together."""
        if self.steps is None:
            return ()
        each = self.steps * len(self.times)
        return tuple((n, each * n // self.grids[0]) for n in self.grids)


def until(end: float, count: int) -> tuple[float, ...]:
    """`count` equally spaced times from after 0 to `end` [s]."""
    return tuple(float(t) for t in np.linspace(0.0, end, count + 1)[1:])


def _circular(compliant: bool):
    return circular_section(
        0.01, 1.25e7, 5e6, 1500.0, extensible=compliant, shear_factor=SHEAR_FACTOR
    )


def cantilever(compliant: bool) -> Callable[[int], Scene]:
    """Released straight under gravity."""

    def build(elements):
        rod = straight_rod(1.0, elements, _circular(compliant), direction=(1.0, 0.0, 0.0))
        return Scene(rod, Clamped(), Free(), (Gravity((0.0, 0.0, -9.81)),))

    return build


def buckling(compliant: bool) -> Callable[[int], Scene]:
    """Twisted by 3 turns in 6 s in water, one end free to slide; naturally curved by 0.1 /m.

    It buckles at 4 s and is drawn into a loop at 4.6 s, with Wr at 0.7; without contact its strands
    pass through each other soon after, on coarse grids before 4.8 s.
    """
    axis = (0.0, 0.0, 1.0)
    turn = Turn(axis, PiecewiseLinear([0.0, 6.0, 1000.0], -2 * np.pi * np.array([0.0, 3.0, 3.0])))

    def build(elements):
        rod = straight_rod(1.0, elements, _circular(compliant), natural_curvature=(0.1, 0.0, 0.0))
        drag = MorisonDrag(1000.0, normal_coefficient=0.1, tangential_coefficient=0.01)
        return Scene(rod, Clamped(rotation=turn), Slider(axis), (drag,))

    return build


def bend(compliant: bool) -> Callable[[int], Scene]:
    """The 45-degree bend of Bathe & Bolourchi (1979), tip load 600 normal to its plane."""
    radius = 100.0
    stiffness, area = 1e7 / 12, 1.0
    shear = 1 / (SHEAR_FACTOR * 5e6 * area)
    section = Section(
        stiffness=(stiffness, stiffness, stiffness),
        compliance=(shear, shear, 1 / (1e7 * area)) if compliant else None,
        mass=1.0,  # of no influence: at rest
    )

    def curve(s):
        angle = s / radius
        return np.array([radius * np.sin(angle), radius * (1 - np.cos(angle)), 0.0])

    def build(elements):
        rod = curved_rod(curve, radius * np.pi / 4, elements, section)
        return Scene(rod, Clamped(), Free(), (PointLoad(-1, force=Constant([0.0, 0.0, 600.0])),))

    return build


def intertwining(contact: bool) -> Callable[[int], Scene]:
    """The example of the paper, in the preset whose times are those of the paper."""
    return lambda elements: example.scene(example.PRESETS["timeline"], elements, contact=contact)


PROBLEMS = {
    "cantilever": Problem(
        "swinging cantilever",
        cantilever(True),
        until(1.0, 20),
        (20, 40, 80, 160),
        4,
        (320, 256),
        compliant=True,
    ),
    "cantilever_inextensible": Problem(
        "swinging cantilever, inextensible",
        cantilever(False),
        until(1.0, 20),
        (20, 40, 80, 160),
        4,
        (320, 256),
    ),
    "buckling": Problem(
        "torsional buckling",
        buckling(True),
        until(4.6, 23),
        (20, 40, 80, 160),
        4,
        (320, 256),
        compliant=True,
        writhe=True,
    ),
    "buckling_inextensible": Problem(
        "torsional buckling, inextensible",
        buckling(False),
        until(4.6, 23),
        (20, 40, 80, 160),
        4,
        (320, 256),
        writhe=True,
    ),
    "example_before_contact": Problem(
        "the example before contact",
        intertwining(False),
        until(25.0, 50),
        (40, 80, 160),
        5,
        (320, 40),
        writhe=True,
    ),
    "example": Problem(
        "the example through intertwining",
        intertwining(True),
        until(32.0, 64),
        (40, 80),
        None,
        (160, 40),
        writhe=True,
    ),
    "bend": Problem(
        "45-degree bend", bend(True), (0.0,), (20, 40, 80, 160), None, (1280, 1), compliant=True
    ),
    "bend_inextensible": Problem(
        "45-degree bend, inextensible", bend(False), (0.0,), (20, 40, 80, 160), None, (1280, 1)
    ),
}


class Record(NamedTuple):
    """What is compared: positions (times, POINTS, 3), and scalars over the times by name."""

    positions: np.ndarray
    scalars: dict[str, np.ndarray]


def at_points(positions: np.ndarray) -> np.ndarray:
    """The recorded nodes among all (..., n + 1, 3)."""
    elements = positions.shape[-2] - 1
    if elements % (POINTS - 1):
        raise ValueError(f"elements: must be a multiple of {POINTS - 1}, got {elements}")
    return np.asarray(positions[..., :: elements // (POINTS - 1), :])


def errors(found: Record, reference: Record, start: np.ndarray) -> dict[str, float]:
    """Relative errors: rms over points and times, over the rms displacement from the start.

    Of a scalar: rms over the times, over that of the reference.
    """
    rms = lambda x: float(np.sqrt(np.mean(np.square(x))))
    moved = rms(reference.positions - start)
    result = {"positions": rms(found.positions - reference.positions) / moved}
    for name in found.scalars.keys() & reference.scalars.keys():
        exact = reference.scalars[name]
        result[name] = rms(found.scalars[name] - exact) / rms(exact)
    return result
