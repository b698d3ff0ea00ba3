"""HDF5 read as plain trees: numbers and text that lie inside the file, and nothing else.

A file may come from a stranger, or be damaged without a seal to show it. HDF5 can point to other
files, to itself, to data that unpack to any size, and h5py turns some types into Python objects.
Every object is therefore looked at through HDF5's own description of it before it is read; what
is not plain is not read, and says so where somebody asks for it.
"""

import dataclasses
import io
import json
import math
import os
import warnings
from pathlib import Path
from typing import TypeVar

import h5py
import numpy as np
from h5py import h5a, h5d, h5g, h5l, h5o, h5s, h5t, h5z  # pyright: ignore[reportAttributeAccessIssue]

from rodjax.files.sealed_files import StorageError, frames
from rodjax.numerics.results import ModelWarning

_LARGEST_SMALL = 64 << 20  # bytes that any file may unpack to
_LARGEST_RATIO = 16  # and how many times its own size on top
_MOST_OBJECTS = 200_000
_DEEPEST = 60
_SIZES = {h5t.INTEGER: (1, 2, 4, 8), h5t.FLOAT: (2, 4, 8)}

Plain = TypeVar("Plain", bool, int, float, str)


@dataclasses.dataclass
class Node:
    """A group or a dataset; `problem` says why it was not read."""

    attributes: dict[str, bool | int | float | str] = dataclasses.field(default_factory=dict)
    children: dict[str, "Node"] = dataclasses.field(default_factory=dict)
    array: np.ndarray | np.generic | None = None
    is_group: bool = True
    problem: str | None = None

    def has(self, name: str) -> bool:
        """Whether there is an attribute of this name."""
        return name in self.attributes

    def child(self, name: str, place: str) -> "Node":
        """A group or dataset inside.

        Raises:
            StorageError: there is none of this name, or it could not be read.
        """
        if name not in self.children:
            raise StorageError(f"{place}: is missing from the file")
        node = self.children[name]
        if node.problem is not None:
            raise StorageError(f"{place}: {node.problem}")
        return node

    def attribute(self, name: str, kind: type[Plain], place: str) -> Plain:
        """An attribute of a type asked for.

        Raises:
            StorageError: there is none of this name and type.
        """
        value = self.attributes.get(name)
        if not isinstance(value, kind) or (kind is int and isinstance(value, bool)):
            raise StorageError(f"{place}: the file has no valid {name} for it")
        return value

    def names(self, name: str, place: str) -> list[str]:
        """A list of names that an attribute holds, as `write_names` wrote it."""
        try:
            found = json.loads(self.attribute(name, str, place))
        except ValueError as error:
            raise StorageError(f"{place}: the file has no valid {name} for it") from error
        if not isinstance(found, list) or not all(isinstance(item, str) for item in found):
            raise StorageError(f"{place}: the file has no valid {name} for it")
        return found


def write_names(attributes, name: str, names) -> None:
    """Write a list of names as an attribute, as JSON in one string."""
    attributes[name] = json.dumps(list(names))


def write_array(group: h5py.Group, name: str, value) -> h5py.Dataset:
    """Write an array with HDF5's own checksum (filter fletcher32) on every chunk."""
    value = np.asarray(value)
    return group.create_dataset(name, data=value, fletcher32=bool(value.ndim and value.size))


def read_images(path: str | os.PathLike) -> tuple[list[Node], bool]:
    """The images of a file (see `sealed_files`), and whether its last one was cut off.

    A file without a seal (of rodjax before format 2, or from elsewhere) is read with a warning.

    Raises:
        StorageError: the file is damaged, or cannot be read.
        FileNotFoundError: there is no such file.
    """
    path = Path(path)
    if path.is_dir():
        raise StorageError(f"path: {path} is a folder; give a file in it")
    try:
        with open(path, "rb") as stream:
            return _images(stream, path)
    except FileNotFoundError as error:
        raise FileNotFoundError(f"path: there is no file {path}") from error
    except OSError as error:
        raise StorageError(f"path: {path} cannot be read: {error}") from error


def _images(stream: io.BufferedIOBase, path: Path) -> tuple[list[Node], bool]:
    found = frames(stream, path)
    size = stream.seek(0, os.SEEK_END)
    first = read_plain(stream, size if found.whole is None else found.whole[0].stop, path)
    if found.whole is None:
        warnings.warn(
            f"{path} has no checksums (rodjax wrote none before format 2): whether it is as it was"
            " written cannot be told; load and save it to give it some",
            ModelWarning,
            stacklevel=5,
        )
        return [first], False
    images = [first]
    for frame in found.whole[1:]:
        stream.seek(frame.start)
        images.append(read_plain(io.BytesIO(stream.read(frame.length)), frame.length, path))
    return images, found.torn


def read_plain(stream: io.BufferedIOBase, size: int, path: Path) -> Node:
    """Everything plain in an HDF5 file.

    Args:
        size: of the file [bytes]; what it may unpack to is bounded by it.

    Raises:
        StorageError: HDF5 cannot read it, or it unpacks to more than it may.
    """
    try:
        with h5py.File(stream, "r") as file:
            reader = _PlainReader(_LARGEST_SMALL + _LARGEST_RATIO * size, path)
            return reader.object(h5g.open(file.id, b"/"), 0)
    except StorageError:
        raise
    except Exception as error:  # whatever h5py makes of a damaged file
        raise StorageError(f"path: {path} is damaged or cut off ({error})") from error


@dataclasses.dataclass
class _PlainReader:
    left: int  # bytes that may still be unpacked
    path: Path
    seen: set = dataclasses.field(default_factory=set)

    def group(self, group, depth: int) -> Node:
        count = group.get_num_objs()
        if count > _MOST_OBJECTS:
            return Node(problem=f"holds {count} objects, which rodjax does not write")
        children = {}
        for raw in list(group):
            name = raw.decode("utf-8")
            if group.links.get_info(raw).type != h5l.TYPE_HARD:
                children[name] = Node(problem="is a link to elsewhere; only what lies here is read")
                continue
            children[name] = self.object(h5o.open(group, raw), depth + 1)
        return Node(self.attributes(group), children)

    def object(self, item, depth: int) -> Node:
        info = h5o.get_info(item)
        if (info.fileno, info.addr) in self.seen:
            return Node(problem="is an object that also lies elsewhere in the file")
        self.seen.add((info.fileno, info.addr))
        if depth > _DEEPEST or len(self.seen) > _MOST_OBJECTS:
            raise StorageError(f"path: {self.path} holds more objects than rodjax writes")
        if isinstance(item, h5g.GroupID):
            return self.group(item, depth)
        if isinstance(item, h5d.DatasetID):
            return self.dataset(item)
        return Node(problem="is neither a group nor a dataset")

    def dataset(self, data) -> Node:
        space, kind, layout = data.get_space(), data.get_type(), data.get_create_plist()
        node = Node(self.attributes(data), is_group=False)
        if space.get_simple_extent_type() == h5s.NULL:
            return node
        if layout.get_layout() not in (h5d.COMPACT, h5d.CONTIGUOUS, h5d.CHUNKED):
            return dataclasses.replace(node, problem="is put together from other files")
        if layout.get_external_count():
            return dataclasses.replace(node, problem="lies in another file")
        if not _is_number(kind):
            return dataclasses.replace(node, problem="is not an array of plain numbers")
        # no filter of HDF5's that unpacks says beforehand how much it unpacks to
        filters = [layout.get_filter(i)[0] for i in range(layout.get_nfilters())]
        if any(code != h5z.FILTER_FLETCHER32 for code in filters):
            return dataclasses.replace(node, problem="is packed; unpack it by h5repack -f NONE")
        self.count(_values_held(space, layout) * kind.get_size())
        value = h5py.Dataset(data)[()]
        if value.dtype.byteorder in "<>":  # to this machine's order
            value = value.astype(value.dtype.newbyteorder("="))
        return dataclasses.replace(node, array=value)

    def attributes(self, item) -> dict:
        found = {}
        for index in range(h5a.get_num_attrs(item)):
            attribute = h5a.open(item, index=index)
            space, kind = attribute.get_space(), attribute.get_type()
            one = space.get_simple_extent_type() == h5s.SCALAR
            if not one or not (kind.get_class() == h5t.STRING or _is_number(kind)):
                continue  # of no meaning here
            self.count(kind.get_size())
            name = attribute.name.decode("utf-8")
            value = h5py.AttributeManager(_Holder(item))[name]
            value = value.decode("utf-8") if isinstance(value, bytes) else value
            assert not isinstance(value, h5py.Empty)  # of a scalar space, so it holds one
            found[name] = value if isinstance(value, str) else value.item()
            self.count(len(value) if isinstance(value, str) else 0)
        return found

    def count(self, size: int) -> None:
        self.left -= size
        if self.left < 0:
            raise StorageError(
                f"path: {self.path} unpacks to far more than its own size, as no file of rodjax"
                " does; it is damaged or was made to exhaust the memory"
            )


@dataclasses.dataclass
class _Holder:
    """What h5py's manager of attributes asks of an object."""

    id: object


def _values_held(space, layout) -> int:
    """How many values reading the dataset holds at least: HDF5 reads chunks as a whole."""
    values = space.get_simple_extent_npoints()
    if layout.get_layout() != h5d.CHUNKED:
        return values
    return max(values, math.prod(layout.get_chunk()))


def _is_number(kind) -> bool:
    """Whether a type is a plain number: integer, float, truth value or complex."""
    name = kind.get_class()
    if name in _SIZES:
        return kind.get_size() in _SIZES[name]
    if name == h5t.ENUM:  # as h5py writes truth values
        return kind.get_size() == 1 and _members(kind) == [b"FALSE", b"TRUE"]
    if name == h5t.COMPOUND:  # as h5py writes complex numbers
        if _members(kind) != [b"r", b"i"]:
            return False
        parts = [kind.get_member_type(i) for i in range(2)]
        return all(p.get_class() == h5t.FLOAT and p.get_size() in (4, 8) for p in parts)
    return False


def _members(kind) -> list[bytes]:
    return [kind.get_member_name(i) for i in range(min(kind.get_nmembers(), 3))]
