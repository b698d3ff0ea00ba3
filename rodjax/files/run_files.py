"""Layout of the file of a run: its parts by name, and the chunks of a recording behind them."""

import dataclasses
import io
import os
import warnings
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import h5py
import jax
import numpy as np

from rodjax.dynamics.coarseness import turns_of_elements
from rodjax.dynamics.run import Run, join_runs
from rodjax.files.object_reading import ObjectReader
from rodjax.files.object_writing import ObjectWriter
from rodjax.files.plain_trees import Node, read_images
from rodjax.files.records import fits, registry
from rodjax.files.sealed_files import StorageError, hdf5_path, replacing
from rodjax.files.versions import version
from rodjax.inputs.units import Units
from rodjax.numerics.results import ModelWarning, Result, as_code
from rodjax.scenes.scene import Scene

FORMAT = "rodjax run"
CHUNK_FORMAT = "rodjax chunk"
FORMAT_VERSION = 2  # 1 had no checksums

_SYMBOLS = {"time": "t", "position": "R", "quaternion": "a_i", "velocity": "v",
            "angular_velocity": "omega", "curvature": "kappa", "force": "f"}  # fmt: skip


def write_run(
    path: str | os.PathLike,
    scene: Scene,
    run: Run,
    units: Units,
    others: Mapping[str, Any],
    measure_units: Mapping[str, str] | None = None,
) -> None:
    """Write the file of a run in place of an earlier one.

    Args:
        others: method, control, measures and schedule, each possibly None.
    """
    path = hdf5_path(path)
    for name, value, kind in (("scene", scene, Scene), ("run", run, Run), ("units", units, Units)):
        if not fits(value, kind):
            raise StorageError(
                f"{name}: give save(path, scene, run, ...) a {kind.__name__}, not a"
                f" {type(value).__name__}"
            )
    check_run(scene, run)
    with replacing(path) as file:
        file.attrs.update(format=FORMAT, format_version=FORMAT_VERSION, rodjax_version=version())
        file.attrs.update({f"unit_of_{k}": name for k, name in units._asdict().items()})
        write = ObjectWriter(units)
        for name, part in {"scene": scene, "run": run, **others}.items():
            write(file, name, part, name, units.time if name == "schedule" else None)
        for name, unit in (measure_units or {}).items():
            if name not in (others["measures"] or {}) or f"measures/{name}" not in file:
                raise StorageError(f"measure_units: '{name}' is no array among the measures")
            file[f"measures/{name}"].attrs["units"] = unit
        # a run may be kept in less precision than its scene; no program for every number of states
        length = np.asarray(scene.rod.gauge_length)
        frames = np.asarray(run.states.quaternion, length.dtype)
        kappa = turns_of_elements(frames) / length[:, None]
        kappa[..., list(scene.rod.breaks), :] = 0.0
        # derived from the quaternions: written for readers of the file, not read back
        states = file.require_group("run/states")
        write(states, "curvature", kappa, "curvature", f"rad/{units.length}")
        for name, symbol in _SYMBOLS.items():
            states[name].attrs["symbol"] = symbol


def chunk_image(part: Run, after: float, units: Units) -> bytes:
    """The image of a chunk of a recording.

    Args:
        after: time of the state that it goes on from.
    """
    stream = io.BytesIO()
    with h5py.File(stream, "w") as file:
        file.attrs.update(format=CHUNK_FORMAT, format_version=FORMAT_VERSION, after=after)
        ObjectWriter(units)(file, "part", part, "part")
    return stream.getvalue()


def read_run(
    path: str | os.PathLike,
    classes: Iterable[type] = (),
    functions: Mapping[str, Callable] | None = None,
) -> dict[str, Any]:
    """Everything in the file of a run, by name: the fields of `storage.Stored`."""
    images, torn = read_images(path)
    file, read = images[0], ObjectReader(registry(classes), functions or {})
    if file.attributes.get("format") != FORMAT:
        raise StorageError(f"path: {path} was not written by rodjax.storage.save")
    found = file.attribute("format_version", int, "format")
    wrote = file.attribute("rodjax_version", str, "format")
    if not 1 <= found <= FORMAT_VERSION:
        raise StorageError(
            f"path: {path} has format {found}, this rodjax reads up to {FORMAT_VERSION};"
            f" it was written by rodjax {wrote}"
        )
    units = Units(*(file.attribute(f"unit_of_{name}", str, "units") for name in Units._fields))
    names = ("scene", "run", "method", "control", "measures", "schedule")
    parts = {name: read(file, name, name) for name in names}
    for name, kind in (("scene", Scene), ("run", Run)):
        if not fits(parts[name], kind):
            raise StorageError(f"{name}: the file does not hold one")
    check_run(parts["scene"], parts["run"])
    if torn:
        warnings.warn(
            f"{path}: its last chunk was cut off while it was written; what is whole is read",
            ModelWarning,
            stacklevel=3,
        )
    if len(images) > 1:
        parts["run"] = with_chunks(parts["run"], images[1:], read)
        check_run(parts["scene"], parts["run"])
    return {**parts, "units": units, "version": wrote}


def with_chunks(run: Run, images: list[Node], read: ObjectReader) -> Run:
    """The run that a recording holds, INTERRUPTED if it is not known to have ended otherwise."""
    parts: list[Run] = []
    place = "run"
    for i, image in enumerate(images, start=1):
        place = f"chunk {i}"
        if image.attributes.get("format") != CHUNK_FORMAT:
            raise StorageError(f"{place}: is none of a recording")
        part, after = read(image, "part", place), image.attribute("after", float, place)
        if not fits(part, Run):
            raise StorageError(f"{place}: the file does not hold one")
        last = (parts or [run])[-1]
        if part.states.time.shape[0] and after != float(last.states.time[-1]):
            # resumed from before the steps that the former end shortened: they are made anew
            run, parts = _until(_joined(run, parts, place), after, place), []
        parts.append(part)
    run = _joined(run, parts, place)
    code = Result(int(run.result))
    return dataclasses.replace(run, result=as_code(code or Result.INTERRUPTED))


def _joined(run: Run, parts: list[Run], place: str) -> Run:
    first = dataclasses.replace(run, states=jax.tree.map(lambda leaf: leaf[1:], run.states))
    try:
        return join_runs(run.state(0), [first, *parts])
    except (TypeError, ValueError) as error:
        raise StorageError(f"{place}: does not go on from what is before it: {error}") from error


def _until(run: Run, time: float, place: str) -> Run:
    """The run up to its state of a time."""
    at = np.flatnonzero(np.asarray(run.times) == time)
    if not at.size:
        raise StorageError(f"{place}: does not go on from what is before it")
    cut = lambda tree, size: jax.tree.map(lambda leaf: leaf[:size], tree)
    states, infos = cut(run.states, int(at[-1]) + 1), cut(run.infos, int(at[-1]))
    return dataclasses.replace(run, states=states, infos=infos)


def check_run(scene: Scene, run: Run) -> None:
    """Raise StorageError unless the run is one of the scene's rod, with arrays that fit."""
    n, states, infos = scene.rod.elements, run.states, run.infos
    count = np.shape(states.time)[:1] or (0,)
    node, shapes = (*count, n + 1), {"time": count, "force": (*count, n, 3)}
    shapes |= {"position": (*node, 3), "quaternion": (*node, 4), "settling": count}
    shapes |= {name: (*node, 6) for name in ("rate", "acceleration", "auxiliary", "jerk")}
    for name, shape in shapes.items():
        value = getattr(states, name)
        if value is not None and (np.shape(value) != shape or not shape[0]):
            raise StorageError(
                f"run.states.{name}: has shape {np.shape(value)}, expected {shape} in a run of"
                f" {count[0]} states of this scene's rod of {n} elements"
            )
    steps = np.shape(infos.result)
    for name, value in infos._asdict().items():
        if np.shape(value) != steps or len(steps) != 1:
            raise StorageError(f"run.infos.{name}: has shape {np.shape(value)}, expected {steps}")
    intervals, before = count[0] - 1, run.steps_before
    if before is not None:
        told = np.asarray(before)
        if told.shape != count or np.any(np.diff(told) < 0) or told[-1] != steps[0] or told[0]:
            raise StorageError(
                f"run.steps_before: does not tell of {intervals + 1} states of {steps[0]} steps"
            )
    # every step, or every so many, is saved
    elif steps[0] % max(intervals, 1) or (not intervals and steps[0]):
        raise StorageError(f"run: has {intervals + 1} states for {steps[0]} steps")
    if np.shape(run.result) or int(run.result) not in set(Result):
        raise StorageError(f"run.result: is no code of a run: {run.result}")
    for place, part in (("scene.rod", scene.rod), ("run.states", states)):
        floats = {x.dtype.name for x in jax.tree.leaves(part) if x.dtype.kind == "f"}
        if len(floats) > 1:
            raise StorageError(f"{place}: holds numbers of mixed precision, {sorted(floats)}")
