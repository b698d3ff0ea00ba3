"""Starts and restarts: velocities, accelerations and forces that agree with the constraints.

Both are one solve with the constrained mass matrix. A start out of equilibrium, or a constraint
that begins during a run, is first order or fails without them.
"""

import dataclasses

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rodjax.constraints import ends
from rodjax.equations import start_checks
from rodjax.equations.constrained import Constrained
from rodjax.equations.imbalance import acting_on, imbalance
from rodjax.equations.overlap import check_apart
from rodjax.inputs.argument_types import AnyArray
from rodjax.inputs.validation import all_known, check_finite, check_numbers, check_scalar
from rodjax.numerics import rotations
from rodjax.numerics.compilation import compiled
from rodjax.numerics.failure import not_a_number
from rodjax.rods import balance
from rodjax.rods.framing import of_one_sign
from rodjax.rods.state import State, at_rest
from rodjax.rods.strains import strains
from rodjax.scenes.arguments import check_scene
from rodjax.scenes.memory import remembering
from rodjax.scenes.scene import Scene


def start(
    scene: Scene,
    *,
    position: Float[AnyArray, "nodes 3"] | None = None,
    quaternion: Float[AnyArray, "nodes 4"] | None = None,
    velocity: Float[AnyArray, "nodes 3"] | None = None,
    angular_velocity: Float[AnyArray, "nodes 3"] | None = None,
    time: float | Float[Array, ""] = 0.0,
) -> State:
    """Consistent state at the start of a run.

    Args:
        scene: what is to run.
        time: of the state [s].
        position, quaternion: configuration; the rod's own placing by default. Without compliance
            it must be unstretched (each edge along its element frame with the rest length). Of
            given frames an element's two are taken to be less than half a turn apart.
        velocity: v in inertial components [m/s]; zero by default.
        angular_velocity: omega in body components [rad/s]; zero by default.

    Velocities that disagree with constraints and ends are projected (least kinetic energy). In
    traced code, which cannot raise, the state of a rod that is stretched is not a number.

    Raises:
        ValueError: a shape is wrong, a value not finite or too small for the rod's precision, the
            rod is stretched, its ends hold it twice in some direction, nothing resists its spin, or
            strands are nearer to each other than the contact can hold them.

    Example:
        >>> state = rx.start(scene, velocity=np.zeros((21, 3)))
        >>> float(state.time)
        0.0
    """
    check_scene(scene)
    rod = scene.rod
    dtype = rod.position.dtype
    nodes = rod.elements + 1
    check_scalar(time=time)
    check_finite(time=time)
    given = {
        "position": (position, rod.position, 3),
        "quaternion": (quaternion, rod.quaternion, 4),
        "velocity": (velocity, jnp.zeros((nodes, 3)), 3),
        "angular_velocity": (angular_velocity, jnp.zeros((nodes, 3)), 3),
    }
    arrays = {}
    for name, (value, default, width) in given.items():
        chosen = default if value is None else value
        check_numbers(**{name: chosen})
        array = jnp.asarray(chosen, dtype)
        if array.shape != (nodes, width):
            raise ValueError(f"{name}: expected shape {(nodes, width)}, got {array.shape}")
        if all_known(array) and not np.all(np.isfinite(array)):
            raise ValueError(f"{name}: must be finite everywhere")
        start_checks.check_size(name, array)
        arrays[name] = array
    if quaternion is not None:
        arrays["quaternion"] = jnp.asarray(of_one_sign(arrays["quaternion"]))
    start_checks.check_single_precision(scene)
    state = State(
        jnp.asarray(time, dtype),
        arrays["position"],
        arrays["quaternion"],
        jnp.concatenate([arrays["velocity"], arrays["angular_velocity"]], 1),
        jnp.zeros((nodes, 6), dtype),
        jnp.zeros((nodes, 6), dtype),
        jnp.zeros((rod.elements, 3), dtype),
        breaks=rod.breaks,
    )
    state = remembering(scene, state)
    start_checks.check_driven_joints(scene, state)
    start_checks.check_held_once(scene, state)
    start_checks.check_spin(scene, state)
    check_apart(scene, state)
    new, _, gap = compiled_restart(scene, state)
    tolerance = 1e3 * float(jnp.finfo(dtype).eps) * nodes
    # negated, so that a frame of zero length (not a number here) is an error too
    stretched = ~(gap <= tolerance)
    if all_known(stretched) and bool(stretched):
        raise ValueError(
            f"position: stretched or sheared by {float(gap):.2g} at most, but the rod is"
            " inextensible: place nodes at rest length along the element frames"
        )
    if not all_known(new):
        return not_a_number(new, stretched | start_checks.held_twice(scene, new))
    _check_start(new, scene.holding)
    return new


def _check_start(state: State, holding: str) -> None:
    """Raise ValueError where no consistent start was found (outside traced code only)."""
    for name in ("rate", "acceleration", "force"):
        value = getattr(state, name)
        if all_known(value) and not np.all(np.isfinite(value)):
            raise ValueError(
                f"{holding}: no unique {name} of the start; ends, mass and loads leave"
                " some motion or force of the rod undetermined"
            )


def project(scene: Scene, state: State) -> tuple[State, Float[Array, ""]]:
    """The state with velocities that agree with the constraints, and the energy lost [J].

    Of a rod without inertia, whose velocities follow from the forces, it is `restart`.
    """
    if scene.rod.mass is None:
        return restart(scene, state)
    rate, loss = Constrained.of(scene, state).project()
    return dataclasses.replace(state, rate=rate), loss


def restart(
    scene: Scene, state: State, *, with_jerk: bool = False
) -> tuple[State, Float[Array, ""]]:
    """The state with consistent velocities, accelerations and forces, and the energy lost [J].

    Velocities are projected; then accelerations and forces are those of
    M V' + J^T f = loads - internal - gyroscopic, J V' = -J' V, the ends' accelerations;
    `with_jerk` also the part of V'' normal to the constraints: M V'' + J^T p = 0,
    J V'' = -J'' V - 2 J' V' and the ends' own (see `generalized_alpha.opening`).
    """
    scene = scene.recalling(state.memory)
    rod, system = scene.rod, Constrained.of(scene, state)
    given = jnp.zeros_like(state.force)
    still = jnp.zeros_like(state.rate)
    rate, loss = (still, jnp.zeros_like(state.time)) if rod.mass is None else system.project()
    motion = system.moving(rate)
    if rod.compliance is not None:
        give = jnp.where(rod.compliance > 0, rod.compliance, 1.0)
        strain = balance.damped_strain(rod, system.kinematics, motion)
        given = jnp.where(rod.compliance > 0, strain / give, 0.0)
        given = given / system.scales.force
    none = jnp.zeros_like(state.force)
    wrench = -imbalance(scene, motion, none, acting_on(scene, motion), still)[0]
    velocities, accelerations = zip(*system.prescribed(ends.rates), strict=True)

    if rod.mass is None:
        right = system.joint_derivatives(still, still, 1)
        rate, force, joints = system.rates(wrench, given, velocities, right)
        new = dataclasses.replace(
            state, rate=rate, acceleration=still, auxiliary=still, force=force, joints=joints
        )
        return new, loss

    right = jnp.where(system.rigid > 0, -system.stretch_derivatives(rate, still, 2)[1], given)
    of_joints = system.joint_derivatives(rate, still, 2)
    acceleration, force, joints = system.rates(wrench, right, accelerations, of_joints)
    new = dataclasses.replace(
        state,
        rate=rate,
        acceleration=acceleration,
        auxiliary=acceleration,
        force=force,
        joints=joints,
    )
    if with_jerk:
        right = -system.rigid * system.stretch_derivatives(rate, acceleration, 3)[2]
        of_joints = system.joint_derivatives(rate, acceleration, 3)
        jerk = system.rates(still, right, system.prescribed(ends.jerk), of_joints)[0]
        new = dataclasses.replace(new, jerk=jerk)
    return new, loss


@compiled
def compiled_restart(
    scene: Scene, state: State
) -> tuple[State, Float[Array, ""], Float[Array, ""]]:
    """`restart` with the jerk, of unit quaternions; the worst error of the constraint besides."""
    unit = rotations.normalize(state.quaternion)
    kinematics = strains(scene.rod, state.position, unit)
    still = at_rest(state.time, state.position, unit)
    gap = balance.constraint(scene.rod, kinematics, jnp.zeros_like(state.force), still)
    if scene.rod.compliance is not None:
        gap = jnp.where(scene.rod.compliance > 0, 0.0, gap)
    new, lost = restart(scene, dataclasses.replace(state, quaternion=unit), with_jerk=True)
    return new, lost, jnp.max(jnp.abs(gap))
