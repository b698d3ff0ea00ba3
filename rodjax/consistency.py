"""Starts and restarts: velocities, accelerations and forces that agree with the constraints.

Both are one solve with the constrained mass matrix. A start out of equilibrium, or a constraint
that begins during a run, is first order or fails without them.
"""

import dataclasses

import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from rodjax import balance, contact_forces, ends, inertia, rotations
from rodjax.balance import Scales
from rodjax.block_tridiagonal import BlockTridiagonal
from rodjax.compilation import compiled
from rodjax.loads import NodeMotion, total_wrench
from rodjax.scene import Scene, projectors
from rodjax.state import State
from rodjax.strains import relative_rotation, strains


def start(
    scene: Scene,
    *,
    position: Float[Array, "nodes 3"] | None = None,
    quaternion: Float[Array, "nodes 4"] | None = None,
    velocity: Float[Array, "nodes 3"] | None = None,
    angular_velocity: Float[Array, "nodes 3"] | None = None,
    time: float | Float[Array, ""] = 0.0,
) -> State:
    """Consistent state at the start of a run.

    Args:
        position, quaternion: configuration; the rod's own placing by default. Without compliance
            it must be unstretched (each edge along its element frame with the rest length).
        velocity: v in inertial components [m/s]; zero by default.
        angular_velocity: omega in body components [rad/s]; zero by default.

    Velocities that disagree with constraints and ends are projected (least kinetic energy).

    Raises:
        ValueError: a shape is wrong, a value not finite, or the rod is stretched.
    """
    rod = scene.rod
    dtype = rod.position.dtype
    nodes = rod.elements + 1
    given = {
        "position": (position, rod.position, 3),
        "quaternion": (quaternion, rod.quaternion, 4),
        "velocity": (velocity, jnp.zeros((nodes, 3)), 3),
        "angular_velocity": (angular_velocity, jnp.zeros((nodes, 3)), 3),
    }
    arrays = {}
    for name, (value, default, width) in given.items():
        array = jnp.asarray(default if value is None else value, dtype)
        if array.shape != (nodes, width):
            raise ValueError(f"{name}: expected shape {(nodes, width)}, got {array.shape}")
        if not isinstance(array, jax.core.Tracer) and not np.all(np.isfinite(array)):
            raise ValueError(f"{name}: must be finite everywhere")
        arrays[name] = array
    state = State(
        jnp.asarray(time, dtype),
        arrays["position"],
        arrays["quaternion"],
        jnp.concatenate([arrays["velocity"], arrays["angular_velocity"]], 1),
        jnp.zeros((nodes, 6), dtype),
        jnp.zeros((nodes, 6), dtype),
        jnp.zeros((rod.elements, 3), dtype),
    )
    new, _, gap = compiled_restart(scene, state)
    tolerance = 1e3 * float(jnp.finfo(dtype).eps) * nodes
    # negated, so that a frame of zero length (not a number here) is an error too
    if not isinstance(gap, jax.core.Tracer) and not float(gap) <= tolerance:
        raise ValueError(
            f"position: stretched or sheared by {float(gap):.2g} at most, but the rod is"
            " inextensible: place nodes at rest length along the element frames"
        )
    return new


def restart(
    scene: Scene, state: State, *, with_jerk: bool = False
) -> tuple[State, Float[Array, ""]]:
    """The state with consistent velocities, accelerations and forces, and the energy lost [J].

    Velocities: M dV + J^T p = 0 with J (V + dV) = 0 and the ends' velocities; then accelerations
    and forces: M V' + J^T f = loads - internal - gyroscopic, J V' = -J' V, the ends' accelerations;
    `with_jerk` also the part of V'' normal to the constraints: M V'' + J^T p = 0,
    J V'' = -J'' V - 2 J' V' and the ends' own (see `generalized_alpha.opening`).
    """
    rod = scene.rod
    both = projectors(scene, state.time)
    kinematics = strains(rod, state.position, state.quaternion)
    tangent = balance.constraint_tangent(rod, kinematics)
    rigid = jnp.ones_like(kinematics.stretch)
    if rod.compliance is not None:
        rigid = jnp.where(rod.compliance > 0, 0.0, 1.0)
    matrix = _inertia_matrix(scene, state)
    scales = Scales(jnp.mean(rod.length), jnp.mean(matrix[:, 0, 0]) * jnp.mean(rod.length))
    blocks = _release(balance.assemble(rod, tangent, matrix, tuple(both), scales), rigid)

    def solve(wrench, constraint, prescribed):
        """Rates (n+1, 6) and multipliers (n, 3) for balance, constraint and end right sides."""
        scale = jnp.repeat(jnp.stack([scales.force, scales.force * scales.length]), 3)
        unit = jnp.repeat(jnp.stack([scales.length, jnp.ones_like(scales.length)]), 3)
        right = wrench / scale
        for index, projector in zip((0, -1), both, strict=True):
            row = right[index] + projector @ (prescribed[index] / unit - right[index])
            right = right.at[index].set(row)
        pad = jnp.zeros_like(constraint[:1])
        b = jnp.concatenate([jnp.concatenate([pad, constraint]), right], 1)
        refine = lambda _, x: x + blocks.solve(b - blocks.multiply(x[:, :, None])[:, :, 0])
        x = lax.fori_loop(0, 2, refine, jnp.zeros_like(b))
        return jnp.concatenate([x[:, :3] * scales.length, x[:, 6:]], 1), x[1:, 3:6] * scales.force

    def constraint_rate(rate):
        """d gamma / dt of a motion with these rates, and its own rate at constant rates."""
        spin = jnp.concatenate([jnp.zeros_like(rate[:, :1]), 0.5 * rate[:, 3:]], 1)
        turning = rotations.multiply(state.quaternion, spin)
        return jax.jvp(
            lambda r, q: balance.stretch_rate(rod, r, q, rate),
            (state.position, state.quaternion),
            (rate[:, :3], turning),
        )

    motions = [
        ends.rates(end, state.time, state.quaternion[index])
        for index, end in zip((0, -1), scene.ends, strict=True)
    ]
    internal = balance.internal(rod, state.position, state.quaternion, jnp.zeros_like(state.force))
    elastic = jnp.concatenate([internal.force, internal.moment], 1)
    motion = NodeMotion(
        state.time, state.position, state.quaternion, state.velocity, state.angular_velocity
    )
    given = jnp.zeros_like(state.force)
    if rod.compliance is not None:
        axial = jnp.asarray([0.0, 0.0, 1.0], given.dtype)
        give = jnp.where(rod.compliance > 0, rod.compliance, 1.0)
        given = jnp.where(rod.compliance > 0, (kinematics.stretch - axial) / give, 0.0)

    if rod.mass is None:
        still = motion._replace(
            velocity=jnp.zeros_like(motion.velocity),
            angular_velocity=jnp.zeros_like(motion.angular_velocity),
        )
        wrench = total_wrench(scene.loads, rod, still) - elastic
        rate, force = solve(wrench, given / scales.force, (motions[0][0], motions[1][0]))
        zero = jnp.zeros_like(rate)
        new = dataclasses.replace(state, rate=rate, acceleration=zero, auxiliary=zero, force=force)
        return new, jnp.zeros_like(state.time)

    before = inertia.kinetic_energy(scene, motion)
    gap = [m[0] - state.rate[i] for i, m in zip((0, -1), motions, strict=True)]
    change, _ = solve(
        jnp.zeros_like(state.rate), -rigid * constraint_rate(state.rate)[0], tuple(gap)
    )
    rate = state.rate + change
    motion = motion._replace(velocity=rate[:, :3], angular_velocity=rate[:, 3:])
    after = inertia.kinetic_energy(scene, motion)
    wrench = -elastic - inertia.inertial_wrench(scene, motion, jnp.zeros_like(rate))
    if scene.loads:
        wrench = wrench + total_wrench(scene.loads, rod, motion)
    if scene.contact is not None:
        pushed = contact_forces.report(scene.contact, rod, state.position, motion.velocity).force
        wrench = wrench.at[:, :3].add(pushed)
    right = jnp.where(rigid > 0, -constraint_rate(rate)[1], given / scales.force)
    acceleration, force = solve(wrench, right, (motions[0][1], motions[1][1]))
    new = dataclasses.replace(
        state, rate=rate, acceleration=acceleration, auxiliary=acceleration, force=force
    )
    if with_jerk:
        prescribed = tuple(
            ends.jerk(end, state.time, state.quaternion[index])
            for index, end in zip((0, -1), scene.ends, strict=True)
        )
        right = -rigid * _stretch_jerk(rod, state.quaternion, kinematics, rate, acceleration)
        jerk, _ = solve(jnp.zeros_like(rate), right, prescribed)
        new = dataclasses.replace(new, jerk=jerk)
    return new, before - after


@compiled
def compiled_restart(
    scene: Scene, state: State
) -> tuple[State, Float[Array, ""], Float[Array, ""]]:
    """`restart` with the jerk, of unit quaternions; the worst error of the constraint besides."""
    unit = rotations.normalize(state.quaternion)
    stretch = strains(scene.rod, state.position, unit).stretch
    gap = balance.constraint(scene.rod, stretch, jnp.zeros_like(stretch))
    if scene.rod.compliance is not None:
        gap = jnp.where(scene.rod.compliance > 0, 0.0, gap)
    new, lost = restart(scene, dataclasses.replace(state, quaternion=unit), with_jerk=True)
    return new, lost, jnp.max(jnp.abs(gap))


def _stretch_jerk(rod, quaternion, kinematics, rate, acceleration) -> Float[Array, "n 3"]:
    """Third derivative of gamma in a motion of these rates and constant accelerations.

    By the product rule from gamma' = E^T dv/ds - omega_e x gamma and E' = E [omega_e x], which
    compiles in a fraction of the time of two derivatives of `balance.stretch_rate`.
    """

    def element_spin(t):
        """omega_e = (omega_i + omega_{i+1})/2 + u x (omega_{i+1} - omega_i), u = p/(2 (1 + w)).

        (w, p) = q_i^-1 q_{i+1}; the same as in `balance.stretch_rate`, without logarithms.
        """
        turn = t * rate[:, 3:] + 0.5 * t**2 * acceleration[:, 3:]
        # the exponential map to second order
        real = 1 - 0.125 * jnp.sum(turn**2, 1, keepdims=True)
        turned = rotations.multiply(quaternion, jnp.concatenate([real, 0.5 * turn], 1))
        relative = relative_rotation(turned)
        spin = rate[:, 3:] + t * acceleration[:, 3:]
        change = jnp.cross(0.5 * relative[:, 1:] / (1 + relative[:, :1]), spin[1:] - spin[:-1])
        return 0.5 * (spin[:-1] + spin[1:]) + change

    now = jnp.zeros((), rate.dtype)
    derivative = lambda f: lambda t: jax.jvp(f, (t,), (jnp.ones_like(t),))
    (spin, spin1), (_, spin2) = derivative(derivative(element_spin))(now)
    across = lambda v: jnp.einsum(
        "nji,nj->ni", kinematics.frame, (v[1:, :3] - v[:-1, :3]) / rod.length[:, None]
    )
    stretch, edge, edge_pull = kinematics.stretch, across(rate), across(acceleration)
    edge1 = edge_pull - jnp.cross(spin, edge)
    edge2 = -jnp.cross(spin, edge_pull) - jnp.cross(spin1, edge) - jnp.cross(spin, edge1)
    stretch1 = edge - jnp.cross(spin, stretch)
    stretch2 = edge1 - jnp.cross(spin1, stretch) - jnp.cross(spin, stretch1)
    return (
        edge2
        - jnp.cross(spin2, stretch)
        - 2 * jnp.cross(spin1, stretch1)
        - jnp.cross(spin, stretch2)
    )


def _release(blocks: BlockTridiagonal, rigid: Float[Array, "n 3"]) -> BlockTridiagonal:
    """Rows of the constraint replaced by `multiplier = right side` where the rod is compliant."""
    keep = rigid[:, :, None]
    multiplier = jnp.zeros((3, 9), rigid.dtype).at[:, 3:6].set(jnp.eye(3))
    diagonal = blocks.diagonal.at[1:, :3].set(
        keep * blocks.diagonal[1:, :3] + (1 - keep) * multiplier
    )
    return BlockTridiagonal(
        blocks.lower.at[1:, :3].set(keep * blocks.lower[1:, :3]), diagonal, blocks.upper
    )


def _inertia_matrix(scene: Scene, state: State) -> Float[Array, "nodes 6 6"]:
    """Mass matrix of the nodes; for a rod without inertia the matrix of its linear drag.

    Where rotations have no inertia (or drag) of their own they get that of a short segment,
    which decides nothing but how the fastest, unobservable rates are started.
    """
    rod = scene.rod
    at_rest = NodeMotion(
        state.time,
        state.position,
        state.quaternion,
        jnp.zeros_like(state.velocity),
        jnp.zeros_like(state.angular_velocity),
    )
    zero = jnp.zeros_like(state.rate)
    if rod.mass is None:

        def wrench(rate):
            moving = at_rest._replace(velocity=rate[:, :3], angular_velocity=rate[:, 3:])
            return -total_wrench(scene.loads, rod, moving)
    else:
        wrench = lambda rate: inertia.inertial_wrench(scene, at_rest, rate)
    matrix = inertia.node_jacobian(wrench, zero)
    if rod.mass is None or rod.rotary_inertia is None:
        segment = jnp.trace(matrix[:, :3, :3], axis1=1, axis2=2) / 3 * rod.node_length**2 / 12
        angular = jnp.diagonal(matrix[:, 3:, 3:], axis1=1, axis2=2)
        add = jnp.where(angular > 0, 0.0, segment[:, None])
        matrix = matrix.at[:, 3:, 3:].add(add[:, :, None] * jnp.eye(3, dtype=matrix.dtype))
    return matrix
