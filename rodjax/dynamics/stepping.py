"""One step of the motion: its equations solved, and restarts where a constraint begins."""

import dataclasses
from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, Bool, Float, Int

from rodjax.dynamics.consistency import project
from rodjax.equations import overlap
from rodjax.equations.equations import step_equations
from rodjax.equations.generalized_alpha import (
    GeneralizedAlpha,
    coefficients,
    local_error,
    opening,
)
from rodjax.equations.start_checks import held_twice
from rodjax.interactions.interaction import as_seen
from rodjax.numerics import newton, rotations
from rodjax.numerics.batching import only_where
from rodjax.numerics.results import Result, as_code, join
from rodjax.rods.state import State, node_motion
from rodjax.rods.strains import wound
from rodjax.scenes import drives
from rodjax.scenes.memory import next_memory, remembering
from rodjax.scenes.scene import Found, Scene


class StepInfo(NamedTuple):
    """What a step reports besides the new state.

    Attributes:
        result: a `Result` as a number; 0 is success.
        iterations: of Newton's method.
        error_position: largest local error of a displacement [m].
        error_bending: of a rotation of the tangent [rad].
        error_twisting: of a rotation about it [rad].
        growth_position: largest displacement of the step [m].
        growth_bending: largest rotation of a tangent [rad].
        growth_twisting: largest rotation about one [rad].
        projection_loss: kinetic energy lost where a constraint began [J].
        settling: whether the step was damped most, just after a constraint began.
    """

    result: Int[Array, ""]
    iterations: Int[Array, ""]
    error_position: Float[Array, ""]  # largest local error of a displacement [m]
    error_bending: Float[Array, ""]  # of a rotation of the tangent [rad]
    error_twisting: Float[Array, ""]  # and of a rotation about it [rad]
    growth_position: Float[Array, ""]  # largest displacement of the step [m]
    growth_bending: Float[Array, ""]  # rotation of a tangent [rad]
    growth_twisting: Float[Array, ""]  # rotation about one [rad]
    projection_loss: Float[Array, ""]  # kinetic energy lost where a constraint began [J]
    settling: Bool[Array, ""]  # damped most, just after a constraint began


def no_info(dtype) -> StepInfo:
    """A report of zeros, in the types of a step's."""
    number, integer = jnp.zeros((), dtype), jnp.zeros((), jnp.int32)
    numbers = (number, number, number, number, number, number, number)
    return StepInfo(integer, integer, *numbers, jnp.asarray(False))


# Steps after a constraint began that are taken with spectral radius 0: its shock excites modes
# that no step of practical size resolves, and without damping they ring on in the forces.
SETTLING_STEPS = 4


def prepare(scene: Scene, state: State) -> State:
    """The state with the count of settling steps and the memory that the scene needs."""
    if scene.switch_times and state.settling is None:
        state = dataclasses.replace(state, settling=jnp.asarray(0, jnp.int32))
    return remembering(scene, state)


def step(
    scene: Scene,
    state: State,
    stop: Float[Array, ""],
    method: GeneralizedAlpha | None = None,
    held: Float[Array, " g"] | None = None,
) -> tuple[State, StepInfo]:
    """Advance the motion from `state.time` to `stop`.

    Pure and differentiable; if a constraint begins at the step's start, velocities are first
    projected onto it. A failed step is reported in `StepInfo.result`, never raised. So is one that
    strides over the time at which a constraint changes: a step must end exactly there (`rollout`
    sees to rounding).

    Args:
        scene, state: what moves, and from where.
        stop: end of the step [s].
        method: default `GeneralizedAlpha()`.
        held: `overlap.distances_held(scene)`, for strands that come nearer to each other than
            their contact can hold them to be reported (CONTACT_OVERCOME), as rollouts do; by
            default that is not looked at.

    Returns:
        The new state, and what is to be told of the step.

    Example:
        >>> state, info = rx.step(scene, rx.start(scene), jnp.asarray(0.01))
        >>> rx.Result(int(info.result)).name
        'SUCCESS'
    """
    method = GeneralizedAlpha() if method is None else method
    state = prepare(scene, state)
    stop = jnp.asarray(stop, state.time.dtype)
    if not scene.switch_times:
        return advance_to(scene, state, stop, method, held)
    state, loss, twice = only_where(
        switching(scene, state),
        lambda s: begin_constraint(scene, s, project),
        lambda s: (s, jnp.zeros_like(s.time), as_code(Result.SUCCESS)),
        state,
    )
    missed = jnp.any(jnp.stack([(state.time < t) & (t < stop) for t in scene.switch_times]))
    state, info = advance_to(scene, state, stop, method, held)
    code = join(info.result, jnp.where(missed, Result.SWITCH_MISSED, Result.SUCCESS), twice)
    return state, info._replace(projection_loss=loss, result=code)


def switching(scene: Scene, state: State) -> Bool[Array, ""]:
    """Whether a constraint changes at the state's time."""
    return jnp.any(jnp.stack([t == state.time for t in scene.switch_times]))


def begin_constraint(
    scene: Scene, state: State, project
) -> tuple[State, Float[Array, ""], Int[Array, ""]]:
    """The state with velocities consistent with a constraint that begins, the loss [J], and a code
    that tells whether the rod is now held twice (its velocities are then not a number).

    Its first steps are damped most, which makes them independent of the accelerations before:
    those are zeroed, since the jolt's own are of modes that no step resolves.
    """
    moving, loss = project(scene, dataclasses.replace(state, settling=None, jerk=None))[:2]
    zero = jnp.zeros_like(state.rate)
    twice = held_twice(scene, state)
    new = dataclasses.replace(
        moving,
        rate=jnp.where(twice, jnp.nan, moving.rate),
        acceleration=zero,
        auxiliary=zero,
        force=state.force,
        settling=jnp.asarray(SETTLING_STEPS, jnp.int32),
        jerk=None if state.jerk is None else zero,
    )
    return new, loss, jnp.where(twice, as_code(Result.HELD_TWICE), as_code(Result.SUCCESS))


def advance_to(
    scene: Scene,
    state: State,
    stop: Float[Array, ""],
    method: GeneralizedAlpha,
    held: Float[Array, " g"] | None = None,
) -> tuple[State, StepInfo]:
    """`step` from a state that is consistent with its constraints."""
    settling = state.settling
    # settings are in the default precision, whatever the rod's
    radius = method.spectral_radius.astype(state.position.dtype)
    if settling is not None:
        radius = jnp.where(settling > 0, 0.0, radius)
    if state.jerk is not None:
        c = coefficients(radius, stop - state.time)
        rate, auxiliary = opening(c, state.rate, state.auxiliary, state.jerk)
        jerk = jnp.zeros_like(state.jerk)
        state = dataclasses.replace(state, rate=rate, auxiliary=auxiliary, jerk=jerk)
    equations = step_equations(scene, state, stop, radius)
    guess = equations.guess(state.force, state.joints)
    found = Found()
    if scene.interactions:
        found = scene.find(state.position, equations.increment(guess)[:, :3])
    equations = dataclasses.replace(equations, found=found)
    guess = equations.limited(guess)
    tolerance = method.newton_tolerance(state.position.dtype)
    iterations = method.max_iterations
    too_fast = drives.too_fast(scene, state.time, stop, state.quaternion)
    if too_fast is not None:  # what it would find is whole turns behind
        iterations = jnp.where(too_fast, 0, iterations)
    x, solved = newton.solve(equations, guess, tolerance, iterations)
    increment, scheme = equations.increment(x), equations.scheme
    rate, acceleration, auxiliary = scheme.advanced(equations.change(x))
    turned = rotations.multiply(state.quaternion, rotations.exponential(increment[:, 3:]))
    new = State(
        stop,
        state.position + increment[:, :3],
        rotations.normalize(turned),
        rate,
        acceleration,
        auxiliary,
        equations.force(x),
        None if settling is None else jnp.maximum(settling - 1, 0).astype(jnp.int32),
        state.jerk,
        joints=equations.joints(x),
        breaks=state.breaks,
    )
    if scene.remembers:
        memory = next_memory(equations.scene, node_motion(new))
        new = dataclasses.replace(new, memory=memory)
    error = local_error(scheme.coefficients, state.auxiliary, auxiliary)
    largest = lambda v: jnp.sqrt(jnp.max(jnp.sum(lax.stop_gradient(v) ** 2, 1)))
    codes = []
    for one, its in zip(scene.interactions, found.each, strict=True):
        there, before = one.held_at(stop), as_seen(one, stop, state.position, state.time)
        codes.append(there.verdict(scene.rod, before, new.position, its))
    if scene.contact is not None and found.contact is not None and held is not None:
        deep = overlap.too_near(scene.contact, found.contact, held, new.position)
        codes.append(jnp.where(deep, Result.CONTACT_OVERCOME, Result.SUCCESS))
    turned_far = (largest(increment[:, 3:]) > jnp.pi) | wound(scene.rod, new.quaternion)
    code = jnp.where(turned_far, Result.ROTATION_TOO_LARGE, Result.SUCCESS)
    code = join(solved.result, *(one for one in codes if one is not None), code)
    if too_fast is not None:
        code = join(code, jnp.where(too_fast, Result.DRIVE_TOO_FAST, Result.SUCCESS))
    info = StepInfo(
        result=checkpoint_name(code, newton.SOLUTION),
        iterations=solved.iterations,
        error_position=largest(error[:, :3]),
        error_bending=largest(error[:, 3:5]),
        error_twisting=largest(error[:, 5:]),
        growth_position=largest(increment[:, :3]),
        growth_bending=largest(increment[:, 3:5]),
        growth_twisting=largest(increment[:, 5:]),
        projection_loss=jnp.zeros_like(state.time),
        settling=jnp.asarray(False) if settling is None else settling > 0,
    )
    return new, info
