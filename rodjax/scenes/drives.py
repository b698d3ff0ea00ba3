"""What the drives of the ends prescribe over a step, and whether a motion followed them.

A rotation is known modulo whole turns only: what an end turns in one step must stay below half a
turn, else the step would find it turned by less, or not at all, and be none the wiser.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from rodjax.constraints import ends
from rodjax.numerics import rotations
from rodjax.numerics.compilation import compiled
from rodjax.rods.state import State
from rodjax.scenes.scene import Scene, projectors

# Largest turn of an end in one step [rad]: half a turn less the rounding of its schedule.
LARGEST_TURN = np.pi * (1 - 1e-6)

# How far an end may be off its schedule when a run has ended, in element lengths and radians.
_ASTRAY = 1e-3

# So far two projectors may differ and be the same.
_SAME = 1e-5


def too_fast(
    scene: Scene,
    start: Float[Array, ""],
    stop: Float[Array, ""],
    quaternion: Float[Array, "nodes 4"],
    largest: float = LARGEST_TURN,
) -> Bool[Array, ""] | None:
    """Whether an end is to turn by `largest` or more from `start` to `stop`; None if none turns.

    `quaternion` are the frames at `start`. What a drive prescribes in directions that its end
    leaves free does not count.
    """
    turns = []
    for index, end in zip((0, -1), scene.ends, strict=True):
        if end.rotation is not None:
            turn = ends.increments(end, start, stop, quaternion[index])[3:]
            turns.append(end.projector(start).astype(turn.dtype)[3:, 3:] @ turn)
    if not turns:
        return None
    return jnp.any(jnp.sum(jnp.stack(turns) ** 2, 1) >= largest**2)


def astray(scene: Scene, states: State, allowed: float) -> bool:
    """Whether an end is not where its schedules put it, over saved states (not in traced code).

    Displacement and turns (modulo two, as far as frames tell) since the start, and since each time
    at which a constraint changed, in the directions that were constrained all the while.

    Args:
        allowed: what the tolerances of all steps sum up to, in element lengths and radians.
    """
    times = np.asarray(states.time)
    switches = sorted(float(t) for t in scene.switch_times if times[0] < t < times[-1])
    marks = [-np.inf, *switches, np.inf]
    at = lambda index: jax.tree.map(lambda leaf: np.asarray(leaf)[index], states)
    for before, after in zip(marks[:-1], marks[1:], strict=True):
        inside = np.flatnonzero((times >= before) & (times <= after)).tolist()
        if len(inside) > 1:
            off = float(_off(scene, at(inside[0]), at(inside[-1])))
            if off > _ASTRAY + allowed:
                return True
    return False


@compiled
def _off(scene: Scene, first: State, last: State) -> Float[Array, ""]:
    """How far an end is off its schedule between two states, see `_ASTRAY`."""
    start, stop = first.time, last.time
    # the projector for the last step, not for one that would begin at its end
    late = jnp.nextafter(stop, start)
    early, late = projectors(scene, start), projectors(scene, late)
    worst = jnp.zeros((), first.position.dtype)
    for k, index, end in zip((0, 1), (0, -1), scene.ends, strict=True):
        held = early[k]
        unchanged = jnp.all(jnp.abs(held - late[k]) < _SAME)
        wanted = ends.increments(end, start, stop, first.quaternion[index])
        shift = held[:3, :3] @ (last.position[index] - first.position[index] - wanted[:3])
        apart = jnp.linalg.norm(shift) / jnp.mean(scene.rod.length)
        turning = jnp.all(jnp.abs(held[3:, 3:] - jnp.eye(3, dtype=held.dtype)) < _SAME)
        there = rotations.multiply(first.quaternion[index], rotations.exponential(wanted[3:]))
        turn = rotations.multiply(rotations.conjugate(there), last.quaternion[index])
        angle = 2 * jnp.arctan2(jnp.linalg.norm(turn[1:]), turn[0])
        apart = jnp.maximum(apart, jnp.where(turning, angle, 0.0))
        worst = jnp.maximum(worst, jnp.where(unchanged, apart, 0.0))
    return worst
