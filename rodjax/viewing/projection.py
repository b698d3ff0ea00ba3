"""Runs on a page: states in parallel projection, with what they touch and are held by."""

from typing import TYPE_CHECKING

import numpy as np

from rodjax.viewing import bodies, colouring
from rodjax.viewing.colouring import Measure
from rodjax.viewing.packing import from_text
from rodjax.viewing.shown import PITCH, YAW, Picked, axes_of, magnified, proportions
from rodjax.viewing.tubes import View, tube

if TYPE_CHECKING:
    from matplotlib.cm import ScalarMappable


def colours_of(measure: Measure) -> "ScalarMappable":
    """What turns the values of a measure into colours, those of `view`."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import LinearSegmentedColormap, LogNorm, Normalize

    low, high = colouring.bounds(measure)
    stops = np.asarray(colouring.COLOURS["signed" if measure.scale == "signed" else "one"]) / 255
    norm = LogNorm(10**low, 10**high) if measure.scale == "log" else Normalize(low, high)
    return ScalarMappable(norm, LinearSegmentedColormap.from_list("rods", stops))


def _plain() -> "ScalarMappable":
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    return ScalarMappable(Normalize(0.0, 1.0), "Blues")


class Page:
    """A run in parallel projection, state by state."""

    def __init__(
        self, few: Picked, first_view: View | None, magnify: float | None, pictures: int = 1
    ):
        self.few, rod = few, few.scene.rod
        self.times = np.asarray(few.states.time, float)
        self.position = np.asarray(few.states.position, float)
        points = self.position.reshape(-1, 3)
        box = proportions(rod, points)
        thicker = magnified(box, pictures) if magnify is None else float(magnify)
        self.diameter = thicker * box.diameter
        axes, tilted = axes_of(points, first_view)
        self.view = _aside(axes) if tilted else View(tuple(axes[0]), tuple(axes[1]))
        self.flat = self.view.axes()[:2]
        margin = 0.75 * float(np.max(self.diameter)) + 0.03 * box.size
        at = points @ self.flat.T
        self.low, self.high = np.min(at, 0) - margin, np.max(at, 0) + margin
        short = 0.5 * np.maximum(0.15 * np.max(self.high - self.low) - (self.high - self.low), 0.0)
        self.low, self.high = self.low - short, self.high + short
        corners = box.origin - box.half, box.origin + box.half
        # of the page's own, whose places are measured from its origin
        self.origin = box.origin
        self.bodies, self.notes = bodies.obstacles(few.scene, self.times, *corners, box.origin)
        self.notes += [f"{body['name']} is not drawn" for body in self.bodies if body["mesh"]]
        if thicker != 1:
            self.notes.append(f"tubes drawn {thicker:g} times as thick as they are")
        self.holds = bodies.holds(few.scene)
        if few.colour < 0:
            self.values = np.zeros((len(self.times), rod.elements))
            self.colors = _plain()
            return
        measure = few.measures[few.colour]
        self.colors = colours_of(measure)
        values = measure.values
        if values.shape[1] == rod.elements + 1:  # of elements the mean of both ends
            values = 0.5 * (values[:, :-1] + values[:, 1:])
        least = 10 ** colouring.bounds(measure)[0] if measure.scale == "log" else -np.inf
        self.values = np.maximum(np.nan_to_num(values), least)

    @property
    def size(self) -> tuple[float, float]:
        """Width and height of what is shown."""
        wide, tall = self.high - self.low
        return float(wide), float(tall)

    def draw(self, axes, index: int, stripe: bool | float = True) -> None:
        """One state, with a stripe as `tube` draws it."""
        from matplotlib.collections import LineCollection

        axes.clear()
        few, time = self.few, self.times[index]
        for body in self.bodies:
            shift = np.zeros(3)
            if body["shift"] is not None:
                shift = from_text(body["shift"], "<f4").reshape(-1, 3)[index]
            for patch in body["patches"]:
                points = from_text(patch["points"], "<f4").astype(float)
                grid = points.reshape(patch["rows"], patch["columns"], 3) + self.origin + shift
                grid = grid @ self.flat.T
                net = [*grid, *np.swapaxes(grid, 0, 1)]
                axes.add_collection(
                    LineCollection(net, colors="#7f8c99", linewidths=0.4, alpha=0.6)
                )
        for hold in self.holds:
            span = [s for s in hold["spans"] if s["after"] is None or s["after"] <= time][-1]
            if span["kind"] is not None:
                place = self.flat @ self.position[index, hold["node"]]
                mark = "o" if span["kind"] == "ball" else "s"
                axes.plot(*place, mark, color="#3b454f", markersize=7, zorder=0.5)
        tube(
            axes,
            self.position[index],
            np.asarray(few.states.quaternion)[index],
            self.diameter,
            self.values[index],
            colors=self.colors,
            view=self.view,
            stripe=stripe,
            sides=16 if stripe is True else 24,
            breaks=few.scene.rod.breaks,
        )
        axes.set(xlim=(self.low[0], self.high[0]), ylim=(self.low[1], self.high[1]))
        axes.set_xlabel(f"t = {time:.4g} {few.units.time}, lengths in {few.units.length}")
        axes.spines[["top", "right"]].set_visible(False)


def _aside(axes: np.ndarray) -> View:
    """The first view of a page, from a little to the right and above."""
    right, up, towards = axes
    flat = np.cos(YAW) * towards + np.sin(YAW) * right
    back = np.cos(PITCH) * flat + np.sin(PITCH) * up
    aside = np.cross(up, back)
    return View(tuple(aside.tolist()), tuple(np.cross(back, aside).tolist()))
