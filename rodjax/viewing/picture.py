"""Pictures of a run by their names: shapes, energies, topology, reactions, and maps of measures."""

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import numpy as np

from rodjax.constraints.ends import Free
from rodjax.dynamics.run import Run
from rodjax.inputs.units import Units
from rodjax.inputs.validation import as_integer, check_integer, check_positive, check_scalar, given
from rodjax.measuring import energy, measures
from rodjax.measuring.blocks import over_states
from rodjax.numerics.results import Result
from rodjax.rods.chain import states_of
from rodjax.rods.winding import twist, writhe
from rodjax.scenes.scene import Scene
from rodjax.viewing import colouring, plot
from rodjax.viewing.colouring import Measure
from rodjax.viewing.maps import space_time
from rodjax.viewing.projection import Page
from rodjax.viewing.shown import Picked, Shown, heading_of, own_measures, shown_of, spread
from rodjax.viewing.tubes import View, direction, facing

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_WIDTH = 10.0  # of a picture [in]
_HIGHEST = 6.0  # of all shapes together [in]
_STRIPE = 0.26  # half its width [rad]
_STATES = 600  # most states in a map
_SEEN = 1e-6  # part of the largest, below which a curve is left out


class _Panel(NamedTuple):
    """A part of a picture: its height [in], and what draws it into a figure."""

    height: float
    draw: Callable[[Any], Any]


class _Asked(NamedTuple):
    """What is to be drawn, and how."""

    shown: Shown
    own: list[Measure]
    view: View | None
    states: int
    magnify: float | None


def picture(
    scene: Any,
    run: Any = None,
    *names: str,
    view: View | None = None,
    states: int = 4,
    magnify: float | None = None,
    measures: Mapping[str, Any] | None = None,
    measure_units: Mapping[str, str] | None = None,
    units: Units | None = None,
    title: str | None = None,
) -> "Figure":
    """A figure of a run by name, or of several names one below the other.

    - "shapes": a few states, seen from the side, with obstacles and holds; coloured by the strain
      energy density, the stripe along a_1.
    - "energies": what `rx.energy.ledger` accounts for, without what is nothing.
    - "topology": twist, writhe and linking number of every rod, and the turns that drives applied.
    - "reactions": forces and torques of what holds the rods; of several parts those that matter.
    - "curvature", "twist", "tension", "speed", "strain energy density", where anything touches
      "contact force", and your own `measures`: a map over time and arc length of every rod.

    Of a run that failed there is what it holds, and the title says how it ended.

    Args:
        scene: of the run, which does not keep it; or a path, or what `storage.load` gave.
        run: a `Run`, one `State`, or a sequence of states; default: the rod as it is placed.
        names: of the pictures; default: "shapes".
        view: what points right and up in "shapes"; default: the side that shows most, see
            `rx.plot.facing`.
        states: how many of them are in "shapes", nearest to equal spacing in time.
        magnify: how much thicker than they are the rods are drawn; default: as much as makes them
            visible.
        measures: your own, by name: for every state a value an element, or a node.
        measure_units: names of their units.
        units: names of the units; default those of the file, else SI.
        title: heading; default: what the scene is.

    Returns:
        A figure of matplotlib, neither shown nor saved; a notebook shows it by itself.

    Raises:
        ValueError: there is no picture of this name; scene, run and measures do not fit each other.

    Example:
        >>> figure = rx.picture(scene, run, "curvature")  # over arc length and time
        >>> both = rx.picture(scene, run, "shapes", "tension")
        >>> both.savefig("run.png")  # doctest: +SKIP
    """
    from matplotlib.figure import Figure

    states = as_integer(states)
    check_integer(1, states=states)
    check_scalar(**given(magnify=magnify))
    check_positive(**given(magnify=magnify))
    shown = shown_of(scene, run, units)
    own = own_measures(measures or {}, measure_units or {}, shown.states, shown.scene.rod)
    asked = _Asked(shown, own, view, states, magnify)
    there = _there(asked)
    for name in names:
        if name not in there:
            raise ValueError(
                f"names: there is no picture {name!r} of this scene; give some of"
                f" {', '.join(map(repr, there))}"
            )
    heading = heading_of(shown.scene) if title is None else title
    words = "; ".join(part for part in (heading, *_alarms(shown)) if part)
    if not len(shown.known):
        figure = Figure(figsize=(_WIDTH, 2.0), layout="constrained")
        figure.text(0.5, 0.4, "there is nothing to show", ha="center")
        figure.suptitle(words, fontsize=11)
        return figure
    panels = [there[name](asked) for name in names or ("shapes",)]
    heights = [panel.height for panel in panels]
    figure = Figure(figsize=(_WIDTH, sum(heights) + 0.4), layout="constrained")
    figure.suptitle(words, fontsize=11)
    parts = figure.subfigures(len(panels), 1, squeeze=False, height_ratios=heights)[:, 0]
    for part, panel in zip(parts, panels, strict=True):
        panel.draw(part)
    return figure


def _there(asked: _Asked) -> dict[str, Callable[[_Asked], _Panel]]:
    """What there is to be drawn of a scene, by its name."""
    scene = asked.shown.scene
    found = {"shapes": _shapes, "energies": _energies, "topology": _topology}
    if _held(scene):
        found["reactions"] = _reactions
    names = [*colouring.names_of(scene), *(measure.name for measure in asked.own)]
    return found | {name: _map_of(name) for name in names}


def _alarms(shown: Shown) -> list[str]:
    """What the run did not do, and what of it there is not."""
    count, known, told = len(shown.states.time), len(shown.known), []
    if shown.code is not Result.SUCCESS:
        told.append(f"the run ended by {shown.code.name}")
    if not count:
        told.append("the run holds no state")
    elif known < count:
        told.append(f"{count - known} of {count} states are no numbers, and not shown")
    if count == 1 and shown.given is not None:
        told.append("the start alone: no step is in the run")
    return told


def _rows(shown: Shown, most: int) -> np.ndarray:
    """Which states are drawn."""
    return shown.known[spread(np.asarray(shown.states.time)[shown.known], most)]


def _measured(asked: _Asked, name: str, rows: np.ndarray) -> Measure:
    """A measure of some of the states."""
    for measure in asked.own:
        if measure.name == name:
            return measure._replace(values=measure.values[rows])
    few = jax.tree.map(lambda leaf: np.asarray(leaf)[rows], asked.shown.states)
    return colouring.measures_of(asked.shown.scene, few, asked.shown.units, [name])[0]


def _map_of(name: str) -> Callable[[_Asked], _Panel]:
    def panel(asked: _Asked) -> _Panel:
        shown, rows = asked.shown, _rows(asked.shown, _STATES)
        rod, times = shown.scene.rod, np.asarray(shown.states.time, float)[rows]
        measure = _measured(asked, name, rows)
        draw = lambda part: space_time(part, rod, times, measure, shown.units)
        return _Panel(1.2 + 2.4 * len(rod.strands), draw)

    return panel


def _shapes(asked: _Asked) -> _Panel:
    shown, rows = asked.shown, _rows(asked.shown, asked.states)
    measure = _measured(asked, "strain energy density", rows)
    few = jax.tree.map(lambda leaf: np.asarray(leaf)[rows], shown.states)
    times, count = np.asarray(shown.states.time), len(rows)
    view = facing(list(np.asarray(few.position))) if asked.view is None else asked.view
    seen = Picked(
        shown.scene, shown.units, few, times, [measure], 0, len(shown.known), len(times), shown.code
    )
    wide, tall = Page(seen, view, asked.magnify).size
    columns = _columns(count, tall / wide)
    page, lines = Page(seen, view, asked.magnify, columns), -(-count // columns)
    right, up, _ = view.axes()

    strained = bool(np.any(measure.values > 0))
    notes = page.notes if strained else [*page.notes, "no strain energy"]
    unit = shown.units.length

    def draw(part) -> None:
        grid = part.subplots(lines, columns, squeeze=False, sharex=True, sharey=True)
        for index, axes in enumerate(grid.ravel()):
            if index >= count:
                axes.set_axis_off()
                continue
            page.draw(axes, index, stripe=_STRIPE)
            axes.set_xlabel(f"t = {page.times[index]:.4g} {shown.units.time}")
            axes.tick_params(labelsize=8)
        if strained:
            bar = part.colorbar(page.colors, ax=list(grid.ravel()), fraction=0.03, pad=0.01)
            bar.set_label(f"{measure.name} [{measure.unit}]")
        part.supxlabel(f"{direction(right)} [{unit}]", fontsize=9)
        part.supylabel(f"{direction(up)} [{unit}]", fontsize=9)
        part.suptitle("; ".join(notes), fontsize=10)

    return _Panel(_height(count, columns, tall / wide) + 0.5 * lines + 0.7, draw)


def _height(count: int, columns: int, aspect: float) -> float:
    """Of so many shapes in so many columns [in]."""
    return -(-count // columns) * aspect * 0.85 * _WIDTH / columns


def _columns(count: int, aspect: float) -> int:
    """In how many columns shapes fit well: in the fewest that leave no place empty."""
    low = [n for n in range(1, count + 1) if _height(count, n, aspect) <= _HIGHEST]
    return min(low or [count], key=lambda n: (-count % n, n))


def _energies(asked: _Asked) -> _Panel:
    shown = asked.shown
    booked = energy.ledger(shown.scene, shown.run)
    fields = {name: getattr(booked, name) for name in booked._fields if name != "time"}
    # its two parts are there
    fields.pop("contact_work" if booked.contact_loss is not None else "contact_loss")
    fields["not accounted for"] = booked.residual
    parts = _that_matter({name.replace("_", " "): part for name, part in fields.items()})
    draw = lambda part: plot.energies(shown.run.times, parts, units=shown.units, figure=part)
    return _Panel(4.5, draw)


def _that_matter(curves: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Those that are not next to nothing beside the largest; of nothing the first."""
    known = {
        name: np.asarray(values, float) for name, values in curves.items() if values is not None
    }
    size = {name: np.max(np.abs(x[np.isfinite(x)]), initial=0.0) for name, x in known.items()}
    least = _SEEN * max(size.values())
    found = {name: values for name, values in known.items() if size[name] > least}
    return found or dict(list(known.items())[:1])


def _topology(asked: _Asked) -> _Panel:
    shown, rods = asked.shown, len(asked.shown.scene.rod.strands)
    curves = _linking(shown.scene, shown.run)

    def draw(part) -> None:
        parts = part.subfigures(rods, 1, squeeze=False)[:, 0]
        for index, (own, values) in enumerate(zip(parts, curves, strict=True)):
            name = f"rod {index}: " if rods > 1 else ""
            title = f"{name}conversion of twist to writhe"
            plot.topology(shown.run.times, *values, units=shown.units, title=title, figure=own)

    return _Panel(3.6 * rods, draw)


def _linking(scene: Scene, run: Run) -> list[tuple]:
    """Twist, writhe and, of one rod whose drives' turns can be counted, these; of every rod."""
    if not scene.rod.breaks:
        try:
            found = measures.linking(scene, run)
            return [(found.twist, found.writhe, found.turns)]
        except ValueError:  # drives about other axes than the tangents: no number of turns
            pass
    strands = states_of(run.states)[: len(scene.rod.strands)]
    return [_wound(states) for states in strands]


@over_states
def _wound(state):
    return twist(state), writhe(state)


def _held(scene: Scene) -> list[int]:
    """Which of `scene.holds` hold anything."""
    return [i for i, held in enumerate(scene.holds) if not isinstance(held.end, Free)]


def _reactions(asked: _Asked) -> _Panel:
    shown, curves = asked.shown, ({}, {})
    found = _supplied(shown.run.states, shown.scene)
    for i in _held(shown.scene):
        name = shown.scene.holds[i].name.replace("_", " ")
        for kind, values in zip(curves, (found.force, found.torque), strict=True):
            kind |= {f"{name}, e{k + 1}": np.asarray(values)[:, i, k] for k in range(3)}
    forces, torques = map(_that_matter, curves)
    say = {"units": shown.units, "title": "Reactions, inertial components"}
    draw = lambda part: plot.reactions(shown.run.times, forces, torques, figure=part, **say)
    return _Panel(6.0, draw)


@over_states
def _supplied(state, scene):
    return energy.reactions(scene, state)
