"""Equilibrium of a scene, reached along a path of loads (see `schemes.AtRest`, `path_following`).

A start that is an equilibrium already stays one; a rod placed at rest sees its loads grow from
zero.
"""

import dataclasses
import warnings
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from rodjax.equations.equations import Equations
from rodjax.equations.imbalance import lacking
from rodjax.equations.overlap import check_apart, overcome
from rodjax.equations.rigid_motions import check_held
from rodjax.equations.schemes import rest_on_path
from rodjax.equations.start_checks import check_driven_joints, check_held_once
from rodjax.equilibria.path_following import (
    ACCEPT,
    LEAVE,
    LEAVE_EXCITED,
    follow,
    spin_is_neutral,
    spin_resistance,
)
from rodjax.inputs.argument_types import Number
from rodjax.inputs.validation import (
    all_known,
    as_integer,
    check_integer,
    check_positive,
    check_scalar,
)
from rodjax.numerics import newton, results, rotations
from rodjax.numerics.compilation import compiled
from rodjax.numerics.failure import not_a_number
from rodjax.numerics.results import ModelWarning, Result
from rodjax.rods.state import State
from rodjax.scenes.arguments import check_motion
from rodjax.scenes.memory import next_memory, remembering
from rodjax.scenes.scene import Scene


class EquilibriumInfo(NamedTuple):
    """How the equilibrium was found.

    Attributes:
        result: a `Result` as a number; 0 is success.
        iterations: Newton iterations in all.
        load_steps: accepted steps of the path.
        rejected: steps that were halved.
        reached: how far along the path, 1 at its end.
        unstable: number of unstable modes of the equilibrium (see `unstable_modes`); -1 where they
            were not counted, in a path that is followed with relax=False and ends early.
        descent: steps of descents from unstable equilibria.
    """

    result: Int[Array, ""]
    iterations: Int[Array, ""]  # Newton iterations in all
    load_steps: Int[Array, ""]  # accepted steps of the path
    rejected: Int[Array, ""]  # steps that were halved
    reached: Float[Array, ""]  # how far along the path, 1 at its end
    unstable: Int[Array, ""]  # unstable modes of the equilibrium (see `unstable_modes`)
    descent: Int[Array, ""]  # steps of descents from unstable equilibria


def equilibrium(
    scene: Scene,
    state: State,
    *,
    time: Number | Float[Array, ""] | None = None,
    load_steps: int = 10,
    tolerance: Number | Float[Array, ""] | None = None,
    max_iterations: int = 30,
    max_rotation: Number = 0.6,
    relax: bool | None = None,
    throw: bool = True,
) -> tuple[State, EquilibriumInfo]:
    """Configuration in which all forces balance, found along a load path from `state`.

    Args:
        state: where the path starts, at rest; for instance `placing(scene)` or an earlier
            equilibrium. If it is not in equilibrium, loads and what it lacks are brought
            on in proportion (see the module). Ends move from where they are in it, as their
            schedules say from `state.time` to `time`. A constraint that changes does so where a
            path starts, so end one path and start the next at that time.
        time: when schedules are evaluated at the end of the path; `state.time` by default. It may
            lie before it: what was brought on is taken off again.
        load_steps: steps of the path. A step in which Newton fails is halved, up to 12 times, and
            one in which an end would turn by more than a quarter of a turn is cut.
        tolerance: predicted error after the last Newton update, in rotations [rad] and
            displacements over the rod's length; None takes 1e-10 in float64, 1e-4 in float32.
        max_iterations: Newton iterations allowed in a step of the path.
        max_rotation: largest rotation of a node in one Newton iteration [rad].
        relax: what to do about equilibria that a rod would not stay in. By default the path leaves
            those that anything in the scene excites it to leave: where the number of unstable
            modes grows in a step the step is halved, then the rod descends to a stable state near
            by. If nothing does (a perfect column beyond Euler's load) the path goes on through the
            unstable one, with a `ModelWarning` at its end. True also disturbs those, and descends
            where Newton's method fails: the state is stable, though where loads drop a rod it may
            be far away. False takes whatever Newton's method finds.
        throw: raise `SimulationError` if the path could not be followed to its end; its `partial`
            holds the last equilibrium on the path. Otherwise, and in traced code,
            `EquilibriumInfo.result` tells, and the state's numbers are NaN.

    Differentiable in every array of scene, state and time, in forward and reverse mode: by the
    implicit function theorem at the solution, without differentiating the path. What friction or
    a material remembers is what the steps of the path left, so the state hangs on the path and on
    `load_steps`; derivatives hold the memory before the last step.

    Where neither end holds the spin of the rod about itself (a cable between pins, or hung from
    one) and turning all cross-sections about their tangents costs no energy, they stay as they
    were turned. A rod held at one pin swings to where its loads hold it. So does a body by itself,
    and one that turns about its joint at no cost stays as it was turned.

    `EquilibriumInfo.unstable` counts the unstable modes; `stability` finds them.

    Raises:
        ValueError: ends and loads leave the rod free to move, or the ends hold it twice in some
            direction, strands start too near for the contact, a schedule or a constraint's time
            does not fit, a value is not finite (checked outside traced code).
        SimulationError: the path ended early, as it does where the equilibrium becomes critical.

    Example:
        >>> state, info = rx.equilibrium(scene, rx.placing(scene))
        >>> float(state.position[-1, 2]) < -0.01, int(info.unstable)
        (True, 0)
    """
    check_motion(scene, state)
    state = remembering(scene, state)
    dtype = state.position.dtype
    stop = jnp.asarray(state.time if time is None else time, dtype)
    if tolerance is None:
        tolerance = 1e-10 if jnp.finfo(dtype).eps < 1e-12 else 1e-4
    counts = {"load_steps": as_integer(load_steps), "max_iterations": as_integer(max_iterations)}
    for name, count in counts.items():
        if all_known(count):
            check_integer(1, **{name: count})
    numbers = {"tolerance": tolerance, "max_rotation": max_rotation}
    check_scalar(**numbers, **counts)
    check_positive(**numbers)
    if all_known(tolerance) and tolerance < 10 * jnp.finfo(dtype).eps:
        raise ValueError(
            f"tolerance: {float(tolerance):g} is out of reach of {np.dtype(dtype).name}; use a"
            " larger one, or float64 (jax.config.update('jax_enable_x64', True))"
        )
    if relax not in (None, True, False):
        raise ValueError(f"relax: must be True, False or None, got {relax}")
    _check_path(scene, state, stop)
    hold = check_held(scene, state, stop, spin_free=True)
    check_held_once(scene, state)
    check_driven_joints(scene, state)
    check_apart(scene, state)
    as_array = lambda value: jnp.asarray(value, dtype)
    new, info = _equilibrium(
        scene,
        state,
        stop,
        as_array(counts["load_steps"]),
        as_array(tolerance),
        jnp.asarray(counts["max_iterations"], jnp.int32),
        as_array(max_rotation),
        jnp.asarray({None: LEAVE_EXCITED, True: LEAVE, False: ACCEPT}[relax], jnp.int32),
        hold,
    )
    if all_known(info.result) and overcome(scene, new):
        info = info._replace(result=results.as_code(Result.CONTACT_OVERCOME))
    if relax is None:
        _warn_if_unstable(info)
    if throw:
        if not all_known(info.result):
            message = "no equilibrium was found; call with throw=False and look at `result`"
            new = eqx.error_if(new, info.result != Result.SUCCESS, message)
        else:
            where = (
                f"equilibrium, at {float(info.reached):.3g} of the load path (it ends where an"
                " equilibrium becomes critical: lessen the load, disturb the symmetry, or descend"
                " to a stable state with relax=True)"
            )
            results.raise_if_failed(info.result, where, (new, info))
    return not_a_number(new, info.result != Result.SUCCESS), info


def _warn_if_unstable(info: EquilibriumInfo) -> None:
    if not all_known(info.unstable) or info.result != Result.SUCCESS:
        return
    if np.any(np.asarray(info.unstable) > 0):
        warnings.warn(
            f"equilibrium: the state has {int(info.unstable)} unstable mode(s) that nothing in the"
            " scene excites; a rod would leave it at the least disturbance. Find a stable state"
            " with relax=True, give an imperfection (natural curvature, a small load), or take"
            " this one knowingly with relax=False",
            ModelWarning,
            stacklevel=3,
        )


@compiled
def _equilibrium(
    scene, state, stop, load_steps, tolerance, max_iterations, max_rotation, leave, hold
):
    fixed, start, end = newton.constant((scene, state, stop))
    path, descent = follow(
        fixed, start, end, load_steps, tolerance, max_iterations, max_rotation, leave, hold
    )
    time = state.time + path.reached * (stop - state.time)
    at_start = lacking(scene, state)
    before = dataclasses.replace(state, memory=newton.constant(path.memory))

    def resisted(resistance):
        rest = rest_on_path(path.reference, max_rotation, path.reached, at_start, resistance)
        return Equations.of(scene, rest, before, time)

    equations = resisted(None)
    kept = None
    if hold.bodies:
        # so little that what costs energy follows the scene all the same
        turns = newton.constant(spin_resistance(fixed, hold._replace(spin=False)))
        kept = jnp.sqrt(jnp.finfo(turns.dtype).eps) * turns
    if hold.spin:
        # a spin that costs no energy stays also when the scene changes
        spins = newton.constant(spin_resistance(fixed, hold._replace(bodies=False)))
        resistance = spins if kept is None else spins + kept
        neutral = spin_is_neutral(newton.constant(resisted(resistance)), path.x)
        spins = jnp.where(newton.constant(neutral), spins, 0.0)
        kept = spins if kept is None else spins + kept
    if kept is not None:
        equations = resisted(kept)
    x = newton.root(equations, path.x)
    motion = equations.motion(x)
    zero = jnp.zeros_like(state.rate)
    quaternion = rotations.normalize(motion.quaternion)
    memory, force = next_memory(equations.scene, motion), equations.force(x)
    at_rest = zero, zero, zero, force
    breaks = scene.rod.breaks
    new = State(time, motion.position, quaternion, *at_rest, memory=memory, breaks=breaks)
    if scene.joints:
        new = dataclasses.replace(new, joints=equations.joints(x))
    return new, EquilibriumInfo(
        result=path.result,
        iterations=path.iterations,
        load_steps=path.accepted,
        rejected=path.rejected,
        reached=path.reached,
        unstable=path.unstable,
        descent=descent,
    )


def _check_path(scene: Scene, state: State, stop) -> None:
    """Raise ValueError where schedules, switches or values do not fit the path."""
    for name in ("position", "quaternion", "force"):
        value = getattr(state, name)
        if all_known(value) and not np.all(np.isfinite(value)):
            raise ValueError(f"state.{name}: must be finite everywhere")
    if not all_known(stop) or not all_known(state.time):
        return
    begin, end = float(state.time), float(stop)
    if not np.isfinite(end):
        raise ValueError(f"time: must be finite, got {end:g}")
    scene.check_until(max(begin, end))
    for switch in scene.switch_times:
        if not all_known(switch):
            continue
        # a constraint is in force from its switch on: backwards it ends where it began
        if begin < float(switch) < end or end < float(switch) <= begin:
            raise ValueError(
                f"time: a constraint changes at {float(switch):g}; find the equilibrium at that"
                " time first and start from it"
            )
