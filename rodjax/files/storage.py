"""Runs in HDF5 files: everything needed to look at a motion again, and to go on with it.

A file holds the scene, the integrator, the step control and the run as trees of groups; arrays
are datasets with a `units` attribute. Reading gives equal objects, bit for bit, so a run that is
resumed continues as if it had not stopped. The states are in `run/states`: time, position (R),
quaternion, velocity (v), angular_velocity (omega), curvature (kappa), force (f), each with the
saved states as first axis.

A file knows whether it is whole (`sealed_files`); what is read is plain numbers and text that lie
in it, of known classes, with the checks of their constructors. `Recorder` writes a run while it is
computed.
"""

import os
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from rodjax.dynamics.adaptive import adaptive_rollout
from rodjax.dynamics.fixed_rollout import rollout
from rodjax.dynamics.run import Run
from rodjax.dynamics.step_control import StepControl
from rodjax.equations.generalized_alpha import GeneralizedAlpha
from rodjax.files.recorder import Recorder
from rodjax.files.run_files import FORMAT_VERSION, read_run, write_run
from rodjax.files.sealed_files import StorageError
from rodjax.inputs.argument_types import AnyArray
from rodjax.inputs.units import SI, Units
from rodjax.numerics.results import Result
from rodjax.scenes.scene import Scene

__all__ = ["FORMAT_VERSION", "Recorder", "StorageError", "Stored", "load", "save"]


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

    def __repr__(self):
        run, result = self.run, Result(int(np.max(self.run.result))).name
        return (
            f"Stored(a run of {self.steps_done} steps to t = {float(run.times[-1]):g}"
            f" {self.units.time}, {result}, of a rod of {self.scene.rod.elements} elements;"
            f" written by rodjax {self.version})"
        )

    @property
    def steps_done(self) -> int:
        """Accepted steps so far: the index into `schedule` at which a fixed rollout goes on."""
        return self.run.infos.result.shape[0]

    def resume(self, end_time: float | None = None, **options: Any) -> Run:
        """Go on: to `end_time`, or through the rest of the schedule.

        Without failures this repeats, bit for bit, what the run would have done without the stop,
        wherever that was. An adaptive run that had reached its end time goes on from before the
        steps that were shortened to end there (`Run.resume_state`, at most a few steps earlier);
        `rodjax.run.continued(stored.run, rest)` is the whole. `options` go to `adaptive_rollout`
        or `rollout`.

        Raises:
            ValueError: neither is an `end_time` given nor is anything left of a schedule.
        """
        if end_time is not None:
            return adaptive_rollout(
                self.scene,
                self.run.resume_state,
                end_time,
                self.method,
                self.control,
                resume=self.run.control,
                **options,
            )
        if self.schedule is None or self.steps_done >= self.schedule.shape[0]:
            raise ValueError("end_time: give one; the file has no schedule with steps left")
        rest = self.schedule[self.steps_done :]
        return rollout(self.scene, self.run.final, rest, self.method, **options)


def save(
    path: str | os.PathLike,
    scene: Scene,
    run: Run,
    *,
    method: GeneralizedAlpha | None = None,
    control: StepControl | None = None,
    measures: Mapping[str, Any] | None = None,
    measure_units: Mapping[str, str] | None = None,
    schedule: Float[AnyArray, " k"] | None = None,
    units: Units = SI,
) -> None:
    """Write a run, and all that is needed to continue it, to an HDF5 file.

    Args:
        path: of a file named .h5 (or .hdf5); its folder is made.
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
        StorageError: an object of a kind that has no place in a file, or a path that is none of
            an HDF5 file or cannot be written; the message says which.
    """
    others = {"method": method, "control": control, "schedule": schedule}
    others["measures"] = None if measures is None else dict(measures)
    write_run(path, scene, run, units, others, measure_units)


def load(
    path: str | os.PathLike,
    *,
    classes: Iterable[type] = (),
    functions: Mapping[str, Callable] | None = None,
) -> Stored:
    """Read a file written by `save` or by a `Recorder`; the objects are equal to those written.

    Equal bit for bit. Of a recording that was cut off, by a kill or a power failure, everything
    up to its last whole chunk is read, with a `ModelWarning` if a chunk was cut in two, and the
    run's result is INTERRUPTED. So is a file without checksums, as rodjax wrote before format 2.

    Args:
        path: of the file.
        classes: your own classes (laws, loads, ends, schedules) that the scene contains.
        functions: Python functions of the scene by their place in it, for example
            `{"scene.loads[0].function": my_load}`.

    Raises:
        StorageError: not such a file, a damaged one, a class or a function is missing, or its
            numbers do not fit the precision that jax is set to.
        FileNotFoundError: there is no such file.
    """
    return Stored(**read_run(path, classes, functions))
