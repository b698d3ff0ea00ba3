"""Runs that were stored go on bit for bit, wherever they were cut."""

import jax.numpy as jnp
import pytest
from helpers import assert_identical, switched_scene

from rodjax import storage
from rodjax.dynamics.adaptive import adaptive_rollout
from rodjax.dynamics.consistency import start
from rodjax.dynamics.fixed_rollout import rollout
from rodjax.dynamics.run import continued, join_runs
from rodjax.dynamics.step_control import StepControl
from rodjax.equations.generalized_alpha import GeneralizedAlpha
from rodjax.numerics.results import Result

CHUNK = 8
END = 1.0
METHOD = GeneralizedAlpha(0.7)
CONTROL = StepControl(absolute=1e-4)


@pytest.fixture(scope="module")
def example():
    """A scene and its uninterrupted run."""
    scene = switched_scene()
    run = adaptive_rollout(scene, start(scene), END, METHOD, CONTROL, chunk=CHUNK)
    assert len(run.times) > 4 * CHUNK
    return scene, run


@pytest.mark.slow
@pytest.mark.parametrize("stop_after", [1, 3])
def test_interrupted_run_goes_on_bit_for_bit(example, tmp_path, stop_after):
    """Ctrl-C between two chunks: the parts seen so far are a run that can be stored and resumed.

    No step bounds are given: those chosen for the whole run are part of the stored memory.
    """
    scene, whole = example
    parts = []

    def on_chunk(part):
        parts.append(part)
        if len(parts) == stop_after:
            raise KeyboardInterrupt

    first = start(scene)
    with pytest.raises(KeyboardInterrupt):
        adaptive_rollout(scene, first, END, METHOD, CONTROL, chunk=CHUNK, on_chunk=on_chunk)
    interrupted = join_runs(first, parts[:stop_after])
    assert len(interrupted.times) == 1 + stop_after * CHUNK
    storage.save(tmp_path / "run.h5", scene, interrupted, method=METHOD, control=CONTROL)
    rest = storage.load(tmp_path / "run.h5").resume(END, chunk=CHUNK)
    assert_same_motion(continued(interrupted, rest), whole)


def assert_same_motion(a, b):
    """Equal states, reports and memory, bit for bit."""
    pick = lambda run: (run.states, run.infos, run.control)
    assert_identical(pick(a), pick(b))


@pytest.mark.slow
def test_run_stopped_anywhere_goes_on_bit_for_bit(example, tmp_path):
    """A stop that is not at a multiple of the chunk: boundaries of chunks do not matter."""
    scene, whole = example
    stopped = adaptive_rollout(scene, start(scene), END, METHOD, CONTROL, max_steps=5, throw=False)
    assert int(stopped.result) == Result.MAX_STEPS
    storage.save(tmp_path / "run.h5", scene, stopped, method=METHOD, control=CONTROL)
    rest = storage.load(tmp_path / "run.h5").resume(END, chunk=CHUNK)
    assert_same_motion(continued(stopped, rest), whole)


# the constraint begins at 0.4 and the drive has a corner at 1.0; the last is within a step
STOPS = [(0.4,), (0.1, 0.25), (0.39, 0.41, 0.9), (0.2, 0.2000001)]


@pytest.mark.slow
@pytest.mark.parametrize("stops", STOPS, ids=str)
def test_a_resumed_run_does_not_depend_on_where_it_was_cut(example, tmp_path, stops):
    """Steps shortened to end on an end time are made anew by what goes on from there."""
    scene, _ = example
    # a bound of the step that does not depend on the span of the first run
    control = StepControl(absolute=1e-4, max_step=0.05)
    whole = adaptive_rollout(scene, start(scene), END, METHOD, control, chunk=CHUNK)
    run = adaptive_rollout(scene, start(scene), stops[0], METHOD, control, chunk=CHUNK)
    for stop in (*stops[1:], END):
        assert float(run.times[-1]) in stops
        storage.save(tmp_path / "run.h5", scene, run, method=METHOD, control=control)
        rest = storage.load(tmp_path / "run.h5").resume(stop, chunk=CHUNK)
        assert float(rest.times[-1]) == stop
        run = continued(run, rest)
    assert_same_motion(run, whole)


@pytest.mark.slow
def test_schedule_goes_on_where_it_stopped(example, tmp_path):
    scene, _ = example
    schedule = jnp.linspace(0.0, 0.3, 13)[1:]
    first = start(scene)
    halves = [rollout(scene, first, schedule[:6], METHOD)]
    path = tmp_path / "run.h5"
    storage.save(path, scene, halves[0], method=METHOD, schedule=schedule)
    halves.append(storage.load(path).resume())
    # the same compiled program for either half: to be compared bit for bit
    expected = rollout(scene, halves[0].final, schedule[6:], METHOD)
    assert_identical(halves[1], expected)
    assert float(halves[1].times[-1]) == float(schedule[-1])
    storage.save(path, scene, expected, method=METHOD, schedule=schedule[6:])
    with pytest.raises(ValueError, match="end_time"):
        storage.load(path).resume()
