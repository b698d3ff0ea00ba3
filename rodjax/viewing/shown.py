"""What is to be shown, whatever it was given as, and how it is looked at first."""

import dataclasses
import os
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from rodjax.dynamics.run import Run, of_states
from rodjax.files import storage
from rodjax.inputs.units import Units, used
from rodjax.inputs.validation import as_integer, check_integer
from rodjax.inputs.validation import shown as briefly
from rodjax.numerics.results import Result
from rodjax.rods.rod import Rod
from rodjax.rods.state import State
from rodjax.scenes.arguments import check_scene
from rodjax.scenes.placing import placing
from rodjax.scenes.scene import Scene
from rodjax.viewing import colouring
from rodjax.viewing.colouring import Measure
from rodjax.viewing.tubes import View

# From where the first view looks, if not from straight before it [rad].
YAW, PITCH = 0.35, 0.3


class Shown(NamedTuple):
    """What is to be shown, whatever it was given as."""

    scene: Scene
    states: State  # stacked
    code: Result
    units: Units
    given: Any = None  # the run as it was given, if that was one

    @property
    def run(self) -> Run:
        """The states as a run, with its steps if there are any."""
        return of_states(self.states, self.code) if self.given is None else self.given

    @property
    def known(self) -> np.ndarray:
        """Which of the states are numbers."""
        return np.flatnonzero(np.all(np.isfinite(np.asarray(self.states.position)), (1, 2)))


def shown_of(scene: Any, run: Any, units: Units | None) -> Shown:
    """Scene, states and code of whatever was given."""
    if isinstance(scene, str | os.PathLike):
        scene = storage.load(scene)
    if hasattr(scene, "run") and hasattr(scene, "scene"):
        if run is not None:
            raise ValueError("run: the file holds one; give the file alone, or its scene and a run")
        scene, run, units = scene.scene, scene.run, units or scene.units
    if hasattr(scene, "states") or hasattr(scene, "position"):
        raise ValueError("scene: a run does not keep its scene; give both, view(scene, run)")
    check_scene(scene)
    code, states = Result.SUCCESS, run
    if run is None:
        states = placing(scene)
    elif hasattr(run, "states"):
        code, states = Result(int(np.max(np.asarray(run.result)))), run.states
    elif not hasattr(run, "position"):
        states = _stacked(run)
    if not hasattr(states, "position"):
        raise ValueError(f"run: give a Run, a State or a sequence of them, got {briefly(run)}")
    if np.ndim(states.position) == 2:
        states = jax.tree.map(lambda leaf: np.asarray(leaf)[None], states)
    shape, nodes = np.shape(states.position), scene.rod.elements + 1
    if len(shape) != 3 or shape[1:] != (nodes, 3):
        raise ValueError(
            f"run: has positions of shape {shape}, the scene's rod {nodes} nodes; give the scene"
            " that the run is of, and one run"
        )
    given = run if hasattr(run, "infos") else None
    return Shown(scene, states, code, units or used(), given)


def _stacked(states: Any) -> Any:
    """A sequence of states as one."""
    if not isinstance(states, Sequence) or not states:
        return None
    if not all(hasattr(state, "position") for state in states):
        return None
    # what only some of them have is not shown
    bare = [dataclasses.replace(state, settling=None, jerk=None) for state in states]
    try:
        return jax.tree.map(lambda *leaves: np.stack([np.asarray(x) for x in leaves]), *bare)
    except ValueError as error:
        raise ValueError(f"run: its states are not of one scene: {error}") from error


def spread(times: Float[np.ndarray, " k"], count: int) -> np.ndarray:
    """Indices of at most so many, the first and last among them, nearest to equal spacing."""
    if len(times) <= count:
        return np.arange(len(times))
    even = np.linspace(times[0], times[-1], count)
    return np.unique(np.argmin(np.abs(times[:, None] - even[None]), 0))


def own_measures(
    given: Mapping[str, Any], units: Mapping[str, str], states: State, rod: Rod
) -> list[Measure]:
    """The user's measures, of all states."""
    found, count, n = [], np.shape(states.time)[0], rod.elements
    for name in units:
        if name not in given:
            raise ValueError(f"measure_units: {name!r} is not among the measures")
    for name, value in given.items():
        values = np.array(value, float)
        if values.shape not in ((count, n), (count, n + 1)):
            raise ValueError(
                f"measures: {name!r} must have shape {(count, n)}, a value an element, or"
                f" {(count, n + 1)}, a value a node, for each state; got {values.shape}"
            )
        both = np.nanmin(values, initial=0.0) < 0 < np.nanmax(values, initial=0.0)
        found.append(Measure(name, units.get(name, ""), "signed" if both else "linear", values))
    return found


class Picked(NamedTuple):
    """The states that are shown, and what they are coloured by.

    Attributes:
        scene, units: of the run.
        states: that are numbers, stacked, at most as many as are asked for.
        all_times: of all states of the run [s].
        measures: of these.
        colour: which of them is shown at first, -1: none.
        known, count: how many states of the run are numbers, and how many there are.
        code: of the run.
    """

    scene: Scene
    units: Units
    states: State
    all_times: np.ndarray
    measures: list[Measure]
    colour: int
    known: int
    count: int
    code: Result

    @property
    def alarms(self) -> list[str]:
        """What the run did not do, and what of it there is not."""
        told = []
        if self.code is not Result.SUCCESS:
            told.append(f"The run ended by {self.code}")
        if not self.count:
            told.append("The run holds no state")
        elif self.known < self.count:
            lost = self.count - self.known
            told.append(f"{lost} of {self.count} states are no numbers, and not shown")
        return told


def picked(
    scene: Any,
    run: Any,
    colour: str | None,
    own: Mapping[str, Any] | None,
    own_units: Mapping[str, str] | None,
    frames: int,
    units: Units | None,
) -> Picked:
    """What `view` and `animate` show of what they are given."""
    shown = shown_of(scene, run, units)
    scene, states, names = shown.scene, shown.states, colouring.names_of(shown.scene)
    frames = as_integer(frames)
    check_integer(1, frames=frames)
    given = own_measures(own or {}, own_units or {}, states, scene.rod)
    names = [*names, *(measure.name for measure in given)]
    if colour is not None and colour not in names:
        raise ValueError(
            f"colour: there is no measure {colour!r} of this scene; give one of"
            f" {', '.join(map(repr, names))}, or None"
        )
    known = shown.known
    rows = known[spread(np.asarray(states.time)[known], frames)]
    few = jax.tree.map(lambda leaf: np.asarray(leaf)[rows], states)
    found = []
    if len(rows):
        found = colouring.measures_of(scene, few, shown.units)
        found += [measure._replace(values=measure.values[rows]) for measure in given]
    index = names.index(colour) if found and colour is not None else -1
    times = np.asarray(states.time)
    counts = len(known), len(times)
    return Picked(scene, shown.units, few, times, found, index, *counts, shown.code)


class Proportions(NamedTuple):
    """Where the rods are and how thick.

    Attributes:
        origin: middle of the box that they are in at any time [m].
        half: of its sides, none of them so short that what is beside the rods is not seen.
        size: its diagonal.
        diameter: of the elements.
        thickest: of these.
        assumed: whether the rods have no diameter of their own.
    """

    origin: np.ndarray
    half: np.ndarray
    size: float
    diameter: np.ndarray
    thickest: float
    assumed: bool


def proportions(rod: Rod, points: Float[np.ndarray, "p 3"]) -> Proportions:
    """Of rods whose nodes are at these points at any time."""
    low, high = np.min(points, 0), np.max(points, 0)
    assumed = rod.diameter is None
    if rod.diameter is None:
        length = float(np.sum(np.asarray(rod.length))) / len(rod.strands)
        diameter = np.full(rod.elements, length / 200)
    else:
        diameter = np.asarray(rod.diameter, float)
    thickest = float(np.max(rod.solid(diameter)))
    size = max(float(np.linalg.norm(high - low)), 4 * thickest)
    half = np.maximum(0.5 * (high - low) + 0.5 * thickest, 0.2 * size)
    return Proportions(0.5 * (low + high), half, size, diameter, thickest, assumed)


def axes_of(points: Float[np.ndarray, "p 3"], first_view: View | None) -> tuple[np.ndarray, bool]:
    """Directions that point right, up and out of the page at first; whether to look from aside."""
    if first_view is not None:
        return first_view.axes(), False
    centred = points - np.mean(points, 0)
    flat = centred[:, :2]
    right = np.append(np.linalg.eigh(flat.T @ flat)[1][:, -1], 0.0)
    if np.sum(flat**2) < 1e-12 * np.sum(centred**2):  # upright
        right = np.array([1.0, 0.0, 0.0])
    if right[np.argmax(np.abs(right))] < 0:
        right = -right
    up = np.array([0.0, 0.0, 1.0])
    return np.stack([right, up, np.cross(right, up)]), True


def magnified(box: Proportions, pictures: int = 1) -> float:
    """How much thicker tubes are drawn to be seen in one of so many pictures side by side."""
    if box.thickest >= pictures * box.size / 180:
        return 1.0
    needed = pictures * box.size / 110 / box.thickest
    power = 10.0 ** np.floor(np.log10(needed))
    return float(power * min((1, 2, 5, 10), key=lambda lead: abs(np.log(lead * power / needed))))


def heading_of(scene: Scene) -> str:
    parts, beside = scene.rod.strands, len(scene.rod.bodies)
    bodies = f" and {beside} bod{'ies' if beside > 1 else 'y'}" if beside else ""
    counts = [part.last - part.first for part in parts]
    if len(parts) == 1:
        return f"a rod of {counts[0]} elements{bodies}"
    return f"{len(parts)} rods of {', '.join(map(str, counts))} elements{bodies}"
