"""One step of a rod in a heat bath, by either method."""

import dataclasses

import jax
import jax.numpy as jnp
from jax import lax
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, Float

from rodjax.dynamics.bath import Bath
from rodjax.dynamics.explicit_thermal import explicit
from rodjax.dynamics.midpoint_thermal import midpoint
from rodjax.dynamics.thermal_state import ThermalState, ThermalStepInfo, elastic_force
from rodjax.interactions.interaction import as_seen
from rodjax.numerics import newton, rotations
from rodjax.numerics.results import Result, join
from rodjax.rods.state import State
from rodjax.rods.strains import wound
from rodjax.scenes import drives
from rodjax.scenes.scene import Found, Scene


def thermal_step(
    scene: Scene, start: ThermalState, bath: Bath, dt: Float[Array, ""]
) -> tuple[ThermalState, ThermalStepInfo]:
    """A step of a rod in a heat bath, explicit or by the midpoint rule as the bath says.

    Pure and differentiable for its key held (pathwise); a failure is reported, never raised.

    Args:
        scene: what moves.
        start: from where, with the key of the noise.
        bath: its thermal energy, and the method.
        dt: the step [s].

    Returns:
        The new state with the next key, and what is to be told of the step.

    Example:
        >>> drag = rx.LinearDrag(normal=0.2, tangential=0.1, rotational=1e-6)
        >>> bathed = rx.Scene(rx.yielding(rod), rx.Clamped(), loads=(drag,))
        >>> begun = rx.thermal_start(bathed, jax.random.key(0))
        >>> new, told = rx.thermal_step(bathed, begun, rx.Bath(1e-12), jnp.asarray(1e-8))
        >>> rx.Result(int(told.result)).name
        'SUCCESS'
    """
    state, dtype = start.state, start.state.position.dtype
    dt = jnp.asarray(dt, dtype)
    stop = state.time + dt
    key, drawn = jax.random.split(start.key)
    # a barrier, or XLA draws each number anew wherever it is used: half of the step on CPUs
    white = lax.optimization_barrier(jax.random.normal(drawn, state.rate.shape, dtype))
    too_fast = drives.too_fast(scene, state.time, stop, state.quaternion)
    codes = []
    if too_fast is not None:
        codes.append(jnp.where(too_fast, Result.DRIVE_TOO_FAST, Result.SUCCESS))
    iterations = jnp.asarray(0, jnp.int32)
    if bath.implicit:
        patient = bath.max_iterations
        if too_fast is not None:
            patient = jnp.where(too_fast, 0, patient)
        change, found, code, iterations = midpoint(scene, state, bath, dt, white, patient)
        codes.append(code)
    else:
        change, found = explicit(scene, state, bath, dt, 0.5 * (start.white + white))
        finite = jnp.all(jnp.isfinite(change))
        codes.append(jnp.where(finite, Result.SUCCESS, Result.NON_FINITE))
    position = state.position + change[:, :3]
    turned = rotations.multiply(state.quaternion, rotations.exponential(change[:, 3:]))
    quaternion = rotations.normalize(turned)
    force = elastic_force(scene.rod, stop, position, quaternion)
    new = dataclasses.replace(
        state, time=stop, position=position, quaternion=quaternion, force=force
    )
    largest = lambda v: jnp.sqrt(jnp.max(jnp.sum(lax.stop_gradient(v) ** 2, 1)))
    moved, turn = largest(change[:, :3]), largest(change[:, 3:])
    far = (turn > jnp.pi) | wound(scene.rod, quaternion)
    codes.append(jnp.where(far, Result.ROTATION_TOO_LARGE, Result.SUCCESS))
    codes += _verdicts(scene, found, state, new, moved)
    code = checkpoint_name(join(*codes), newton.SOLUTION)
    return ThermalState(new, key, white), ThermalStepInfo(code, iterations, moved, turn)


def _verdicts(scene: Scene, found: Found, before: State, after: State, moved) -> list:
    """What the interactions say of a step, and whether it is too long for contact."""
    codes = []
    for one, its in zip(scene.interactions, found.each, strict=True):
        there = one.held_at(after.time)
        began = as_seen(one, after.time, before.position, before.time)
        codes.append(there.verdict(scene.rod, began, after.position, its))
    if scene.contact is not None:
        far = moved > 0.5 * scene.contact.cutoff.astype(moved.dtype)
        codes.append(jnp.where(far, Result.DIFFUSED_TOO_FAR, Result.SUCCESS))
    return [code for code in codes if code is not None]
