"""Runs as meshes over time that ParaView, VisIt and VTK read: PolyData in XML."""

import base64
import os
from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from rodjax.exchange.node_columns import Column, at_nodes, columns_of, frames_of, part_of_nodes
from rodjax.inputs.units import Units
from rodjax.inputs.validation import check_flag
from rodjax.rods.rod import Rod
from rodjax.viewing.shown import shown_of

# names of numbers in these files
_KINDS = {"f": ("Float64", "<f8"), "i": ("Int64", "<i8")}


def to_paraview(
    scene: Any,
    run: Any,
    path: str | os.PathLike,
    *,
    measures: bool = True,
    units: Units | None = None,
) -> Path:
    """Write a run for ParaView: a mesh of polylines for every saved state, and their times.

    Every rod is one polyline, every body by itself a vertex. At the points there are the velocity,
    the frame a1, a2, a3, the radius, the rest arc length, which rod it is, and the measures that
    `view` colours by; names say the unit, as "tension [N]". Measures of elements stand at the nodes
    as the mean of the elements beside. In ParaView the filter Tube, varying the radius by "radius",
    gives rods their thickness. States that are no numbers are left out.

    Args:
        scene: of the run, which does not keep it; or a path, or what `storage.load` gave.
        run: a `Run`, one `State`, or a sequence of states; None where the scene's file has it.
        path: of the collection, which ends in .pvd; or a folder, in which it is named run.pvd.
        measures: False leaves them out.
        units: names of the units; default those of the file, else SI.

    Returns:
        The path of the collection.

    Raises:
        ValueError: the run is not of this scene, or none of its states is of numbers.

    Example:
        >>> path = rx.to_paraview(scene, run, "run.pvd")  # open this one; the meshes are in run/
        >>> len(list(path.parent.glob("run/*.vtp")))
        11
    """
    check_flag(measures=measures)
    shown = shown_of(scene, run, units)
    path = Path(path)
    if path.suffix.lower() != ".pvd":
        if path.suffix:
            raise ValueError(f"path: name a file that ends in .pvd, or a folder; got {str(path)!r}")
        path = path / "run.pvd"
    position = np.asarray(shown.states.position, float)
    known = shown.known
    if not len(known):
        raise ValueError(f"run: none of its {len(position)} states is of numbers to be written")
    columns = _still(shown.scene.rod, len(position), shown.units)
    columns += [*frames_of(shown), *columns_of(shown, measures)]
    times, cells = np.asarray(shown.states.time, float), _cells(shown.scene.rod)
    folder = path.with_suffix("")
    folder.mkdir(parents=True, exist_ok=True)
    collection = Element("VTKFile", type="Collection", version="1.0", byte_order="LittleEndian")
    sets = SubElement(collection, "Collection")
    for number, row in enumerate(known):
        name = f"{folder.name}_{number:05d}.vtp"
        at_points = [(column.label, column.values[row]) for column in columns]
        _write(_mesh(position[row], cells, at_points, float(times[row])), folder / name)
        of_time = {"timestep": repr(float(times[row])), "group": "", "part": "0"}
        SubElement(sets, "DataSet", of_time, file=f"{folder.name}/{name}")
    _write(collection, path)
    return path


def _still(rod: Rod, count: int, units: Units) -> list[Column]:
    """What does not change: where a node is along which of the rods, and how thick that is."""
    always = lambda values: np.broadcast_to(np.asarray(values), (count, rod.elements + 1))
    found = [
        Column("s", units.length, always(rod.arc_length)),
        Column("rod", "", always(part_of_nodes(rod))),
    ]
    if rod.diameter is not None:
        radius = np.nan_to_num(at_nodes(rod, 0.5 * np.asarray(rod.diameter, float)[None]))
        found.append(Column("radius", units.length, always(radius[0])))
    return found


def _cells(rod: Rod) -> dict[str, list[range]]:
    """The nodes of the lines, and of the vertices."""
    lines = [range(part.first, part.last + 1) for part in rod.strands]
    return {"Verts": [range(node, node + 1) for node in rod.bodies], "Lines": lines}


def _mesh(points, cells, at_points, time: float) -> Element:
    """One state."""
    file = Element("VTKFile", type="PolyData", version="1.0", byte_order="LittleEndian")
    file.set("header_type", "UInt64")
    data = SubElement(file, "PolyData")
    moment = SubElement(data, "FieldData")
    _put(moment, "TimeValue", np.array([time]))
    moment[0].set("NumberOfTuples", "1")
    sizes = {f"NumberOf{kind}": str(len(own)) for kind, own in cells.items()}
    piece = SubElement(data, "Piece", {"NumberOfPoints": str(len(points))} | sizes)
    at = SubElement(piece, "PointData")
    for name, values in at_points:
        _put(at, name, values)
    _put(SubElement(piece, "Points"), "Points", points)
    for kind, own in cells.items():
        element = SubElement(piece, kind)
        _put(element, "connectivity", np.array([node for cell in own for node in cell], int))
        _put(element, "offsets", np.cumsum([len(cell) for cell in own]).astype(int))
    return file


def _put(parent: Element, name: str, values: np.ndarray) -> None:
    SubElement(parent, "DataArray", _array(name, values)).text = _packed(values)


def _array(name: str, values: np.ndarray) -> dict[str, str]:
    """What is said of an array: its name, numbers and components."""
    kind, _ = _KINDS[values.dtype.kind]
    components = str(values.shape[1] if values.ndim == 2 else 1)
    return {"type": kind, "Name": name, "NumberOfComponents": components, "format": "binary"}


def _packed(values: np.ndarray) -> str:
    """Its count of bytes and these, as text."""
    content = np.ascontiguousarray(values, _KINDS[values.dtype.kind][1]).tobytes()
    return base64.b64encode(np.uint64(len(content)).astype("<u8").tobytes() + content).decode()


def _write(root: Element, path: Path) -> None:
    ElementTree.indent(root)
    ElementTree.ElementTree(root).write(path, encoding="utf-8", xml_declaration=True)
