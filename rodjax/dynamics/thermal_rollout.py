"""Rollouts of rods in a heat bath by `lax.scan`, with averages on the way."""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from rodjax.dynamics.bath import Bath, check_thermal
from rodjax.dynamics.run import Run
from rodjax.dynamics.stepping import no_info
from rodjax.dynamics.thermal_state import ThermalState
from rodjax.dynamics.thermal_stepping import thermal_step
from rodjax.equations.overlap import check_apart
from rodjax.inputs.argument_types import Number
from rodjax.inputs.user_functions import check_function
from rodjax.inputs.validation import (
    all_known,
    check_instance,
    check_integer,
    check_positive,
    check_scalar,
    given,
)
from rodjax.numerics import newton, results
from rodjax.numerics.averages import Averages
from rodjax.numerics.compilation import compiled
from rodjax.numerics.failure import not_a_number
from rodjax.numerics.results import Result, as_code
from rodjax.scenes.arguments import check_motion
from rodjax.scenes.scene import Scene


class ThermalRun(eqx.Module):
    """What became of a rod in a heat bath.

    Attributes:
        run: the states saved, the first being the start, as a `Run` for pictures and measures. Of
            its `infos` only `result`, `iterations` (the most of a step) and `growth_position` (the
            farthest that a node went in a step) are told, one for each saved state.
        final: where it ended, with the key to go on with; bit for bit as if it had not stopped.
        averages: of what `measure` gave; None without.
        result: the first failure of a step as a number, a `Result`; 0 is success.

    Example:
        >>> drag = rx.LinearDrag(normal=0.2, tangential=0.1, rotational=1e-6)
        >>> bathed = rx.Scene(rx.yielding(rod), rx.Clamped(), loads=(drag,))
        >>> begun = rx.thermal_start(bathed, jax.random.key(0))
        >>> ended = rx.thermal_rollout(bathed, begun, rx.Bath(1e-12), 1e-8, 10)
        >>> more = rx.thermal_rollout(bathed, ended.final, rx.Bath(1e-12), 1e-8, 10)
        >>> round(1e8 * float(more.final.state.time))
        20
    """

    run: Run
    final: ThermalState
    averages: Averages | None
    result: Int[Array, ""]


def thermal_rollout(
    scene: Scene,
    start: ThermalState,
    bath: Bath,
    dt: Number | Float[Array, ""],
    steps: int,
    *,
    save_every: int | None = None,
    measure: Callable[[Any], Any] | None = None,
    measure_every: int = 1,
    averages: Averages | None = None,
    throw: bool = True,
) -> ThermalRun:
    """Steps of a rod in a heat bath, by `lax.scan`.

    Under `vmap` over starts (of `thermal_start` with a key each) it is a run of replicas. The
    number of steps is compiled in: for a long run call it again with what it returns.

    Args:
        scene: what moves; it must stretch and shear (`yielding`), and its loads have linear drag.
        start: from where, with the key of the noise.
        bath: its thermal energy.
        dt: the step [s].
        steps: how many of them.
        save_every: store every so many steps; None for the last state alone.
        measure: called with a `State`, gives a pytree of floating point arrays to average; written
            with jax.numpy. Pass the same function every time, or it is compiled anew.
        measure_every: look by so many steps, which must divide the steps between stored states.
        averages: to go on with, of the same measure.
        throw: raise `SimulationError` if a step fails. Without it, states, averages and their
            derivatives after a failure are not numbers.

    Raises:
        ValueError: the scene has no equilibrium with a bath, or numbers do not fit.
        SimulationError: a step failed; its `.partial` is the `ThermalRun`.

    Example:
        >>> drag = rx.LinearDrag(normal=0.2, tangential=0.1, rotational=1e-6)
        >>> bathed = rx.Scene(rx.yielding(rod), rx.Clamped(), loads=(drag,))
        >>> begun = rx.thermal_start(bathed, jax.random.key(0))
        >>> tip = lambda state: state.position[-1]
        >>> ended = rx.thermal_rollout(bathed, begun, rx.Bath(1e-12), 1e-8, 10, measure=tip)
        >>> ended.averages.mean.shape, int(ended.averages.count)
        ((3,), 10)
    """
    _check(scene, start, bath, dt, steps, save_every, measure, measure_every)
    save_every = steps if save_every is None else save_every
    if measure is not None and averages is None:
        averages = Averages.of(jax.eval_shape(measure, start.state))
    dt = jnp.asarray(dt, start.state.position.dtype)
    found = _rollout(
        scene, start, bath, dt, steps // save_every, save_every, measure, measure_every, averages
    )
    if not throw:
        return found
    if all_known(scene, found.result, jnp.zeros(()) + 0):
        results.raise_if_failed(found.result, partial=found)
        return found
    message = "a step failed; call with throw=False and look at `result`"
    return eqx.error_if(found, found.result != Result.SUCCESS, message)


def _check(scene, start, bath, dt, steps, save_every, measure, measure_every) -> None:
    mend = "give a ThermalState, of thermal_start(scene, key) or of a run its `final`"
    check_instance(ThermalState, mend, start=start)
    check_instance(Bath, "give a Bath, Bath(thermal_energy=kT)", bath=bath)
    check_motion(scene, start.state)
    check_scalar(dt=dt)
    check_positive(dt=dt)
    check_integer(1, steps=steps, measure_every=measure_every, **given(save_every=save_every))
    block = steps if save_every is None else save_every
    if steps % block:
        raise ValueError(f"save_every: {save_every} does not divide the {steps} steps")
    if measure is not None:
        check_function(measure=measure)
        if block % measure_every:
            raise ValueError(
                f"measure_every: {measure_every} does not divide the {block} steps between stored"
                " states"
            )
    if all_known(scene, start, bath, dt, jnp.zeros(()) + 0):
        check_thermal(scene)
        check_apart(scene, start.state)
        scene.check_until(float(start.state.time) + steps * float(dt))


@compiled
def _rollout(scene, start, bath, dt, saves, save_every, measure, measure_every, averages):
    def one(carry, _):
        before, failed, most, farthest = carry
        # after a failure no iterations are made
        left = jnp.where(failed == Result.SUCCESS, bath.max_iterations, 0)
        after, info = thermal_step(
            scene, before, dataclasses.replace(bath, max_iterations=left), dt
        )
        good = failed == Result.SUCCESS
        code = jnp.where(good, info.result, failed)
        stays = lambda new, old: jnp.where(code == Result.SUCCESS, new, old)
        state = jax.tree.map(stays, after.state, before.state)
        most = jnp.maximum(most, info.iterations)
        farthest = jnp.maximum(farthest, jnp.where(good, info.moved, 0.0))
        return (ThermalState(state, after.key, after.white), code, most, farthest), None

    # the reverse pass takes Newton's solutions from the forward pass and recomputes the rest
    keep = jax.checkpoint_policies.save_only_these_names(newton.SOLUTION)
    again = partial(jax.checkpoint, policy=keep, prevent_cse=False)

    def look(carry, _):
        (moving, averages), length = carry, save_every if measure is None else measure_every
        moving, _ = lax.scan(again(one), moving, length=length)
        if measure is not None:
            seen = measure(not_a_number(moving[0].state, moving[1] != Result.SUCCESS))
            averages = averages.added(seen)
        return (moving, averages), None

    @again
    def block(carry, _):
        (start, code, averages) = carry
        zero = jnp.asarray(0, jnp.int32)
        begun = ((start, code, zero, jnp.zeros((), dt.dtype)), averages)
        length = 1 if measure is None else save_every // measure_every
        (moving, averages), _ = lax.scan(look, begun, length=length)
        moved, code, most, farthest = moving
        state = not_a_number(moved.state, code != Result.SUCCESS)
        info = no_info(dt.dtype)._replace(result=code, iterations=most, growth_position=farthest)
        return (moved, code, averages), (state, info)

    begun = (start, as_code(Result.SUCCESS), averages)
    (final, code, averages), (saved, infos) = lax.scan(block, begun, length=saves)
    first = start.state
    states = jax.tree.map(lambda one, rest: jnp.concatenate([one[None], rest]), first, saved)
    zero = jnp.asarray(0, jnp.int32)
    ended = not_a_number(final.state, code != Result.SUCCESS)
    final = dataclasses.replace(final, state=ended)
    return ThermalRun(Run(states, infos, code, zero, zero), final, averages, code)
