"""Attempts at steps whose length follows from the local error, chunk by chunk."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Int

from rodjax.dynamics.step_control import (
    Control,
    choose,
    error_ratio,
    near_end,
)
from rodjax.dynamics.stepping import (
    StepInfo,
    advance_to,
    no_info,
)
from rodjax.numerics.compilation import compiled
from rodjax.numerics.results import Result
from rodjax.rods.state import State


class Chunk(NamedTuple):
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


@compiled
def attempt_steps(
    scene, state, control, end_time, method, tolerances, held, room, passes, size, stops=None
):
    """Attempts at steps: at most `passes`, until `room` are accepted, in buffers of `size`.

    They end on `stops` as well, if there are any, of which those to come are enough.
    """
    empty = lambda leaf: jnp.zeros((size, *leaf.shape), leaf.dtype)
    switches = jnp.asarray(scene.switch_times, end_time.dtype)
    marks = jnp.concatenate([switches, scene.corners.astype(end_time.dtype), end_time[None]])
    if stops is not None:
        marks = jnp.concatenate([marks, stops])

    def attempt(loop: Chunk) -> Chunk:
        now = loop.state.time
        control = near_end(loop.control, end_time - now)
        dt = control.dt
        # land on the next mark, without leaving a sliver of a step before it
        mark = jnp.min(jnp.where(marks > now, marks, jnp.inf))
        left = mark - now
        dt = jnp.where(left < 2 * dt, jnp.where(left < 1.01 * dt, left, 0.5 * left), dt)
        stop = jnp.where(left <= 1.0001 * dt, mark, now + dt)
        new, info = advance_to(scene, loop.state, stop, method, held)
        error = error_ratio(tolerances, scene.rod, loop.state, info)
        accept, following = choose(control, dt, error, info, stop == mark)
        too_small = ~accept & (following.dt < following.min_step)
        failed = info.result != Result.SUCCESS
        result = jnp.where(failed, info.result, Result.STEP_TOO_SMALL)
        result = jnp.where(too_small, result, Result.SUCCESS)
        put = lambda buffer, value: buffer.at[jnp.where(accept, loop.accepted, size)].set(
            value, mode="drop"
        )
        chosen = jax.tree.map(lambda a, b: jnp.where(accept, a, b), new, loop.state)
        one = accept.astype(jnp.int32)
        return Chunk(
            chosen,
            following,
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
    first = Chunk(
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

    def going(loop: Chunk):
        tried = loop.accepted + loop.rejected
        return ~loop.done & ~loop.switching & (loop.accepted < room) & (tried < passes)

    return lax.while_loop(going, attempt, first)
