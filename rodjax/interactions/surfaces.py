"""Grids of points on the surfaces of obstacles, for pictures."""

import itertools

import numpy as np
from jaxtyping import Float, Int

Points = Float[np.ndarray, "i j 3"]


def across(axis: Float[np.ndarray, "3"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A unit vector along the axis and two across it, each along a coordinate as far as can be."""
    along = axis / np.linalg.norm(axis)
    first = np.eye(3)[int(np.argmin(np.abs(along)))]
    first = first - np.sum(first * along) * along
    first = first / np.linalg.norm(first)
    return along, first, np.cross(along, first)


def grid(
    low: Float[np.ndarray, "2"], high: Float[np.ndarray, "2"], count: int
) -> Float[np.ndarray, "i j 2"]:
    """So many points a side, evenly spread over a rectangle."""
    return np.stack(np.meshgrid(*np.linspace(low, high, count).T, indexing="ij"), -1)


def plane(point, normal, low: Float[np.ndarray, "3"], high: Float[np.ndarray, "3"]) -> Points:
    """The square of a plane that is below a box, wider by a third."""
    along, first, second = across(normal)
    middle = 0.5 * (low + high)
    middle = middle - np.sum((middle - point) * along) * along
    half = 0.65 * np.linalg.norm(high - low)
    at = grid(np.full(2, -half), np.full(2, half), 17)
    return middle + at[..., :1] * first + at[..., 1:] * second


def sphere(centre, radius: float) -> Points:
    """Parallels and meridians of a sphere."""
    polar, turn = np.meshgrid(
        np.linspace(0, np.pi, 25), np.linspace(0, 2 * np.pi, 49), indexing="ij"
    )
    x, y = np.sin(polar) * np.cos(turn), np.sin(polar) * np.sin(turn)
    return centre + radius * np.stack([x, y, np.cos(polar)], -1)


def cylinder(
    point, axis, radius: float, low: Float[np.ndarray, "3"], high: Float[np.ndarray, "3"]
) -> Points:
    """As much of an endless cylinder as stands beside a box, longer by a quarter."""
    along, first, second = across(axis)
    corners = np.stack(np.meshgrid(*np.stack([low, high], -1), indexing="ij"), -1).reshape(-1, 3)
    reach = (corners - point) @ along
    more = 0.125 * np.ptp(reach) + 0.25 * radius
    s = np.linspace(np.min(reach) - more, np.max(reach) + more, 9)[:, None, None]
    turn = np.linspace(0, 2 * np.pi, 49)[None, :, None]
    return point + s * along + radius * (np.cos(turn) * first + np.sin(turn) * second)


def net(
    distances: Float[np.ndarray, "c c c"], low: Float[np.ndarray, "3"], high: Float[np.ndarray, "3"]
) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "q 4"]]:
    """Points near the surface where distances on a grid change their sign, and its quadrangles.

    One point in each cell that the surface passes, the mean of where it crosses the cell's edges
    (Gibson's surface nets).

    Args:
        distances: at equally spaced points of a box.
        low, high: its corners.
    """
    count, inside = distances.shape[0], distances < 0
    corners = np.array(list(itertools.product((0, 1), repeat=3)))
    cells = np.stack(np.meshgrid(*[np.arange(count - 1)] * 3, indexing="ij"), -1).reshape(-1, 3)
    within = np.sum([inside[tuple((cells + corner).T)] for corner in corners], 0)
    cells = cells[(within > 0) & (within < 8)]
    total, crossings = np.zeros(cells.shape), np.zeros(len(cells))
    for first, second in itertools.combinations(corners, 2):
        if np.sum(second - first) != 1 or np.any(second < first):  # no edge
            continue
        a, b = distances[tuple((cells + first).T)], distances[tuple((cells + second).T)]
        crossed = (a < 0) != (b < 0)
        part = np.where(crossed, a / np.where(crossed, a - b, 1.0), 0.0)[:, None]
        total += crossed[:, None] * (cells + first + part * (second - first))
        crossings += crossed
    number = np.full([count - 1] * 3, -1)
    number[tuple(cells.T)] = np.arange(len(cells))
    quads = []
    for axis in range(3):
        along, *others = np.roll(np.eye(3, dtype=int), -axis, 0)
        # edges along the axis that four cells have in common
        edges = np.stack(np.meshgrid(*[np.arange(1, count - 1)] * 3, indexing="ij"), -1)
        edges = edges.reshape(-1, 3)
        edges[:, axis] -= 1
        edges = edges[inside[tuple(edges.T)] != inside[tuple((edges + along).T)]]
        around = [0 * along, others[0], others[0] + others[1], others[1]]
        quads.append(np.stack([number[tuple((edges - step).T)] for step in around], 1))
    vertices = low + (high - low) * total / crossings[:, None] / (count - 1)
    return vertices, np.concatenate(quads)
