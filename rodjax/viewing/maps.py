"""Measures over arc length and time, as maps of colours."""

from typing import Any

import numpy as np
from jaxtyping import Float

from rodjax.inputs.units import Units
from rodjax.rods.rod import Rod
from rodjax.viewing.colouring import Measure, scaled
from rodjax.viewing.projection import colours_of


def space_time(
    figure: Any, rod: Rod, times: Float[np.ndarray, " k"], measure: Measure, units: Units
) -> None:
    """Draw a measure of every rod over time, all with one scale, into a figure or part of one.

    Each value fills its element, or of nodes the half of the elements beside, from halfway since
    the state before to halfway to the next.
    """
    colours, parts = colours_of(measure), rod.strands
    rows = figure.subplots(len(parts), 1, sharex=True, squeeze=False)[:, 0]
    along = np.asarray(rod.arc_length, float)
    of_nodes = measure.values.shape[1] == rod.elements + 1
    values = 10 ** scaled(measure) if measure.scale == "log" else measure.values
    for index, (axes, part) in enumerate(zip(rows, parts, strict=True)):
        own = values[:, part.nodes if of_nodes else part.elements]
        places = along[part.nodes]
        if of_nodes:
            places = between(places, places[0], places[-1])
        _fill(axes, between(times), places, own, colours)
        name = f"rod {index}: " if len(parts) > 1 else ""
        axes.set_ylabel(f"{name}arc length s [{units.length}]")
    rows[-1].set_xlabel(f"time [{units.time}]")
    bar = figure.colorbar(colours, ax=list(rows), fraction=0.05, pad=0.02)
    bar.set_label(f"{measure.name} [{measure.unit}]" if measure.unit else measure.name)


def _fill(axes, times, places, values, colours) -> None:
    """One rod; what is no number is left grey."""
    axes.set_facecolor("0.85")
    shown = np.ma.masked_invalid(values.T)
    axes.pcolormesh(times, places, shown, norm=colours.norm, cmap=colours.cmap, rasterized=True)


def between(
    places: Float[np.ndarray, " k"], first: float | None = None, last: float | None = None
) -> Float[np.ndarray, " k+1"]:
    """Borders of cells about places: halfway to their neighbours, the ends as far beyond.

    A single place has a cell of width one.
    """
    if len(places) < 2:
        return np.array([places[0] - 0.5, places[0] + 0.5])
    middle = 0.5 * (places[1:] + places[:-1])
    before = 2 * places[0] - middle[0] if first is None else first
    behind = 2 * places[-1] - middle[-1] if last is None else last
    return np.array([before, *middle, behind])
