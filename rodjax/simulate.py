"""Rollouts: over given times by `lax.scan`, or with the step chosen by the local error."""

import dataclasses
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from rodjax import newton, results
from rodjax.compilation import compiled
from rodjax.consistency import compiled_restart, start
from rodjax.equilibrium import placing
from rodjax.generalized_alpha import GeneralizedAlpha
from rodjax.results import Result
from rodjax.rotations import logarithm
from rodjax.scene import Scene
from rodjax.state import State
from rodjax.step import StepInfo, advance_to, begin_constraint, no_info, prepare, step, switching
from rodjax.strains import relative_rotation


class Run(eqx.Module):
    """A stored motion: the states saved, the first being the start, and what every step told.

    `states` has a leading axis over the saved states, `infos` over the accepted steps. `control`
    is the step control's memory of an adaptive run (None otherwise): with it, resuming continues
    bit for bit.
    """

    states: State
    infos: StepInfo
    result: Int[Array, ""]
    rejected: Int[Array, ""]
    wasted_iterations: Int[Array, ""]
    control: "Control | None" = None

    @property
    def times(self) -> Float[Array, " k"]:
        """Times of the saved states."""
        return self.states.time

    @property
    def final(self) -> State:
        """The last state."""
        return jax.tree.map(lambda leaf: leaf[-1], self.states)

    def state(self, index: int) -> State:
        """One saved state."""
        return jax.tree.map(lambda leaf: leaf[index], self.states)

    def nearest(self, time: float) -> State:
        """The saved state nearest to a time."""
        return self.state(int(np.argmin(np.abs(np.asarray(self.times) - time))))


def _is_traced(*trees) -> bool:
    leaves = jax.tree.leaves(trees)
    return any(isinstance(leaf, jax.core.Tracer) for leaf in leaves)


def rollout(
    scene: Scene,
    state: State,
    times: Float[Array, " k"],
    method: GeneralizedAlpha | None = None,
    *,
    save_every: int = 1,
    throw: bool = True,
) -> Run:
    """Step from one given time to the next by `lax.scan`, saving by step index.

    Args:
        times: ends of the steps, increasing, the first after `state.time`. A time at which an
            end's constraint changes must be among them (within 1e-6 of a step; it is then made
            exact).
        save_every: store every so many steps; the number of steps must be a multiple.
        throw: raise `SimulationError` if a step fails. Either way the motion up to the failure
            is in the result (the states after it repeat the last good one).

    Differentiable in every array of scene, state, times and method, in forward and reverse mode;
    the reverse pass keeps of every step Newton's solution, of every `save_every` steps the state,
    and recomputes the rest block by block without iterating. Each step's solution takes a quarter
    of a state, so 10 or 20 steps a block nearly reach the least memory. The times at which
    constraints change, and the contact's `exclusion`, have no derivative.

    Raises:
        ValueError: times or schedules do not fit (checked outside traced code).
        SimulationError: a step failed.
    """
    state = prepare(scene, state)
    method = GeneralizedAlpha() if method is None else method
    times = jnp.asarray(times, state.position.dtype)
    if times.ndim != 1 or times.shape[0] < 1 or times.shape[0] % save_every:
        raise ValueError(
            f"save_every: {save_every} does not divide the {times.shape[0]} steps of `times`"
        )
    if not _is_traced(scene, state, times):
        check_times(scene, state, times)
        method.check_precision(state.position.dtype)
    run = _rollout(scene, state, times, method, save_every)
    if throw:
        if _is_traced(run.result):
            message = "a step failed; call with throw=False and look at `result`"
            run = eqx.error_if(run, run.result != Result.SUCCESS, message)
        else:
            done = run.times[-1] if run.result == 0 else jnp.max(run.times)
            results.raise_if_failed(run.result, f"after t = {float(done):g}", run)
    return run


def check_times(scene, state, times):
    given = np.asarray(times)
    steps = np.diff(np.concatenate([[float(state.time)], given]))
    if not np.all(np.isfinite(given)) or np.any(steps <= 0):
        raise ValueError("times: must be finite and increase from after the state's time")
    scene.check_until(float(given[-1]))
    for switch in map(float, scene.switch_times):
        if not float(state.time) < switch < given[-1]:
            continue
        nearest = int(np.argmin(np.abs(given - switch)))
        if abs(given[nearest] - switch) > 1e-6 * steps[nearest]:
            raise ValueError(
                f"times: a constraint changes at {switch:g}, which must be one of the times"
            )


def onto_switches(scene, start, times):
    """The times, those within rounding of a switch exactly on it."""
    steps = jnp.diff(times, prepend=start)
    for switch in scene.switch_times:
        times = jnp.where(jnp.abs(times - switch) <= 1e-6 * steps, switch, times)
    return times


@compiled
def _rollout(scene, state, times, method, save_every):
    def one(carry, stop):
        before, failed = carry
        # after a failure no iterations are made
        left = jnp.where(failed == Result.SUCCESS, method.max_iterations, 0)
        limited = dataclasses.replace(method, max_iterations=left)
        after, info = step(scene, before, stop, limited)
        info = jax.tree.map(
            lambda leaf: jnp.where(failed == Result.SUCCESS, leaf, jnp.zeros_like(leaf)), info
        )
        code = jnp.where(failed == Result.SUCCESS, info.result, failed)
        info = info._replace(result=code)
        good = code == Result.SUCCESS
        after = jax.tree.map(lambda new, old: jnp.where(good, new, old), after, before)
        return (after, code), info

    # the reverse pass takes Newton's solutions from the forward pass and recomputes the rest
    keep = jax.checkpoint_policies.save_only_these_names(newton.SOLUTION)
    again = partial(jax.checkpoint, policy=keep, prevent_cse=False)

    @again
    def block(carry, stops):
        carry, infos = lax.scan(again(one), carry, stops)
        return carry, (carry[0], infos)

    times = onto_switches(scene, state.time, times)
    start = (state, jnp.asarray(0, jnp.int32))
    (_, code), (states, infos) = lax.scan(block, start, times.reshape(-1, save_every))
    states = jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest]), state, states)
    infos = jax.tree.map(lambda leaf: leaf.reshape((-1, *leaf.shape[2:])), infos)
    zero = jnp.asarray(0, jnp.int32)
    return Run(states, infos, code, zero, zero)


class StepControl(eqx.Module):
    """How the adaptive rollout chooses its steps.

    A step is accepted if its local error is at most `relative` times the step's own increment
    plus `absolute` times the size of the deformation, both for displacements (in tenths of the
    rod's length) and for rotations of the tangent [rad]. The size is the rod's total bending
    angle, at most 1 rad: so a growing mode is followed from its imperfection on, while vibrations
    that are small beside a developed shape are not resolved. Rotations are watched because a
    straight rod about to buckle moves its ends in second order only; twist, whose waves are fast
    and harmless, has a wide absolute tolerance of its own.

    Args:
        relative, absolute: tolerances.
        twisting: absolute tolerance of the rotation about the tangent [rad].
        first_step, max_step, min_step: [time]; max_step None means a hundredth of the run,
            first_step None a thousandth of max_step, min_step None 1e-9 of it.
    """

    relative: Float[Array, ""] = eqx.field(converter=lambda x: jnp.asarray(x, float), default=0.01)
    absolute: Float[Array, ""] = eqx.field(
        converter=lambda x: jnp.asarray(x, float), default=2.5e-3
    )
    max_step: float | Array | None = None
    first_step: float | Array | None = None
    min_step: float | Array | None = None
    twisting: Float[Array, ""] = eqx.field(converter=lambda x: jnp.asarray(x, float), default=0.05)

    def __check_init__(self):
        for name in ("relative", "absolute", "twisting", "max_step", "first_step", "min_step"):
            value = getattr(self, name)
            if value is None or isinstance(value, jax.core.Tracer) or type(value) is object:
                continue
            if not np.all(np.asarray(value) > 0):
                raise ValueError(f"{name}: must be positive, got {value}")


class Control(NamedTuple):
    """Memory of the step control."""

    dt: Float[Array, ""]  # step to try next
    growth: Float[Array, ""]  # how much it may grow after the next accepted step
    max_step: Float[Array, ""]  # bounds of the step; those left to the rollout depend on its span,
    min_step: Float[Array, ""]  # so a resumed run takes them from here


class _Chunk(NamedTuple):
    """Carry of the adaptive loop; the buffers hold the accepted steps of one chunk."""

    state: State
    control: Control
    states: State
    infos: StepInfo
    accepted: Int[Array, ""]
    rejected: Int[Array, ""]
    wasted: Int[Array, ""]
    result: Int[Array, ""]
    done: Bool[Array, ""]
    switching: Bool[Array, ""]  # a constraint begins: the caller makes the state consistent


def adaptive_rollout(
    scene: Scene,
    state: State,
    end_time: float,
    method: GeneralizedAlpha | None = None,
    control: StepControl | None = None,
    *,
    resume: Control | None = None,
    max_steps: int = 100_000,
    chunk: int = 50,
    on_chunk: Callable[[Run], None] | None = None,
    throw: bool = True,
) -> Run:
    """Run to `end_time` with steps chosen by the local error; every accepted step is saved.

    Steps end exactly on the times at which a constraint or a drive's rate changes (and a
    constraint that begins at `end_time` itself is left to the run resumed from there). The loop
    is compiled once and called for `chunk` accepted steps at a time; `on_chunk(part)` is called
    after each, for progress and storage, with a `Run` of its accepted steps (its states lack the
    start, its counts are those so far; see `join_runs`). Not differentiable itself: replay
    `run.times[1:]` by `rollout`, whose derivative is exact for that schedule.
    `compile_adaptive_rollout` compiles the loop beforehand.

    Raises:
        ValueError: a schedule of the scene ends before `end_time`, or a tolerance is out of
            reach of the precision.
        SimulationError: the run failed; its `.partial` is the run up to the failure.
    """
    span = float(end_time) - float(state.time)
    for name, count in (("chunk", chunk), ("max_steps", max_steps)):
        if count < 1:
            raise ValueError(f"{name}: must be at least 1, got {count}")
    if not span > 0:
        raise ValueError(f"end_time: must lie after the state's time {float(state.time):g}")
    scene.check_until(float(end_time))
    state = prepare(scene, state)
    method = GeneralizedAlpha() if method is None else method
    control = StepControl() if control is None else control
    dtype = state.position.dtype
    method.check_precision(dtype)
    tolerances = _tolerances(control, dtype)
    memory = _memory(control, span, dtype, resume)
    end, size = jnp.asarray(end_time, dtype), min(chunk, max_steps)
    as_int = lambda x: jnp.asarray(x, jnp.int32)

    parts: list[Run] = []
    rejected = wasted = accepted = 0
    current, code, done = state, Result.SUCCESS, False
    while not done:
        loss = None
        if scene.switch_times and bool(switching(scene, current)):
            current, loss = begin_constraint(scene, current, compiled_restart)
        out = _adaptive_chunk(scene, current, memory, end, method, tolerances, size)
        count = int(out.accepted)
        current, memory = out.state, out.control
        cut = lambda leaf, count=count: np.asarray(leaf)[:count]
        states, infos = jax.tree.map(cut, (out.states, out.infos))
        if loss is not None and count:
            losses = infos.projection_loss.copy()
            losses[0] = loss
            infos = infos._replace(projection_loss=losses)
        accepted += count
        rejected += int(out.rejected)
        wasted += int(out.wasted)
        code, done = Result(int(out.result)), bool(out.done)
        if not done and accepted >= max_steps:
            code, done = Result.MAX_STEPS, True
        parts.append(Run(states, infos, as_int(code), as_int(rejected), as_int(wasted), memory))
        if on_chunk is not None and count:
            on_chunk(parts[-1])
    run = join_runs(state, parts)
    if throw:
        results.raise_if_failed(code, f"after t = {float(current.time):g}", run)
    return run


def join_runs(start: State, parts: list[Run]) -> Run:
    """The run from `start` through the parts given to `on_chunk`, up to the last of them."""
    last = parts[-1]
    if start.settling is None and last.states.settling is not None:  # as the rollout did
        start = dataclasses.replace(start, settling=jnp.asarray(0, jnp.int32))
    join = lambda *leaves: jnp.asarray(np.concatenate(leaves))
    states, infos = jax.tree.map(join, *[(part.states, part.infos) for part in parts])
    states = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), start, states)
    return Run(states, infos, last.result, last.rejected, last.wasted_iterations, last.control)


def compile_adaptive_rollout(
    scene: Scene,
    state: State | None = None,
    method: GeneralizedAlpha | None = None,
    *,
    chunk: int = 50,
) -> None:
    """Compile the loop of `adaptive_rollout` for this scene and chunk without taking a step.

    Without a state `start(scene)` is compiled too, at the same time in a thread of its own.
    """
    if state is None:
        with ThreadPoolExecutor(1) as other:
            starting = other.submit(start, scene)
            compile_adaptive_rollout(scene, _placeholder(scene), method, chunk=chunk)
            starting.result()
        return
    control, dtype = StepControl(), state.position.dtype
    state = prepare(scene, state)
    method = GeneralizedAlpha() if method is None else method
    memory, tolerances = _memory(control, 1.0, dtype), _tolerances(control, dtype)
    out = _adaptive_chunk(scene, state, memory, state.time, method, tolerances, chunk)
    jax.block_until_ready(out.accepted)


def _placeholder(scene: Scene) -> State:
    """A state of the kind that `start` returns, to compile with."""
    state = placing(scene)
    return state if scene.rod.mass is None else dataclasses.replace(state, jerk=state.rate)


def _tolerances(control: StepControl, dtype) -> tuple[Array, ...]:
    """Relative, absolute and twisting tolerance in the run's precision."""
    return tuple(
        jnp.asarray(t, dtype) for t in (control.relative, control.absolute, control.twisting)
    )


def _memory(control: StepControl, span: float, dtype, resume: Control | None = None) -> Control:
    """Memory to start with: that of the run resumed, and what `control` says anew."""
    as_array = lambda x: jnp.asarray(x, dtype)
    max_step = span / 100 if resume is None else resume.max_step
    max_step = as_array(max_step if control.max_step is None else control.max_step)
    min_step = 1e-9 * max_step if resume is None else resume.min_step
    min_step = as_array(min_step if control.min_step is None else control.min_step)
    if resume is not None:
        return Control(as_array(resume.dt), as_array(resume.growth), max_step, min_step)
    first = 1e-3 * max_step if control.first_step is None else control.first_step
    return Control(as_array(first), as_array(2.0), max_step, min_step)


@compiled
def _adaptive_chunk(scene, state, control, end_time, method, tolerances, size):
    empty = lambda leaf: jnp.zeros((size, *leaf.shape), leaf.dtype)
    switches = jnp.asarray(scene.switch_times, end_time.dtype)
    marks = jnp.concatenate([switches, scene.corners.astype(end_time.dtype), end_time[None]])
    length = jnp.sum(scene.rod.length)
    relative, absolute, twisting = tolerances
    tiny = jnp.finfo(state.position.dtype).tiny

    def attempt(loop: _Chunk) -> _Chunk:
        now, dt = loop.state.time, loop.control.dt
        # land on the next mark, without leaving a sliver of a step before it
        mark = jnp.min(jnp.where(marks > now, marks, jnp.inf))
        left = mark - now
        dt = jnp.where(left < 2 * dt, jnp.where(left < 1.01 * dt, left, 0.5 * left), dt)
        stop = jnp.where(left <= 1.0001 * dt, mark, now + dt)
        new, info = advance_to(scene, loop.state, stop, method)
        failed = info.result != Result.SUCCESS
        phi = logarithm(relative_rotation(loop.state.quaternion))[:, :2]
        bent = jnp.clip(jnp.sum(jnp.sqrt(jnp.sum(phi**2, 1) + tiny)), 1e-6, 1.0)
        allowed = lambda growth, unit: relative * growth + absolute * unit
        error = jnp.maximum(
            info.error_position / allowed(info.growth_position, 0.1 * bent * length),
            jnp.maximum(
                info.error_bending / allowed(info.growth_bending, bent),
                info.error_twisting / (relative * info.growth_twisting + twisting),
            ),
        )
        # the shock of a new constraint is not resolved but damped: keep the step through it
        error = jnp.where(info.settling, 0.5, error)
        error = jnp.where(failed, 8.0, jnp.maximum(error, 1e-6))
        accept = ~failed & (error <= 1.0)
        factor = jnp.clip(0.85 * error ** (-1 / 3), 0.25, loop.control.growth)
        # many iterations: near the limit of what Newton can do, so do not ask for more
        factor = jnp.where(info.iterations > 8, jnp.minimum(factor, 0.8), factor)
        # a dead band: every jump of the step makes forces first order for a while
        factor = jnp.where(accept & (factor > 0.9) & (factor < 1.2), 1.0, factor)
        factor = jnp.where(accept, factor, jnp.minimum(factor, 0.7))
        # growth is forbidden after a failure and given back gradually
        growth = jnp.where(
            failed, 1.0, jnp.where(accept, jnp.minimum(loop.control.growth * 1.06, 2.0), 1.2)
        )
        trial = jnp.where(accept & (stop == mark), jnp.maximum(dt, loop.control.dt), dt)
        dt = jnp.minimum(trial * factor, loop.control.max_step)
        too_small = ~accept & (dt < loop.control.min_step)
        result = jnp.where(
            too_small, jnp.where(failed, info.result, Result.STEP_TOO_SMALL), Result.SUCCESS
        )
        put = lambda buffer, value: buffer.at[jnp.where(accept, loop.accepted, size)].set(
            value, mode="drop"
        )
        chosen = jax.tree.map(lambda a, b: jnp.where(accept, a, b), new, loop.state)
        one = accept.astype(jnp.int32)
        return _Chunk(
            chosen,
            loop.control._replace(dt=dt, growth=growth.astype(dt.dtype)),
            jax.tree.map(put, loop.states, new),
            jax.tree.map(put, loop.infos, info),
            loop.accepted + one,
            loop.rejected + 1 - one,
            loop.wasted + (1 - one) * info.iterations,
            result.astype(jnp.int32),
            (chosen.time >= end_time) | too_small,
            accept & jnp.any(chosen.time == switches),
        )

    zero = jnp.asarray(0, jnp.int32)
    first = _Chunk(
        state,
        control,
        jax.tree.map(empty, state),
        jax.tree.map(empty, no_info(state.position.dtype)),
        zero,
        zero,
        zero,
        zero,
        state.time >= end_time,
        jnp.asarray(False),
    )

    def going(loop: _Chunk):
        return ~loop.done & ~loop.switching & (loop.accepted < size)

    return lax.while_loop(going, attempt, first)
