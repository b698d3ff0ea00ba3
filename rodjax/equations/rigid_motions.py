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
from rodjax.numerics.compilation import compiled
from rodjax.rods.state import NodeMotion, State, at_rest
from rodjax.scenes.scene import Scene, directions


class Hold(NamedTuple):
    """What holds a rod besides its ends (not in traced code)."""

    loads: bool = False  # they hold rigid motions that the ends leave free
    spin: bool = False  # nothing but a convention holds the spin about itself
    bodies: bool = False  # nor how bodies by themselves are turned


def check_held(
    scene: Scene, state: State, time: Float[Array, ""] | None = None, spin_free: bool = False
) -> Hold:
    """Raise ValueError if ends and loads (those at `time`) leave the rod free as a rigid body.

    A rod held in part passes if a load says that it might hold the rest. Skipped for traced values.

    Args:
        spin_free: whether the spin of the rod about itself may stay free, and turns of bodies by
            themselves.
    """
    # known values stay known also inside a transformation without jit
    with jax.ensure_compile_time_eval():
        both = directions(scene, state.time)
        bodies = spin_free and len(scene.rod.bodies) > 0
        if not all_known(both):
            return Hold(bodies=bodies)
        both = np.asarray(both)
        free_at_ends = (
            f"{scene.holding}: a rod held at neither end has no unique equilibrium; hold one"
            " (ends.Clamped, or ends.Pinned and ends.Slider together)"
        )
        if not np.any(both) and not scene.loads:
            raise ValueError(free_at_ends)
        # of one rod: what holds it, not its bodies
        own = np.delete(both, 2 + np.arange(len(scene.rod.bodies)), 0)
        spin = spin_free and not np.any(own[:, 5, 5] > 0) and len(scene.rod.strands) == 1
        needed = (state.position, state.quaternion, scene.rod.length, *scene.held_nodes)
        needed = (*needed, scene.joints)
        if not all_known(needed):
            # where neither end holds the tangent, loads must
            return Hold(not np.any(both[:, (3, 4), (3, 4)] > 0), spin, bodies)
        rigid = _Rigid(scene, state, both, spin)
        free = rigid.free()
        if len(free) == 0:
            return Hold(spin=spin)
        if any(load.may_hold for load in scene.loads):
            return Hold(True, spin, bodies)
        time = state.time if time is None else time
        if not all_known((scene, time)):
            return Hold(True, spin, bodies)
        unheld = len(free) - rigid.held_by_loads(free, time)
        if unheld > 0 and bodies:
            # a body that turns about what joins it, at no cost, stays as it is turned
            rigid = rigid._replace(bodies=True)
            free = rigid.free()
            if len(free) == rigid.held_by_loads(free, time):
                return Hold(True, spin, bodies)
    if unheld > 0 and not np.any(both):
        raise ValueError(free_at_ends)
    if unheld > 0:
        raise ValueError(
            f"{scene.holding}: they leave {unheld} rigid motion(s) of the {_what(scene)} free (a"
            " swing about a pin, a spin about two, a slide along two sliders), and the loads do not"
            f" hold them, so the equilibrium is not unique; hold the {_what(scene)} more"
            + (" (a Joint to what is held, the body's `end`, or Gravity)" if bodies else "")
        )
    return Hold(loads=True, spin=spin)


def _what(scene: Scene) -> str:
    """What moves, for messages."""
    return "rod and bodies" if scene.rod.bodies else "rod"


class _Rigid(NamedTuple):
    """Rigid motions of rods and bodies, six numbers of each one after the other: translation over
    the length, rotation about its first node (not in traced code).
    """

    scene: Scene
    state: State
    both: np.ndarray  # projectors of what is held
    spin: bool  # whether a convention holds the spin of node 0
    bodies: bool = False  # and how bodies by themselves are turned

    @property
    def length(self) -> float:
        """By numpy: under a transformation even a known value becomes traced by a `custom_jvp`."""
        return float(np.sum(np.asarray(self.scene.rod.length)))

    def rows(self, position, quaternion):
        """What is held, as rows by the numbers of the motions."""
        scene, length, parts = self.scene, self.length, self.scene.rod.parts

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
        for node, projector in zip(scene.held_nodes, self.both, strict=True):
            rows.append(projector @ motion_of(int(node)))
            if self.spin and int(node) == 0:
                rows.append(motion_of(0)[5:])
        if self.bodies:
            rows += [motion_of(node)[3:] for node in scene.rod.bodies]
        if scene.joints:
            unit = np.repeat([length, 1.0], 3)
            slopes = np.asarray(_joints(scene, self._at(position, quaternion))[1])
            slopes = slopes * unit / unit[:, None, None]
            for slope, (a, b) in zip(slopes, joint_terms.nodes_of(scene), strict=True):
                rows.append(slope[:, 0] @ motion_of(a) + slope[:, 1] @ motion_of(b))
        return np.concatenate(rows)

    def _own(self, array):
        """Numpy's arrays are in double precision, what loads are given is in the rod's."""
        return jnp.asarray(array, self.state.position.dtype)

    def _at(self, position, quaternion, time=None):
        time = self.state.time if time is None else time
        return at_rest(self._own(time), self._own(position), self._own(quaternion))

    def free(self, position=None, quaternion=None):
        """The motions that are left free, where rods and bodies are or would be."""
        if position is None:
            position, quaternion = self.state.position, self.state.quaternion
        rows = self.rows(np.asarray(position), np.asarray(quaternion))
        _, size, motions = np.linalg.svd(rows)
        negligible = max(1e-6, 30 * float(jnp.finfo(self.state.position.dtype).eps))
        return motions[int(np.sum(size > negligible)) :]

    def _moved(self, position, quaternion, motion):
        """Positions and frames after a motion."""
        parts = self.scene.rod.parts
        counts = [part.last - part.first + 1 for part in parts]
        motion = motion.reshape(-1, 6)[np.repeat(np.arange(len(parts)), counts)]
        turn = rotations.exponential(self._own(motion[:, 3:]))
        pivot = self._pivots(position)
        arm = self._own(position - pivot)
        place = pivot + self.length * motion[:, :3] + np.asarray(rotations.rotate(turn, arm))
        return place, np.asarray(rotations.multiply(turn, self._own(quaternion)))

    def _pivots(self, position):
        parts = self.scene.rod.parts
        counts = [part.last - part.first + 1 for part in parts]
        return np.repeat(position[[part.first for part in parts]], counts, 0)

    def _joined(self, position, quaternion):
        """The nearest positions and frames in which joints are closed."""
        if not self.scene.joints:
            return position, quaternion
        unit = np.repeat([self.length, 1.0], 3)
        for _ in range(4):
            gap, _ = _joints(self.scene, self._at(position, quaternion))
            lacking = (np.asarray(gap) / unit).ravel()
            rows = self.rows(position, quaternion)
            whole = np.concatenate([np.zeros(len(rows) - len(lacking)), -lacking])
            step = np.linalg.lstsq(rows, whole, rcond=1e-6)[0]
            position, quaternion = self._moved(position, quaternion, step)
        return position, quaternion

    def _work(self, position, quaternion, time):
        """The generalised forces of the loads, and their size."""
        scene, length = self.scene, self.length
        wrench = np.asarray(_pushed(scene, self._at(position, quaternion, time)))
        spatial = np.asarray(rotations.rotate(self._own(quaternion), self._own(wrench[:, 3:])))
        moment = np.cross(position - self._pivots(position), wrench[:, :3]) + spatial
        rows = np.concatenate([length * wrench[:, :3], moment], 1)
        generalised = np.add.reduceat(rows, [part.first for part in scene.rod.parts]).ravel()
        return generalised, length * np.abs(wrench[:, :3]).sum() + np.abs(spatial).sum()

    def held_by_loads(self, free, time) -> int:
        """How many of these motions the loads resist or drive, as the rods are or swung.

        What loads do in them, the generalised forces, must change with them: a pendulum's weight
        does. Rods without joints swing about their first nodes, others along their free motions.
        """
        scene = self.scene
        if not scene.loads or len(free) == 0:
            return 0
        place = np.asarray(self.state.position, float)
        frames = np.asarray(self.state.quaternion, float)
        parts = len(scene.rod.parts)
        # so far that rounding is little of what changes, in single precision too: what no load
        # holds changes nowhere
        rows, largest, step = [], 0.0, 0.1
        swings = [np.zeros(3), np.array([0.5, 0.3, 0.2]), np.array([-0.4, 0.6, 1.1])]
        for i, swing in enumerate(swings):
            if scene.joints:
                mixed = 0.8 * np.sin((1.0 + i) * (1.0 + np.arange(len(free)))) * (i > 0)
                base = self._joined(*self._moved(place, frames, mixed @ free))
            else:
                swung = np.tile(np.concatenate([np.zeros(3), swing]), parts)
                base = self._moved(place, frames, swung)
            own = self._carried(free, *base)
            for motion in own:
                ends = []
                for way in (step, -step):
                    there = self._joined(*self._moved(*base, way * motion))
                    force, size = self._work(*there, time)
                    ends.append(self._carried(own, *there) @ force)
                    largest = max(largest, size)
                rows.append((ends[0] - ends[1]) / (2 * step))
        if largest == 0:
            return 0
        rows = np.stack(rows) / largest
        if not np.all(np.isfinite(rows)):
            return len(free)
        rounding = 30 * float(jnp.finfo(self.state.position.dtype).eps) / step
        return int(np.linalg.matrix_rank(rows, max(1e-5, rounding)))

    def _carried(self, motions, position, quaternion):
        """Free motions there that are those from elsewhere; without joints these.

        Those of the same turns about inertial axes, as far as there are, so that a turn that costs
        nothing is one of them wherever it has come to.
        """
        if not self.scene.joints:
            return motions
        there = self.free(position, quaternion)
        weight = np.tile(np.repeat([1e-3, 1.0], 3), len(self.scene.rod.parts))
        shares = np.linalg.lstsq((weight * there).T, (weight * motions).T, rcond=None)[0]
        return shares.T @ there


@compiled
def _joints(scene: Scene, motion: NodeMotion):
    """What joints lack, and its slopes."""
    return joint_terms.gaps(scene, motion), joint_terms.slopes(scene, motion)


@compiled
def _pushed(scene: Scene, motion: NodeMotion):
    """What the loads exert."""
    return total_wrench(scene.loads, scene.rod, motion)


def _skew(v):
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
