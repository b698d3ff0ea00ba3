"""Whether rods at rest are held: what their ends and joints leave free to move as rigid bodies.

Where neither end holds the spin of the rod about itself (a cable between pins, or hung from one),
every cross-section may turn about the tangent together with all others: in a naturally straight
rod of equal bending stiffnesses nothing tells such configurations apart.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rodjax.equations import joint_terms
from rodjax.inputs.validation import all_known
from rodjax.interactions.load import total_wrench
from rodjax.numerics import rotations
from rodjax.rods.state import State, at_rest
from rodjax.scenes.scene import Scene, directions


class Hold(NamedTuple):
    """What holds a rod besides its ends (not in traced code)."""

    loads: bool = False  # they hold rigid motions that the ends leave free
    spin: bool = False  # nothing but a convention holds the spin about itself


def check_held(
    scene: Scene, state: State, time: Float[Array, ""] | None = None, spin_free: bool = False
) -> Hold:
    """Raise ValueError if ends and loads (those at `time`) leave the rod free as a rigid body.

    A rod held in part passes if a load says that it might hold the rest. Skipped for traced values.

    Args:
        spin_free: whether the spin of the rod about itself may stay free.
    """
    # known values stay known also inside a transformation without jit
    with jax.ensure_compile_time_eval():
        both = directions(scene, state.time)
        if not all_known(both):
            return Hold()
        both = np.asarray(both)
        free_at_ends = (
            f"{scene.holding}: a rod held at neither end has no unique equilibrium; hold one"
            " (ends.Clamped, or ends.Pinned and ends.Slider together)"
        )
        if not np.any(both) and not scene.loads:
            raise ValueError(free_at_ends)
        spin = spin_free and not np.any(both[:, 5, 5] > 0) and not scene.rod.breaks
        needed = (state.position, state.quaternion, scene.rod.length, *scene.held_nodes)
        needed = (*needed, scene.joints)
        if not all_known(needed):
            # where neither end holds the tangent, loads must
            return Hold(loads=not np.any(both[:, (3, 4), (3, 4)] > 0), spin=spin)
        nodes = [int(node) for node in scene.held_nodes]
        free = _free_motions(scene, state, both, nodes, spin)
        if len(free) == 0:
            return Hold(spin=spin)
        if any(load.may_hold for load in scene.loads):
            return Hold(loads=True, spin=spin)
        time = state.time if time is None else time
        if not all_known((scene, time)):
            return Hold(loads=True, spin=spin)
        unheld = len(free) - _held_by_loads(scene, state, free, time)
    if unheld > 0 and not np.any(both):
        raise ValueError(free_at_ends)
    if unheld > 0:
        raise ValueError(
            f"{scene.holding}: they leave {unheld} rigid motion(s) of the rod free (a swing"
            " about a pin, a spin about two, a slide along two sliders), and the loads do not hold"
            " them, so the equilibrium is not unique; hold the rod more"
        )
    return Hold(loads=True, spin=spin)


def _free_motions(scene: Scene, state: State, both, nodes, spin: bool):
    """Rigid motions that are left free, six numbers of each rod one after the other: translation
    over the length, rotation about its first node.
    """
    # by numpy: under a transformation even a known value becomes traced by a `custom_jvp`
    length = float(np.sum(np.asarray(scene.rod.length)))
    position, quaternion = np.asarray(state.position), np.asarray(state.quaternion)
    parts = scene.rod.parts

    def motion_of(index):
        """Displacement over the length and body spin of a node, by these numbers."""
        rod = next(i for i, part in enumerate(parts) if part.first <= index <= part.last)
        arm = (position[index] - position[parts[rod].first]) / length
        w, v = quaternion[index, 0], quaternion[index, 1:]
        frame = np.eye(3) + 2 * (w * _skew(v) + _skew(v) @ _skew(v))
        own = np.block([[np.eye(3), -_skew(arm)], [np.zeros((3, 3)), frame.T]])
        found = np.zeros((6, 6 * len(parts)))
        found[:, 6 * rod : 6 * rod + 6] = own
        return found

    rows = []
    for index, projector in zip(nodes, both, strict=True):
        rows.append(projector @ motion_of(index))
        if spin and index == 0:
            rows.append(motion_of(index)[5:])
    if scene.joints:
        motion = at_rest(state.time, state.position, state.quaternion)
        unit = np.repeat([length, 1.0], 3)
        slopes = np.asarray(joint_terms.slopes(scene, motion)) * unit / unit[:, None, None]
        for slope, (a, b) in zip(slopes, joint_terms.nodes_of(scene), strict=True):
            rows.append(slope[:, 0] @ motion_of(a) + slope[:, 1] @ motion_of(b))
    _, size, motions = np.linalg.svd(np.concatenate(rows))
    negligible = max(1e-6, 30 * float(jnp.finfo(state.position.dtype).eps))
    return motions[int(np.sum(size > negligible)) :]


def _skew(v):
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


def _held_by_loads(scene: Scene, state: State, free, time) -> int:
    """How many of these rigid motions the loads resist or drive, as the rod is or turned.

    What loads do in them, the generalised forces, must change with them: a pendulum's weight does.
    """
    if not scene.loads:
        return 0
    length = float(jnp.sum(scene.rod.length))
    place = np.asarray(state.position)
    # numpy's arrays are in double precision, what the loads are given is in the rod's
    own = lambda array: jnp.asarray(array, state.position.dtype)
    time = own(time)

    parts = scene.rod.parts
    counts = [part.last - part.first + 1 for part in parts]
    rod = np.repeat(np.arange(len(parts)), counts)
    pivot = place[[part.first for part in parts]][rod]

    def moved(position, quaternion, motion):
        motion = motion.reshape(-1, 6)[rod]
        turn = rotations.exponential(own(motion[:, 3:]))
        arm = own(position - pivot)
        position = pivot + length * motion[:, :3] + np.asarray(rotations.rotate(turn, arm))
        return position, rotations.multiply(turn, quaternion)

    def work(position, quaternion):
        motion = at_rest(time, own(position), quaternion)
        wrench = np.asarray(total_wrench(scene.loads, scene.rod, motion))
        spatial = np.asarray(rotations.rotate(quaternion, own(wrench[:, 3:])))
        moment = np.cross(position - pivot, wrench[:, :3]) + spatial
        rows = np.concatenate([length * wrench[:, :3], moment], 1)
        generalised = np.add.reduceat(rows, [part.first for part in parts]).ravel()
        return free @ generalised, length * np.abs(wrench[:, :3]).sum() + np.abs(spatial).sum()

    # so far that rounding is little of what changes, in single precision too: what no load holds
    # changes nowhere
    rows, largest, step = [], 0.0, 0.1
    for swing in (np.zeros(3), np.array([0.5, 0.3, 0.2]), np.array([-0.4, 0.6, 1.1])):
        swung = np.tile(np.concatenate([np.zeros(3), swing]), len(parts))
        base = moved(place, state.quaternion, swung)
        for motion in free:
            ahead, size = work(*moved(*base, step * motion))
            behind, _ = work(*moved(*base, -step * motion))
            rows.append((ahead - behind) / (2 * step))
            largest = max(largest, size)
    if largest == 0:
        return 0
    rows = np.stack(rows) / largest
    if not np.all(np.isfinite(rows)):
        return len(free)
    rounding = 30 * float(jnp.finfo(state.position.dtype).eps) / step
    return int(np.linalg.matrix_rank(rows, max(1e-5, rounding)))
