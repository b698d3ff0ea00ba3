"""Ctrl-C keeps what was computed, and calls of any length compute the same."""

import os
import signal
import threading

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import UNIT_SECTION

from rodjax.constraints.ends import Clamped
from rodjax.dynamics.adaptive import adaptive_rollout
from rodjax.dynamics.consistency import start
from rodjax.dynamics.fixed_rollout import rollout
from rodjax.inputs.schedules import Function
from rodjax.interactions.loads import LinearDrag, PointLoad
from rodjax.numerics import pace
from rodjax.numerics.pace import Pace
from rodjax.numerics.results import Interrupted, Result
from rodjax.rods.builders import straight_rod
from rodjax.scenes.scene import Scene

TRACED = []
"""One entry for every time that a program is traced."""


def pull(time):
    """A tip load that swings, so that every step is another."""
    TRACED.append(time)
    return jnp.asarray([0.3, 0.1, 0.0]) * jnp.sin(9 * time)


SCENE = Scene(
    straight_rod(1.0, 6, UNIT_SECTION),
    Clamped(),
    loads=(LinearDrag(1.0, 1.0, 0.1), PointLoad(-1, Function(pull))),
)
TIMES = jnp.linspace(0.0, 0.9, 91)[1:]


@pytest.fixture(scope="module")
def state():
    return start(SCENE)


@pytest.fixture(scope="module")
def whole(state):
    """Both kinds of run, never interrupted."""
    return rollout(SCENE, state, TIMES), adaptive_rollout(SCENE, state, 0.9, chunk=8)


class Steady(pace.Pace):
    """So many passes in every call, and Ctrl-C in one of them."""

    passes_a_call, interrupted = 1, -1

    def __init__(self, most):
        super().__init__(most)
        self.calls = 0

    def call(self, loop):
        self.calls += 1
        if self.calls - 1 == self.interrupted:
            raise KeyboardInterrupt
        return loop(jnp.asarray(min(self.passes_a_call, self.most), jnp.int32))


@pytest.fixture
def steady(monkeypatch):
    """Set the passes of a call, and the call that Ctrl-C hits."""

    def set_to(passes, interrupted=-1):
        kind = type("Kind", (Steady,), {"passes_a_call": passes, "interrupted": interrupted})
        for module in ("rodjax.dynamics.given_steps.Pace", "rodjax.dynamics.adaptive.Pace"):
            monkeypatch.setattr(module, kind)

    return set_to


def assert_same(one, other):
    """Equal to the last bit."""
    jax.tree.map(np.testing.assert_array_equal, one, other)


@pytest.mark.slow
@pytest.mark.parametrize("passes", [1, 7])
def test_calls_of_any_length_compute_the_same(whole, state, steady, passes):
    steady(passes)
    assert_same(rollout(SCENE, state, TIMES), whole[0])
    assert_same(adaptive_rollout(SCENE, state, 0.9, chunk=8), whole[1])


def test_a_rollout_keeps_what_was_saved(whole, state, steady):
    steady(7, interrupted=5)
    for every, saved in ((1, 35), (10, 3), (90, 0)):
        with pytest.raises(Interrupted, match="after t = 0.35: stopped by the user") as stop:
            rollout(SCENE, state, TIMES, save_every=every, throw=False)
        partial = stop.value.partial
        assert stop.value.result is Result.INTERRUPTED == int(partial.result)
        kept = slice(0, 36, every)
        assert_same(partial.states, jax.tree.map(lambda x, k=kept: x[k], whole[0].states))
        assert partial.infos.iterations.shape == (every * saved,)


@pytest.mark.slow
@pytest.mark.parametrize("call", [0, 3, 9])
def test_an_adaptive_run_goes_on_from_where_it_was_stopped(whole, state, steady, call):
    """Within a chunk too; what was accepted of it is given to `on_chunk`."""
    steady(3, interrupted=call)
    seen = []
    with pytest.raises(Interrupted) as stop:
        adaptive_rollout(SCENE, state, 0.9, chunk=8, on_chunk=seen.append)
    partial = stop.value.partial
    assert int(partial.result) == Result.INTERRUPTED
    assert sum(len(part.states.time) for part in seen) == len(partial.times) - 1
    assert (len(partial.times) > 1) == (call > 0)
    steady(50)
    rest = adaptive_rollout(SCENE, partial.final, 0.9, resume=partial.control)
    assert_same(rest.final, whole[1].final)
    assert len(partial.times) + len(rest.times) - 1 == len(whole[1].times)


def test_ctrl_c_in_on_chunk_keeps_the_chunk_once(state):
    seen = []

    def stop_at_second(part):
        seen.append(part)
        if len(seen) == 2:
            raise KeyboardInterrupt

    with pytest.raises(Interrupted) as stop:
        adaptive_rollout(SCENE, state, 0.9, chunk=8, on_chunk=stop_at_second)
    assert len(stop.value.partial.times) == 17 and len(seen) == 2


def test_a_signal_stops_a_run(state, monkeypatch):
    """Scripts end by it: no `except Exception` holds it."""
    long, call, calls = jnp.linspace(0.0, 1e4, 1_000_001)[1:], Pace.call, []
    stopped = threading.Event()

    def press():
        # again where Python lost it, as in a destructor
        if not stopped.wait(0.1):
            os.kill(os.getpid(), signal.SIGINT)
        while not stopped.wait(5.0):  # the whole run takes some half a minute
            os.kill(os.getpid(), signal.SIGINT)

    def counted(pace, loop):
        out = call(pace, loop)
        calls.append(out)
        if len(calls) == 2:  # the first call's steps are kept by now
            threading.Thread(target=press).start()
        return out

    monkeypatch.setattr(Pace, "call", counted)
    # a shell that starts the tests in the background has the signal ignored
    handler = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt) as stop:
            rollout(SCENE, state, long, throw=False)
    finally:
        stopped.set()
        signal.signal(signal.SIGINT, handler)
    assert not isinstance(stop.value, Exception)
    partial = stop.value.partial
    assert 1 < len(partial.times) < len(long)
    assert np.all(np.isfinite(partial.final.position))


def test_one_program_serves_any_number_of_steps_and_saves(whole, state):
    before = len(TRACED)
    for count, every in ((1, 1), (5, 1), (70, 1), (90, 3), (84, 42)):
        rollout(SCENE, state, TIMES[:count], save_every=every)
    assert len(TRACED) == before
