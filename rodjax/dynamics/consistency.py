"""Starts and restarts: velocities, accelerations and forces that agree with the constraints.

Both are one solve with the constrained mass matrix. A start out of equilibrium, or a constraint
that begins during a run, is first order or fails without them.
"""

import dataclasses

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from rodjax.constraints import ends
from rodjax.equations import start_checks
from rodjax.equations.assembly import Scales, assemble, residual_rows
from rodjax.equations.imbalance import imbalance
from rodjax.equations.overlap import check_apart
from rodjax.inputs.argument_types import AnyArray
from rodjax.inputs.validation import check_finite, check_numbers, check_scalar
from rodjax.interactions import contact_forces
from rodjax.interactions.loads import total_wrench
from rodjax.numerics import newton, rotations
from rodjax.numerics.block_tridiagonal import BlockTridiagonal
from rodjax.numerics.compilation import compiled
from rodjax.numerics.failure import not_a_number
from rodjax.rods import balance, inertia
from rodjax.rods.framing import of_one_sign
from rodjax.rods.state import NodeMotion, State
from rodjax.rods.strains import Strains, relative_rotation, strains
from rodjax.scenes.arguments import check_scene
from rodjax.scenes.holds import impose, rows_at
from rodjax.scenes.scene import Scene, projectors


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
        if not isinstance(array, jax.core.Tracer) and not np.all(np.isfinite(array)):
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
    )
    start_checks.check_held_once(scene, state)
    start_checks.check_spin(scene, state)
    check_apart(scene, state)
    new, _, gap = compiled_restart(scene, state)
    tolerance = 1e3 * float(jnp.finfo(dtype).eps) * nodes
    # negated, so that a frame of zero length (not a number here) is an error too
    stretched = ~(gap <= tolerance)
    if not isinstance(stretched, jax.core.Tracer) and bool(stretched):
        raise ValueError(
            f"position: stretched or sheared by {float(gap):.2g} at most, but the rod is"
            " inextensible: place nodes at rest length along the element frames"
        )
    if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(new)):
        return not_a_number(new, stretched | start_checks.held_twice(scene, new))
    _check_start(new)
    return new


def _check_start(state: State) -> None:
    """Raise ValueError where no consistent start was found (outside traced code only)."""
    for name in ("rate", "acceleration", "force"):
        value = getattr(state, name)
        if not isinstance(value, jax.core.Tracer) and not np.all(np.isfinite(value)):
            raise ValueError(
                f"first_end, last_end: no unique {name} of the start; ends, mass and loads leave"
                " some motion or force of the rod undetermined"
            )


class _Constrained(eqx.Module):
    """The mass matrix of a configuration, bordered by the constraints of elements and ends."""

    scene: Scene
    state: State
    kinematics: Strains
    rigid: Float[Array, "n 3"]  # 0 where the element is compliant
    projectors: Float[Array, "h 6 6"]
    scales: Scales
    mass: Float[Array, "nodes 6 6"]
    blocks: BlockTridiagonal  # of `multiply`, without derivative

    @classmethod
    def of(cls, scene: Scene, state: State) -> "_Constrained":
        """Of the constraints from `state.time` on."""
        rod, both = scene.rod, projectors(scene, state.time)
        kinematics = strains(rod, state.position, state.quaternion)
        rigid = jnp.ones_like(kinematics.stretch)
        if rod.compliance is not None:
            rigid = jnp.where(rod.compliance > 0, 0.0, 1.0)
        matrix = _inertia_matrix(scene, state)
        scales = Scales(jnp.mean(rod.length), jnp.mean(matrix[:, 0, 0]) * jnp.mean(rod.length))
        tangent = balance.constraint_tangent(rod, kinematics)
        blocks = _release(assemble(rod, tangent, matrix, both, scene.held_nodes, scales), rigid)
        blocks = lax.stop_gradient(blocks)
        return cls(scene, state, kinematics, rigid, both, scales, matrix, blocks)

    def multiply(self, x: Float[Array, "nodes 9"]) -> Float[Array, "nodes 9"]:
        """The matrix times scaled rates and multipliers, without the matrix.

        The solution is differentiated through this, which costs less than through the blocks.
        """
        scales, rate = self.scales, self.scales.change(x)
        wrench = jnp.einsum("nij,nj->ni", self.mass, rate) + balance.constraint_wrench(
            self.scene.rod, self.kinematics, scales.internal_force(x)
        )
        nodes = self.scene.held_nodes
        moved = rows_at(rate, nodes) / scales.motion[None]
        wrench = impose(wrench / scales.wrench[None], moved, self.projectors, nodes)
        stretching = self.stretch_derivatives(rate, jnp.zeros_like(rate), 1)[0]
        constraint = self.rigid * stretching + (1 - self.rigid) * x[1:, 3:6]
        return residual_rows(x, constraint, wrench)

    def solve(self, b: Float[Array, "nodes 9"]) -> Float[Array, "nodes 9"]:
        """Solution of the scaled system."""
        return _refined(self.blocks, b)

    def solve_transpose(self, b: Float[Array, "nodes 9"]) -> Float[Array, "nodes 9"]:
        """Solution of the transposed one."""
        return _refined(self.blocks.transpose(), b)

    def rates(self, wrench, constraint, prescribed):
        """Rates (n+1, 6) and multipliers (n, 3) for balance, constraint and end right sides."""
        scales = self.scales
        goals = jnp.stack(prescribed) / scales.motion[None]
        nodes = self.scene.held_nodes
        right = impose(wrench / scales.wrench[None], goals, self.projectors, nodes)
        pad = jnp.zeros_like(constraint[:1])
        b = jnp.concatenate([jnp.concatenate([pad, constraint]), right], 1)
        x = newton.solve_linear(_LinearEquations(self, b))
        return scales.change(x), scales.internal_force(x)

    def stretch_derivatives(self, rate, acceleration, order):
        """See `_stretch_derivatives`."""
        return _stretch_derivatives(
            self.scene.rod, self.state.quaternion, self.kinematics, rate, acceleration, order
        )

    def prescribed(self, motion) -> tuple:
        """What ends and supports prescribe: `motion` is `ends.rates` or `ends.jerk`."""
        time, frames = self.state.time, self.state.quaternion
        return tuple(motion(end, time, frames[node]) for _, node, end in self.scene.holds)

    def moving(self, rate) -> NodeMotion:
        """The nodes with these rates."""
        state = self.state
        return NodeMotion(state.time, state.position, state.quaternion, rate[:, :3], rate[:, 3:])

    def project(self) -> tuple[Float[Array, "nodes 6"], Float[Array, ""]]:
        """Rates nearest to the state's that obey the constraints, and the energy lost [J].

        M dV + J^T p = 0 with J (V + dV) = 0 and the ends' velocities.
        """
        rate, still = self.state.rate, jnp.zeros_like(self.state.rate)
        gap = tuple(
            velocity - rate[node]
            for node, (velocity, _) in zip(
                self.scene.held_nodes, self.prescribed(ends.rates), strict=True
            )
        )
        stretching = self.stretch_derivatives(rate, still, 1)[0]
        new = rate + self.rates(still, -self.rigid * stretching, gap)[0]
        energy = lambda rate: inertia.kinetic_energy(self.scene, self.moving(rate))
        return new, energy(rate) - energy(new)


class _LinearEquations(eqx.Module):
    """Matrix times x equals `right`, as `newton.solve_linear` takes them."""

    matrix: _Constrained
    right: Float[Array, "nodes 9"]

    def residual(self, x):
        return self.matrix.multiply(x) - self.right

    def linearize(self, x) -> _Constrained:
        return self.matrix

    def lift(self, x, dx):
        return dx


def project(scene: Scene, state: State) -> tuple[State, Float[Array, ""]]:
    """The state with velocities that agree with the constraints, and the energy lost [J].

    Of a rod without inertia, whose velocities follow from the forces, it is `restart`.
    """
    if scene.rod.mass is None:
        return restart(scene, state)
    rate, loss = _Constrained.of(scene, state).project()
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
    rod, system = scene.rod, _Constrained.of(scene, state)
    given = jnp.zeros_like(state.force)
    if rod.compliance is not None:
        axial = jnp.asarray([[0.0, 0.0, 1.0]], given.dtype)
        give = jnp.where(rod.compliance > 0, rod.compliance, 1.0)
        given = jnp.where(rod.compliance > 0, (system.kinematics.stretch - axial) / give, 0.0)
        given = given / system.scales.force
    still = jnp.zeros_like(state.rate)
    rate, loss = (still, jnp.zeros_like(state.time)) if rod.mass is None else system.project()
    motion = system.moving(rate)
    pushed = None
    if scene.contact is not None:
        at = motion.position, motion.velocity
        pushed = contact_forces.report(scene.contact, rod, *at, scene.closed).force
    acting = imbalance(
        scene, motion, jnp.zeros_like(state.force), acceleration=still, contact_force=pushed
    )
    wrench = -acting[0]
    velocities, accelerations = zip(*system.prescribed(ends.rates), strict=True)

    if rod.mass is None:
        rate, force = system.rates(wrench, given, velocities)
        new = dataclasses.replace(
            state, rate=rate, acceleration=still, auxiliary=still, force=force
        )
        return new, loss

    right = jnp.where(system.rigid > 0, -system.stretch_derivatives(rate, still, 2)[1], given)
    acceleration, force = system.rates(wrench, right, accelerations)
    new = dataclasses.replace(
        state, rate=rate, acceleration=acceleration, auxiliary=acceleration, force=force
    )
    if with_jerk:
        right = -system.rigid * system.stretch_derivatives(rate, acceleration, 3)[2]
        jerk, _ = system.rates(still, right, system.prescribed(ends.jerk))
        new = dataclasses.replace(new, jerk=jerk)
    return new, loss


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


def _stretch_derivatives(
    rod, quaternion, kinematics, rate, acceleration, order
) -> list[Float[Array, "n 3"]]:
    """First derivatives in time, up to `order` <= 3, of gamma in a motion of these accelerations.

    By the product rule from gamma' = E^T dv/ds - omega_e x gamma and E' = E [omega_e x], with
    omega_e = (omega_i + omega_{i+1})/2 + u x (omega_{i+1} - omega_i), u = p/(2 (1 + w)),
    (w, p) = r = q_i^-1 q_{i+1} and r' = (r omega_{i+1} - omega_i r)/2.
    """
    cross = rotations.cross
    across = lambda v: jnp.einsum(
        "nji,nj->ni", kinematics.frame, (v[1:, :3] - v[:-1, :3]) / rod.length[:, None]
    )
    pure = lambda v: jnp.concatenate([jnp.zeros_like(v[:, :1]), v], 1)
    mean = lambda v: 0.5 * (v[:-1, 3:] + v[1:, 3:])
    jump = lambda v: v[1:, 3:] - v[:-1, 3:]
    before = lambda v, r: rotations.multiply(pure(v[:-1, 3:]), r)
    after = lambda r, v: rotations.multiply(r, pure(v[1:, 3:]))

    relative = relative_rotation(quaternion)
    over = 2 * (1 + relative[:, :1])
    u = relative[:, 1:] / over
    spin = mean(rate) + cross(u, jump(rate))
    stretch, edge = kinematics.stretch, across(rate)
    stretch1 = edge - cross(spin, stretch)
    if order == 1:
        return [stretch1]

    relative1 = 0.5 * (after(relative, rate) - before(rate, relative))
    over1 = 2 * relative1[:, :1]
    u1 = (relative1[:, 1:] - u * over1) / over
    spin1 = mean(acceleration) + cross(u1, jump(rate)) + cross(u, jump(acceleration))
    pull = across(acceleration)
    edge1 = pull - cross(spin, edge)
    stretch2 = edge1 - cross(spin1, stretch) - cross(spin, stretch1)
    if order == 2:
        return [stretch1, stretch2]

    relative2 = after(relative1, rate) + after(relative, acceleration)
    relative2 = 0.5 * (relative2 - before(acceleration, relative) - before(rate, relative1))
    u2 = (relative2[:, 1:] - 2 * u1 * over1 - 2 * u * relative2[:, :1]) / over
    spin2 = cross(u2, jump(rate)) + 2 * cross(u1, jump(acceleration))
    edge2 = -cross(spin, pull) - cross(spin1, edge) - cross(spin, edge1)
    stretch3 = edge2 - cross(spin2, stretch) - 2 * cross(spin1, stretch1) - cross(spin, stretch2)
    return [stretch1, stretch2, stretch3]


def _refined(matrix: BlockTridiagonal, b: Float[Array, "nodes 9"]) -> Float[Array, "nodes 9"]:
    """Solution with one step of iterative refinement."""
    factors, columns = matrix.factorize(), b[:, :, None]
    refine = lambda _, x: x + factors.solve(columns - matrix.multiply(x))
    return lax.fori_loop(0, 2, refine, jnp.zeros_like(columns))[:, :, 0]


def _release(blocks: BlockTridiagonal, rigid: Float[Array, "n 3"]) -> BlockTridiagonal:
    """Rows of the constraint replaced by `multiplier = right side` where the rod is compliant."""
    keep = rigid[:, :, None]
    multiplier = jnp.eye(3, 9, k=3, dtype=rigid.dtype)[None]
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
    segment = jnp.trace(matrix[:, :3, :3], axis1=1, axis2=2) / 3 * rod.node_length**2 / 12
    angular = jnp.diagonal(matrix[:, 3:, 3:], axis1=1, axis2=2)
    add = jnp.where(angular > 0, 0.0, segment[:, None])
    return matrix.at[:, 3:, 3:].add(add[:, :, None] * jnp.eye(3, dtype=matrix.dtype)[None])
