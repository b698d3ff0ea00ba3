"""Files of sweeps: results with their names, units and dimensions, and with what made them."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

import equinox as eqx
import numpy as np

from rodjax.files.plain_trees import Node, read_images, write_array, write_names
from rodjax.files.sealed_files import StorageError, replacing

FORMAT = "rodjax sweep"
FORMAT_VERSION = 2

Units = Mapping[str, str]
Dimensions = Mapping[str, Sequence[str]]


class StoredSweep(eqx.Module):
    """What the file of a sweep holds; arrays have the sets along the leading axis."""

    parameters: dict[str, np.ndarray]
    results: dict[str, np.ndarray]
    done: np.ndarray  # which sets have results; those of the others are zero
    units: dict[str, str] = eqx.field(static=True)  # by name of parameter or result
    dimensions: dict[str, tuple[str, ...]] = eqx.field(static=True)  # names of a result's axes
    made_by: dict[str, str] = eqx.field(static=True)  # versions, fingerprint of the function
    traced_as: tuple[str, ...] = eqx.field(static=True)  # types that the function saw


def read(path: str | Path) -> StoredSweep:
    """The results of a sweep without the function that made them, finished or not.

    Raises:
        StorageError: not the file of a sweep, or a damaged one.
        FileNotFoundError: there is no such file.
    """
    file = read_images(path)[0][0]
    if file.attributes.get("format") != FORMAT:
        raise StorageError(f"path: {path} is no sweep that says what made it; give another path")
    found = file.attribute("format_version", int, "format")
    if not 2 <= found <= FORMAT_VERSION:
        raise StorageError(f"path: {path} has format {found}, this rodjax reads {FORMAT_VERSION}")
    groups = {name: file.child(name, name) for name in ("parameters", "results")}
    arrays = {
        part: {name: _array(group, name, part) for name in group.names("NAMES", part)}
        for part, group in groups.items()
    }
    nodes = {**groups["parameters"].children, **groups["results"].children}
    stored = StoredSweep(
        **arrays,
        done=_array(file, "done", "done"),
        units={
            k: n.attribute("units", str, k) for k, n in nodes.items() if "units" in n.attributes
        },
        dimensions={
            k: tuple(n.names("DIMENSIONS", k))
            for k, n in groups["results"].children.items()
            if n.has("DIMENSIONS")
        },
        made_by={name: file.attribute(name, str, name) for name in ("rodjax", "jax", "function")},
        traced_as=tuple(groups["parameters"].names("TRACED_AS", "parameters")),
    )
    leading = {value.shape[:1] for part in arrays.values() for value in part.values()}
    if stored.done.dtype != bool or leading != {stored.done.shape}:
        raise StorageError(f"path: {path}: its arrays do not have one set each")
    return stored


def _array(group: Node, name: str, place: str) -> np.ndarray:
    value = group.child(name, f"{place}/{name}").array
    if not isinstance(value, np.ndarray):
        raise StorageError(f"{place}/{name}: is not an array")
    return value


def check_labels(
    parameters: Sequence[str],
    axes: Mapping[str, int],
    units: Units | None,
    dimensions: Dimensions | None,
) -> None:
    """Raise ValueError unless units and dimensions are of arrays that exist.

    Args:
        axes: number of axes of each result of one set.
    """
    known = [*parameters, *axes]
    for name, unit in (units or {}).items():
        if name not in known or not isinstance(unit, str):
            raise ValueError(f"units: '{name}' is none of {', '.join(known)}, or its unit no text")
    for name, names in (dimensions or {}).items():
        if isinstance(names, str) or axes.get(name) != len(names):
            raise ValueError(
                f"dimensions: give for the result '{name}' a name an axis,"
                f" {axes.get(name, 'but there is no such result')}; got {names!r}"
            )


@dataclasses.dataclass
class SweepFile:
    """A sweep on its way: what it is, what is done, and the file that keeps it."""

    path: Path
    made_by: dict[str, str]
    title: str  # the function's name, for readers of the file
    parameters: dict[str, np.ndarray]
    traced_as: tuple[str, ...]
    results: dict[str, np.ndarray]
    done: np.ndarray
    units: dict[str, str]
    dimensions: dict[str, tuple[str, ...]]
    stamp: tuple[int, ...] | None = None  # of the file as last read or written here

    def continue_from_disk(self) -> None:
        """Take what the file has and this sweep has not; None where there is no file.

        Raises:
            StorageError: the file holds another sweep.
        """
        stamp = self._stamp()
        if stamp is None or stamp == self.stamp:
            return
        stored = read(self.path)
        differences = self._differences(stored)
        if differences:
            raise StorageError(
                f"path: {self.path} holds another sweep: {'; '.join(differences)}. Give another"
                " path, or delete the file (rodjax.sweep.read shows its results)"
            )
        new = stored.done & ~self.done
        for name, values in self.results.items():
            values[new] = stored.results[name][new]
        self.done |= new
        # labels that the call leaves out are kept
        self.units = {**stored.units, **self.units}
        self.dimensions = {**stored.dimensions, **self.dimensions}
        self.stamp = stamp

    def write(self) -> None:
        """Replace the file by one with all that is done, here and meanwhile by another process."""
        self.continue_from_disk()
        with replacing(self.path) as file:
            file.attrs.update(format=FORMAT, format_version=FORMAT_VERSION, **self.made_by)
            file.attrs["function_name"] = self.title
            for part, arrays in (("parameters", self.parameters), ("results", self.results)):
                group = file.create_group(part)
                write_names(group.attrs, "NAMES", arrays)
                for name, value in arrays.items():
                    self._write(write_array(group, name, value), name)
            write_names(file["parameters"].attrs, "TRACED_AS", self.traced_as)
            write_array(file, "done", self.done)
        self.stamp = self._stamp()

    def _write(self, data, name: str) -> None:
        data.dims[0].label = "set"
        if name in self.units:
            data.attrs["units"] = self.units[name]
        if name in self.dimensions and data.parent.name == "/results":
            write_names(data.attrs, "DIMENSIONS", self.dimensions[name])
            for axis, label in enumerate(self.dimensions[name], start=1):
                data.dims[axis].label = label

    def _stamp(self) -> tuple[int, ...] | None:
        try:
            status = self.path.stat()
        except FileNotFoundError:
            return None
        return status.st_ino, status.st_size, status.st_mtime_ns

    def _differences(self, stored: StoredSweep) -> list[str]:
        """In what the file's sweep is another one, in words."""
        found = []

        def compare(what, theirs, ours):
            if theirs != ours:
                found.append(f"its {what} {theirs}, not {ours}")

        listed = lambda names: ", ".join(names) or "none"
        compare("parameters are named", listed(stored.parameters), listed(self.parameters))
        if not found:
            found += [
                f"its values of the parameter {name} are other ones"
                for name, ours in self.parameters.items()
                if not _identical(stored.parameters[name], ours)
            ]
        compare("results are named", listed(stored.results), listed(self.results))
        for name in stored.results.keys() & self.results.keys():
            theirs, ours = stored.results[name], self.results[name]
            compare(f"result {name} has shape", theirs.shape[1:], ours.shape[1:])
            compare(f"result {name} has the precision", theirs.dtype.name, ours.dtype.name)
        precisions = lambda types: listed(sorted(set(types)))
        compare(
            "parameters were traced as", precisions(stored.traced_as), precisions(self.traced_as)
        )
        for name in ("rodjax", "jax"):
            compare(f"results were made by {name}", stored.made_by[name], self.made_by[name])
        if not found and stored.made_by["function"] != self.made_by["function"]:
            found.append("its function computes something else (operations, or constants in it)")
        for label in ("units", "dimensions"):
            theirs, ours = getattr(stored, label), getattr(self, label)
            for name in theirs.keys() & ours.keys():
                compare(f"{label} of {name} are", theirs[name], ours[name])
        return found


def _identical(a: np.ndarray, b: np.ndarray) -> bool:
    return (a.dtype, a.shape) == (b.dtype, b.shape) and a.tobytes() == b.tobytes()
