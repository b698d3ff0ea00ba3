"""What a rod is held by and runs into, as a page draws it."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from rodjax.interactions import surfaces
from rodjax.interactions.shapes import AbstractShape
from rodjax.scenes.holds import Held
from rodjax.scenes.scene import Scene
from rodjax.viewing.packing import as_text

# Points a side of the grid on which surfaces are looked for, and how far what is found may be moved
# onto the surface then, over the side of the grid.
_GRID = 48
_NEAR = np.array([-1.0, 1.0]) / _GRID


def holds(scene: Scene) -> list[dict[str, Any]]:
    """Nodes that are held, and how from when on: as a ball, a plate, or a plate on a rail."""
    return [
        {
            "node": int(held.node) % (scene.rod.elements + 1),
            "name": held.name,
            "spans": _spans(held),
        }
        for held in scene.holds
        if not held.end.nothing
    ]


def _spans(held: Held) -> list[dict[str, Any]]:
    times = [None, *sorted(float(t) for t in held.end.switch_times)]
    return [{"after": time, **_kind(held, time)} for time in times]


def _kind(held: Held, time: float | None) -> dict[str, Any]:
    # the first long before any change
    directions = np.asarray(held.end.projector(jnp.asarray(-1e30 if time is None else time)))
    places, turns = directions[:3, :3], directions[3:, 3:]
    held_places, held_turns = round(float(np.trace(places))), round(float(np.trace(turns)))
    if not held_places and not held_turns:
        return {"kind": None, "axis": None}
    axis = None
    if held_places == 2:  # along what it may slide
        axis = np.linalg.eigh(places)[1][:, 0].tolist()
    return {"kind": "plate" if held_turns else "ball", "axis": axis}


def lumps(scene: Scene) -> list[dict[str, Any]]:
    """Bodies, by themselves or fixed to nodes: where they are, in the frames of their nodes.

    One with moments of inertia is drawn as the box of uniform density that has them, another as the
    ball that displaces its volume, or as a mark.
    """
    found = []
    for lump in scene.rod.lumps:
        offset = np.zeros(3) if lump.offset is None else np.asarray(lump.offset, float)
        volume = 0.0 if lump.volume is None else float(lump.volume)
        radius = float(np.cbrt(3 * volume / (4 * np.pi))) or None
        halves = axes = None
        if lump.inertia is not None:
            halves, axes = box_of(float(lump.mass), np.asarray(lump.inertia, float))
        node = lump.place(scene.rod.parts)
        shape = {"radius": radius, "halves": halves, "axes": axes}
        found.append({"node": node, "offset": offset.tolist(), **shape})
    return found


def box_of(mass: float, inertia: Float[np.ndarray, "..."]) -> tuple[list[float], list[list[float]]]:
    """Half sides and axes (rows) of the uniform box of a mass and of moments of inertia."""
    moments, axes = inertia, np.eye(3)
    if inertia.ndim == 2:
        moments, columns = np.linalg.eigh(inertia)
        axes = columns.T
    squares = 6 / mass * (np.sum(moments) - 2 * moments)
    # of a flat body some thickness, to be seen
    sides = np.sqrt(np.maximum(squares, 1e-3 * np.max(np.abs(squares))))
    return (0.5 * sides).tolist(), axes.tolist()


def obstacles(
    scene: Scene,
    times: Float[np.ndarray, " k"],
    low: Float[np.ndarray, "3"],
    high: Float[np.ndarray, "3"],
    origin: Float[np.ndarray, "3"],
) -> tuple[list[dict[str, Any]], list[str]]:
    """Surfaces of the scene's obstacles and how they are moved; what of them is not to be seen.

    Args:
        times: of the frames [s].
        low, high: corners of the box in which the rods are [m].
        origin: from which places in the page are measured [m].
    """
    drawn, unseen = [], []
    for index, load in enumerate(scene.loads):
        shape: Any = getattr(load, "shape", None)
        if not hasattr(shape, "patches"):
            continue
        patches, found = shape.patches(low, high), None
        if not patches:
            found = _found(shape, 1.5 * low - 0.5 * high, 1.5 * high - 0.5 * low, origin)
            if found is None:
                unseen.append(f"loads[{index}], a {type(shape).__name__}, is not in the picture")
                continue
        shift, moved = None, getattr(load, "displacement", None)
        if moved is not None:
            shift = as_text(np.asarray(jax.vmap(moved)(jnp.asarray(times))), "<f4")
        drawn.append(
            {
                "patches": [
                    {
                        "rows": points.shape[0],
                        "columns": points.shape[1],
                        "points": as_text(points - origin, "<f4"),
                    }
                    for points in patches
                ],
                "name": f"loads[{index}]",
                "mesh": found,
                "shift": shift,
                "inside": bool(getattr(shape, "inside", False)),
            }
        )
    return drawn, unseen


def _found(shape: AbstractShape, low, high, origin) -> dict[str, str] | None:
    """The surface of a shape within a box by its signed distance; None if it is not there."""
    places = np.stack(np.meshgrid(*np.linspace(low, high, _GRID).T, indexing="ij"), -1)
    distances = np.asarray(jax.vmap(shape.distance)(jnp.asarray(places.reshape(-1, 3))))
    if not np.any(distances < 0) or not np.any(distances > 0):
        return None
    points, quads = surfaces.net(distances.reshape([_GRID] * 3), low, high)
    for _ in range(3):  # onto the surface
        away, normal = jax.vmap(shape.distance_and_normal)(jnp.asarray(points))
        normal = np.asarray(normal)
        normal = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
        points = points - np.clip(np.asarray(away)[:, None], *_NEAR * (high - low).max()) * normal
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    vertices = np.concatenate([points - origin, normal], 1)
    return {"vertices": as_text(vertices, "<f4"), "faces": as_text(faces, "<u4")}
