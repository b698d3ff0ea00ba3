"""What the drives of ends and supports prescribe over a step, and whether a motion followed them.

A rotation is known modulo whole turns only: what an end turns in one step must stay below half a
turn, else the step would find it turned by less, or not at all, and be none the wiser.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from rodjax.constraints import ends
from rodjax.numerics import rotations
from rodjax.rods.state import State
from rodjax.scenes.scene import Scene, projectors

# Largest turn of an end in one step [rad]: half a turn less the rounding of its schedule.
LARGEST_TURN = np.pi * (1 - 1e-6)

# How far an end may be off its schedule when a run has ended, in element lengths and radians.
_ASTRAY = 1e-3


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
    for _, node, end in scene.holds:
        if end.rotation is not None:
            turn = ends.increments(end, start, stop, quaternion[node])[3:]
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
    for before, after in zip(marks[:-1], marks[1:], strict=True):
        inside = np.flatnonzero((times >= before) & (times <= after)).tolist()
        if len(inside) > 1 and _off(scene, states, inside[0], inside[-1]) > _ASTRAY + allowed:
            return True
    return False


def _off(scene: Scene, states: State, first: int, last: int) -> float:
    """How far an end is off its schedule between two saved states, see `_ASTRAY`."""
    # not one program, which every new scene would compile anew
    start, stop = states.time[first], states.time[last]
    # the projector for the last step, not for one that would begin at its end
    late = jnp.nextafter(stop, start)
    held = np.asarray(projectors(scene, start)), np.asarray(projectors(scene, late))
    length, worst = float(np.mean(np.asarray(scene.rod.length))), 0.0
    for k, (_, node, end) in enumerate(scene.holds):
        if not np.allclose(held[0][k], held[1][k]):
            continue
        index = int(node)
        frames = states.quaternion[first, index], states.quaternion[last, index]
        wanted = ends.increments(end, start, stop, frames[0])
        moved = states.position[last, index] - states.position[first, index]
        shift = held[0][k][:3, :3] @ np.asarray(moved - wanted[:3])
        worst = max(worst, float(np.linalg.norm(shift)) / length)
        if np.allclose(held[0][k][3:, 3:], np.eye(3)):
            there = rotations.multiply(frames[0], rotations.exponential(wanted[3:]))
            turn = np.asarray(rotations.multiply(rotations.conjugate(there), frames[1]))
            worst = max(worst, 2 * float(np.arctan2(np.linalg.norm(turn[1:]), turn[0])))
    return worst
