"""Runs as moving pictures in files: a gif, or an mp4 where ffmpeg is."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from rodjax.inputs.units import Units
from rodjax.inputs.validation import check_integer, check_positive, check_scalar, given
from rodjax.viewing.projection import Page
from rodjax.viewing.shown import heading_of, picked
from rodjax.viewing.tubes import View


def animate(
    scene: Any,
    run: Any = None,
    path: str | os.PathLike = "run.gif",
    *,
    colour: str | None = "strain energy density",
    measures: Mapping[str, Any] | None = None,
    measure_units: Mapping[str, str] | None = None,
    curves: Mapping[str, Any] | None = None,
    curves_label: str = "",
    magnify: float | None = None,
    frames: int = 100,
    seconds: float = 8.0,
    first_view: View | None = None,
    units: Units | None = None,
    title: str | None = None,
    dpi: int = 100,
) -> Path:
    """Write a run as a moving picture of the looks of `view`, beside curves that grow with time.

    A frame takes about half a second to draw.

    Args:
        scene, run, colour, measures, measure_units: as those of `view`.
        path: of the file, which ends in .gif or, with ffmpeg installed, in .mp4.
        curves: values at the run's saved times, by their names; drawn below the rod.
        curves_label: what they are, with their unit.
        magnify, first_view, units, title: as those of `view`; in parallel projection.
        frames: most pictures, of saved states nearest to equal spacing in time.
        seconds: that the film takes.
        dpi: pixels an inch; the picture is 9 inches wide.

    Returns:
        The path.

    Raises:
        ValueError: scene, run, measures and curves do not fit each other, there is nothing to show,
            or the file cannot be of this kind here.

    Example:
        >>> ledger = rx.energy.ledger(scene, run)
        >>> film = rx.animate(scene, run, "run.gif", curves={"kinetic": ledger.kinetic}, frames=3)
        >>> film.name
        'run.gif'
    """
    from matplotlib.animation import FFMpegWriter, PillowWriter
    from matplotlib.figure import Figure

    check_scalar(seconds=seconds, **given(magnify=magnify))
    check_positive(seconds=seconds, **given(magnify=magnify))
    check_integer(10, 1000, dpi=dpi)
    path = Path(path)
    kinds = {".gif": PillowWriter, ".mp4": FFMpegWriter}
    if path.suffix.lower() not in kinds:
        raise ValueError(f"path: name a file that ends in .gif or .mp4, got {str(path)!r}")
    writer = kinds[path.suffix.lower()]
    if not writer.isAvailable():
        raise ValueError("path: mp4 needs the program ffmpeg, which is not installed; take .gif")
    few = picked(scene, run, colour, measures, measure_units, frames, units)
    count = len(np.asarray(few.states.time))
    if not count:
        raise ValueError(f"run: there is nothing to show: {'; '.join(few.alarms)}")
    lines = {
        name: np.atleast_1d(np.asarray(values, float)) for name, values in (curves or {}).items()
    }
    for name, values in lines.items():
        if values.shape != (few.count,):
            raise ValueError(
                f"curves: {name!r} must have a value for each of the {few.count} saved states, got"
                f" shape {values.shape}"
            )
    every = np.asarray(few.all_times, float)
    page = Page(few, first_view, magnify)
    wide, tall = page.high - page.low
    height = float(np.clip(7.5 * tall / wide, 2.2, 7.0))
    figure = Figure(figsize=(9.0, height + 0.9 + (2.4 if lines else 0.0)), layout="constrained")
    ratios = {"height_ratios": [height, 2.2]} if lines else {}
    rows = figure.subplots(1 + bool(lines), 1, squeeze=False, gridspec_kw=ratios)[:, 0]
    if few.colour >= 0:
        shown = few.measures[few.colour]
        bar = figure.colorbar(page.colors, ax=rows[0], fraction=0.03, pad=0.01)
        bar.set_label(f"{shown.name} [{shown.unit}]" if shown.unit else shown.name)
    heading = heading_of(few.scene) if title is None else title
    words = "; ".join([heading, *page.notes, *few.alarms])
    path.parent.mkdir(parents=True, exist_ok=True)
    film = writer(fps=max(1, round(count / seconds)))
    with film.saving(figure, str(path), dpi=dpi):
        for index in range(count):
            page.draw(rows[0], index)
            rows[0].set_title(words, loc="left", fontsize=10)
            if lines:
                _grow(rows[1], every, lines, page.times[index], f"time [{few.units.time}]")
                rows[1].set_ylabel(curves_label)
            if not index:  # laid out once: nothing jumps
                figure.canvas.draw()
                figure.set_layout_engine("none")
            film.grab_frame()
    return path


def _grow(axes, times, lines: Mapping[str, np.ndarray], now: float, label: str) -> None:
    """Curves up to a time, in axes that have room for all of them."""
    axes.clear()
    past = times <= now
    for name, values in lines.items():
        (line,) = axes.plot(times[past], values[past], label=name, linewidth=1.5)
        axes.plot(times[past][-1:], values[past][-1:], "o", markersize=4, color=line.get_color())
    known = np.concatenate([values[np.isfinite(values)] for values in lines.values()])
    low, high = np.min(known, initial=0.0), np.max(known, initial=0.0)
    room = 0.05 * (high - low) or 1.0
    axes.set(xlim=(times[0], times[-1]), ylim=(low - room, high + room), xlabel=label)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=9, loc="upper left")
