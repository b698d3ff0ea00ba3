"""Problems stated once for rodjax and for the codes that it is compared with.

`rodjax_scene` and the runners of the peers (`peer_pyelastica.py`, `peer_dismech.py`) build their
scenes from `PROBLEMS`; one that cannot run says why (`CannotRun`).

What is matched: geometry, elastic and shear stiffness (PyElastica's shear factor 27/28 in rodjax
too), mass lumped to the nodes, weight, drag, drives; no damping is added. What is not:
- PyElastica and dismech-newton hold the frame of an end at the middle of the end's element. Held
  at s = 0 this would make them first order in the element length: here their rod is half an
  element longer at a held end, so that the middle of the end's element is the end of the rod.
  The half element more at a sliding end moves, and weighs, half an element's mass too much.
- PyElastica gives rotary inertia to elements, rodjax to nodes (half of either element's);
  it divides moments by the cube of the stretch, rodjax keeps B constant.
- dismech-newton computes in single precision, has no shear and no rotary inertia across the axis.
"""

import dataclasses
from typing import NamedTuple

import numpy as np

SHEAR_FACTOR = 27 / 28  # fixed in PyElastica
POINTS = 11  # recorded, equally spaced from end to end


class Outcome(NamedTuple):
    """What a code found, and what the warm integration loop cost."""

    times: np.ndarray  # (k,) [s]
    positions: np.ndarray  # (k, POINTS, 3) at equal arc lengths [m]
    cpu_seconds: float
    wall_seconds: float
    steps: int


class CannotRun(NamedTuple):
    """Why a code cannot run a problem."""

    reason: str


@dataclasses.dataclass(frozen=True)
class Drag:
    """Morison drag, as `rodjax.MorisonDrag`."""

    fluid_density: float
    normal: float
    tangential: float


@dataclasses.dataclass(frozen=True)
class Problem:
    """A rod of circular section, held at s = 0, from rest; SI units.

    Args:
        direction: of the straight rod from s = 0.
        neck: (begin, end, ratio): where the diameter is less, and to what part.
        seed_curvature: natural curvature about a_1 [1/m].
        gravity: acceleration; None for none.
        turns: knots (time, turns) of the rotation of the end s = 0 by minus the turns about its
            tangent, linear between them; None: it is clamped.
        slides: whether the other end slides along the rod's axis without turning; if not it is
            free.
        times: to be recorded, the last ending the run.
    """

    direction: tuple[float, float, float]
    times: tuple[float, ...]
    length: float = 1.0
    diameter: float = 0.01
    youngs_modulus: float = 1.25e7
    shear_modulus: float = 5e6
    density: float = 1500.0
    neck: tuple[float, float, float] | None = None
    seed_curvature: float = 0.0
    gravity: tuple[float, float, float] | None = None
    turns: tuple[tuple[float, float], ...] | None = None
    slides: bool = False
    drag: Drag | None = None

    @property
    def jumps(self) -> tuple[float, ...]:
        """Arc lengths where the diameter jumps."""
        return () if self.neck is None else self.neck[:2]

    def diameter_at(self, s: np.ndarray) -> np.ndarray:
        """Diameter at arc lengths."""
        if self.neck is None:
            return np.full(np.shape(s), self.diameter)
        begin, end, ratio = self.neck
        return np.where((s > begin) & (s < end), ratio, 1.0) * self.diameter


def _until(end: float, count: int) -> tuple[float, ...]:
    return tuple(float(t) for t in np.linspace(0.0, end, count + 1)[1:])


@dataclasses.dataclass(frozen=True)
class Bend:
    """The static 45-degree bend of Bathe & Bolourchi (1979): dead load normal to its plane [N].

    A stress-free eighth of a circle, clamped at s = 0 along x, its centre on the y axis.
    """

    load: float = 600.0
    radius: float = 100.0
    angle: float = np.pi / 4
    bend_stiffness: float = 1e7 / 12  # A1 = A2 = C of the unit square section, E = 1e7
    stretch_stiffness: float = 1e7


PROBLEMS: dict[str, Problem | Bend] = {
    "cantilever": Problem((1.0, 0.0, 0.0), _until(1.0, 20), gravity=(0.0, 0.0, -9.81)),
    "bend": Bend(),
    # it buckles at 4 s and has drawn itself into a loop at 4.8 s; without contact its strands pass
    # through each other just after
    "buckling": Problem(
        (0.0, 0.0, 1.0),
        _until(8.0, 40),
        seed_curvature=0.1,
        turns=((0.0, 0.0), (6.0, 3.0), (1000.0, 3.0)),
        slides=True,
        drag=Drag(1000.0, 0.1, 0.01),
    ),
}


def rodjax_scene(problem: Problem, elements: int, contact=None, extensible: bool = True):
    """The problem as a rodjax scene; `extensible=False` leaves Kirchhoff's constraints."""
    import rodjax as rx

    section = rx.circular_section(
        problem.diameter_at,
        problem.youngs_modulus,
        problem.shear_modulus,
        problem.density,
        extensible=extensible,
        shear_factor=SHEAR_FACTOR,
    )
    rod = rx.straight_rod(
        problem.length,
        elements,
        section,
        direction=problem.direction,
        natural_curvature=(problem.seed_curvature, 0.0, 0.0),
        jumps=problem.jumps,
    )
    drive = None
    if problem.turns is not None:
        knots, turns = np.array(problem.turns).T
        drive = rx.Turn(problem.direction, rx.PiecewiseLinear(knots, -2 * np.pi * turns))
    loads = () if problem.gravity is None else (rx.Gravity(problem.gravity),)
    if problem.drag is not None:
        drag = problem.drag
        loads += (rx.MorisonDrag(drag.fluid_density, drag.normal, drag.tangential),)
    last = rx.Slider(problem.direction) if problem.slides else rx.Free()
    return rx.Scene(rod, rx.Clamped(rotation=drive), last, loads, contact)


def held_grid(problem: Problem, elements: int) -> np.ndarray:
    """Arc lengths of nodes of which held ends lie in the middle of the first or last element.

    Jumps of the properties are nodes; elements are equal between them.
    """
    marks = np.array([0.0, *problem.jumps, problem.length])
    spans = np.diff(marks)
    outside = np.zeros(len(spans))  # of elements, beyond the ends of the rod
    outside[0] += 0.5
    if problem.slides:
        outside[-1] += 0.5
    count = np.maximum(1, np.round(spans * (elements - outside.sum()) + outside)).astype(int)
    count[len(count) // 2] += elements - count.sum()
    size = spans / (count - outside)
    first = -0.5 * size[0]
    lengths = np.repeat(size, count)
    return first + np.concatenate([[0.0], np.cumsum(lengths)])


def sampled(arc_length: np.ndarray, position: np.ndarray, length: float) -> np.ndarray:
    """Positions (n+1, 3) of nodes at `POINTS` equal arc lengths, by a cubic spline (4th order)."""
    from scipy.interpolate import CubicSpline

    return CubicSpline(arc_length, position)(np.linspace(0.0, length, POINTS))
