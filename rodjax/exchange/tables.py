"""Runs as tables of comma-separated values."""

import os
from pathlib import Path
from typing import Any

import numpy as np

from rodjax.exchange.node_columns import columns_of, part_of_nodes
from rodjax.inputs.units import Units
from rodjax.inputs.validation import check_flag
from rodjax.viewing.shown import shown_of


def to_csv(
    scene: Any,
    run: Any,
    path: str | os.PathLike,
    *,
    measures: bool = True,
    units: Units | None = None,
) -> Path:
    """Write the states of a run as one table, a row for every node at every saved time.

    Columns are time, rod (from 0, bodies behind the rods), node (from 0 in its rod), the rest arc
    length s, the position x, y, z, the velocity vx, vy, vz, and the measures that `view` colours
    by. Each says its unit in brackets, as in "curvature [rad/m]". Measures of elements stand at the
    nodes as the mean of the elements beside; cells of what there is none are empty.

    Args:
        scene: of the run, which does not keep it; or a path, or what `storage.load` gave.
        run: a `Run`, one `State`, or a sequence of states; None where the scene's file has it.
        path: of the file, whose folder is made.
        measures: False leaves them out.
        units: names of the units; default those of the file, else SI.

    Returns:
        The path of the file.

    Raises:
        ValueError: the run is not of this scene, or the path names no file for a table.

    Example:
        >>> path = rx.to_csv(scene, run, "run.csv")
        >>> len(path.read_text().splitlines())  # a heading, 11 times, 21 nodes
        232
    """
    check_flag(measures=measures)
    path = Path(path)
    if path.suffix.lower() not in (".csv", ".txt"):
        raise ValueError(f"path: name a file that ends in .csv, got {str(path)!r}")
    shown = shown_of(scene, run, units)
    rod, states, u = shown.scene.rod, shown.states, shown.units
    count, nodes, which = len(states.time), rod.elements + 1, part_of_nodes(rod)
    own = np.arange(nodes) - np.array([part.first for part in rod.parts])[which]
    whole = lambda per_node: np.tile(np.asarray(per_node, float), count)
    table = {
        f"time [{u.time}]": np.repeat(np.asarray(states.time, float), nodes),
        "rod": whole(which),
        "node": whole(own),
        f"s [{u.length}]": whole(rod.arc_length),
    }
    flat = np.asarray(states.position, float).reshape(-1, 3)
    table |= {f"{axis} [{u.length}]": flat[:, i] for i, axis in enumerate("xyz")}
    velocity, *others = columns_of(shown, measures)
    flat = velocity.values.reshape(-1, 3)
    table |= {f"v{axis} [{velocity.unit}]": flat[:, i] for i, axis in enumerate("xyz")}
    table |= {one.label: one.values.ravel() for one in others}
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", encoding="utf-8", newline="") as file:
        file.write(",".join(table) + "\n")
        for row in zip(*(column.tolist() for column in table.values()), strict=True):
            file.write(",".join(map(_cell, row)) + "\n")
    return path


def _cell(value: float) -> str:
    """The shortest text that is read as the same number; none of what is no number."""
    if value != value:
        return ""
    return str(int(value)) if value.is_integer() and abs(value) < 1e15 else repr(value)
