"""Runs in three dimensions: tubes that move, turn and are coloured, in a notebook or in one file.

Everything that a page needs is in it: it opens without a network, and sends nothing.
"""

import dataclasses
import html
import json
import os
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from rodjax.files import storage
from rodjax.files.tubes import View
from rodjax.files.units import SI, Units
from rodjax.inputs.validation import as_integer, check_integer, check_positive, check_scalar, given
from rodjax.inputs.validation import shown as briefly
from rodjax.numerics.results import Result
from rodjax.rods.rod import Rod
from rodjax.rods.state import State
from rodjax.scenes.arguments import check_scene
from rodjax.scenes.placing import placing
from rodjax.scenes.scene import Scene
from rodjax.viewing import bodies, colouring, packing
from rodjax.viewing.colouring import Measure


class RunView:
    """A page that shows a run; a notebook shows it by itself.

    Attributes:
        page: the whole page, as HTML.
        title: its heading.
        frames: how many states it holds.
    """

    def __init__(self, page: str, title: str, frames: int):
        self.page, self.title, self.frames = page, title, frames

    def save(self, path: str | os.PathLike) -> Path:
        """Write the page to a file, which any browser opens, offline too; returns its path."""
        path = Path(path)
        if path.suffix.lower() not in (".html", ".htm"):
            raise ValueError(f"path: name a file that ends in .html, got {str(path)!r}")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(self.page, encoding="utf-8")
        return path

    def _repr_html_(self) -> str:
        return (
            f'<iframe srcdoc="{html.escape(self.page)}" title="{html.escape(self.title)}"'
            ' style="width: 100%; height: 560px; border: 1px solid #d5dbe1;"></iframe>'
        )

    def __repr__(self) -> str:
        size = len(self.page) / 1e6
        return f"RunView({self.frames} states, {size:.2g} MB; save('run.html') makes a file of it)"


class _Shown(NamedTuple):
    """What is to be shown, whatever it was given as."""

    scene: Scene
    states: State  # stacked
    code: Result
    units: Units


def view(
    scene: Any,
    run: Any = None,
    *,
    colour: str | None = "strain energy density",
    measures: Mapping[str, Any] | None = None,
    measure_units: Mapping[str, str] | None = None,
    magnify: float | None = None,
    frames: int = 300,
    seconds: float = 8.0,
    first_view: View | None = None,
    units: Units | None = None,
    title: str | None = None,
) -> RunView:
    """Look at a run in three dimensions: turn it, let it play, colour it by any measure.

        rx.view(scene, run)  # in a notebook
        rx.view(scene, run).save("run.html")  # one file, which works offline
        rx.view("run.h5")  # a file of `storage.save` or of a recorder

    Tubes are of the rods' own diameters, or so many times as thick as the page says; the black
    stripe follows the director a_1 and shows twist. Held nodes are plates (on a rail where they may
    slide), pinned ones balls, and so are lumps, of their volume if they have one. While it plays,
    nodes go straight from one saved state to the next.

    Args:
        scene: of the run, which does not keep it; or a path, or what `storage.load` gave, alone.
        run: a `Run`, one `State`, or a sequence of states such as those of a load path; default:
            the rod as it is placed.
        colour: the measure shown at first: "strain energy density", "curvature", "twist",
            "tension", "contact force" (of all that touches, per length), "speed", one of
            `measures`, or None. The page has all of them to choose from.
        measures: your own, by name: for every state a value an element, or a node.
        measure_units: names of their units.
        magnify: how much thicker than they are the tubes are drawn at first. Default: as much as
            makes them visible.
        frames: most states in the page, of a run of more those nearest to equal spacing in time.
        seconds: that the whole takes to play.
        first_view: what points right and up at first; default: e3 upwards, along the widest
            direction across it.
        units: names of the units; default those of the file, else SI.
        title: heading; default: what the scene is.

    Raises:
        ValueError: scene, run and measures do not fit each other, or there is no such measure.
    """
    shown = _shown(scene, run, units)
    scene, states, names = shown.scene, shown.states, colouring.names_of(shown.scene)
    frames = as_integer(frames)
    check_integer(1, frames=frames)
    check_scalar(seconds=seconds, **given(magnify=magnify))
    check_positive(seconds=seconds, **given(magnify=magnify))
    own = _own_measures(measures or {}, measure_units or {}, states, scene.rod)
    names = [*names, *(measure.name for measure in own)]
    if colour is not None and colour not in names:
        raise ValueError(
            f"colour: there is no measure {colour!r} of this scene; give one of"
            f" {', '.join(map(repr, names))}, or None"
        )
    known = np.flatnonzero(np.all(np.isfinite(np.asarray(states.position)), (1, 2)))
    rows = known[_spread(np.asarray(states.time)[known], frames)]
    picked = jax.tree.map(lambda leaf: np.asarray(leaf)[rows], states)
    found = []
    if len(rows):
        found = colouring.measures_of(scene, picked, shown.units)
        found += [measure._replace(values=measure.values[rows]) for measure in own]
    data = _data(scene, picked, found, shown.units, first_view)
    size, thick = data["size"], data.pop("thickest")
    data |= {
        "magnify": _magnified(size, thick) if magnify is None else float(magnify),
        "colour": names.index(colour) if found and colour is not None else -1,
        "seconds": float(seconds),
        "title": _heading(scene) if title is None else title,
    }
    if len(rows) < len(known):
        data["notes"].append(_note(f"{len(rows)} of {len(known)} states"))
    data["notes"] += _alarms(shown, len(known))
    return RunView(_page(data), data["title"], len(rows))


def _shown(scene: Any, run: Any, units: Units | None) -> _Shown:
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
    return _Shown(scene, states, code, units or SI)


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


def _spread(times: Float[np.ndarray, " k"], count: int) -> np.ndarray:
    """Indices of at most so many, the first and last among them, nearest to equal spacing."""
    if len(times) <= count:
        return np.arange(len(times))
    even = np.linspace(times[0], times[-1], count)
    return np.unique(np.argmin(np.abs(times[:, None] - even[None]), 0))


def _own_measures(
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


def _data(
    scene: Scene, states: State, found: list[Measure], units: Units, first_view: View | None
) -> dict[str, Any]:
    """What the page is given."""
    rod, times = scene.rod, np.asarray(states.time, float)
    position = np.asarray(states.position, float)
    points = position.reshape(-1, 3) if len(times) else np.asarray(rod.position, float)
    low, high = np.min(points, 0), np.max(points, 0)
    origin, size = 0.5 * (low + high), float(np.linalg.norm(high - low))
    notes = []
    if rod.diameter is None:
        length = float(np.sum(np.asarray(rod.length))) / len(rod.parts)
        diameter = np.full(rod.elements, length / 200)
        notes.append(_note("no diameter was given: drawn as a two hundredth of the length"))
    else:
        diameter = np.asarray(rod.diameter, float)
    thickest = float(np.max(rod.solid(diameter)))
    size = max(size, 4 * thickest)
    # a box of some depth: what lies beside a rod in a plane is seen too
    half = np.maximum(0.5 * (high - low) + 0.5 * thickest, 0.2 * size)
    drawn, unseen = bodies.obstacles(scene, times, origin - half, origin + half, origin)
    axes, tilted = _axes(points, first_view)
    return {
        "times": times.tolist(),
        "nodes": rod.elements + 1,
        "parts": [[part.first, part.last] for part in rod.parts],
        "position": packing.as_text(position - origin, "<f4"),
        "quaternion": packing.frames_as_text(np.asarray(states.quaternion, float)),
        "origin": origin.tolist(),
        "diameter": diameter.tolist(),
        "thickest": thickest,
        "size": size,
        "measures": [_levels(measure, rod.elements) for measure in found],
        "colours": colouring.COLOURS,
        "holds": bodies.holds(scene),
        "lumps": bodies.lumps(scene),
        "bodies": drawn,
        "units": {"length": units.length, "time": units.time},
        "axes": axes.tolist(),
        "yaw": 0.35 if tilted else 0.0,
        "pitch": 0.3 if tilted else 0.0,
        "notes": [*notes, *map(_note, unseen)],
    }


def _levels(measure: Measure, elements: int) -> dict[str, Any]:
    packed = packing.levels(colouring.scaled(measure), *colouring.bounds(measure))
    at = "elements" if measure.values.shape[1] == elements else "nodes"
    own = {"name": measure.name, "unit": measure.unit, "scale": measure.scale, "at": at}
    return own | {"low": packed.low, "high": packed.high, "values": packed.text}


def _axes(points: Float[np.ndarray, "p 3"], first_view: View | None) -> tuple[np.ndarray, bool]:
    """Directions that point right, up and out of the page at first; whether to look from aside."""
    if first_view is not None:
        return first_view.axes(), False
    flat = points[:, :2] - np.mean(points[:, :2], 0)
    right = np.append(np.linalg.eigh(flat.T @ flat)[1][:, -1], 0.0)
    if np.sum(flat**2) < 1e-12 * np.sum(points**2):  # upright
        right = np.array([1.0, 0.0, 0.0])
    if right[np.argmax(np.abs(right))] < 0:
        right = -right
    up = np.array([0.0, 0.0, 1.0])
    return np.stack([right, up, np.cross(right, up)]), True


def _magnified(size: float, thick: float) -> float:
    """How much thicker tubes are drawn to be seen in a picture of this size."""
    if thick >= size / 180:
        return 1.0
    needed = size / 110 / thick
    power = 10.0 ** np.floor(np.log10(needed))
    return float(power * min((1, 2, 5, 10), key=lambda lead: abs(np.log(lead * power / needed))))


def _heading(scene: Scene) -> str:
    parts = scene.rod.parts
    counts = [part.last - part.first for part in parts]
    if len(parts) == 1:
        return f"a rod of {counts[0]} elements"
    return f"{len(parts)} rods of {', '.join(map(str, counts))} elements"


def _note(text: str, alarm: bool = False) -> dict[str, Any]:
    return {"text": text, "alarm": alarm}


def _alarms(shown: _Shown, known: int) -> list[dict[str, Any]]:
    """What a run did not do, and what of it there is."""
    told, count = [], np.shape(shown.states.time)[0]
    if shown.code is not Result.SUCCESS:
        told.append(_note(f"The run ended by {shown.code}", True))
    if not count:
        told.append(_note("The run holds no state", True))
    elif known < count:
        told.append(_note(f"{count - known} of {count} states are no numbers, and not shown", True))
    return told


def _page(data: dict[str, Any]) -> str:
    """The page that shows it."""
    part = lambda name: (resources.files("rodjax.viewing") / name).read_text(encoding="utf-8")
    # nothing of it may end the element that holds it
    told = json.dumps(data, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    page = part("page.html").replace("%STYLE%", part("page.css"))
    page = page.replace("%SCRIPT%", part("page.js"))
    return page.replace("%TITLE%", html.escape(data["title"])).replace("%DATA%", told)
