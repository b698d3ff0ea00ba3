"""A run written while it is computed: what was appended survives a kill of the process."""

import contextlib
import dataclasses
import io
import os
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from rodjax.dynamics.run import Run, of_no_steps
from rodjax.dynamics.step_control import StepControl
from rodjax.dynamics.stepping import prepare
from rodjax.equations.generalized_alpha import GeneralizedAlpha
from rodjax.files.object_reading import ObjectReader
from rodjax.files.plain_trees import read_images
from rodjax.files.records import fits, registry
from rodjax.files.run_files import chunk_image, read_run, with_chunks, write_run
from rodjax.files.sealed_files import Frame, StorageError, framed, frames, hdf5_path
from rodjax.inputs.units import SI, Units
from rodjax.numerics.results import Result, as_code
from rodjax.rods.state import State
from rodjax.scenes.scene import Scene

try:
    import fcntl
except ImportError:  # not on Windows, where an open file cannot be replaced anyway
    fcntl = None


class Recorder:
    """Keeps an adaptive run in a file chunk by chunk; a kill loses the chunk in flight at most.

        with storage.Recorder("run.h5", scene, state, method=method, control=control) as recorder:
            run = rx.adaptive_rollout(scene, state, 10.0, method, control, on_chunk=recorder)

    After a kill, a power failure or Ctrl-C `storage.load("run.h5")` reads every chunk that was
    completed, and

        with storage.Recorder.append("run.h5") as recorder:
            rest = recorder.resume(10.0)

    goes on, bit for bit as if nothing had happened. When the block is left the file becomes one as
    `storage.save` writes it. A recorder serves one rollout; several processes cannot record to
    one file.

    Raises:
        StorageError: there is such a file already (use `append`, or delete it), or the path is
            none of an HDF5 file or cannot be written.
    """

    def __init__(
        self,
        path: str | os.PathLike,
        scene: Scene,
        state: State,
        *,
        method: GeneralizedAlpha | None = None,
        control: StepControl | None = None,
        units: Units = SI,
    ):
        path = hdf5_path(path)
        if path.exists():
            raise StorageError(
                f"path: there is a file {path} already; Recorder.append(path) goes on with it"
            )
        for name, value, kind in (("scene", scene, Scene), ("state", state, State)):
            if not fits(value, kind):
                raise StorageError(
                    f"{name}: give Recorder(path, scene, state, ...) a {kind.__name__}, not a"
                    f" {type(value).__name__}"
                )
        others = {"method": method, "control": control, "measures": None, "schedule": None}
        run = of_no_steps(prepare(scene, state))
        write_run(path, scene, run, units, others)
        with contextlib.ExitStack() as unless_begun:
            stream = unless_begun.enter_context(_locked(path))
            self._begin(path, stream, {"scene": scene, "run": run, "units": units, **others})
            unless_begun.pop_all()

    @classmethod
    def append(
        cls,
        path: str | os.PathLike,
        *,
        classes: Iterable[type] = (),
        functions: Mapping[str, Callable] | None = None,
    ) -> "Recorder":
        """Go on with a file of `save` or of a recorder; arguments are those of `storage.load`."""
        path = hdf5_path(path)
        made = object.__new__(cls)
        with contextlib.ExitStack() as unless_begun:
            # locked before it is read: what another recorder appends meanwhile would be lost
            stream = unless_begun.enter_context(_locked(path))
            made._begin(path, stream, read_run(path, classes, functions))
            unless_begun.pop_all()
        return made

    def _begin(self, path: Path, stream: io.BufferedRandom, parts: dict[str, Any]) -> None:
        self.path, self._parts = path, parts
        self._stream, self._last = stream, _last_whole(stream, path)
        run = parts["run"]
        if run.steps_before is not None:
            raise StorageError(
                "path: the run was thinned; a recording keeps the state of every step"
            )
        self._after = float(run.resume_state.time)
        self._counts = run.rejected, run.wasted_iterations
        self._code: Result | None = None

    def resume(self, end_time: float, **options: Any) -> Run:
        """Go on with the file's run to `end_time` and record it; see `storage.Stored.resume`."""
        # here, for storage has the recorder among its names
        from rodjax.files.storage import Stored

        return Stored(**self._parts).resume(end_time, on_chunk=self, **options)

    def __call__(self, part: Run) -> None:
        """Append a chunk, as `adaptive_rollout` hands it to `on_chunk`.

        Raises:
            StorageError: it does not go on from the last, or the disk refuses it.
        """
        if self._stream is None:
            raise StorageError("recorder: it is closed; Recorder.append(path) goes on")
        times = np.asarray(part.states.time)
        if times.size and times[0] <= self._after:
            raise StorageError(
                f"recorder: a chunk from t = {times[0]:g} does not follow t = {self._after:g};"
                " a recorder serves one rollout, for the next use Recorder.append(path)"
            )
        rejected, wasted = self._counts
        counted = dataclasses.replace(
            part,
            rejected=part.rejected + rejected,
            wasted_iterations=part.wasted_iterations + wasted,
        )
        image = chunk_image(counted, self._after, self._parts["units"])
        self._last = _appended(self._stream, image, self._last, self.path)
        self._code = Result(int(part.result))
        if times.size:
            self._after = float(times[-1])

    def close(self, result: Result | None = None) -> None:
        """Make of the chunks one file as `storage.save` writes it.

        Args:
            result: how the run ended, if not as its last chunk says.
        """
        if self._stream is None:
            return
        stream, self._stream = self._stream, None
        try:
            first, *chunks = read_images(self.path)[0]
            if not chunks:
                return
            result = self._code if result is None else result
            read = ObjectReader(registry(()), {})
            run = with_chunks(read(first, "run", "run"), chunks, read)
            if result is not None:
                run = dataclasses.replace(run, result=as_code(result))
            parts = {name: value for name, value in self._parts.items() if name != "version"}
            scene, _, units = (parts.pop(name) for name in ("scene", "run", "units"))
            write_run(self.path, scene, run, units, parts)
        finally:
            stream.close()

    def __enter__(self) -> "Recorder":
        return self

    def __exit__(self, kind, error, trace) -> None:
        if error is None:
            self.close()
            return
        # the chunks are safe as they are, and the error at hand is the one to be told
        with contextlib.suppress(StorageError):
            self.close(getattr(error, "result", Result.INTERRUPTED))


def _locked(path: Path) -> io.BufferedRandom:
    """The file to append to, the recorder's own for as long as it is open.

    Raises:
        StorageError: another recorder has it, or it cannot be written.
        FileNotFoundError: there is no such file.
    """
    try:
        stream = open(path, "r+b")  # noqa: SIM115 (the recorder closes it)
    except FileNotFoundError as error:
        raise FileNotFoundError(f"path: there is no file {path}") from error
    except OSError as error:
        raise StorageError(f"path: {path} cannot be written: {error}") from error
    problem = f"another process is recording to {path}"
    try:
        if _taken(stream, path):
            return stream
    except OSError as error:
        problem = f"{path} cannot be locked: {error}"
    stream.close()
    raise StorageError(f"path: {problem}")


def _taken(stream: io.BufferedRandom, path: Path) -> bool:
    """Whether the lock of the file was free, and it is still the file of this path."""
    if fcntl is not None:
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
    # a recorder that closes puts another file in its place
    return os.path.samestat(os.fstat(stream.fileno()), os.stat(path))


def _last_whole(stream: io.BufferedRandom, path: Path) -> Frame:
    """The last whole frame, behind which the file is cut off: what a kill left of a chunk."""
    try:
        found = frames(stream, path).whole
        if found is None:
            raise StorageError(f"path: {path} has no checksums; load and save it first")
        stream.truncate(found[-1].stop)
    except OSError as error:
        raise StorageError(f"path: {path} cannot be written: {error}") from error
    return found[-1]


def _appended(stream: io.BufferedIOBase, image: bytes, last: Frame, path: Path) -> Frame:
    """The frame of an image that has been written behind the last, to the disk."""
    header_and_image, frame = framed(image, last)
    try:
        stream.seek(last.stop)
        stream.write(header_and_image)
        stream.flush()
        os.fsync(stream.fileno())
    except OSError as error:
        with contextlib.suppress(OSError):
            stream.truncate(last.stop)
        raise StorageError(f"path: {path} cannot be written: {error}") from error
    return frame
