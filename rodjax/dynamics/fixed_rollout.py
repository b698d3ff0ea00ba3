"""Rollouts over given times, by `lax.scan`: what gradients pass through."""

import dataclasses
from collections.abc import Callable, Sequence
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Float

from rodjax.dynamics import resolution
from rodjax.dynamics.coarseness import warn_if_hopeless
from rodjax.dynamics.given_steps import onto_switches, run_given_steps, until_failure
from rodjax.dynamics.run import Run
from rodjax.dynamics.stepping import prepare, step
from rodjax.dynamics.unexcited import warn_if_unexcited
from rodjax.equations.generalized_alpha import GeneralizedAlpha
from rodjax.equations.overlap import check_apart, distances_held
from rodjax.inputs.argument_types import AnyArray
from rodjax.inputs.validation import all_known, check_instance, check_integer
from rodjax.numerics import newton, results
from rodjax.numerics.carried import with_tangents
from rodjax.numerics.compilation import compiled
from rodjax.numerics.failure import not_a_number
from rodjax.numerics.results import Result
from rodjax.rods.state import State
from rodjax.scenes.arguments import check_motion, check_step_times
from rodjax.scenes.corners import warn_of_corners
from rodjax.scenes.scene import Scene


def _is_traced(*trees) -> bool:
    leaves = jax.tree.leaves(trees)
    return not all_known(leaves)


def rollout(
    scene: Scene,
    state: State,
    times: Float[AnyArray, " k"] | Sequence[float] | None = None,
    method: GeneralizedAlpha | None = None,
    *,
    save_every: int = 1,
    progress: Callable[[float, int], None] | None = None,
    throw: bool = True,
) -> Run:
    """Step from one given time to the next by `lax.scan`, saving by step index.

    Args:
        times: ends of the steps, increasing, the first after `state.time`. A time at which an
            end's constraint changes must be among them (within 1e-6 of a step; it is then made
            exact).
        save_every: store every so many steps; the number of steps must be a multiple.
        progress: called about once a second with the time reached [s] and the steps made (outside
            traced code).
        throw: raise `SimulationError` if a step fails. Either way the motion up to the failure
            is kept: the error's `.partial` is the run up to it; without the error the states
            after it are not numbers, nor is the derivative of what is built on them. A passage
            that shows only by the linking number of the whole run counts from the first saved
            state that has it; steps that do not resolve the motion are reported with all states.

    Differentiable in every array of scene, state, times and method, in forward and reverse mode;
    the reverse pass keeps of every step Newton's solution, of every `save_every` steps the state,
    and recomputes the rest block by block without iterating. Each step's solution takes a quarter
    of a state, so 10 or 20 steps a block nearly reach the least memory. The times at which
    constraints change, and the contact's `exclusion`, have no derivative.

    Outside traced code one compiled loop serves any number of steps, in calls of about a second.
    Only there a start with strands too near for the contact and drives whose corners lie inside
    steps are noticed, and the ended run is looked at for passages that no step saw (by the linking
    number: STRAND_PASSAGE) and for ends that are not where their schedules put them (DRIVE_MISSED).
    All that a step itself tells is told in traced code as well.

    Raises:
        ValueError: times or schedules do not fit (checked outside traced code).
        SimulationError: a step failed.
        Interrupted: Ctrl-C; its `.partial` is the run up to then (outside traced code).

    Example:
        >>> run = rx.rollout(scene, rx.start(scene), np.linspace(0.02, 0.2, 10))
        >>> len(run.times)
        11
    """
    check_motion(scene, state)
    check_step_times(times)
    method = GeneralizedAlpha() if method is None else method
    check_instance(GeneralizedAlpha, "give GeneralizedAlpha(...)", method=method)
    check_integer(1, save_every=save_every)
    state = prepare(scene, state)
    times = jnp.asarray(times, state.position.dtype)
    if times.ndim != 1 or times.shape[0] < 1 or times.shape[0] % save_every:
        raise ValueError(
            f"save_every: {save_every} does not divide the {times.shape[0]} steps of `times`"
        )
    if not _is_traced(scene, state, times):
        check_times(scene, state, times)
        method.check_precision(state.position.dtype)
        check_apart(scene, state)
    if _is_traced(scene, state, times, method, jnp.zeros(()) + 0):  # whatever is computed here is
        run = _rollout(scene, state, times, method, save_every)
        message = "a step failed; call with throw=False and look at `result`"
        return eqx.error_if(run, run.result != Result.SUCCESS, message) if throw else run
    warn_of_corners(scene, float(state.time), np.asarray(times))
    run = run_given_steps(scene, state, np.asarray(times), method, save_every, progress)
    if throw and int(run.result) != Result.SUCCESS:
        told = np.asarray(run.infos.result)
        good = int(np.argmax(told != 0)) if np.any(told) else len(told)
        after = float(times[good - 1]) if good else float(state.time)
        results.raise_if_failed(run.result, f"after t = {after:g}", until_failure(run))
    warn_if_hopeless(run)
    warn_if_unexcited(scene, run)
    return run


def check_times(scene: Scene, state: State, times: Float[AnyArray, " k"] | Sequence[float]) -> None:
    """Raise ValueError unless the times suit the scene (outside traced code)."""
    given = np.asarray(times)
    steps = np.diff(np.concatenate([[float(state.time)], given]))
    if not np.all(np.isfinite(steps)):
        raise ValueError("times: must be finite")
    if steps[0] <= 0:
        raise ValueError(
            f"times: the first step must end after the state's time {float(state.time):g}, but ends"
            f" at {given[0]:g}; give the ends of steps alone, without the time of the state itself"
            " (times[1:])"
        )
    if np.any(steps <= 0):
        k = int(np.argmax(steps <= 0))
        raise ValueError(f"times: must increase, but {given[k]:g} comes after {given[k - 1]:g}")
    scene.check_until(float(given[-1]))
    for switch in map(float, scene.switch_times):
        if not float(state.time) < switch < given[-1]:
            continue
        nearest = int(np.argmin(np.abs(given - switch)))
        if abs(given[nearest] - switch) > 1e-6 * steps[nearest]:
            raise ValueError(
                f"times: a constraint changes at {switch:g}, which must be one of the times"
            )


@compiled
def _rollout(scene, state, times, method, save_every):
    def one(carry, stop):
        before, failed = carry
        # after a failure no iterations are made
        left = jnp.where(failed == Result.SUCCESS, method.max_iterations, 0)
        limited = dataclasses.replace(method, max_iterations=left)
        after, info = step(scene, before, stop, limited, held)
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
        if save_every == 1:  # a loop in a loop would be traced and compiled as such
            carry, info = one(carry, stops[0])
            infos = jax.tree.map(lambda leaf: leaf[None], info)
        else:
            carry, infos = lax.scan(again(one), carry, stops)
        return carry, (carry[0], infos)

    held = distances_held(scene)
    times = onto_switches(scene, state.time, times)
    # the time has the tangent of `times`, and a jerk is of a start alone
    begun = with_tangents(state, (scene, times, method))
    begun = dataclasses.replace(begun, time=state.time, jerk=state.jerk)
    start = (begun, jnp.asarray(0, jnp.int32))
    (_, code), (saved, infos) = lax.scan(block, start, times.reshape(-1, save_every))
    infos = jax.tree.map(lambda leaf: leaf.reshape((-1, *leaf.shape[2:])), infos)
    steps = jnp.diff(times, prepend=state.time)
    states = jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest]), state, saved)
    unresolved = resolution.unresolved(scene, states, infos, steps)
    last = slice(save_every - 1, None, save_every)
    failed = jnp.append(False, infos.result[last] != Result.SUCCESS)
    given = jnp.append(state.time, times[last])
    states = eqx.tree_at(lambda s: s.time, not_a_number(states, failed), given)
    code = jnp.where((code == Result.SUCCESS) & unresolved, Result.UNRESOLVED, code)
    zero = jnp.asarray(0, jnp.int32)
    return Run(states, infos, code.astype(jnp.int32), zero, zero)
