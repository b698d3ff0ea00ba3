"""Equilibrium of a scene, reached along a path of loads (see `statics`).

A start that is an equilibrium already stays one; a rod placed at rest sees its loads grow from
zero. Where Newton's method fails the path's step is halved.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from rodjax import newton, results, rotations
from rodjax.arguments import check_motion, check_scene
from rodjax.balance import Internal
from rodjax.compilation import compiled
from rodjax.loads import DistributedLoad
from rodjax.results import Result
from rodjax.rod import Number
from rodjax.scene import Scene, projectors
from rodjax.start_checks import check_held_once
from rodjax.state import State
from rodjax.statics import Ramp, StaticEquations, at_rest, static_balance
from rodjax.validation import check_finite, check_scalar

# How often the path's step may be halved before the path is given up.
_HALVINGS = 12


class EquilibriumInfo(NamedTuple):
    """How the equilibrium was found.

    Attributes:
        result: a `Result` as a number; 0 is success.
        iterations: Newton iterations in all.
        load_steps: accepted steps of the path.
        rejected: steps that were halved.
        reached: how far along the path, 1 at its end.
    """

    result: Int[Array, ""]
    iterations: Int[Array, ""]  # Newton iterations in all
    load_steps: Int[Array, ""]  # accepted steps of the path
    rejected: Int[Array, ""]  # steps that were halved
    reached: Float[Array, ""]  # how far along the path, 1 at its end


def placing(scene: Scene, time: Number | Float[Array, ""] = 0.0) -> State:
    """The rod at rest as it was built, without internal force: where a load path may start.

    Args:
        scene: whose rod it is.
        time: of the state [s].
    """
    check_scene(scene)
    check_scalar(time=time)
    check_finite(time=time)
    rod = scene.rod
    dtype = rod.position.dtype
    rate = jnp.zeros((rod.elements + 1, 6), dtype)
    force = jnp.zeros((rod.elements, 3), dtype)
    now = jnp.asarray(time, dtype)
    return State(now, rod.position, rod.quaternion, rate, rate, rate, force)


class _Path(NamedTuple):
    """Where the path has come to: x solves the equations at `reached` from `reference`."""

    step: Float[Array, ""]
    reference: tuple[Float[Array, "nodes 3"], Float[Array, "nodes 4"]]
    x: Float[Array, "nodes 9"]
    result: Int[Array, ""]
    iterations: Int[Array, ""]
    accepted: Int[Array, ""]
    rejected: Int[Array, ""]
    reached: Float[Array, ""]


def equilibrium(
    scene: Scene,
    state: State,
    *,
    time: Number | Float[Array, ""] | None = None,
    load_steps: int = 10,
    tolerance: Number | Float[Array, ""] | None = None,
    max_iterations: int = 30,
    max_rotation: Number = 0.6,
    throw: bool = True,
) -> tuple[State, EquilibriumInfo]:
    """Configuration in which all forces balance, found along a load path from `state`.

    Args:
        state: where the path starts, at rest; for instance `placing(scene)` or an earlier
            equilibrium. If it is not in equilibrium, loads and what it lacks are brought
            on in proportion (see the module). Ends move from where they are in it, as their
            schedules say from `state.time` to `time`. A constraint that changes does so where a
            path starts, so end one path and start the next at that time.
        time: when schedules are evaluated at the end of the path; `state.time` by default.
        load_steps: steps of the path; a step in which Newton fails is halved, up to 12 times.
        tolerance: predicted error after the last Newton update, in rotations [rad] and
            displacements over the rod's length; None takes 1e-10 in float64, 1e-4 in float32.
        max_iterations: Newton iterations allowed in a step of the path.
        max_rotation: largest rotation of a node in one Newton iteration [rad].
        throw: raise `SimulationError` if the path could not be followed to its end. Otherwise
            `EquilibriumInfo.result` tells, and the state is the last equilibrium on the path.

    Differentiable in every array of scene, state and time, in forward and reverse mode: by the
    implicit function theorem at the solution, without differentiating the path.

    Statics cannot tell whether the equilibrium is stable: see `stability`.

    Raises:
        ValueError: the ends leave the rod free to move, or hold it twice in some direction, a
            schedule or a constraint's time does not fit, a value is not finite (checked outside
            traced code).
        SimulationError: the path ended early, as it does where the equilibrium becomes critical.
    """
    check_motion(scene, state)
    dtype = state.position.dtype
    stop = jnp.asarray(state.time if time is None else time, dtype)
    if tolerance is None:
        tolerance = 1e-10 if jnp.finfo(dtype).eps < 1e-12 else 1e-4
    numbers = {
        "load_steps": load_steps,
        "tolerance": tolerance,
        "max_iterations": max_iterations,
        "max_rotation": max_rotation,
    }
    for name, value in numbers.items():
        if not isinstance(value, jax.core.Tracer) and not np.all(np.asarray(value) > 0):
            raise ValueError(f"{name}: must be positive, got {value}")
    if not isinstance(tolerance, jax.core.Tracer) and tolerance < 10 * jnp.finfo(dtype).eps:
        raise ValueError(
            f"tolerance: {float(tolerance):g} is out of reach of {np.dtype(dtype).name}; use a"
            " larger one, or float64 (jax.config.update('jax_enable_x64', True))"
        )
    _check_path(scene, state, stop)
    check_held(scene, state)
    check_held_once(scene, state)
    as_array = lambda value: jnp.asarray(value, dtype)
    new, info = _equilibrium(
        scene,
        state,
        stop,
        as_array(load_steps),
        as_array(tolerance),
        jnp.asarray(max_iterations, jnp.int32),
        as_array(max_rotation),
    )
    if throw:
        if isinstance(info.result, jax.core.Tracer):
            message = "no equilibrium was found; call with throw=False and look at `result`"
            new = eqx.error_if(new, info.result != Result.SUCCESS, message)
        else:
            where = (
                f"equilibrium, at {float(info.reached):.3g} of the load path (it ends where an"
                " equilibrium becomes critical: lessen the load or disturb the symmetry)"
            )
            results.raise_if_failed(info.result, where, (new, info))
    return new, info


@compiled
def _equilibrium(scene, state, stop, load_steps, tolerance, max_iterations, max_rotation):
    fixed, start, end = newton.constant((scene, state, stop))
    path = _follow(fixed, start, end, load_steps, tolerance, max_iterations, max_rotation)
    time = state.time + path.reached * (stop - state.time)
    ramp = Ramp(path.reached, _imbalance(scene, state))
    position, quaternion = path.reference
    equations = StaticEquations(scene, state, position, quaternion, time, max_rotation, ramp)
    x = newton.root(equations, path.x)
    motion = equations.motion(x)
    zero = jnp.zeros_like(state.rate)
    quaternion = rotations.normalize(motion.quaternion)
    new = State(time, motion.position, quaternion, zero, zero, zero, equations.force(x))
    return new, EquilibriumInfo(
        result=path.result,
        iterations=path.iterations,
        load_steps=path.accepted,
        rejected=path.rejected,
        reached=path.reached,
    )


def _imbalance(scene: Scene, state: State) -> Internal:
    """What internal forces lack at the start of a path."""
    motion = at_rest(state.time, state.position, state.quaternion)
    wrench, constraint = static_balance(scene, motion, state.force, 0.0)
    return Internal(wrench[:, :3], wrench[:, 3:], constraint)


def _follow(scene, state, stop, load_steps, tolerance, max_iterations, max_rotation) -> _Path:
    """The equilibrium at the end of the path, by steps of at most 1/load_steps."""
    imbalance = _imbalance(scene, state)
    first = 1 / load_steps

    def equations(target, reference):
        time = state.time + target * (stop - state.time)
        ramp = Ramp(target, imbalance)
        position, quaternion = reference
        return StaticEquations(scene, state, position, quaternion, time, max_rotation, ramp)

    def attempt(path: _Path) -> _Path:
        # no sliver of a step at the end
        target = path.reached + path.step
        target = jnp.where(target > 1 - 1e-3 * first, 1.0, target)
        before = equations(path.reached, path.reference)
        motion = before.motion(path.x)
        reference = motion.position, rotations.normalize(motion.quaternion)
        trial = equations(target, reference)
        guess = trial.guess(before.force(path.x))
        x, solved = newton.iterate(trial, guess, tolerance, max_iterations)
        turned = jnp.sqrt(jnp.max(jnp.sum(x[:, 6:] ** 2, 1)))
        far = jnp.where(turned > jnp.pi, Result.ROTATION_TOO_LARGE, Result.SUCCESS)
        result = results.join(solved.result, far, trial.overflow(x))
        good = result == Result.SUCCESS
        keep = lambda new, old: jnp.where(good, new, old)
        return _Path(
            jnp.where(good, jnp.minimum(2 * path.step, first), 0.5 * path.step),
            jax.tree.map(keep, reference, path.reference),
            keep(x, path.x),
            result,
            path.iterations + solved.iterations,
            path.accepted + good.astype(jnp.int32),
            path.rejected + (~good).astype(jnp.int32),
            keep(target, path.reached),
        )

    def unfinished(path: _Path):
        return (path.reached < 1) & (path.step > first * 0.5 ** (_HALVINGS + 0.5))

    none = jnp.zeros((), jnp.int32)
    nowhere = jnp.zeros_like(first)
    reference = state.position, state.quaternion
    x = equations(nowhere, reference).guess(state.force)
    begin = _Path(first, reference, x, none, none, none, none, nowhere)
    return lax.while_loop(unfinished, attempt, begin)


def _check_path(scene: Scene, state: State, stop) -> None:
    """Raise ValueError where schedules, switches or values do not fit the path."""
    for name in ("position", "quaternion", "force"):
        value = getattr(state, name)
        if not isinstance(value, jax.core.Tracer) and not np.all(np.isfinite(value)):
            raise ValueError(f"state.{name}: must be finite everywhere")
    if isinstance(stop, jax.core.Tracer) or isinstance(state.time, jax.core.Tracer):
        return
    if not float(stop) >= float(state.time):
        raise ValueError(f"time: {float(stop):g} lies before the state's {float(state.time):g}")
    scene.check_until(float(stop))
    for switch in scene.switch_times:
        if isinstance(switch, jax.core.Tracer):
            continue
        if float(state.time) < float(switch) < float(stop):
            raise ValueError(
                f"time: a constraint changes at {float(switch):g}; find the equilibrium at that"
                " time first and start from it"
            )


def check_held(scene: Scene, state: State) -> None:
    """Raise ValueError if the ends leave the rod free to move as a rigid body.

    A rod held in part passes if a `DistributedLoad` might hold the rest. Skipped for traced values.
    """
    leaves = jax.tree.leaves((projectors(scene, state.time), state, scene.rod.length))
    if any(isinstance(leaf, jax.core.Tracer) for leaf in leaves):
        return
    both = np.asarray(projectors(scene, state.time))
    if not np.any(both):
        raise ValueError(
            "first_end, last_end: a rod held at neither end has no unique equilibrium; hold one"
            " (ends.Clamped, or ends.Pinned and ends.Slider together)"
        )
    if any(isinstance(load, DistributedLoad) for load in scene.loads):
        return
    length = float(jnp.sum(scene.rod.length))
    rows = []
    for index, projector in zip((0, -1), both, strict=True):
        arm = np.asarray(state.position[index] - state.position[0]) / length
        frame = np.asarray(rotations.matrix(state.quaternion[index]))
        # rigid motion: translation a over L, rotation w about node 0
        translation = np.concatenate([np.eye(3), -np.asarray(rotations.hat(jnp.asarray(arm)))], 1)
        rotation = np.concatenate([np.zeros((3, 3)), frame.T], 1)
        rows.append(projector @ np.concatenate([translation, rotation]))
    rank = np.linalg.matrix_rank(np.concatenate(rows), tol=1e-6)
    if rank < 6:
        raise ValueError(
            f"first_end, last_end: they leave {6 - rank} rigid motion(s) of the rod free (a spin"
            " about the line through two pins, a slide along two sliders), so the equilibrium is"
            " not unique; hold the rod more"
        )
