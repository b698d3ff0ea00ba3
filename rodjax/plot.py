"""Figures of runs: tubes coloured by strain-energy density, energies, topology, reactions.

matplotlib is imported when a figure is made, not with this module. Figures are returned, neither
shown nor saved; colours and labels can be changed on them as on any other.
"""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Array, Float

from rodjax.rod import Rod
from rodjax.state import State
from rodjax.units import SI, Units

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Values = np.ndarray | Array


class View(NamedTuple):
    """Parallel projection: inertial directions that point right and up on the page.

    The default lays the loading axis e2 along the page with the end s = 0 of a rod placed along
    e2 on the right, and e1 upwards, as in Fig. 7 of Goyal, Perkins & Lee.
    """

    right: tuple[float, float, float] = (0.0, -1.0, 0.0)
    up: tuple[float, float, float] = (1.0, 0.0, 0.0)

    def axes(self) -> np.ndarray:
        """Orthonormal rows: right, up, towards the reader."""
        right = np.asarray(self.right, float)
        right = right / np.linalg.norm(right)
        up = np.asarray(self.up, float)
        up = up - (up @ right) * right
        up = up / np.linalg.norm(up)
        return np.stack([right, up, np.cross(right, up)])


def tube(
    axes: "Axes",
    position: Float[Values, "nodes 3"],
    quaternion: Float[Values, "nodes 4"],
    diameter: Float[Values, " n"],
    values: Float[Values, " n"],
    *,
    colors: Any,
    view: View = View(),  # noqa: B008 (immutable)
    stripe: bool = False,
    sides: int = 20,
) -> None:
    """Draw a rod as a shaded tube in parallel projection.

    Args:
        diameter, values: of the elements; `values` choose the colours.
        colors: a `matplotlib.cm.ScalarMappable` that turns values into colours.
        stripe: draw a black line along the director a_1, so that twist can be seen.
        sides: faces around the tube.
    """
    from matplotlib.collections import PolyCollection

    pieces = max(1, int(np.ceil(800 / len(diameter))))
    center, frames = _refine(np.asarray(position, float), np.asarray(quaternion, float), pieces)
    radius = np.interp(
        np.arange(len(center)) / pieces,
        np.arange(len(diameter)) + 0.5,
        0.5 * np.asarray(diameter, float),
    )
    shade = np.repeat(np.asarray(values, float), pieces)
    page = view.axes()
    angles = 2 * np.pi * (np.arange(sides) + 0.5) / sides
    ring = np.stack([np.cos(angles), np.sin(angles), np.zeros(sides)], -1)
    corners = center[:, None] + radius[:, None, None] * np.einsum("nij,mj->nmi", frames, ring)
    corners = corners @ page.T
    around = np.roll(corners, -1, axis=1)
    quads = np.stack([corners[:-1], around[:-1], around[1:], corners[1:]], 2)  # (n, sides, 4, 3)
    middle = angles + np.pi / sides
    outward = np.stack([np.cos(middle), np.sin(middle), np.zeros(sides)], -1)
    normal = np.einsum("nij,mj->nmi", frames[:-1], outward) @ page.T
    light = np.array([-0.4, 0.7, 0.6]) / np.linalg.norm([-0.4, 0.7, 0.6])
    brightness = 0.65 + 0.35 * np.clip(normal @ light, 0, 1)
    rgb = colors.to_rgba(shade)[:, None, :3] * brightness[..., None]
    if stripe:
        width = 2 * np.pi / sides * max(1, sides // 8)
        rgb[:, np.cos(middle) > np.cos(width)] = 0.0
    visible = normal[..., 2] > -0.1
    faces, rgb = quads[visible], rgb[visible]
    order = np.argsort(faces[..., 2].mean(1))  # painter's order, the nearest last
    faces, rgb = faces[order, :, :2], rgb[order]
    axes.add_collection(PolyCollection(list(faces), facecolors=rgb, edgecolors=rgb, linewidths=0.3))
    axes.set_aspect("equal")


def _refine(position, quaternion, pieces):
    """Smooth points and frames between the nodes: cubic along the tangents, shortest rotation."""
    q0 = quaternion[:-1]
    cosine = np.sum(q0 * quaternion[1:], 1, keepdims=True)
    q1 = np.where(cosine < 0, -quaternion[1:], quaternion[1:])
    u = (np.arange(pieces) / pieces)[None, :, None]
    angle = np.arccos(np.clip(np.abs(cosine), 0, 1))[:, :, None]
    # nearly equal frames: the straight line between them is exact enough
    near = angle < 1e-4
    sine = np.sin(np.where(near, 1.0, angle))
    weight0 = np.where(near, 1 - u, np.sin((1 - u) * np.where(near, 1.0, angle)) / sine)
    weight1 = np.where(near, u, np.sin(u * np.where(near, 1.0, angle)) / sine)
    between = weight0 * q0[:, None] + weight1 * q1[:, None]
    between = np.concatenate([between.reshape(-1, 4), quaternion[-1:]])
    frames = _matrices(between / np.linalg.norm(between, axis=1, keepdims=True))
    tangents = _matrices(quaternion)[:, :, 2]
    edge = position[1:] - position[:-1]
    length = np.linalg.norm(edge, axis=1)[:, None]
    a, b = length * tangents[:-1] - edge, edge - length * tangents[1:]
    line = position[:-1, None] + u * edge[:, None]
    cubic = line + u * (1 - u) * ((1 - u) * a[:, None] + u * b[:, None])
    return np.concatenate([cubic.reshape(-1, 3), position[-1:]]), frames


def _matrices(q):
    w, x, y, z = q.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), -1, 0)


def snapshots(
    rod: Rod,
    states: Sequence[State],
    densities: Sequence[Float[Values, " n"]],
    *,
    magnify: float = 1.0,
    stripe_first: bool = True,
    view: View = View(),  # noqa: B008 (immutable)
    units: Units = SI,
    title: str = "",
) -> "Figure":
    """One row a state, to one scale, coloured by strain-energy density (Fig. 7 of the paper).

    Shapes that are taller than wide stand side by side instead.

    Args:
        states: states to draw, in order.
        densities: strain-energy density of the elements of each, Eq. (4) [N].
        magnify: how much thicker than they are the tubes are drawn; the title says so.
        stripe_first: draw the twist stripe on the first.
    """
    from matplotlib import colormaps
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import ListedColormap, LogNorm
    from matplotlib.figure import Figure

    if rod.diameter is None:
        raise ValueError("diameter: tubes need the rod's diameter; give it to the rod's section")
    diameter = magnify * np.asarray(rod.diameter)
    page = view.axes()
    flat = [np.asarray(state.position) @ page.T for state in states]
    margin = 0.75 * diameter.max() + 0.01 * float(np.sum(np.asarray(rod.length)))
    left = min(points[:, 0].min() for points in flat) - margin
    right = max(points[:, 0].max() for points in flat) + margin
    least = 0.06 * (right - left)  # so that a straight rod has a row too
    low = [min(points[:, 1].min() - margin, -least) for points in flat]
    high = [max(points[:, 1].max() + margin, least) for points in flat]
    heights = [b - a for a, b in zip(low, high, strict=True)]
    top = max(float(np.max(density)) for density in densities)
    bottom = max(min(float(np.min(density)) for density in densities), 1e-3 * top)
    bottom = min(bottom, 0.3 * top)
    bright = ListedColormap(colormaps["turbo"](np.linspace(0.1, 0.92, 256)))
    colors = ScalarMappable(LogNorm(bottom, top), bright)  # so that a black stripe shows
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
    for index, (axes, state, density) in enumerate(zip(rows, states, densities, strict=True)):
        tube(
            axes,
            np.asarray(state.position),
            np.asarray(state.quaternion),
            diameter,
            np.clip(np.asarray(density), colors.norm.vmin, None),
            colors=colors,
            view=view,
            stripe=stripe_first and index == 0,
        )
        axes.set(xlim=(left, right), ylim=(low[index], high[index]))
        axes.set_title(f"t = {float(state.time):.4g} {units.time}", loc="left", fontsize=10)
        axes.spines[["top", "right"]].set_visible(False)
        axes.tick_params(labelsize=8)
        axes.locator_params(axis="y", nbins=max(2, int(12 * heights[index] / (right - left)) + 1))
    figure.supxlabel(f"along the page [{units.length}]; the end s = 0 is on the right", fontsize=10)
    figure.supylabel(f"up the page [{units.length}]", fontsize=10)
    bar = figure.colorbar(colors, ax=list(rows), fraction=0.03, pad=0.01)
    bar.set_label(f"strain energy density [{units.energy}/{units.length}]")
    thick = "" if magnify == 1 else f"tubes drawn {magnify:g} times as thick as they are"
    figure.suptitle("; ".join(part for part in (title, thick) if part), fontsize=11)
    return figure


def _curves(rows: int = 1, height: float = 4.5):
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, height), layout="constrained")
    axes = figure.subplots(rows, 1, squeeze=False)[:, 0]
    for row in axes:
        row.grid(alpha=0.3)
    return figure, axes


def _legend(axes):
    axes.legend(fontsize=9, loc="center left", bbox_to_anchor=(1.0, 0.5))


def _mark(axes, marks: Mapping[str, float] | None):
    """Thin vertical lines, each with its name written along it, haloed against curves."""
    from matplotlib.patheffects import withStroke

    for name, time in (marks or {}).items():
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
) -> "Figure":
    """Energies and works against time (Fig. 8); `marks` are named times to point out.

    Works are dashed, totals heavy, by their names.
    """
    figure, (axes,) = _curves()
    for name, values in parts.items():
        style = {"color": "black", "linestyle": "--"} if "work" in name else {}
        axes.plot(times, values, label=name, linewidth=2.2 if "total" in name else 1.4, **style)
    axes.set_title(title, fontsize=11)
    axes.set_xlabel(f"time [{units.time}]")
    axes.set_ylabel(f"energy [{units.energy}]")
    axes.set_xlim(float(times[0]), float(times[-1]))
    _mark(axes, marks)
    _legend(axes)
    return figure


def topology(
    times: Float[Values, " k"],
    twist: Float[Values, " k"],
    writhe: Float[Values, " k"],
    turns: Float[Values, " k"],
    *,
    marks: Mapping[str, float] | None = None,
    units: Units = SI,
    title: str = "Conversion of twist to writhe",
) -> "Figure":
    """Tw, Wr and their sum Lk against time, with the turns applied at the end (Fig. 9)."""
    figure, (axes,) = _curves()
    axes.set_title(title, fontsize=11)
    axes.set_xlabel(f"time [{units.time}]")
    linking = np.asarray(twist) + np.asarray(writhe)
    axes.plot(times, linking, color="black", linewidth=1.8, label="Lk = Tw + Wr")
    axes.plot(times, twist, label="twist Tw")
    axes.plot(times, writhe, label="writhe Wr")
    axes.plot(times, turns, "--", color="tab:red", linewidth=1.0, label="turns applied")
    axes.set_ylabel("turns")
    axes.set_xlim(float(times[0]), float(times[-1]))
    _mark(axes, marks)
    _legend(axes)
    return figure


def reactions(
    times: Float[Values, " k"],
    forces: Mapping[str, Float[Values, " k"]],
    torques: Mapping[str, Float[Values, " k"]],
    *,
    turns: Float[Values, " k"] | None = None,
    units: Units = SI,
    title: str = "Reactions of the ends",
) -> "Figure":
    """Forces and torques of the ends against time; with `turns` also torque against rotation."""
    figure, axes = _curves(rows=2 if turns is None else 3, height=6 if turns is None else 8)
    axes[0].set_title(title, fontsize=11)
    for name, values in forces.items():
        axes[0].plot(times, values, label=name, linewidth=1.2)
    for index, (name, values) in enumerate(torques.items()):  # equal ones must both be seen
        axes[1].plot(times, values, "--" if index else "-", label=name, linewidth=1.4)
    for row in axes[:2]:
        row.set_xlabel(f"time [{units.time}]")
        row.set_xlim(float(times[0]), float(times[-1]))
    axes[0].set_ylabel(f"force [{units.force}]")
    axes[1].set_ylabel(f"torque [{units.force} {units.length}]")
    if turns is not None:
        for index, (name, values) in enumerate(torques.items()):
            axes[2].plot(turns, values, "--" if index else "-", label=name, linewidth=1.4)
        axes[2].set_xlabel("turns applied")
        axes[2].set_ylabel(f"torque [{units.force} {units.length}]")
    for row in axes:
        _legend(row)
    return figure
