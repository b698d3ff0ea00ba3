"""Runs recorded while they are computed: what a kill, a power failure or an error leaves."""

import os
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest
from helpers import assert_identical, driven_scene, standing_run
from test_resumed_runs import CHUNK, CONTROL, METHOD

import rodjax
from rodjax import storage
from rodjax.dynamics.adaptive import adaptive_rollout
from rodjax.dynamics.consistency import start
from rodjax.dynamics.run import continued, join_runs
from rodjax.files.sealed_files import HEADER_SIZE, StorageError
from rodjax.numerics.results import ModelWarning, Result, SimulationError

SCENE = driven_scene(elements=4)
STEPS = 3


def part(number: int, **changes):
    """What `on_chunk` is given: steps without the state they begin from."""
    run = standing_run(SCENE, STEPS, first=0.1 * STEPS * number)
    run = eqx.tree_at(lambda r: r.states.position, run, run.states.position + number)
    states = jax.tree.map(lambda leaf: np.asarray(leaf[1:]), run.states)
    run = eqx.tree_at(lambda r: r.states, run, states)
    return eqx.tree_at(lambda r: [getattr(r, k) for k in changes], run, list(changes.values()))


START = standing_run(SCENE, 0).state(0)


def expected(count: int):
    """States of a recording of so many chunks."""
    return join_runs(START, [part(i) for i in range(count)]).states


def recorded(path, count: int) -> bytes:
    """The bytes of a recording with so many chunks that was never closed."""
    recorder = storage.Recorder(path, SCENE, START, method=METHOD)
    for i in range(count):
        recorder(part(i))
    recorder._stream.close()  # as when the process dies
    return path.read_bytes()


def test_a_closed_recording_is_a_file_of_save(tmp_path):
    with storage.Recorder(tmp_path / "a.h5", SCENE, START, method=METHOD) as recorder:
        for i in range(3):
            recorder(part(i))
    run = join_runs(START, [part(i) for i in range(3)])
    storage.save(tmp_path / "b.h5", SCENE, run, method=METHOD)
    a, b = (storage.load(tmp_path / name) for name in ("a.h5", "b.h5"))
    assert_identical((a.scene, a.run, a.method), (b.scene, b.run, b.method))
    assert int(a.run.result) == Result.SUCCESS
    assert [entry.name for entry in sorted(tmp_path.iterdir())] == ["a.h5", "b.h5"]
    with pytest.raises(StorageError, match="it is closed"):
        recorder(part(3))


def test_a_recording_cut_off_anywhere_has_its_whole_chunks(tmp_path):
    """At the ends of frames and of headers, and at random places."""
    path = tmp_path / "run.h5"
    sizes = [len(recorded(tmp_path / f"{i}.h5", i)) for i in range(4)]
    whole = (tmp_path / "3.h5").read_bytes()
    assert sizes[-1] == len(whole)
    rng = np.random.default_rng(0)
    cuts = [size + shift for size in sizes for shift in (0, 1, HEADER_SIZE)]
    cuts += list(map(int, rng.integers(sizes[0], sizes[-1], 5)))
    for cut in cuts:
        if not sizes[0] <= cut <= sizes[-1]:
            continue
        path.write_bytes(whole[:cut])
        count = sum(size <= cut for size in sizes) - 1
        if cut in sizes:
            stored = storage.load(path)
        else:
            with pytest.warns(ModelWarning, match="cut off"):
                stored = storage.load(path)
        if count:
            assert_identical(stored.run.states, expected(count))
        assert stored.steps_done == STEPS * count
        assert int(stored.run.result) == Result.INTERRUPTED
    path.write_bytes(whole[: sizes[0] - 1])
    with pytest.raises(StorageError, match="nothing of it is whole"):
        storage.load(path)


def test_a_changed_byte_in_a_recording_is_refused(tmp_path):
    whole = recorded(tmp_path / "run.h5", 2)
    rng = np.random.default_rng(0)
    places = [*rng.integers(0, len(whole), 60), len(whole) - 1]
    for place in places:
        changed = bytearray(whole)
        changed[place] ^= 1
        (tmp_path / "run.h5").write_bytes(changed)
        with pytest.raises(StorageError, match="damaged"):
            storage.load(tmp_path / "run.h5")


def test_chunks_of_two_recordings_are_not_mixed(tmp_path):
    one, two = (recorded(tmp_path / f"{i}.h5", i) for i in (1, 2))
    base = len(recorded(tmp_path / "0.h5", 0))
    (tmp_path / "run.h5").write_bytes(one + two[base:])
    with pytest.raises(StorageError, match="damaged"):
        storage.load(tmp_path / "run.h5")


def test_appending_goes_on_behind_the_last_whole_chunk(tmp_path):
    path = tmp_path / "run.h5"
    path.write_bytes(recorded(tmp_path / "all.h5", 2)[:-100])
    with pytest.warns(ModelWarning, match="cut off"):
        recorder = storage.Recorder.append(path)
    with recorder:
        recorder(part(1))
        recorder(part(2))
    stored = storage.load(path)
    assert_identical(stored.run.states, expected(3))
    assert int(stored.run.result) == Result.SUCCESS


def test_counts_of_the_parts_before_are_kept(tmp_path):
    path, count = tmp_path / "run.h5", lambda number: jnp.asarray(number, jnp.int32)
    with storage.Recorder(path, SCENE, START) as recorder:
        recorder(part(0, rejected=count(2), wasted_iterations=count(7)))
    with storage.Recorder.append(path) as recorder:
        recorder(part(1, rejected=count(3), wasted_iterations=count(5)))
    stored = storage.load(path).run
    assert (int(stored.rejected), int(stored.wasted_iterations)) == (5, 12)


@pytest.mark.parametrize(
    "error", [KeyboardInterrupt(), ValueError("x"), SimulationError(Result.NEWTON_FAILED)], ids=repr
)
def test_how_a_run_ended_is_kept(tmp_path, error):
    path = tmp_path / "run.h5"
    with pytest.raises(type(error)), storage.Recorder(path, SCENE, START) as recorder:
        recorder(part(0))
        raise error
    stored = storage.load(path)
    assert_identical(stored.run.states, expected(1))
    wanted = getattr(error, "result", Result.INTERRUPTED)
    assert int(stored.run.result) == wanted != Result.SUCCESS


def test_a_failure_in_the_last_chunk_is_kept(tmp_path):
    path, failed = tmp_path / "run.h5", jnp.asarray(int(Result.STEP_TOO_SMALL), jnp.int32)
    nothing = jax.tree.map(lambda leaf: leaf[:0], (part(1).states, part(1).infos))
    empty = eqx.tree_at(lambda r: (r.states, r.infos, r.result), part(1), (*nothing, failed))
    with storage.Recorder(path, SCENE, START) as recorder:
        recorder(part(0))
        recorder(empty)
    stored = storage.load(path)
    assert_identical(stored.run.states, expected(1))
    assert int(stored.run.result) == Result.STEP_TOO_SMALL


def test_earlier_files_and_other_recorders_are_left_alone(tmp_path):
    path = tmp_path / "run.h5"
    recorder = storage.Recorder(path, SCENE, START)
    recorder(part(0))
    with pytest.raises(StorageError, match=r"a file .* already; Recorder.append"):
        storage.Recorder(path, SCENE, START)
    with pytest.raises(StorageError, match="another process is recording"):
        storage.Recorder.append(path)
    with pytest.raises(StorageError, match="does not follow"):
        recorder(part(0))
    recorder.close()
    assert_identical(storage.load(path).run.states, expected(1))
    with pytest.raises(StorageError, match="only HDF5"):
        storage.Recorder(tmp_path / "run.csv", SCENE, START)
    with pytest.raises(FileNotFoundError):
        storage.Recorder.append(tmp_path / "none.h5")


def test_a_file_that_is_replaced_while_it_is_locked(tmp_path, monkeypatch):
    """By a recorder that closes: what is appended to the old file would be lost with it."""
    path = tmp_path / "run.h5"
    recorded(path, 1)

    def late(stream, mode):
        other = tmp_path / "other.h5"
        other.write_bytes(path.read_bytes())
        other.replace(path)

    with monkeypatch.context() as patch:
        patch.setattr("rodjax.files.recorder.fcntl.flock", late)
        with pytest.raises(StorageError, match="another process is recording"):
            storage.Recorder.append(path)
    storage.Recorder.append(path).close()


def test_faults_of_the_disk_are_not_taken_for_another_recorder(tmp_path, monkeypatch):
    path = tmp_path / "run.h5"
    recorded(path, 1)

    def broken(*_):
        raise OSError(5, "Input/output error")

    for what, message in (("frames", "cannot be written"), ("fcntl.flock", "cannot be locked")):
        with monkeypatch.context() as patch:
            patch.setattr(f"rodjax.files.recorder.{what}", broken)
            with pytest.raises(StorageError, match=f"{message}: .*Input/output error"):
                storage.Recorder.append(path)
    # and no lock was left behind
    storage.Recorder.append(path).close()


def test_a_full_disk_loses_the_chunk_alone(tmp_path, monkeypatch):
    path = tmp_path / "run.h5"
    recorder = storage.Recorder(path, SCENE, START)
    recorder(part(0))

    def full(_):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        with pytest.raises(StorageError, match="No space left"):
            recorder(part(1))
    assert_identical(storage.load(path).run.states, expected(1))
    recorder(part(1))
    recorder.close()
    assert_identical(storage.load(path).run.states, expected(2))


RECORD = """
    import sys
    import jax
    jax.config.update("jax_enable_x64", True)
    sys.path[:0] = sys.argv[2:]
    from test_recorder import SCENE, START, part
    from rodjax import storage
    parts = [part(i) for i in range(200)]
    recorder = storage.Recorder(sys.argv[1], SCENE, START)
    print("begun", flush=True)
    for one in parts:
        recorder(one)
    recorder.close()
    print("closed", flush=True)
"""
PLACES = [str(Path(file).parents[i]) for file, i in ((__file__, 0), (rodjax.__file__, 1))]


@pytest.mark.slow
def test_a_killed_process_leaves_what_it_had_appended(tmp_path):
    """Kill -9 at random times, in the middle of chunks and of the conversion at the end."""
    rng = np.random.default_rng(3)
    counts = []
    for trial in range(6):
        path = tmp_path / f"{trial}.h5"
        command = [sys.executable, "-c", textwrap.dedent(RECORD), str(path), *PLACES]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        assert process.stdout.readline() == "begun\n"
        time.sleep(rng.uniform(0.05, 1.5))
        process.send_signal(signal.SIGKILL)
        process.wait()
        process.stdout.close()
        try:
            stored = storage.load(path)
        except ModelWarning:  # an error in tests
            with pytest.warns(ModelWarning, match="cut off"):
                stored = storage.load(path)
        count = stored.steps_done // STEPS
        counts.append(count)
        if count:
            assert_identical(stored.run.states, expected(count))
    assert max(counts) > 3


@pytest.mark.slow
def test_a_real_run_is_recorded_cut_off_and_goes_on_bit_for_bit(tmp_path):
    path = tmp_path / "run.h5"
    first = start(SCENE)
    whole = adaptive_rollout(SCENE, first, 0.4, METHOD, CONTROL, chunk=CHUNK)
    before = []

    def die(run):
        if len(before) == 2:
            raise MemoryError
        before.append(path.read_bytes())

    def both(part):
        die(part)
        recorder(part)

    recorder = storage.Recorder(path, SCENE, first, method=METHOD, control=CONTROL)
    with pytest.raises(MemoryError):
        adaptive_rollout(SCENE, first, 0.4, METHOD, CONTROL, chunk=CHUNK, on_chunk=both)
    recorder._stream.close()
    stored = storage.load(path)
    assert stored.steps_done == 2 * CHUNK
    for content, steps in ((path.read_bytes(), 2 * CHUNK), (before[0], 0)):
        path.write_bytes(content)
        with storage.Recorder.append(path) as recorder:
            rest = recorder.resume(0.4, chunk=CHUNK)
        now = storage.load(path).run
        pick = lambda run: (run.states, run.infos, run.control)
        assert_identical(pick(now), pick(whole))
        if steps:
            assert_identical(pick(continued(stored.run, rest)), pick(whole))
    # beyond the former end: what was shortened to end there is made anew, in the file too
    longer = storage.load(path).resume(0.5, chunk=CHUNK)
    with storage.Recorder.append(path) as recorder:
        recorder.resume(0.5, chunk=CHUNK)
    assert_identical(pick(storage.load(path).run), pick(continued(whole, longer)))


def test_a_recorder_needs_a_state_and_a_scene(tmp_path):
    jaxtyping.config.update("jaxtyping_disable", True)
    try:
        with pytest.raises(StorageError, match="scene: "):
            storage.Recorder(tmp_path / "run.h5", START, SCENE)
        with pytest.raises(StorageError, match="state: "):
            storage.Recorder(tmp_path / "run.h5", SCENE, standing_run(SCENE, 1))
        with pytest.raises(StorageError, match="path: .* a Scene"):
            storage.Recorder(SCENE, START, tmp_path / "run.h5")
    finally:
        jaxtyping.config.update("jaxtyping_disable", False)
    assert list(tmp_path.iterdir()) == []
