"""Objects written as trees of HDF5 groups: records, arrays, tuples, dictionaries, numbers, text."""

import dataclasses

import h5py
import jax
import jax.core
import jax.numpy as jnp
import numpy as np

from rodjax.files.plain_trees import write_array, write_names
from rodjax.files.records import field_names, home, is_record
from rodjax.files.sealed_files import StorageError
from rodjax.inputs.units import Units, unit_of
from rodjax.rods.state import State

# attributes that say what something is
RESERVED = ("KIND", "LENGTH", "KEYS", "CLASS", "MODULE", "FIELDS", "NAME")


@dataclasses.dataclass
class ObjectWriter:
    """Writes one value, of any kind that has a place in a file, under a name in a group.

    Raises:
        StorageError: it has none; the message names it.
    """

    units: Units

    def __call__(self, group, name: str, value, place: str, unit: str | None = None) -> None:
        if name in RESERVED or name in ("", ".", "..") or "/" in name or "\0" in name:
            raise StorageError(f"{place}: '{name}' cannot be a name in HDF5; give another")
        if isinstance(value, jax.Array | np.ndarray | np.generic):
            self._array(group, name, value, place, unit)
        elif isinstance(value, bool | int | float | str):
            group.attrs[name] = _plain(value, place)
        elif value is None:
            group.create_dataset(name, data=h5py.Empty("f")).attrs["KIND"] = "none"
        elif is_record(type(value)):
            self._record(group.create_group(name), value, place, unit)
        elif isinstance(value, tuple | list):
            child = group.create_group(name)
            child.attrs.update(KIND=type(value).__name__, LENGTH=len(value))
            for i, item in enumerate(value):
                self(child, str(i), item, f"{place}[{i}]", unit)
        elif isinstance(value, dict) and all(isinstance(key, str) for key in value):
            child = group.create_group(name)
            child.attrs["KIND"] = "dict"
            write_names(child.attrs, "KEYS", value)
            for key, item in value.items():
                self(child, key, item, f"{place}.{key}", unit)
        elif callable(value):
            child = group.create_group(name)
            title = f"{getattr(value, '__module__', '?')}.{getattr(value, '__qualname__', '?')}"
            child.attrs.update(KIND="function", NAME=title)
        else:
            raise StorageError(f"{place}: a {type(value).__name__} cannot be stored in HDF5")

    def _array(self, group, name, value, place, unit):
        if isinstance(value, jax.core.Tracer):
            raise StorageError(f"{place}: is traced; save outside of jit, grad and vmap")
        if jnp.issubdtype(value.dtype, jax.dtypes.prng_key):
            raise StorageError(f"{place}: keys cannot be stored; give jax.random.key_data of them")
        largest = 16 if value.dtype.kind == "c" else 8  # there is no standard for longer ones
        if value.dtype.kind not in "biufc" or value.dtype.itemsize > largest:
            raise StorageError(f"{place}: an array of {value.dtype} cannot be stored in HDF5")
        data = write_array(group, name, value)
        kinds = {jax.Array: "jax", np.ndarray: "numpy", np.generic: "scalar"}
        data.attrs["KIND"] = next(k for t, k in kinds.items() if isinstance(value, t))
        data.attrs["weak_type"] = getattr(value, "weak_type", False)
        if unit is not None:
            data.attrs["units"] = unit

    def _record(self, group, value, place, unit):
        kind = type(value)
        group.attrs.update(KIND="record", CLASS=kind.__qualname__, MODULE=home(kind.__module__))
        # so that a field that was lost is told from one that came with a later version
        write_names(group.attrs, "FIELDS", field_names(kind))
        for field in field_names(kind):
            part = getattr(value, field)
            if kind is State and field == "rate":  # under the names a reader looks for
                self(group, "velocity", part[..., :3], place, self._unit("velocity"))
                spin = self._unit("angular_velocity")
                self(group, "angular_velocity", part[..., 3:], place, spin)
                continue
            inner = unit_of(kind.__name__, field, self.units, unit)
            if inner is None and is_record(type(part)):
                inner = unit  # an object inside another of that unit, as a schedule in a turn
            self(group, field, part, f"{place}.{field}", inner)

    def _unit(self, name):
        return unit_of("State", name, self.units)


def _plain(value, place: str):
    """A number or text as an attribute that comes back as it was."""
    if isinstance(value, str):
        if "\0" in value or not value.isprintable() and _not_unicode(value):
            raise StorageError(f"{place}: this text cannot be stored in HDF5")
        return str(value)
    if isinstance(value, int) and not isinstance(value, bool) and not -(2**63) <= value < 2**63:
        raise StorageError(f"{place}: {value} is too large an integer for HDF5")
    return value


def _not_unicode(text: str) -> bool:
    try:
        text.encode()
    except UnicodeEncodeError:
        return True
    return False
