"""What equations of a scheme begin with: their units, and where schedules have what is held."""

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from rodjax.constraints import ends
from rodjax.equations.assembly import Scales
from rodjax.equations.schemes import AbstractScheme
from rodjax.numerics import rotations
from rodjax.rods.state import State
from rodjax.scenes.holds import rows_at
from rodjax.scenes.scene import Scene


class Goals(NamedTuple):
    """Where schedules have what is held, from the nodes that increments count from."""

    shift: Float[Array, "h 3"]
    turn: Float[Array, "h 4"]


def goals_of(scene: Scene, scheme: AbstractScheme, start: State, time) -> Goals:
    """What the schedules of ends and supports say for `time`."""
    both = lambda rows: rows_at(rows, scene.held_nodes)
    frames, (position, quaternion) = both(start.quaternion), scheme.origin()
    moved = [
        ends.increments(end, start.time, time, frame)
        for (_, _, end), frame in zip(scene.holds, frames, strict=True)
    ]
    moved = jnp.stack(moved)
    turn = rotations.multiply(frames, rotations.exponential(moved[:, 3:]))
    turn = rotations.multiply(rotations.conjugate(both(quaternion)), turn)
    return Goals(moved[:, :3] - both(position - start.position), turn)


def gaps(goals: Goals, moved: Float[Array, "h 6"]) -> Float[Array, "h 6"]:
    """What they lack after such increments: displacement, rotation as the body spin to undo."""
    turn = rotations.multiply(rotations.conjugate(goals.turn), rotations.exponential(moved[:, 3:]))
    return jnp.concatenate([moved[:, :3] - goals.shift, rotations.logarithm(turn)], 1)


def scales_of(scene: Scene, scheme: AbstractScheme) -> Scales:
    """Mean element length; a force that makes inertia plus bending of an element about 1.

    Without derivative, for the solution does not hang on them.
    """
    rod = scene.rod
    length = rod.mean_length
    force = rod.mean_bending / length**2
    slopes = scheme.slopes()
    if rod.mass is not None and slopes is not None:
        mass = jnp.mean(rod.solid(rod.mass)) * length
        force = force + slopes.by_acceleration * mass * length
    return Scales(*lax.stop_gradient((length, force)))
