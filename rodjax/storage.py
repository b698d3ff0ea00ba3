"""Runs in HDF5 files: everything needed to look at a motion again, and to go on with it.

A file holds the scene, the integrator, the step control and the run as trees of groups; arrays
are datasets with a `units` attribute. Reading gives equal objects, bit for bit, so a run that is
resumed continues as if it had not stopped. The states are in `run/states`: time, position (R),
quaternion, velocity (v), angular_velocity (omega), curvature (kappa), force (f), each with the
saved states as first axis.
"""

import contextlib
import dataclasses
import importlib
import os
import pkgutil
from collections.abc import Callable, Iterable, Iterator, Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

import equinox as eqx
import h5py
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import rodjax
from rodjax.adaptive import adaptive_rollout
from rodjax.compilation import compiled
from rodjax.fixed_rollout import rollout
from rodjax.generalized_alpha import GeneralizedAlpha
from rodjax.run import Run
from rodjax.scene import Scene
from rodjax.state import State
from rodjax.step_control import StepControl
from rodjax.strains import curvature
from rodjax.units import SI, Units, unit_of

FORMAT = "rodjax run"
FORMAT_VERSION = 1

_SYMBOLS = {"time": "t", "position": "R", "quaternion": "a_i", "velocity": "v",
            "angular_velocity": "omega", "curvature": "kappa", "force": "f"}  # fmt: skip


class StorageError(ValueError):
    """A file that cannot be read as asked; the message says what to do."""


class Stored(eqx.Module):
    """What a file holds; see `save`.

    Attributes:
        scene, run: as they were saved.
        method, control, measures, schedule: what `save` was given beside them, else None.
        units: names of the units of the scene.
        version: of rodjax, when the file was written.
    """

    scene: Scene
    run: Run
    method: GeneralizedAlpha | None  # None: not told to `save`, the default is used
    control: StepControl | None
    measures: dict[str, Any] | None
    schedule: Float[Array, " k"] | None
    units: Units = eqx.field(static=True)
    version: str = eqx.field(static=True)  # of rodjax, when the file was written

    @property
    def steps_done(self) -> int:
        """Accepted steps so far: the index into `schedule` at which a fixed rollout goes on."""
        return self.run.infos.result.shape[0]

    def resume(self, end_time: float | None = None, **options: Any) -> Run:
        """Go on from the last state: to `end_time`, or through the rest of the schedule.

        Without failures this repeats, bit for bit, what the run would have done without the stop.
        `options` go to `adaptive_rollout` or `rollout`.

        Raises:
            ValueError: neither is an `end_time` given nor is anything left of a schedule.
        """
        state = self.run.final
        if end_time is not None:
            return adaptive_rollout(
                self.scene,
                state,
                end_time,
                self.method,
                self.control,
                resume=self.run.control,
                **options,
            )
        if self.schedule is None or self.steps_done >= self.schedule.shape[0]:
            raise ValueError("end_time: give one; the file has no schedule with steps left")
        rest = self.schedule[self.steps_done :]
        return rollout(self.scene, state, rest, self.method, **options)


def save(
    path: str | os.PathLike,
    scene: Scene,
    run: Run,
    *,
    method: GeneralizedAlpha | None = None,
    control: StepControl | None = None,
    measures: Mapping[str, Any] | None = None,
    measure_units: Mapping[str, str] | None = None,
    schedule: Float[Array, " k"] | None = None,
    units: Units = SI,
) -> None:
    """Write a run, and all that is needed to continue it, to an HDF5 file.

    Args:
        path: of the file.
        scene, run: what is kept.
        method, control: those the run was made with.
        measures: anything measured, by name: arrays over the saved times, ledgers, numbers.
        measure_units: units of those of them that are plain arrays, by name.
        schedule: all the times that a fixed rollout was asked for, also those not reached.
        units: names of the units of the scene.

    An earlier file of that name is replaced only when the new one is complete on the disk.
    A Python function in the scene (`schedules.Function`, `loads.DistributedLoad`) cannot be
    written: its name is, and `load` asks for it.

    Raises:
        StorageError: an object of a kind that has no place in a file; the message names it.
    """
    parts = {"scene": scene, "run": run, "method": method, "control": control}
    with replacing(Path(path)) as file:
        file.attrs.update(format=FORMAT, format_version=FORMAT_VERSION, rodjax_version=_version())
        file.attrs.update({f"unit_of_{k}": name for k, name in units._asdict().items()})
        write = _Writer(units)
        for name, part in parts.items():
            write(file, name, part, name)
        write(file, "measures", None if measures is None else dict(measures), "measures")
        for name, unit in (measure_units or {}).items():
            file[f"measures/{name}"].attrs["units"] = unit
        write(file, "schedule", schedule, "schedule", units.time)
        frames = jnp.asarray(run.states.quaternion)
        kappa = _curvatures(scene.rod, frames)
        # derived from the quaternions: written for readers of the file, not read back
        states = file.require_group("run/states")
        write(states, "curvature", kappa, "curvature", f"rad/{units.length}")
        for name, symbol in _SYMBOLS.items():
            states[name].attrs["symbol"] = symbol


def load(
    path: str | os.PathLike,
    *,
    classes: Iterable[type] = (),
    functions: Mapping[str, Callable] | None = None,
) -> Stored:
    """Read a file written by `save`; the objects are equal to those written, bit for bit.

    Args:
        path: of the file.
        classes: your own classes (laws, loads, ends, schedules) that the scene contains.
        functions: Python functions of the scene by their place in it, for example
            `{"scene.loads[0].function": my_load}`.

    Raises:
        StorageError: not such a file, a class or a function is missing, or its numbers do not
            fit the precision that jax is set to.
        FileNotFoundError: there is no such file.
    """
    if not Path(path).exists():
        raise FileNotFoundError(f"path: there is no file {path}")
    if not h5py.is_hdf5(path):
        raise StorageError(f"path: {path} is not an HDF5 file")
    with h5py.File(path, "r") as file:
        if file.attrs.get("format") != FORMAT:
            raise StorageError(f"path: {path} was not written by rodjax.storage.save")
        version = int(str(file.attrs["format_version"]))
        if version > FORMAT_VERSION:
            raise StorageError(
                f"path: {path} has format {version}, this rodjax reads up to {FORMAT_VERSION};"
                f" it was written by rodjax {file.attrs['rodjax_version']}"
            )
        read = _Reader(_registry(classes), functions or {})
        names = ("scene", "run", "method", "control", "measures", "schedule")
        units = Units(*(str(file.attrs[f"unit_of_{name}"]) for name in Units._fields))
        parts = {name: read(file, name, name) for name in names}
        return Stored(**parts, units=units, version=str(file.attrs["rodjax_version"]))


_curvatures = compiled(jax.vmap(curvature, (None, 0)))


def _version() -> str:
    try:
        return metadata.version("rodjax")
    except metadata.PackageNotFoundError:  # run from a source tree
        return getattr(rodjax, "__version__", "unknown")


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[h5py.File]:
    """A new HDF5 file that takes the place of that at `path` only when complete on the disk."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with h5py.File(temporary, "w") as file:
            yield file
        _flush(temporary)
        os.replace(temporary, path)
        _flush(path.parent)
    finally:
        temporary.unlink(missing_ok=True)


def _flush(path: Path) -> None:
    """Have the operating system write a file, or the entries of a folder, to the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _registry(classes: Iterable[type]) -> dict[str, type]:
    """Storable classes by full name, and by plain name where that is unique."""
    found: list[type] = list(classes)
    for entry in pkgutil.iter_modules(rodjax.__path__, "rodjax."):
        module = importlib.import_module(entry.name)
        own = (c for c in vars(module).values() if getattr(c, "__module__", "") == entry.name)
        found += [c for c in own if isinstance(c, type) and _is_record(c)]
    registry: dict[str, type] = {}
    names = [c.__name__ for c in found]
    for c in found:
        registry[f"{c.__module__}.{c.__qualname__}"] = c
        if names.count(c.__name__) == 1:
            registry[c.__name__] = c
    return registry


def _is_record(kind: type) -> bool:
    """A class with named fields: an equinox module or a named tuple."""
    return issubclass(kind, eqx.Module) or (issubclass(kind, tuple) and hasattr(kind, "_fields"))


def _fields(kind: type) -> list[str]:
    if issubclass(kind, eqx.Module):
        return [field.name for field in dataclasses.fields(kind)]
    return list(kind._fields)  # pyright: ignore[reportAttributeAccessIssue]


@dataclasses.dataclass
class _Writer:
    """Writes one value, of any kind that has a place in a file, under a name in a group."""

    units: Units

    def __call__(self, group, name: str, value, place: str, unit: str | None = None) -> None:
        if isinstance(value, jax.Array | np.ndarray | np.generic):
            data = group.create_dataset(name, data=np.asarray(value))
            kinds = {jax.Array: "jax", np.ndarray: "numpy", np.generic: "scalar"}
            data.attrs["KIND"] = next(k for t, k in kinds.items() if isinstance(value, t))
            data.attrs["weak_type"] = getattr(value, "weak_type", False)
            if unit is not None:
                data.attrs["units"] = unit
        elif isinstance(value, bool | int | float | str):
            group.attrs[name] = value
        elif value is None:
            group.create_dataset(name, data=h5py.Empty("f")).attrs["KIND"] = "none"
        elif _is_record(type(value)):
            self._record(group.create_group(name), value, place, unit)
        elif isinstance(value, tuple | list):
            child = group.create_group(name)
            child.attrs.update(KIND=type(value).__name__, LENGTH=len(value))
            for i, item in enumerate(value):
                self(child, str(i), item, f"{place}[{i}]", unit)
        elif isinstance(value, dict) and all(isinstance(key, str) for key in value):
            child = group.create_group(name)
            child.attrs.update(KIND="dict", KEYS=list(value))
            for key, item in value.items():
                self(child, key, item, f"{place}.{key}", unit)
        elif callable(value):
            child = group.create_group(name)
            title = f"{getattr(value, '__module__', '?')}.{getattr(value, '__qualname__', '?')}"
            child.attrs.update(KIND="function", NAME=title)
        else:
            raise StorageError(f"{place}: a {type(value).__name__} cannot be stored in HDF5")

    def _record(self, group, value, place, unit):
        kind = type(value)
        group.attrs.update(KIND="record", CLASS=kind.__qualname__, MODULE=kind.__module__)
        for field in _fields(kind):
            part = getattr(value, field)
            if kind is State and field == "rate":  # under the names a reader looks for
                self(group, "velocity", part[..., :3], place, self._unit("velocity"))
                spin = self._unit("angular_velocity")
                self(group, "angular_velocity", part[..., 3:], place, spin)
                continue
            inner = unit_of(kind.__name__, field, self.units, unit)
            if inner is None and _is_record(type(part)):
                inner = unit  # an object inside another of that unit, as a schedule in a turn
            self(group, field, part, f"{place}.{field}", inner)

    def _unit(self, name):
        return unit_of("State", name, self.units)


@dataclasses.dataclass
class _Reader:
    """The inverse of `_Writer`."""

    registry: dict[str, type]
    functions: Mapping[str, Callable]

    def __call__(self, group, name: str, place: str) -> Any:
        if name not in group:
            value = group.attrs[name]  # a plain number or string
            return value if isinstance(value, str) else value.item()
        item = group[name]
        kind = item.attrs["KIND"]
        if isinstance(item, h5py.Dataset):
            return None if kind == "none" else self._array(item, kind, place)
        if kind in ("tuple", "list"):
            count = int(item.attrs["LENGTH"])
            items = [self(item, str(i), f"{place}[{i}]") for i in range(count)]
            return tuple(items) if kind == "tuple" else items
        if kind == "dict":
            return {key: self(item, key, f"{place}.{key}") for key in item.attrs["KEYS"]}
        if kind == "function":
            if place not in self.functions:
                raise StorageError(
                    f"{place}: the file cannot hold the Python function {item.attrs['NAME']};"
                    f" give it as load(..., functions={{{place!r}: ...}})"
                )
            return self.functions[place]
        return self._record(item, place)

    def _array(self, data, kind, place):
        value = data[()]
        if kind == "scalar":
            return value
        if kind == "numpy":
            return np.asarray(value)
        if data.attrs["weak_type"] and data.ndim == 0:
            return jnp.asarray(value.item())
        if jax.dtypes.canonicalize_dtype(data.dtype) != data.dtype:
            raise StorageError(
                f"{place}: the file holds {data.dtype}; switch double precision on first"
                " (jax.config.update('jax_enable_x64', True))"
            )
        return jnp.asarray(value)

    def _record(self, group, place):
        name, module = group.attrs["CLASS"], group.attrs["MODULE"]
        kind = self.registry.get(f"{module}.{name}", self.registry.get(name))
        if kind is None:
            raise StorageError(
                f"{place}: no class {module}.{name} in rodjax; give yours as load(..., classes=...)"
            )
        values = {}
        for field in _fields(kind):
            if kind is State and field == "rate":
                parts = [self(group, n, place) for n in ("velocity", "angular_velocity")]
                values[field] = jnp.concatenate(parts, -1)
            elif field in group or field in group.attrs:
                values[field] = self(group, field, f"{place}.{field}")
            else:
                values[field] = _default(kind, field, place)
        if not issubclass(kind, eqx.Module):
            return kind(**values)
        # not by __init__: its converters may change the last bit
        made = object.__new__(kind)
        for field, value in values.items():
            object.__setattr__(made, field, value)
        return made


def _default(kind: type, field: str, place: str):
    """Default of a field that a file written by an earlier version does not have."""
    if issubclass(kind, eqx.Module):
        for entry in dataclasses.fields(kind):
            if entry.name == field and entry.default is not dataclasses.MISSING:
                return entry.default
    elif field in kind._field_defaults:  # pyright: ignore[reportAttributeAccessIssue]
        return kind._field_defaults[field]  # pyright: ignore[reportAttributeAccessIssue]
    raise StorageError(f"{place}: the file has no {field} of {kind.__name__}; write it again")
