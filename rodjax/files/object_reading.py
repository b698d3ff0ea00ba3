"""The inverse of `object_writing`: objects from plain trees, of known classes and checked."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rodjax.files import records
from rodjax.files.object_writing import RESERVED
from rodjax.files.plain_trees import Node
from rodjax.files.sealed_files import StorageError
from rodjax.rods.state import State


@dataclasses.dataclass
class ObjectReader:
    """Reads what lies under a name in a group.

    Raises:
        StorageError: it is missing, of a class that is not known, or no valid object.
    """

    registry: dict[str, type]
    functions: Mapping[str, Callable]

    def __call__(self, group: Node, name: str, place: str) -> Any:
        if name not in group.children and group.has(name):
            return group.attributes[name]  # a plain number or text
        item = group.child(name, place)
        kind = item.attribute("KIND", str, place)
        if not item.is_group:
            return self._array(item, kind, place)
        if kind in ("tuple", "list"):
            count, members = item.attribute("LENGTH", int, place), self._members(item)
            if count != len(members) or {str(i) for i in range(count)} != members:
                raise StorageError(f"{place}: the file does not hold its {count} entries")
            items = [self(item, str(i), f"{place}[{i}]") for i in range(count)]
            return tuple(items) if kind == "tuple" else items
        if kind == "dict":
            # before format 2 the list of keys was of a type that is not read
            keys = item.names("KEYS", place) if item.has("KEYS") else sorted(self._members(item))
            return {key: self(item, key, f"{place}.{key}") for key in keys}
        if kind == "function":
            if place not in self.functions:
                raise StorageError(
                    f"{place}: the file cannot hold the Python function"
                    f" {item.attribute('NAME', str, place)}; give it as load(...,"
                    f" functions={{{place!r}: ...}})"
                )
            return self.functions[place]
        if kind == "record":
            return self._record(item, place)
        raise StorageError(f"{place}: is of the unknown kind '{kind}'")

    def _members(self, item: Node) -> set[str]:
        return {*item.children, *(name for name in item.attributes if name not in RESERVED)}

    def _array(self, item: Node, kind: str, place: str):
        value = item.array
        if kind == "none" and value is None:
            return None
        if kind not in ("jax", "numpy", "scalar") or value is None:
            raise StorageError(f"{place}: is of the unknown kind '{kind}'")
        if kind == "scalar" and value.ndim == 0:
            return np.asarray(value)[()]
        if kind != "jax":
            return np.asarray(value)
        if item.attributes.get("weak_type") and value.ndim == 0:
            return jnp.asarray(value.item())
        if jax.dtypes.canonicalize_dtype(value.dtype) != value.dtype:
            raise StorageError(
                f"{place}: the file holds {value.dtype}; switch double precision on first"
                " (jax.config.update('jax_enable_x64', True))"
            )
        return jnp.asarray(value)

    def _record(self, group: Node, place: str):
        name = group.attribute("CLASS", str, place)
        module = group.attribute("MODULE", str, place)
        kind = self.registry.get(f"{records.home(module)}.{name}", self.registry.get(name))
        if kind is None:
            raise StorageError(
                f"{place}: no class {module}.{name} in rodjax; give yours as load(..., classes=...)"
            )
        written = group.names("FIELDS", place) if group.has("FIELDS") else []
        values = {}
        for field in records.field_names(kind):
            if kind is State and field == "rate":
                values[field] = self._rate(group, place)
            elif field in written or field in group.children or group.has(field):
                values[field] = self(group, field, f"{place}.{field}")
            else:
                values[field] = records.default(kind, field, place)
        return records.make(kind, values, place)

    def _rate(self, group: Node, place: str):
        """Velocity and angular velocity beside each other, as `State` has them."""
        parts = [self(group, name, f"{place}.{name}") for name in ("velocity", "angular_velocity")]
        if any(np.ndim(part) < 2 or np.shape(part) != np.shape(parts[0]) for part in parts):
            raise StorageError(f"{place}: velocity and angular_velocity have different shapes")
        # by numpy, which mixes nothing up when the two have different types
        joined = np.concatenate([np.asarray(part) for part in parts], -1)
        return jnp.asarray(joined) if isinstance(parts[0], jax.Array) else joined
