"""The compliant rod as an ordinary differential equation, for any solver of diffrax.

A rod with compliance in shear and extension has no constraint left: its internal force follows
from its strains, f = (gamma - e3) / compliance, and the balances (8), (9) give the accelerations,

    R' = v,    q' = q (0, omega) / 2,
    m v' = F - internal force,    I omega' = Q - internal moment - omega x I omega.

The grid and its forces are those of the library's own steps, the time integration is another's: an
independent check of the steps. Use:

    term = diffrax.ODETerm(semidiscrete.vector_field)
    y0 = semidiscrete.initial_value(scene)
    diffrax.diffeqsolve(term, diffrax.Dopri8(), 0.0, 1.0, dt0, y0, args=scene, ...)

An explicit solver is held to steps near the diameter over the speed of sound, an implicit one
solves with a dense Jacobian of 13 unknowns a node; generalised-alpha needs neither.
"""

import functools
import operator

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rodjax.constraints import ends
from rodjax.dynamics.consistency import start
from rodjax.inputs.validation import all_known
from rodjax.interactions.load import total_wrench
from rodjax.numerics import rotations
from rodjax.rods import balance
from rodjax.rods.chain import check_alone
from rodjax.rods.inertia import node_inertia
from rodjax.rods.rod import Rod
from rodjax.rods.state import NodeMotion, State
from rodjax.rods.strains import strains
from rodjax.scenes.holds import impose
from rodjax.scenes.scene import Scene, projectors


class Motion(eqx.Module):
    """What the differential equation advances; its derivative has the same form.

    `rate` holds v in inertial and omega in body components, as in `State`.

    Attributes:
        position: nodes in inertial components [m].
        quaternion: frames of the nodes, scalar first, body to inertial.
        rate: v and omega [m/s, rad/s].
    """

    position: Float[Array, "*k nodes 3"]
    quaternion: Float[Array, "*k nodes 4"]
    rate: Float[Array, "*k nodes 6"]


def initial_value(scene: Scene, state: State | None = None) -> Motion:
    """The motion at a state (by default the scene's `start`), where the scene has the form.

    Raises:
        ValueError: the rod has no compliance or no inertia in some direction, touches itself, or
            an end's constraint changes during the run.
    """
    _check(scene)
    state = start(scene) if state is None else state
    return Motion(state.position, state.quaternion, state.rate)


def vector_field(time: Float[Array, ""], motion: Motion, scene: Scene) -> Motion:
    """Derivative of a scene's motion at a time, in the order of arguments that diffrax passes.

    Constrained directions of an end move as its schedules say, at every time, whatever the rates
    of the motion there are; so a schedule whose rate jumps needs no impulse. Quaternions count
    by their direction only: a solver may let their length drift.
    """
    time = jnp.asarray(time, motion.position.dtype)
    quaternion = rotations.normalize(motion.quaternion)
    rate, prescribed = motion.rate, jnp.zeros_like(motion.rate)
    both = projectors(scene, time)
    for index, end, projector in zip((0, -1), scene.ends, both, strict=True):
        velocity, acceleration = ends.rates(end, time, quaternion[index])
        rate = rate.at[index].add(projector @ (velocity - rate[index]))
        prescribed = prescribed.at[index].set(projector @ acceleration)
    moving = NodeMotion(time, motion.position, quaternion, rate[:, :3], rate[:, 3:])
    spin = jnp.concatenate([jnp.zeros_like(rate[:, :1]), 0.5 * rate[:, 3:]], 1)
    return Motion(
        moving.velocity,
        rotations.multiply(quaternion, spin),
        _accelerations(scene, moving, both, prescribed),
    )


def internal_force(rod: Rod, motion: Motion) -> Float[Array, "n 3"]:
    """f of the elements of a rod in a motion, in their own frames [N]."""
    time = jnp.zeros((), motion.position.dtype)
    quaternion, rate = rotations.normalize(motion.quaternion), motion.rate
    return _force(rod, NodeMotion(time, motion.position, quaternion, rate[:, :3], rate[:, 3:]))


def _force(rod: Rod, motion: NodeMotion):
    assert rod.compliance is not None  # checked in `initial_value`
    kinematics = strains(rod, motion.position, motion.quaternion)
    return balance.damped_strain(rod, kinematics, motion) / rod.compliance


def _accelerations(scene: Scene, motion: NodeMotion, both, prescribed) -> Float[Array, "nodes 6"]:
    """Accelerations of the nodes, the constrained ones (by the projectors) as prescribed."""
    rod = scene.rod
    mass, rotary = node_inertia(rod)
    assert rotary is not None  # checked in `initial_value`
    force = _force(rod, motion)
    inner = balance.internal(rod, motion, force)
    wrench = -jnp.concatenate([inner.force, inner.moment], 1)
    if scene.loads:
        wrench = wrench + total_wrench(scene.loads, rod, motion)
    spin = motion.angular_velocity
    angular = (wrench[:, 3:] - rotations.cross(spin, rotary * spin)) / rotary
    added = [load.added_mass(rod, motion) for load in scene.loads]
    added = [matrix for matrix in added if matrix is not None]
    if added:
        whole = functools.reduce(operator.add, added)
        linear = _with_added_mass(mass, whole, wrench[:, :3], both, prescribed)
    else:
        linear = wrench[:, :3] / mass[:, None]
    free = jnp.concatenate([linear, angular], 1)
    return impose(free, jnp.stack([prescribed[0], prescribed[-1]]), both, scene.held_nodes)


def _with_added_mass(mass, added, force, both, prescribed):
    """Linear accelerations where added mass couples an end's free and constrained directions."""
    eye = jnp.eye(3, dtype=force.dtype)
    matrix = mass[:, None, None] * eye[None] + added
    for index, projector in zip((0, -1), both, strict=True):
        fixed = projector[:3, :3]
        free = eye - fixed
        right = free @ (force[index] - matrix[index] @ prescribed[index, :3])
        force = force.at[index].set(right + prescribed[index, :3])
        matrix = matrix.at[index].set(free @ matrix[index] @ free + fixed)
    return jnp.linalg.solve(matrix, force[:, :, None])[:, :, 0]


def _check(scene: Scene) -> None:
    """Raise ValueError where the scene is not a differential equation in this form."""
    rod = scene.rod
    check_alone(rod, "the differential equation")
    if scene.joints:
        raise ValueError("joints: not part of the differential equation; use rodjax.rollout")
    for name, mend in (
        ("mass", "a density"),
        ("rotary_inertia", "rotary_inertia=True"),
        ("compliance", "extensible=True"),
    ):
        value = getattr(rod, name)
        known = value is not None and all_known(value)
        if value is None or (known and np.any(np.asarray(value) <= 0)):
            raise ValueError(
                f"{name}: must be positive in every direction for the rod to be a differential"
                f" equation; give {mend} to its section, or use rodjax.rollout"
            )
    if scene.contact is not None:
        raise ValueError("contact: not part of the differential equation; use rodjax.rollout")
    if rod.lumps:
        raise ValueError("lumps: not part of the differential equation; use rodjax.rollout")
    if scene.supports:
        raise ValueError("supports: not part of the differential equation; use rodjax.rollout")
    if scene.remembers:
        raise ValueError("loads: one remembers, which the equation cannot; use rodjax.rollout")
    if scene.switch_times:
        raise ValueError(
            "first_end, last_end: a constraint that changes gives an impulse; integrate up to the"
            " change and start again from there with the other end"
        )
