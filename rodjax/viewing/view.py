"""Runs in three dimensions: tubes that move, turn and are coloured, in a notebook or in one file.

Everything that a page needs is in it: it opens without a network, and sends nothing.
"""

import html
import json
import os
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from rodjax.inputs.units import Units
from rodjax.inputs.validation import check_positive, check_scalar, given
from rodjax.viewing import bodies, colouring, packing
from rodjax.viewing.colouring import Measure
from rodjax.viewing.shown import (
    PITCH,
    YAW,
    Picked,
    axes_of,
    heading_of,
    magnified,
    picked,
    proportions,
)
from rodjax.viewing.tubes import View


class RunView:
    """A page that shows a run; a notebook shows it by itself.

    Attributes:
        page: the whole page, as HTML.
        title: its heading.
        frames: how many states it holds.

    Example:
        >>> shown = rx.view(scene, run)
        >>> shown.save("run.html")  # doctest: +SKIP
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

    Tubes are of the rods' own diameters, or so many times as thick as the page says; the black
    stripe follows the director a_1 and shows twist. Held nodes are plates (on a rail where they may
    slide), pinned ones balls; bodies are boxes of their moments of inertia, lumps without these
    balls. While it plays, nodes go straight from one saved state to the next.

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

    Example:
        >>> shown = rx.view(scene, run)  # at the end of a cell of a notebook it is shown
        >>> shown.save("run.html")  # one file, which works offline  # doctest: +SKIP
        >>> rx.view("run.h5")  # a file of `storage.save` or of a recorder  # doctest: +SKIP
    """
    check_scalar(seconds=seconds, **given(magnify=magnify))
    check_positive(seconds=seconds, **given(magnify=magnify))
    few = picked(scene, run, colour, measures, measure_units, frames, units)
    heading = heading_of(few.scene) if title is None else title
    data = _data(few, first_view, magnify) | {"seconds": float(seconds), "title": heading}
    return RunView(_page(data), heading, len(data["times"]))


def _data(few: Picked, first_view: View | None, magnify: float | None) -> dict[str, Any]:
    """What the page is given."""
    scene, rod, states = few.scene, few.scene.rod, few.states
    times, position = np.asarray(states.time, float), np.asarray(states.position, float)
    points = position.reshape(-1, 3) if len(times) else np.asarray(rod.position, float)
    box = proportions(rod, points)
    corners = box.origin - box.half, box.origin + box.half
    drawn, unseen = bodies.obstacles(scene, times, *corners, box.origin)
    axes, tilted = axes_of(points, first_view)
    if box.assumed:
        unseen.append("no diameter was given: drawn as a two hundredth of the length")
    if len(times) < few.known:
        unseen.append(f"{len(times)} of {few.known} states")
    notes = [{"text": text, "alarm": False} for text in unseen]
    return {
        "times": times.tolist(),
        "nodes": rod.elements + 1,
        "parts": [[part.first, part.last] for part in rod.strands],
        "position": packing.as_text(position - box.origin, "<f4"),
        "quaternion": packing.frames_as_text(np.asarray(states.quaternion, float)),
        "origin": box.origin.tolist(),
        "diameter": box.diameter.tolist(),
        "size": box.size,
        "magnify": magnified(box) if magnify is None else float(magnify),
        "measures": [_levels(measure, rod.elements) for measure in few.measures],
        "colour": few.colour,
        "colours": colouring.COLOURS,
        "holds": bodies.holds(scene),
        "lumps": bodies.lumps(scene),
        "bodies": drawn,
        "units": {"length": few.units.length, "time": few.units.time},
        "axes": axes.tolist(),
        "yaw": YAW if tilted else 0.0,
        "pitch": PITCH if tilted else 0.0,
        "notes": [*notes, *({"text": text, "alarm": True} for text in few.alarms)],
    }


def _levels(measure: Measure, elements: int) -> dict[str, Any]:
    packed = packing.levels(colouring.scaled(measure), *colouring.bounds(measure))
    at = "elements" if measure.values.shape[1] == elements else "nodes"
    own = {"name": measure.name, "unit": measure.unit, "scale": measure.scale, "at": at}
    return own | {"low": packed.low, "high": packed.high, "values": packed.text}


def _page(data: dict[str, Any]) -> str:
    """The page that shows it."""
    part = lambda name: (resources.files("rodjax.viewing") / name).read_text(encoding="utf-8")
    # nothing of it may end the element that holds it
    told = json.dumps(data, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    page = part("page.html").replace("%STYLE%", part("page.css"))
    page = page.replace("%SCRIPT%", part("page.js"))
    return page.replace("%TITLE%", html.escape(data["title"])).replace("%DATA%", told)
