"""Rods drawn as shaded tubes in parallel projection, and the views they are seen in."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Array, Float

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Values = np.ndarray | Array


class View(NamedTuple):
    """Parallel projection: inertial directions that point right and up on the page.

    The defaults are those of Fig. 7 of Goyal, Perkins & Lee: the loading axis e2 along the page,
    with the end s = 0 of a rod placed along e2 on the right, and e1 upwards. `facing` finds a view
    for rods placed in any other way.

    Attributes:
        right: inertial direction that points right; need not be a unit vector.
        up: inertial direction that points up, as far as it is across `right`.
    """

    right: tuple[float, float, float] = (0.0, -1.0, 0.0)
    up: tuple[float, float, float] = (1.0, 0.0, 0.0)

    def axes(self) -> np.ndarray:
        """Orthonormal rows: right, up, towards the reader."""
        right, up = np.asarray(self.right, float), np.asarray(self.up, float)
        area = np.linalg.norm(np.cross(right, up)) if right.shape == up.shape == (3,) else 0.0
        if not area > 1e-9 * np.linalg.norm(right) * np.linalg.norm(up):
            raise ValueError(
                "right, up: give two directions (x, y, z) that are not along each other, got"
                f" {self.right} and {self.up}"
            )
        right = right / np.linalg.norm(right)
        up = up - (up @ right) * right
        up = up / np.linalg.norm(up)
        return np.stack([right, up, np.cross(right, up)])


# where two directions across a rod are about as wide, the one first here points up
_UPWARDS = {0: (2, 1), 1: (0, 2), 2: (0, 1)}


def facing(positions: Sequence[Float[Values, "nodes 3"]]) -> View:
    """The view along an inertial axis that shows most of a rod's shapes, given as nodes' positions.

    The axis along which they extend farthest lies along the page, the end s = 0 of the first shape
    on the right; the wider of the other two points up, and of equals e1, for a rod along e1
    gravity's e3. Shapes that are not finite are left out.
    """
    shapes = [np.asarray(position, float) for position in positions]
    shapes = [shape for shape in shapes if np.all(np.isfinite(shape))]
    if not shapes:
        return View()
    extent = np.max([np.ptp(shape, 0) for shape in shapes], 0)
    along = int(np.argmax(extent))
    one, other = _UPWARDS[along]
    above = one if extent[one] >= 0.7 * extent[other] else other
    towards_start = -1.0 if shapes[0][-1, along] > shapes[0][0, along] else 1.0
    unit = np.eye(3)
    return View(tuple(towards_start * unit[along]), tuple(unit[above]))


def direction(row: np.ndarray) -> str:
    """What runs along an axis of the page: the inertial coordinate, or a mixture."""
    k = int(np.argmax(np.abs(row)))
    if abs(row[k]) < 1 - 1e-9:
        return "along the page"
    return f"{'-' if row[k] < 0 else ''}e{k + 1}"


def tube(
    axes: "Axes",
    position: Float[Values, "nodes 3"],
    quaternion: Float[Values, "nodes 4"],
    diameter: Float[Values, " n"],
    values: Float[Values, " n"],
    *,
    colors: Any,
    view: View | None = None,
    stripe: bool | float = False,
    sides: int = 20,
    breaks: tuple[int, ...] = (),
) -> None:
    """Draw a rod, or several, as shaded tubes in parallel projection.

    Args:
        diameter, values: of the elements [m; any]; `values` choose the colours.
        axes: where it is drawn; its limits are the caller's.
        position, quaternion: of the nodes, as in a `State`.
        colors: a `matplotlib.cm.ScalarMappable` that turns values into colours.
        view: default: `facing` this shape.
        stripe: draw a black line along the director a_1, so that twist can be seen; a number is
            half its width, as the angle around the tube [rad].
        sides: faces around the tube.
        breaks: elements that are none, between rods (`Rod.breaks`).
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
    page = (facing([position]) if view is None else view).axes()
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
        wide = max(1, sides // 8) if stripe is True else max(1, round(stripe * sides / (2 * np.pi)))
        width = 2 * np.pi / sides * wide
        rgb[:, np.cos(middle) > np.cos(width)] = 0.0
    visible = normal[..., 2] > -0.1
    for element in breaks:
        visible[element * pieces : (element + 1) * pieces] = False
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
    frames = matrices(between / np.linalg.norm(between, axis=1, keepdims=True))
    tangents = matrices(quaternion)[:, :, 2]
    edge = position[1:] - position[:-1]
    length = np.linalg.norm(edge, axis=1)[:, None]
    a, b = length * tangents[:-1] - edge, edge - length * tangents[1:]
    line = position[:-1, None] + u * edge[:, None]
    cubic = line + u * (1 - u) * ((1 - u) * a[:, None] + u * b[:, None])
    return np.concatenate([cubic.reshape(-1, 3), position[-1:]]), frames


def matrices(quaternion: Float[np.ndarray, "*k 4"]) -> Float[np.ndarray, "*k 3 3"]:
    """Rotation matrices of unit quaternions, their columns a_1, a_2, a_3."""
    w, x, y, z = np.moveaxis(quaternion, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))
