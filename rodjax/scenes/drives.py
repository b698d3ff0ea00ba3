"""What drives prescribe over a step, and whether a motion followed them.

A rotation is known modulo whole turns only: what an end turns in one step must stay below half a
turn, else the step would find it turned by less, or not at all, and be none the wiser.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from rodjax.constraints import ends
from rodjax.constraints.ends import AbstractEnd
from rodjax.numerics import rotations
from rodjax.numerics.compilation import compiled
from rodjax.rods.state import State
from rodjax.scenes.closure import closings
from rodjax.scenes.scene import Scene

# Largest turn of an end in one step [rad]: half a turn less the rounding of its schedule.
LARGEST_TURN = np.pi * (1 - 1e-6)

# Sine of the angle between the axis of a joint and a tangent about which it turns.
_ASKEW = 1e-6

# How far an end may be off its schedule when a run has ended, in element lengths and radians.
_ASTRAY = 1e-3


def too_fast(
    scene: Scene,
    start: Float[Array, ""],
    stop: Float[Array, ""],
    quaternion: Float[Array, "nodes 4"],
    largest: float = LARGEST_TURN,
) -> Bool[Array, ""] | None:
    """Whether an end or joint is to turn by `largest` or more from `start` to `stop`.

    None if none turns. `quaternion` are the frames at `start`. What a drive prescribes in
    directions that its end leaves free does not count.
    """
    both = (turns_of_joints(scene, time, quaternion.dtype) for time in (start, stop))
    turns = [after - before for before, after in zip(*both, strict=True)]
    for _, node, end in scene.holds:
        if end.rotation is not None:
            turn = ends.increments(end, start, stop, quaternion[node])[3:]
            turns.append(end.projector(start).astype(turn.dtype)[3:, 3:] @ turn)
    if not turns:
        return None
    return jnp.any(jnp.sum(jnp.stack(turns) ** 2, 1) >= largest**2)


def turns_of_joints(scene: Scene, time: Float[Array, ""], dtype) -> list[Float[Array, "3"]]:
    """By what driven joints have turned at a time, about their axes [rad]."""
    found = []
    for joint in scene.joints:
        along = joint.driven()
        if along is not None:
            found.append((along[3:] * joint.coordinate(time)).astype(dtype))
    return found


def turns_of_ring(scene: Scene, time: Float[Array, ""]) -> Float[Array, ""]:
    """Turns of Lk that driven joints have given the scene's first rod at a time, which they close.

    Not a number where they turn it about another axis than its tangent.
    """
    total = jnp.zeros((), scene.rod.position.dtype)
    for _, joint, sense in closings(scene, 0):
        along = joint.driven()
        if along is not None:
            about = jnp.where(jnp.sum(along[:5] ** 2) < _ASKEW**2, along[5], jnp.nan)
            turns = sense * about * joint.coordinate(time) / (2 * jnp.pi)
            total = total + turns.astype(total.dtype)
    return total


def turning(scene: Scene) -> bool:
    """Whether a drive turns anything."""
    ends = any(held.end.rotation is not None for held in scene.holds)
    return ends or any(joint.schedules for joint in scene.joints)


def astray(scene: Scene, states: State, allowed: float) -> bool:
    """Whether an end or joint is not where its schedules put it, over saved states, not traced.

    Of ends, displacement and turns (modulo two, as far as frames tell) since the start, and since
    each time at which a constraint changed, in the directions that were constrained all the while.
    Of joints, what is left between their points at the end.

    Args:
        allowed: what the tolerances of all steps sum up to, in element lengths and radians.
    """
    times = np.asarray(states.time)
    switches = sorted(t for t in map(float, scene.switch_times) if times[0] < t < times[-1])
    marks = [-np.inf, *switches, np.inf]
    for before, after in zip(marks[:-1], marks[1:], strict=True):
        inside = np.flatnonzero((times >= before) & (times <= after)).tolist()
        if len(inside) > 1 and _off(scene, states, inside[0], inside[-1]) > _ASTRAY + allowed:
            return True
    return _joints_off(scene, states) > _ASTRAY + allowed


def _joints_off(scene: Scene, states: State) -> float:
    """How far driven joints are off their schedules in the last saved state, see `_ASTRAY`."""
    driven = [joint for joint in scene.joints if joint.schedules]
    if not driven:
        return 0.0
    known = scene.rod.quaternion, states.time, states.position, states.quaternion
    frames, time, position, quaternion = map(np.asarray, known)
    length, worst = float(np.mean(np.asarray(scene.rod.length))), 0.0
    for joint in driven:
        places = [point.place(scene.rod.parts) for point in (joint.first, joint.second)]
        first, second = (jnp.asarray(frames[node]) for node in places)
        placed = rotations.multiply(rotations.conjugate(first), second)
        here, there = (
            (jnp.asarray(position[-1, node]), jnp.asarray(quaternion[-1, node])) for node in places
        )
        now = jnp.asarray(time[-1])
        # as in `_wanted`, not in a compiled program
        gap = joint.projector().astype(placed.dtype) @ joint.gap(here, there, placed, now)
        shift, turn = np.linalg.norm(np.asarray(gap).reshape(2, 3), axis=1)
        worst = max(worst, float(shift) / length, float(turn))
    return worst


def _off(scene: Scene, states: State, first: int, last: int) -> float:
    """How far an end is off its schedule between two saved states, see `_ASTRAY`."""
    times = np.asarray(states.time)
    start, stop = times[first], times[last]
    # the projector for the last step, not for one that would begin at its end
    late = np.nextafter(stop, start)
    length, worst = float(np.mean(np.asarray(scene.rod.length))), 0.0
    for _, node, end in scene.holds:
        index = int(node)
        positions = np.asarray(states.position)[[first, last], index]
        frames = np.asarray(states.quaternion)[[first, last], index]
        wanted = _wanted(end, *map(jnp.asarray, (start, stop)))
        out = _followed(end, start, late, *wanted, *positions, *frames)
        before, after, shift, turn = jax.tree.map(np.asarray, out)
        if not np.allclose(before, after):
            continue
        worst = max(worst, float(np.linalg.norm(before[:3, :3] @ shift)) / length)
        if np.allclose(before[3:, 3:], np.eye(3)):
            worst = max(worst, 2 * float(np.arctan2(np.linalg.norm(turn[1:]), turn[0])))
    return worst


def _wanted(end: AbstractEnd, start: Float[Array, ""], stop: Float[Array, ""]):
    """Displacement [m] and rotation vector [rad], inertial axes, that schedules ask for.

    Not in a compiled program: of a function that reads what changes it would hold, as the steps do,
    what it read when it was compiled, and the check is to see that.
    """
    shift = turn = np.zeros(3, stop.dtype)
    if end.displacement is not None:
        shift = np.asarray(end.displacement(stop)) - np.asarray(end.displacement(start))
    if end.rotation is not None:
        turn = np.asarray(end.rotation(stop)) - np.asarray(end.rotation(start))
    return shift.astype(stop.dtype), turn.astype(stop.dtype)


@compiled  # of an end by itself: not anew for every scene
def _followed(end, start, late, shift, turn, position, reached, frame, turned):
    """Projectors from `start` and from `late` on; how far the end is off in place and frame."""
    wanted = rotations.exponential(rotations.rotate_inverse(frame, turn))
    there = rotations.multiply(frame, wanted)
    turn = rotations.multiply(rotations.conjugate(there), turned)
    return end.projector(start), end.projector(late), reached - position - shift, turn
