"""Figures of runs: tubes coloured by strain-energy density, energies, topology, reactions.

matplotlib is imported when a figure is made, not with this module. Figures are returned, neither
shown nor saved; colours and labels can be changed on them as on any other. What is not finite (a
run that failed) is left out, and the title says how much.
"""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from rodjax.inputs.units import SI, Units
from rodjax.rods.rod import Rod
from rodjax.rods.state import State
from rodjax.viewing.tubes import Values, View, direction, facing, tube

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def snapshots(
    rod: Rod,
    states: Sequence[State],
    densities: Sequence[Float[Values, " n"]],
    *,
    magnify: float = 1.0,
    stripe_first: bool = True,
    view: View | None = None,
    units: Units = SI,
    title: str = "",
) -> "Figure":
    """One row a state, to one scale, coloured by strain-energy density (Fig. 7 of the paper).

    Shapes that are taller than wide stand side by side instead. A circle marks the end s = 0.

    Args:
        rod: with a diameter; of several rods `scene.rod`, which is all of them.
        states: states to draw, in order, such as `[run.state(0), run.final]`.
        densities: strain-energy density of the elements of each, Eq. (4) [N], such as
            `[rx.energy.strain_energy_density(rod, state) for state in states]`.
        magnify: how much thicker than they are the tubes are drawn; the title says so.
        stripe_first: draw the twist stripe on the first.
        view: default: along the inertial axis that shows most of the shapes, see `facing`.
        units: names of the units of the axes.
        title: heading of the figure.

    Raises:
        ValueError: the rod has no diameter, or rod, states and densities do not fit each other.
    """
    from matplotlib.figure import Figure

    _check_shapes(rod, states, densities)
    diameter = magnify * np.asarray(rod.diameter)
    known = [bool(np.all(np.isfinite(np.asarray(state.position)))) for state in states]
    if view is None:
        view = facing([np.asarray(state.position) for state in states])
    page = view.axes()
    flat = [
        np.asarray(state.position) @ page.T if good else np.zeros((1, 3))
        for state, good in zip(states, known, strict=True)
    ]
    margin = 0.75 * diameter.max() + 0.01 * float(np.sum(np.asarray(rod.length)))
    shown = [points for points, good in zip(flat, known, strict=True) if good] or flat
    left = min(points[:, 0].min() for points in shown) - margin
    right = max(points[:, 0].max() for points in shown) + margin
    least = 0.06 * (right - left)  # so that a straight rod has a row too
    middle = [0.5 * (points[:, 1].min() + points[:, 1].max()) for points in flat]
    low = [min(p[:, 1].min() - margin, m - least) for p, m in zip(flat, middle, strict=True)]
    high = [max(p[:, 1].max() + margin, m + least) for p, m in zip(flat, middle, strict=True)]
    heights = [b - a for a, b in zip(low, high, strict=True)]
    width = 10.0
    if sum(heights) > 1.5 * len(states) * (right - left):
        low, high = [min(low)] * len(states), [max(high)] * len(states)
        heights = [b - a for a, b in zip(low, high, strict=True)]
        inches = 0.8 * width * heights[0] / (len(states) * (right - left)) + 1.2
        figure = Figure(figsize=(width, inches), layout="constrained")
        rows = figure.subplots(1, len(states), sharey=True, squeeze=False)[0]
    else:
        inches = 0.86 * width * sum(heights) / (right - left) + 0.42 * len(states) + 1.0
        figure = Figure(figsize=(width, inches), layout="constrained")
        rows = figure.subplots(
            len(states), 1, sharex=True, squeeze=False, gridspec_kw={"height_ratios": heights}
        )[:, 0]
    colors = _colors(densities)
    for index, (axes, state, density) in enumerate(zip(rows, states, densities, strict=True)):
        if known[index]:
            tube(
                axes,
                np.asarray(state.position),
                np.asarray(state.quaternion),
                diameter,
                np.clip(np.nan_to_num(np.asarray(density)), colors.norm.vmin, None),
                colors=colors,
                view=view,
                stripe=stripe_first and index == 0,
                breaks=rod.breaks,
            )
            start = flat[index][[part.first for part in rod.strands], :2].T
            axes.plot(*start, "o", markersize=9, markerfacecolor="none", color="black", zorder=3)
            if rod.bodies:
                places = flat[index][list(rod.bodies), :2].T
                axes.plot(*places, "s", markersize=9, color="black", zorder=3)
        else:
            axes.set_aspect("equal")
            axes.text(0.5, 0.5, "not finite", transform=axes.transAxes, ha="center", va="center")
        axes.set(xlim=(left, right), ylim=(low[index], high[index]))
        axes.set_title(f"t = {float(state.time):.4g} {units.time}", loc="left", fontsize=10)
        axes.spines[["top", "right"]].set_visible(False)
        axes.tick_params(labelsize=8)
        axes.locator_params(axis="y", nbins=max(2, int(12 * heights[index] / (right - left)) + 1))
    label = f"{direction(page[0])} [{units.length}]; a circle marks the end s = 0"
    label += ", a square a body" if rod.bodies else ""
    figure.supxlabel(label, fontsize=10)
    figure.supylabel(f"{direction(page[1])} [{units.length}]", fontsize=10)
    strained = any(np.any(np.asarray(density) > 0) for density in densities)
    if strained:
        bar = figure.colorbar(colors, ax=list(rows), fraction=0.03, pad=0.01)
        bar.set_label(f"strain energy density [{units.energy}/{units.length}]")
    notes = [
        title,
        "" if magnify == 1 else f"tubes drawn {magnify:g} times as thick as they are",
        "" if strained else "no strain energy",
        "" if all(known) else f"{known.count(False)} of {len(states)} states are not finite",
    ]
    figure.suptitle("; ".join(part for part in notes if part), fontsize=11)
    return figure


def _check_shapes(rod: Rod, states, densities) -> None:
    if rod.diameter is None:
        raise ValueError("diameter: tubes need the rod's diameter; give it to the rod's section")
    if hasattr(states, "position") or not len(states):
        raise ValueError("states: give a sequence of at least one state, for one state [state]")
    if len(states) != len(densities):
        raise ValueError(
            f"densities: give those of every state, {len(states)}, not {len(densities)}"
        )
    n = rod.elements
    for i, (state, density) in enumerate(zip(states, densities, strict=True)):
        if np.shape(state.position) != (n + 1, 3):
            raise ValueError(
                f"states[{i}]: has positions of shape {np.shape(state.position)}, the rod"
                f" {n + 1} nodes; give single states of this rod, such as run.state(0)"
            )
        if np.shape(density) != (n,):
            raise ValueError(
                f"densities[{i}]: must have shape ({n},), one number an element, got"
                f" {np.shape(density)}"
            )


def _colors(densities) -> Any:
    """Colours of densities, logarithmic over three decades below the largest."""
    from matplotlib import colormaps
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import ListedColormap, LogNorm

    every = np.concatenate([np.asarray(density, float) for density in densities])
    every = every[np.isfinite(every)]
    top = float(np.max(every, initial=0.0)) or 1.0  # of unstrained rods any scale will do
    bottom = min(max(float(np.min(every, initial=top)), 1e-3 * top), 0.3 * top)
    bright = ListedColormap(colormaps["turbo"](np.linspace(0.1, 0.92, 256)))
    return ScalarMappable(LogNorm(bottom, top), bright)  # so that a black stripe shows


def _curves(rows: int = 1, height: float = 4.5, figure: Any = None):
    from matplotlib.figure import Figure

    if figure is None:
        figure = Figure(figsize=(8, height), layout="constrained")
    axes = figure.subplots(rows, 1, squeeze=False)[:, 0]
    for row in axes:
        row.grid(alpha=0.3)
    return figure, axes


def _draw(axes, x, curves: Mapping[str, Any], styles: Sequence[Mapping[str, Any]]) -> int:
    """Curves with their names; how many values of x have none that is finite in all of them."""
    if not curves:
        raise ValueError("give at least one curve, by its name")
    x = np.atleast_1d(np.asarray(x, float))
    missing = ~np.isfinite(x)
    for (name, values), style in zip(curves.items(), styles, strict=True):
        y = np.atleast_1d(np.asarray(values, float))
        if y.shape != x.shape or x.ndim != 1:
            raise ValueError(f"{name}: has shape {y.shape}, what it is drawn against {x.shape}")
        known = np.isfinite(y) & np.isfinite(x)
        missing |= ~known
        # a value between two that are missing has no line: a point shows it
        beside = np.concatenate([known[1:], [False]]) | np.concatenate([[False], known[:-1]])
        alone = np.flatnonzero(known & ~beside).tolist()
        points = {"marker": "o", "markersize": 4, "markevery": alone} if alone else {}
        axes.plot(x, y, label=name, **points, **style)
    return int(np.sum(missing))


def _finish(axes, x, missing: int, title: str, label: str) -> None:
    """Limits, title and legend, with a word on what is not there."""
    x = np.atleast_1d(np.asarray(x, float))
    known = x[np.isfinite(x)]
    if known.size and np.min(known) < np.max(known):
        axes.set_xlim(np.min(known), np.max(known))
    note = f"{missing} of {len(x)} points are not finite" if missing else ""
    axes.set_title("; ".join(part for part in (title, note) if part), fontsize=11)
    axes.set_xlabel(label)
    axes.legend(fontsize=9, loc="center left", bbox_to_anchor=(1.0, 0.5))


def _mark(axes, marks: Mapping[str, float] | None):
    """Thin vertical lines, each with its name written along it, haloed against curves."""
    from matplotlib.patheffects import withStroke

    left, right = axes.get_xlim()
    for name, time in (marks or {}).items():
        if not left <= float(time) <= right:  # it never came, or not in what is shown
            continue
        axes.axvline(time, color="0.5", linewidth=0.8, linestyle=":", zorder=0)
        axes.annotate(
            name,
            (time, 0.98),
            xycoords=("data", "axes fraction"),
            rotation=90,
            fontsize=8,
            color="0.3",
            ha="right",
            va="top",
            path_effects=[withStroke(linewidth=2.5, foreground="white")],
        )


def energies(
    times: Float[Values, " k"],
    parts: Mapping[str, Float[Values, " k"]],
    *,
    marks: Mapping[str, float] | None = None,
    units: Units = SI,
    title: str = "Energy",
    figure: Any = None,
) -> "Figure":
    """Energies and works against time (Fig. 8).

    Works are dashed, totals heavy, by their names.

    Args:
        times: [s].
        parts: energies [J] by their names, such as fields of `rx.energy.ledger`.
        marks: named times to point out; those outside the times (or infinite) are left out.
        units: names of the units of the axes.
        title: heading of the figure.
        figure: a figure or part of one to draw in; default: a new one.
    """
    figure, (axes,) = _curves(figure=figure)
    styles = [
        {"linewidth": 2.2 if "total" in name else 1.4}
        | ({"color": "black", "linestyle": "--"} if "work" in name else {})
        for name in parts
    ]
    missing = _draw(axes, times, parts, styles)
    axes.set_ylabel(f"energy [{units.energy}]")
    _finish(axes, times, missing, title, f"time [{units.time}]")
    _mark(axes, marks)
    return figure


def topology(
    times: Float[Values, " k"],
    twist: Float[Values, " k"],
    writhe: Float[Values, " k"],
    turns: Float[Values, " k"] | None = None,
    *,
    marks: Mapping[str, float] | None = None,
    units: Units = SI,
    title: str = "Conversion of twist to writhe",
    figure: Any = None,
) -> "Figure":
    """Tw, Wr and their sum Lk against time, with the turns applied at the end (Fig. 9).

    Args:
        times: [s].
        twist, writhe, turns: in turns, as `rx.measures.linking` gives them; without those applied
            where these cannot be counted.
        marks: named times to point out; those outside the times (or infinite) are left out.
        units: names of the units of the axes.
        title: heading of the figure.
        figure: a figure or part of one to draw in; default: a new one.
    """
    figure, (axes,) = _curves(figure=figure)
    curves = {
        "Lk = Tw + Wr": np.asarray(twist) + np.asarray(writhe),
        "twist Tw": twist,
        "writhe Wr": writhe,
    }
    if turns is not None:
        curves["turns applied"] = turns
    dashed = {"linestyle": "--", "color": "tab:red", "linewidth": 1.0}
    styles = [{"color": "black", "linewidth": 1.8}, {}, {}, dashed][: len(curves)]
    missing = _draw(axes, times, curves, styles)
    axes.set_ylabel("turns")
    low, high = axes.get_ylim()
    if high - low < 1e-6:  # rounding
        axes.set_ylim(-0.1 + low, 0.1 + high)
    _finish(axes, times, missing, title, f"time [{units.time}]")
    _mark(axes, marks)
    return figure


def reactions(
    times: Float[Values, " k"],
    forces: Mapping[str, Float[Values, " k"]],
    torques: Mapping[str, Float[Values, " k"]],
    *,
    turns: Float[Values, " k"] | None = None,
    units: Units = SI,
    title: str = "Reactions of the ends",
    figure: Any = None,
) -> "Figure":
    """Forces and torques of the ends against time; with `turns` also torque against rotation.

    Args:
        times: [s].
        forces, torques: components [N; N m] by their names, see `rx.energy.reactions`.
        turns: rotation applied at an end, in turns.
        units: names of the units of the axes.
        title: heading of the figure.
        figure: a figure or part of one to draw in; default: a new one.
    """
    rows = 2 if turns is None else 3
    figure, axes = _curves(rows, 2.0 * rows + 2.0, figure)
    # equal ones must both be seen
    styles = [{"linestyle": "--" if i else "-", "linewidth": 1.4} for i in range(len(torques))]
    time = f"time [{units.time}]"
    missing = _draw(axes[0], times, forces, [{"linewidth": 1.2}] * len(forces))
    _finish(axes[0], times, missing, title, time)
    missing = _draw(axes[1], times, torques, styles)
    _finish(axes[1], times, missing, "", time)
    axes[0].set_ylabel(f"force [{units.force}]")
    axes[1].set_ylabel(f"torque [{units.force} {units.length}]")
    if turns is not None:
        missing = _draw(axes[2], turns, torques, styles)
        axes[2].set_ylabel(f"torque [{units.force} {units.length}]")
        axes[2].set_xlabel("turns applied")
        axes[2].legend(fontsize=9, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure
