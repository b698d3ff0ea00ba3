"""Rollouts whose steps are chosen by the local error."""

import dataclasses
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rodjax.dynamics import passages
from rodjax.dynamics.attempts import Chunk, attempt_steps
from rodjax.dynamics.coarseness import warn_if_hopeless
from rodjax.dynamics.consistency import compiled_restart, start
from rodjax.dynamics.run import Run, join_runs
from rodjax.dynamics.step_control import (
    Control,
    StepControl,
    begin,
    tolerances_of,
)
from rodjax.dynamics.stepping import (
    StepInfo,
    begin_constraint,
    no_info,
    prepare,
    switching,
)
from rodjax.dynamics.unexcited import warn_if_unexcited
from rodjax.equations import overlap
from rodjax.equations.generalized_alpha import GeneralizedAlpha
from rodjax.inputs.argument_types import AnyArray
from rodjax.inputs.validation import all_known, as_integer, check_instance, check_integer
from rodjax.numerics import results
from rodjax.numerics.pace import Pace
from rodjax.numerics.results import Interrupted, Result, as_code
from rodjax.rods.state import State
from rodjax.scenes import drives
from rodjax.scenes.arguments import check_end_time, check_motion
from rodjax.scenes.placing import placing
from rodjax.scenes.scene import Scene


class _Progress(NamedTuple):
    """What has been computed; replaced as a whole, so that an interruption finds it consistent."""

    state: State
    control: Control
    begun: tuple[State, Control]  # where the chunk began
    pieces: tuple[tuple[State, StepInfo], ...]  # accepted in the chunk, call by call
    parts: tuple[Run, ...] = ()  # the chunks before
    accepted: int = 0  # in the parts
    rejected: int = 0
    wasted: int = 0
    loss: Array | None = None  # of the constraint that began with the chunk
    code: Result = Result.SUCCESS
    done: bool = False
    switching: bool = False

    @classmethod
    def of(cls, state: State, control: Control) -> "_Progress":
        return cls(state, control, (state, control), (cls._nothing(state),))

    @staticmethod
    def _nothing(state: State) -> tuple[State, StepInfo]:
        empty = lambda leaf: np.zeros((0, *leaf.shape), leaf.dtype)
        return jax.tree.map(empty, (state, no_info(state.position.dtype)))

    @property
    def count(self) -> int:
        """Steps accepted in the chunk."""
        return sum(len(states.time) for states, _ in self.pieces)

    @property
    def chunk_kept(self) -> bool:
        """Whether the last chunk closed has steps."""
        return len(self.parts[-1].states.time) > 0

    def entering(self, scene: Scene) -> "_Progress":
        """At the begin of a chunk, with a constraint that begins there."""
        if not (scene.switch_times and bool(switching(scene, self.state))):
            return self
        state, loss, held = begin_constraint(scene, self.state, compiled_restart)
        code = Result(int(held))
        return self._replace(state=state, loss=loss, code=code, done=code is not Result.SUCCESS)

    def longer(self, out: Chunk) -> "_Progress":
        """With the steps of a call."""
        cut = lambda leaf: np.asarray(leaf)[: int(out.accepted)]
        return self._replace(
            state=out.state,
            control=out.control,
            pieces=(*self.pieces, jax.tree.map(cut, (out.states, out.infos))),
            rejected=self.rejected + int(out.rejected),
            wasted=self.wasted + int(out.wasted),
            code=Result(int(out.result)),
            done=bool(out.done),
            switching=bool(out.switching),
        )

    def closed(self, scene: Scene, max_steps: int) -> "_Progress":
        """With the chunk among the parts, unless a strand passed in it."""
        now, count = self, self.count
        if count and passages.passed_unseen(scene, self.begun[0], self.state):
            # somewhere in this chunk, of which nothing is kept
            state, control = self.begun
            code, none = Result.STRAND_PASSAGE, (self._nothing(state),)
            now = now._replace(state=state, control=control, pieces=none, code=code, done=True)
            count = 0
        accepted = now.accepted + count
        if not now.done and accepted >= max_steps:
            now = now._replace(code=Result.MAX_STEPS, done=True)
        states, infos = jax.tree.map(lambda *parts: np.concatenate(parts), *now.pieces)
        if now.loss is not None and count:
            infos.projection_loss[0] = now.loss
        as_int = lambda x: jnp.asarray(x, jnp.int32)
        counts = as_code(now.code), as_int(now.rejected), as_int(now.wasted)
        part = Run(states, infos, *counts, now.control)
        return now._replace(
            begun=(now.state, now.control),
            pieces=(self._nothing(now.state),),
            parts=(*now.parts, part),
            accepted=accepted,
            loss=None,
            switching=False,
        )


def adaptive_rollout(
    scene: Scene,
    state: State,
    end_time: float | None = None,
    method: GeneralizedAlpha | None = None,
    control: StepControl | None = None,
    *,
    resume: Control | None = None,
    max_steps: int = 100_000,
    chunk: int = 50,
    on_chunk: Callable[[Run], None] | None = None,
    stops: Float[AnyArray, " s"] | None = None,
    progress: Callable[[float, int], None] | None = None,
    throw: bool = True,
) -> Run:
    """Run to `end_time` with steps chosen by the local error; every accepted step is saved.

    Steps end exactly on the times at which a constraint or a drive's rate changes (and a
    constraint that begins at `end_time` itself is left to the run resumed from there). The loop
    is compiled once, in calls of about a second; `on_chunk(part)` is called after each `chunk` of
    accepted steps (and for what an interruption leaves of one), for progress and storage, with a
    `Run` of these steps (its states lack the start, its counts are those so far; see `join_runs`;
    none if the run fails before the first of them); `rodjax.storage.Recorder` keeps them.
    A chunk over which Tw + Wr jumped is dropped and the run fails by STRAND_PASSAGE; where strands
    would overlap so far that the contact cannot hold them, with steps of any size, it ends by
    CONTACT_OVERCOME. Not differentiable itself: replay `run.times[1:]` by `rollout`, whose
    derivative is exact for that schedule.
    `compile_adaptive_rollout` compiles the loop beforehand.

    Args:
        scene, state: the scene, and where the run begins (`start(scene)`, or the end of a run).
        end_time: where it ends [s].
        method: the time integration; default `GeneralizedAlpha()`.
        control: tolerances and bounds of the steps; default `StepControl()`.
        resume: `run.control` of a run to go on with, from `state=run.resume_state`. Both are those
            of before the last steps were shortened to end on that run's end time, so that with the
            same bounds of the step (`StepControl.max_step`; by default they depend on the span of
            the first run, and are kept) it does not matter, in any bit, where a run was cut; see
            `rodjax.run.continued`.
        max_steps: accepted steps after which the run fails by MAX_STEPS.
        chunk: accepted steps between two returns to Python.
        on_chunk: called with every part.
        stops: increasing times on which steps end as well, such as those of samples [s].
        progress: called about once a second with the time reached [s] and the steps accepted.
        throw: raise `SimulationError` if the run fails; else its code is in `Run.result`.

    Raises:
        ValueError: a schedule of the scene ends before `end_time`, a tolerance is out of reach of
            the precision, or something is traced.
        SimulationError: the run failed; its `.partial` is the run up to the failure.
        Interrupted: Ctrl-C; its `.partial` is the run up to then, to be resumed as any other.

    Example:
        >>> run = rx.adaptive_rollout(scene, rx.start(scene), 0.05)
        >>> float(run.times[-1])
        0.05
    """
    check_motion(scene, state)
    check_end_time(end_time)
    assert end_time is not None
    if not all_known(scene, state, end_time, method, control, resume):
        raise ValueError(
            "scene, state: adaptive_rollout cannot be traced; replay its times by"
            " rollout(scene, state, run.times[1:]) inside jit, grad or vmap"
        )
    span = float(end_time) - float(state.time)
    chunk, max_steps = as_integer(chunk), as_integer(max_steps)
    check_integer(1, chunk=chunk)
    check_integer(1, 2**31 - 1, max_steps=max_steps)
    if not span > 0:
        raise ValueError(f"end_time: must lie after the state's time {float(state.time):g}")
    scene.check_until(float(end_time))
    overlap.check_apart(scene, state)
    state = prepare(scene, state)
    method = GeneralizedAlpha() if method is None else method
    control = StepControl() if control is None else control
    check_instance(GeneralizedAlpha, "give GeneralizedAlpha(...)", method=method)
    check_instance(StepControl, "give StepControl(...)", control=control)
    dtype = state.position.dtype
    method.check_precision(dtype)
    tolerances = tolerances_of(control, dtype)
    memory = begin(control, span, dtype, resume)
    end, size = jnp.asarray(end_time, dtype), min(chunk, max_steps)
    held = overlap.distances_held(scene)

    ends = None if stops is None else np.asarray(stops, dtype)

    def some(now: _Progress, passes) -> Chunk:
        room = jnp.asarray(size - now.count, jnp.int32)
        arguments = (end, method, tolerances, held, room, passes, size)
        if ends is not None:
            arguments = (*arguments, _next_of(ends, now.state.time, size))
        return attempt_steps(scene, now.state, now.control, *arguments)

    now, pace = _Progress.of(state, memory), Pace(size)
    try:
        while not now.done:
            now = now.entering(scene)
            while not (now.done or now.switching or now.count >= size):
                now = now.longer(pace.call(partial(some, now)))
                if progress is not None:
                    progress(float(now.state.time), now.accepted + now.count)
            now = now.closed(scene, max_steps)
            if on_chunk is not None and (now.chunk_kept or now.code is not Result.SUCCESS):
                on_chunk(now.parts[-1])
    except KeyboardInterrupt as error:
        now = now._replace(code=Result.INTERRUPTED, done=True)
        if now.count or not now.parts:
            now = now.closed(scene, max_steps)
            if on_chunk is not None and now.chunk_kept:
                on_chunk(now.parts[-1])
        run = dataclasses.replace(join_runs(state, list(now.parts)), result=as_code(now.code))
        raise Interrupted(f"after t = {float(run.times[-1]):g}", run) from error
    run, code = join_runs(state, list(now.parts)), now.code
    allowed = method.newton_error(dtype, now.accepted)
    if code is Result.SUCCESS and drives.astray(scene, run.states, allowed):
        code = Result.DRIVE_MISSED
        run = dataclasses.replace(run, result=as_code(code))
    if throw:
        results.raise_if_failed(code, f"after t = {float(run.times[-1]):g}", run)
    warn_if_hopeless(run)
    warn_if_unexcited(scene, run)
    return run


def _next_of(stops: np.ndarray, now: Array, size: int) -> np.ndarray:
    """The next stops, more than steps of a chunk can reach: one program whatever their number."""
    coming = stops[np.searchsorted(stops, np.asarray(now), side="right") :][:size]
    return np.concatenate([coming, np.full(size - len(coming), np.inf, stops.dtype)])


def compile_adaptive_rollout(
    scene: Scene,
    state: State | None = None,
    method: GeneralizedAlpha | None = None,
    *,
    chunk: int = 50,
    meanwhile: Callable[[], object] | None = None,
) -> Future:
    """Compile the loop of `adaptive_rollout` for this scene and chunk without taking a step.

    What else a run needs is compiled at the same time in a thread of its own: the passage check,
    what begins a constraint, and without a state `start(scene)`.

    Args:
        scene, state, method: those of the run to come.
        chunk: as in `adaptive_rollout`.
        meanwhile: called in that thread in the end, and not waited for: a run may begin before it
            is done. For `rodjax.measuring.beforehand.compile_measures`, or the import of plots.

    Returns:
        The future of `meanwhile` (of None, if there is none): its `result()` waits, and raises what
        it raised.
    """
    chunk = as_integer(chunk)
    check_integer(1, chunk=chunk)
    if state is not None:
        check_motion(scene, state)
    if method is not None:
        check_instance(GeneralizedAlpha, "give GeneralizedAlpha(...)", method=method)
    given = placeholder(scene) if state is None else prepare(scene, state)
    control, dtype = StepControl(), given.position.dtype
    method = GeneralizedAlpha() if method is None else method
    memory, tolerances = begin(control, 1.0, dtype), tolerances_of(control, dtype)
    none = jnp.asarray(0, jnp.int32)
    held, end = overlap.distances_held(scene), given.time
    arguments = (scene, given, memory, end, method, tolerances, held, none, none, chunk)
    # traced before anything else: what the other thread traces meanwhile would hold it up
    loop = attempt_steps.lower(*arguments)
    other = ThreadPoolExecutor(1)
    try:
        starting = other.submit(_compile_others, scene, given, state is None)
        rest = other.submit(meanwhile if meanwhile is not None else lambda: None)
        loop.compile()
        jax.block_until_ready(attempt_steps(*arguments))
        starting.result()
    finally:
        other.shutdown(wait=False)
    return rest


def _compile_others(scene: Scene, state: State, with_start: bool) -> None:
    """What a run is begun by, and its chunks are begun and closed by."""
    if with_start:
        start(scene)
    passages.passed_unseen(scene, state, state)
    if scene.switch_times:
        begin_constraint(scene, state, compiled_restart)
    drives.astray(scene, _in_a_second(state), 0.0)


def _in_a_second(state: State) -> State:
    """A state twice, a second later."""
    both = jax.tree.map(lambda leaf: np.stack([leaf, leaf]), state)
    return dataclasses.replace(both, time=both.time + np.asarray([0, 1], both.time.dtype))


def placeholder(scene: Scene) -> State:
    """A state of the kind that runs hand on, to compile with."""
    state = prepare(scene, placing(scene))
    return state if scene.rod.mass is None else dataclasses.replace(state, jerk=state.rate)
