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
import peer_problems
from peer_problems import POINTS

from rodjax.constraints.ends import Clamped, Free
from rodjax.inputs.schedules import Constant
from rodjax.interactions.loads import PointLoad
from rodjax.rods.builders import curved_rod
from rodjax.rods.section import Section
from rodjax.scenes.scene import Scene


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


def as_peers(name: str, compliant: bool) -> Callable[[int], Scene]:
    """A problem that `peer_problems.py` states for every code."""
    stated = peer_problems.PROBLEMS[name]
    return lambda elements: peer_problems.rodjax_scene(stated, elements, extensible=compliant)


def bend(compliant: bool) -> Callable[[int], Scene]:
    """The 45-degree bend of Bathe & Bolourchi (1979), a tip load normal to its plane."""
    stated = peer_problems.PROBLEMS["bend"]
    stretch = 1 / stated.stretch_stiffness
    shear = 2.5 * stretch / peer_problems.SHEAR_FACTOR  # E/G = 2.5
    section = Section(
        stiffness=(stated.bend_stiffness,) * 3,
        compliance=(shear, shear, stretch) if compliant else None,
        mass=1.0,  # of no influence: at rest
    )

    def curve(s):
        angle = s / stated.radius
        return stated.radius * np.array([np.sin(angle), 1 - np.cos(angle), 0.0])

    def build(elements):
        rod = curved_rod(curve, stated.radius * stated.angle, elements, section)
        load = PointLoad(-1, force=Constant([0.0, 0.0, stated.load]))
        return Scene(rod, Clamped(), Free(), (load,))

    return build


def intertwining(contact: bool) -> Callable[[int], Scene]:
    """The example of the paper, in the preset whose times are those of the paper."""
    return lambda elements: example.scene(example.PRESETS["timeline"], elements, contact=contact)


PROBLEMS = {
    "cantilever": Problem(
        "swinging cantilever",
        as_peers("cantilever", True),
        until(1.0, 20),
        (20, 40, 80, 160),
        4,
        (320, 256),
        compliant=True,
    ),
    "cantilever_inextensible": Problem(
        "swinging cantilever, inextensible",
        as_peers("cantilever", False),
        until(1.0, 20),
        (20, 40, 80, 160),
        4,
        (640, 512),
    ),
    "buckling": Problem(
        "torsional buckling",
        as_peers("buckling", True),
        until(4.6, 23),
        (20, 40, 80, 160),
        4,
        (320, 256),
        compliant=True,
        writhe=True,
    ),
    "buckling_inextensible": Problem(
        "torsional buckling, inextensible",
        as_peers("buckling", False),
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
