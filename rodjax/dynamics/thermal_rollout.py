"""Rollouts of rods in a heat bath with averages on the way."""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from rodjax.dynamics.bath import Bath, check_thermal
from rodjax.dynamics.run import Run
from rodjax.dynamics.stepping import StepInfo, no_info
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
from rodjax.rods.state import State
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
    """Steps of a rod in a heat bath, with averages over them.

    Under `vmap` over starts (of `thermal_start` with a key each) it is a run of replicas. Outside
    traced code one program serves any number of steps, and a run that goes on from the `final` of
    another is that which never stopped, bit for bit; in traced code numbers of steps are compiled
    in. Derivatives of traced runs are those of a path with its noise held, in forward and reverse
    mode; they are not those of averages where paths part fast.

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
    if measure is not None and averages is None:
        averages = Averages.of(jax.eval_shape(measure, start.state))
    dt = jnp.asarray(dt, start.state.position.dtype)
    plan = _Plan.of(steps, save_every, measure_every if measure is not None else None)
    known = all_known(scene, start, bath, dt, averages, jnp.zeros(()) + 0)
    found = (_by_blocks if known else _scanned)(scene, start, bath, dt, plan, measure, averages)
    if not throw:
        return found
    if known:
        results.raise_if_failed(found.result, partial=found)
        return found
    message = "a step failed; call with throw=False and look at `result`"
    return eqx.error_if(found, found.result != Result.SUCCESS, message)


class _Plan(NamedTuple):
    """Numbers of steps between looks, of looks between saved states, and of these."""

    saves: int
    looks: int
    steps_a_look: int

    @classmethod
    def of(cls, steps: int, save_every: int | None, measure_every: int | None) -> "_Plan":
        """What the arguments say."""
        block = steps if save_every is None else save_every
        look = block if measure_every is None else measure_every
        return cls(steps // block, block // look, look)


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


class _Moving(NamedTuple):
    """What is carried from step to step."""

    thermal: ThermalState
    code: Int[Array, ""]  # of the first step that failed
    iterations: Int[Array, ""]  # most of a step since the last saved state
    moved: Float[Array, ""]  # farthest of a node in a step since then

    @classmethod
    def from_saved(cls, thermal: ThermalState, code: Int[Array, ""]) -> "_Moving":
        """At a saved state."""
        zero = jnp.zeros_like(thermal.state.time)
        return cls(thermal, code, jnp.asarray(0, jnp.int32), zero)

    @property
    def seen(self) -> State:
        """The state, which is no number after a failure."""
        return not_a_number(self.thermal.state, self.code != Result.SUCCESS)

    @property
    def info(self) -> StepInfo:
        """What is told of the steps since the last saved state."""
        return no_info(self.moved.dtype)._replace(
            result=self.code, iterations=self.iterations, growth_position=self.moved
        )


def _stepped(scene: Scene, bath: Bath, dt, moving: _Moving) -> _Moving:
    """After one more step, or as it was if one has failed."""
    before, good = moving.thermal, moving.code == Result.SUCCESS
    # after a failure no iterations are made
    limited = dataclasses.replace(bath, max_iterations=jnp.where(good, bath.max_iterations, 0))
    after, info = thermal_step(scene, before, limited, dt)
    code = jnp.where(good, info.result, moving.code)
    stays = lambda new, old: jnp.where(code == Result.SUCCESS, new, old)
    state = jax.tree.map(stays, after.state, before.state)
    return _Moving(
        ThermalState(state, after.key, after.white),
        code,
        jnp.maximum(moving.iterations, info.iterations),
        jnp.maximum(moving.moved, jnp.where(good, info.moved, 0.0)),
    )


def _by_scans(scene, start, bath, dt, plan: "_Plan", measure, averages) -> ThermalRun:
    """The run as gradients pass through it, its numbers of steps compiled in."""
    # the reverse pass takes Newton's solutions from the forward pass and recomputes the rest
    keep = jax.checkpoint_policies.save_only_these_names(newton.SOLUTION)
    again = partial(jax.checkpoint, policy=keep, prevent_cse=False)

    @again
    def one(moving, _):
        return _stepped(scene, bath, dt, moving), None

    def look(carry, _):
        moving, averages = carry
        moving, _ = lax.scan(one, moving, length=plan.steps_a_look)
        if measure is not None:
            averages = averages.added(measure(moving.seen))
        return (moving, averages), None

    @again
    def block(carry, _):
        moving, averages = carry
        begun = _Moving.from_saved(moving.thermal, moving.code)
        (moving, averages), _ = lax.scan(look, (begun, averages), length=plan.looks)
        return (moving, averages), (moving.seen, moving.info)

    begun = _Moving.from_saved(start, as_code(Result.SUCCESS))
    (moving, averages), saved = lax.scan(block, (begun, averages), length=plan.saves)
    return _gathered(start, saved, moving, averages)


_scanned = compiled(_by_scans)


@compiled
def _block(scene, moving: _Moving, bath, dt, looks, steps_a_look, measure, averages):
    """The steps to the next saved state, any number of them by one program.

    The loops have no known length: XLA makes other programs of loops of one pass, whose rounding
    differs.
    """

    def look(_, carry):
        moving, averages = carry
        one = lambda _, moving: _stepped(scene, bath, dt, moving)
        moving = lax.fori_loop(0, steps_a_look, one, moving)
        if measure is not None:
            averages = averages.added(measure(moving.seen))
        return moving, averages

    begun = _Moving.from_saved(moving.thermal, moving.code), averages
    return lax.fori_loop(0, looks, look, begun)


def _by_blocks(scene, start, bath, dt, plan: "_Plan", measure, averages) -> ThermalRun:
    """The run outside traced code, one call for each saved state."""
    moving, saved = _Moving.from_saved(start, as_code(Result.SUCCESS)), []
    count = lambda number: jnp.asarray(number, jnp.int32)
    looks, steps = count(plan.looks), count(plan.steps_a_look)
    for _ in range(plan.saves):
        moving, averages = _block(scene, moving, bath, dt, looks, steps, measure, averages)
        saved.append(jax.tree.map(np.asarray, (moving.seen, moving.info)))
    stacked = jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves)), *saved)
    return _gathered(start, stacked, moving, averages)


def _gathered(start: ThermalState, saved, moving: _Moving, averages) -> ThermalRun:
    """A run of its saved states."""
    states, infos = saved
    first = start.state
    states = jax.tree.map(lambda one, rest: jnp.concatenate([one[None], rest]), first, states)
    none = jnp.asarray(0, jnp.int32)
    final = dataclasses.replace(moving.thermal, state=moving.seen)
    return ThermalRun(Run(states, infos, moving.code, none, none), final, averages, moving.code)
