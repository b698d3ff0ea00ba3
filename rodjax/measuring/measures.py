"""Measures of a state or a stored run: topology, apex, constraint error, event times."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from rodjax.dynamics.run import Run
from rodjax.inputs.argument_types import AnyArray
from rodjax.inputs.validation import all_known
from rodjax.interactions import contact_report
from rodjax.interactions.contact_report import ContactReport
from rodjax.interactions.obstacle_touch import ObstacleContact
from rodjax.measuring import energy
from rodjax.measuring.blocks import over_states
from rodjax.measuring.event_times import first_crossing, slopes, time_of_maximum  # noqa: F401 (public here)
from rodjax.measuring.mutual import mutual_linking  # noqa: F401 (public here)
from rodjax.numerics import rotations
from rodjax.numerics.compilation import compiled
from rodjax.rods import balance, topology
from rodjax.rods.chain import alone, check_alone
from rodjax.rods.rod import Rod
from rodjax.rods.state import State
from rodjax.rods.strains import curvature, strains
from rodjax.rods.winding import twist, writhe, writhe_of  # noqa: F401 (public here)
from rodjax.scenes import drives
from rodjax.scenes.closure import closings, welded
from rodjax.scenes.scene import Scene


def twist_eq15(rod: Rod, state: State) -> Float[Array, ""]:
    """The paper's twist, Eq. (15), of a rod in a state [turns]; `twist` to second order in ds."""
    return topology.twist_integral(curvature(rod, state.quaternion), rod.length)


def turns(
    scene: Scene, time: Float[Array, ""] | float, start: Float[Array, ""] | float = 0.0
) -> Float[Array, ""]:
    """Turns that a scene's drives of both ends applied from `start` to `time`, in the sense of Lk.

    The end s = 0 turned by -turns about its tangent, or the other by +turns about its own, counts
    positive. Of a ring those of the joint count that closes it, and what turns its ends turns all
    of it.

    Raises:
        ValueError: a drive does not turn about the tangent of its end in the rod's placing, so
            that its angle is no number of turns (checked outside traced code).
    """
    _check_counted(scene)
    as_time = lambda t: t if isinstance(t, jax.Array) else jnp.asarray(t, float)
    return _turns(scene, as_time(time), as_time(start))


@compiled
def _turns(scene, time, start):
    total = jnp.zeros((), scene.rod.position.dtype)
    if welded(scene, 0):
        return total + drives.turns_of_ring(scene, time) - drives.turns_of_ring(scene, start)
    for end, node, sign in zip(scene.ends, (0, -1), (-1, 1), strict=True):
        turn = end.rotation
        if turn is None:
            continue
        # 1 or -1: whether it turns about the tangent or against it
        along = jnp.sum(turn.axis * rotations.tangent_director(scene.rod.quaternion[node]))
        total = total + sign * along * (turn.angle(time) - turn.angle(start)) / (2 * jnp.pi)
    return total


def _check_counted(scene: Scene) -> None:
    """Raise ValueError unless it is one rod and its ends are turned about their tangents.

    The latter outside traced code only.
    """
    check_alone(scene.rod, "a number of turns")
    for name, joint, _ in closings(scene, 0):
        along = joint.driven()
        if along is not None and all_known(along) and np.any(np.abs(np.asarray(along)[:5]) > 1e-12):
            raise ValueError(
                f"{name}: turns are counted for a drive about the tangent only; give the axis"
                " (0, 0, 1)"
            )
    if welded(scene, 0):
        return
    for name, node, end in scene.holds[:2]:
        if end.rotation is None or not all_known(end.rotation.axis, scene.rod.quaternion):
            continue
        w, x, y, z = np.asarray(scene.rod.quaternion)[node]
        tangent = np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
        cosine = np.sum(np.asarray(end.rotation.axis) * tangent)
        if np.abs(np.abs(cosine) - 1) > 1e3 * np.finfo(cosine.dtype).eps:
            raise ValueError(
                f"{name}.rotation: turns are counted for a drive about the end's tangent only;"
                f" its axis makes an angle of {np.degrees(np.arccos(cosine)):.3g} degrees"
            )


class Linking(NamedTuple):
    """Topology of a run at its saved times; all in turns.

    Attributes:
        time: [s].
        twist: exact twist Tw of the polygon of nodes, so that Tw + Wr = Lk to rounding.
        twist_eq15: the paper's, Eq. (15), equal to second order in the element length.
        writhe: Wr.
        turns: applied by the drives since the first state.
    """

    time: Float[Array, " k"]
    twist: Float[Array, " k"]
    twist_eq15: Float[Array, " k"]
    writhe: Float[Array, " k"]
    turns: Float[Array, " k"]  # applied by the drives since the first state

    @property
    def error(self) -> Float[Array, " k"]:
        """Change of Tw + Wr less the turns applied: 0, or 2 more or less for each passage."""
        start = self.twist[0] + self.writhe[0]
        return topology.linking_error(self.turns, self.twist, self.writhe) - start


def linking(scene: Scene, run: Run, extension: float | None = None) -> Linking:
    """Twist, writhe and applied turns over the saved states of a run (one state at a time).

    The drives are those of the scene; `extension` is that of `topology.writhe` [m]. The writhe of a
    ring (`scene.closed`) is that of its closed line: extensions would cross where its ends meet.
    """
    alone(run.states, "linking")
    _check_counted(scene)
    first = run.state(0).time
    return Linking(run.times, *_topology(run.states, scene, extension, first))


@over_states
def _topology(state, scene, extension, first):
    writhes = writhe_of(scene.closed, state, extension)
    applied = turns(scene, state.time, first)
    return twist(state), twist_eq15(scene.rod, state), writhes, applied


def contacts(scene: Scene, run: Run) -> ContactReport:
    """Contact forces of a scene, their sum and the smallest gap at every saved time of a run.

    Raises:
        ValueError: the scene has no contact.
    """
    if scene.contact is None:
        raise ValueError("scene: it has no contact to report")
    return _contacts(run.states, scene)


def obstacle_contact(scene: Scene, run: Run, load: int) -> ObstacleContact:
    """What passes between the nodes and an obstacle at every saved time of a run.

    Forces at points between nodes (`Obstacle.points_per_element`) are shared out to the nodes;
    gaps, slip, and whether they stick or slide, are those of the nodes themselves.

    Args:
        load: which of `scene.loads` is the obstacle.

    Raises:
        ValueError: that is none.
    """
    if not hasattr(scene.loads[load], "contact"):
        raise ValueError(f"load: loads[{load}] is no obstacle, but {scene.loads[load]!r}")
    return over_states(lambda state, scene: _touching(scene, state, load))(run.states, scene)


def _touching(scene: Scene, state: State, load: int) -> ObstacleContact:
    obstacle: Any = scene.recalling(state.memory).loads[load]
    return obstacle.contact(scene.rod, energy.node_motion(state))


@over_states
def _contacts(s, scene):
    spin = rotations.rotate(s.quaternion, s.angular_velocity)
    at = scene.contact, scene.rod, s.position, s.velocity
    found = contact_report.report(*at, scene.closed, spin)
    # what is not a number is near nothing, but not for that free of forces
    unknown = 0 * jnp.sum(s.position)
    known = jax.tree.map(lambda x: x + unknown, found._replace(overflow=None))
    return known._replace(overflow=found.overflow)


def stretch_error(rod: Rod, state: State) -> Float[Array, ""]:
    """Largest |gamma - e3 - compliance f| of any element and component of a rod in a state [-]."""
    kinematics = strains(rod, state.position, state.quaternion)
    motion = energy.node_motion(state)
    return jnp.max(jnp.abs(balance.constraint(rod, kinematics, state.force, motion)))


class Apex(NamedTuple):
    """The point of the rod that is farthest from the loading axis.

    Attributes:
        index: node number, with a fraction.
        position: [m].
        tangent: unit third director there.
    """

    index: Float[Array, ""]  # node number, with a fraction
    position: Float[Array, "3"]
    tangent: Float[Array, "3"]


def apex(
    state: State, axis: Float[AnyArray, "3"], origin: Float[AnyArray, "3"] | None = None
) -> Apex:
    """The apex of a state from the line along `axis` through `origin` (default: the node s = 0).

    The node farthest from the line, refined by the parabola through the squared distances of it
    and its two neighbours; position and third director are interpolated quadratically there. It
    is continuous up to third order in the element length where the farthest node changes, and
    without meaning while the rod is straight.
    """
    alone(state, "an apex")
    axis = jnp.asarray(axis, state.position.dtype)
    unit = axis / jnp.linalg.norm(axis)
    offset = state.position - (state.position[0] if origin is None else origin)[None]
    squared = jnp.sum(jnp.cross(offset, unit[None]) ** 2, 1)
    k = jnp.clip(jnp.argmax(squared), 1, squared.shape[0] - 2)
    near = lambda values: lax.dynamic_slice_in_dim(values, k - 1, 3)
    a, b, c = near(squared)
    bend = a - 2 * b + c
    # not a node that is farther than both neighbours; what is not a number stays so
    flat = bend >= 0
    x = jnp.where(flat, 0.0, 0.5 * (a - c) / jnp.where(flat, 1.0, bend))
    x = jnp.clip(x, -1.0, 1.0)
    weights = jnp.stack([0.5 * x * (x - 1), 1 - x * x, 0.5 * x * (x + 1)])
    tangent = weights @ near(rotations.tangent_director(state.quaternion))
    return Apex(
        k.astype(x.dtype) + x, weights @ near(state.position), tangent / jnp.linalg.norm(tangent)
    )


def apex_angle(
    state: State, axis: Float[AnyArray, "3"], origin: Float[AnyArray, "3"] | None = None
) -> Float[Array, ""]:
    """Angle between the tangent at the apex and the loading axis [rad], pi/2 when orthogonal.

    Arguments as those of `apex`: state, axis, origin.
    """
    unit = axis / jnp.linalg.norm(axis)
    tangent = apex(state, axis, origin).tangent
    squared = jnp.sum(jnp.cross(tangent, unit) ** 2)
    aligned = squared == 0
    sine = jnp.where(aligned, 0.0, jnp.sqrt(jnp.where(aligned, 1.0, squared)))
    return jnp.arctan2(sine, jnp.sum(tangent * unit))


def buckling_time(scene: Scene, run: Run) -> Float[Array, ""]:
    """Time of the largest torsional energy of a scene's run.

    Section 4.3 of Goyal, Perkins & Lee.
    """
    return time_of_maximum(run.times, _torsion(run.states, scene))


@over_states
def _torsion(state, scene):
    return energy.torsion_energy(scene, state)


def apex_orthogonal_time(
    run: Run, axis: Float[AnyArray, "3"], origin: Float[AnyArray, "3"] | None = None
) -> Float[Array, ""]:
    """First time at which the apex tangent is orthogonal to the loading axis; inf if never.

    The axis and the origin of the line are those of `apex`, at every saved state of the run.
    """
    axis = jnp.asarray(axis, run.states.position.dtype)
    return first_crossing(run.times, _apex_angles(run.states, axis, origin), 0.5 * jnp.pi)


_apex_angles = over_states(apex_angle)
