"""Given steps outside traced code: one compiled loop for any number of them, heard by Ctrl-C."""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from rodjax.dynamics import passages, resolution
from rodjax.dynamics.run import Run
from rodjax.dynamics.stepping import StepInfo, no_info, step
from rodjax.equations import overlap
from rodjax.equations.generalized_alpha import GeneralizedAlpha
from rodjax.numerics.compilation import compiled
from rodjax.numerics.pace import Pace
from rodjax.numerics.results import Interrupted, Result, as_code
from rodjax.rods.state import State
from rodjax.scenes import drives
from rodjax.scenes.scene import Scene

# Most steps in one call: its buffers hold so many states.
_MOST = 64


class _Done(NamedTuple):
    """What has been computed; replaced as a whole, so that an interruption finds it consistent."""

    state: State  # after the last good step
    steps: int
    code: Result
    states: tuple[State, ...]  # saved, in pieces
    infos: tuple[StepInfo, ...]

    def so_far(self, start: State) -> tuple[State, StepInfo]:
        """States saved, that at the start among them, and what all steps told."""
        join = lambda *parts: np.concatenate(parts)
        first = jax.tree.map(lambda leaf: np.asarray(leaf)[None], start)
        return jax.tree.map(join, first, *self.states), jax.tree.map(join, *self.infos)


def run_given_steps(
    scene: Scene,
    state: State,
    times: np.ndarray,
    method: GeneralizedAlpha,
    save_every: int,
    progress: Callable[[float, int], None] | None = None,
) -> Run:
    """The run through given times; what comes after a failure is not a number.

    Args:
        progress: called about once a second with the time reached and the steps made.

    Raises:
        Interrupted: by Ctrl-C, with the states saved until then.
    """
    times = onto_switches(scene, float(state.time), times, np)
    nothing = lambda leaf: np.zeros((0, *leaf.shape), leaf.dtype)
    none = jax.tree.map(nothing, (state, no_info(state.position.dtype)))
    done, pace = _Done(state, 0, Result.SUCCESS, none[:1], none[1:]), Pace(_MOST)
    held = overlap.distances_held(scene)
    try:
        while done.code is Result.SUCCESS and done.steps < len(times):
            done = _advance(scene, done, times, method, save_every, pace, held)
            if progress is not None:
                progress(float(done.state.time), done.steps)
    except KeyboardInterrupt as error:
        states, infos = done.so_far(state)
        told = save_every * (len(states.time) - 1)
        partial = _run(states, jax.tree.map(lambda leaf: leaf[:told], infos), Result.INTERRUPTED)
        raise Interrupted(f"after t = {float(done.state.time):g}", partial) from error
    states, infos = done.so_far(state)
    pad = lambda leaf: np.concatenate([leaf, np.zeros(len(times) - len(leaf), leaf.dtype)])
    run = _run(states, jax.tree.map(pad, infos), done.code)
    saved = np.append(states.time[:1], times[save_every - 1 :: save_every])
    if done.code is Result.SUCCESS:
        return _judged(scene, run, times, method)
    return _failed(run, done.code, done.steps, saved)


def until_failure(run: Run) -> Run:
    """The states of a run, and what its steps told, up to its first failure."""
    told = np.asarray(run.infos.result)
    if not np.any(told):
        return run
    every = len(told) // (len(run.times) - 1)
    count = int(np.argmax(told != 0)) // every
    cut = lambda tree, length: jax.tree.map(lambda leaf: jnp.asarray(leaf[:length]), tree)
    return dataclasses.replace(
        run, states=cut(run.states, count + 1), infos=cut(run.infos, count * every)
    )


def _advance(scene, done: _Done, times, method, save_every: int, pace: Pace, held) -> _Done:
    """One call of the loop."""
    index = np.arange(done.steps, min(done.steps + _MOST, len(times)))
    stops = np.full(_MOST, times[-1])
    stops[: len(index)] = times[index]
    saved = (index + 1) % save_every == 0
    slots = np.full(_MOST, _MOST, np.int32)  # the last stands for none
    slots[: len(index)] = np.where(saved, np.cumsum(saved) - 1, _MOST)
    out = pace.call(
        lambda passes: _loop(
            scene,
            done.state,
            jnp.asarray(stops),
            jnp.asarray(slots),
            jnp.minimum(passes, jnp.asarray(len(index), jnp.int32)),
            method,
            held,
        )
    )
    tried, code = int(out.steps), Result(int(out.code))
    good = tried if code is Result.SUCCESS else tried - 1
    cut = lambda tree, count: jax.tree.map(lambda leaf: np.asarray(leaf)[:count], tree)
    states, infos = cut(out.states, int(np.sum(saved[:good]))), cut(out.infos, tried)
    return _Done(out.state, done.steps + good, code, (*done.states, states), (*done.infos, infos))


class _Loop(NamedTuple):
    state: State
    states: State
    infos: StepInfo
    steps: Int[Array, ""]  # taken, a failed one among them
    code: Int[Array, ""]


@compiled
def _loop(
    scene: Scene,
    state: State,
    stops: Float[Array, " most"],
    slots: Int[Array, " most"],
    count: Int[Array, ""],
    method: GeneralizedAlpha,
    held: Float[Array, " g"] | None,
) -> _Loop:
    """`count` steps to the first of `stops`, or until one fails, each state put into its slot."""
    most = stops.shape[0]
    empty = lambda leaf: jnp.zeros((most, *leaf.shape), leaf.dtype)

    def one(loop: _Loop) -> _Loop:
        i = loop.steps
        new, info = step(scene, loop.state, stops[i], method, held)
        good = info.result == Result.SUCCESS
        slot = jnp.where(good, slots[i], most)
        put = lambda buffer, value: buffer.at[slot].set(value, mode="drop")
        return _Loop(
            jax.tree.map(lambda a, b: jnp.where(good, a, b), new, loop.state),
            jax.tree.map(put, loop.states, new),
            jax.tree.map(lambda buffer, value: buffer.at[i].set(value), loop.infos, info),
            i + 1,
            info.result,
        )

    zero = jnp.asarray(0, jnp.int32)
    infos = jax.tree.map(empty, no_info(state.position.dtype))
    going = lambda loop: (loop.steps < count) & (loop.code == Result.SUCCESS)
    begun = _Loop(state, jax.tree.map(empty, state), infos, zero, zero)
    return lax.while_loop(going, one, begun)


def onto_switches(scene: Scene, start, times, xp=jnp):
    """The times, those within rounding of a switch exactly on it, in numpy or jax.numpy."""
    steps = xp.diff(times, prepend=start)
    for switch in scene.switch_times:
        at = xp.asarray(switch, times.dtype)
        times = xp.where(xp.abs(times - at) <= 1e-6 * steps, at, times)
    return times


def _run(states: State, infos: StepInfo, code: Result) -> Run:
    # put, not converted: that would compile a program for every length
    states, infos = jax.tree.map(jax.device_put, (states, infos))
    none = jnp.asarray(0, jnp.int32)
    return Run(states, infos, as_code(code), none, none)


def _failed(run: Run, code: Result, good: int, saved: np.ndarray) -> Run:
    """A run of which `good` steps are, at all of its saved times: then what is not a number."""
    count = 1 + good // (run.infos.result.shape[0] // (len(saved) - 1))

    def lost(leaf):
        rest = np.zeros((len(saved) - count, *leaf.shape[1:]), leaf.dtype)
        rest = rest + np.nan if np.issubdtype(leaf.dtype, np.floating) else rest
        return np.concatenate([np.asarray(leaf)[:count], rest.astype(leaf.dtype)])

    states = jax.tree.map(lost, run.states)
    states.time[:] = saved
    infos = jax.tree.map(np.array, run.infos)
    infos.result[good:] = int(code)
    return _run(states, infos, code)


def _judged(scene: Scene, run: Run, times: np.ndarray, method: GeneralizedAlpha) -> Run:
    """The run with what shows only when it has ended."""
    states, infos = jax.tree.map(np.asarray, (run.states, run.infos))
    steps = np.diff(times, prepend=states.time[0])
    if resolution.unresolved(scene, states, infos, steps):
        return _run(states, infos, Result.UNRESOLVED)
    first = passages.first_passage(scene, run.states)
    if first is not None:
        good = (first - 1) * (len(times) // (len(states.time) - 1))
        return _failed(run, Result.STRAND_PASSAGE, good, states.time)
    if drives.astray(scene, run.states, method.newton_error(states.position.dtype, len(times))):
        return _run(states, infos, Result.DRIVE_MISSED)
    return run
