"""The mass matrix of a configuration, bordered by the constraints of elements and of what is held.

Accelerations and forces of a start are one solve with it, velocities that a new constraint allows
another.
"""

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from rodjax.constraints import ends
from rodjax.equations import joint_terms
from rodjax.equations.assembly import Scales, assemble, residual_rows
from rodjax.equations.border import BorderedSystem
from rodjax.equations.coupled import CoupledSystem
from rodjax.equations.jointed import JointedSystem
from rodjax.interactions.load import total_wrench
from rodjax.numerics import newton
from rodjax.numerics.block_tridiagonal import BlockTridiagonal
from rodjax.rods import balance, inertia, stretch_rates
from rodjax.rods.node_blocks import NodeBlocks, node_blocks
from rodjax.rods.state import NodeMotion, State, at_rest
from rodjax.rods.strains import Strains, strains
from rodjax.scenes.holds import impose, rows_at
from rodjax.scenes.scene import Scene, projectors


class Constrained(eqx.Module):
    """The mass matrix of a configuration, bordered by the constraints of elements and ends."""

    scene: Scene
    state: State
    kinematics: Strains
    rigid: Float[Array, "n 3"]  # 0 where the element is compliant
    projectors: Float[Array, "h 6 6"]
    scales: Scales
    mass: NodeBlocks
    system: CoupledSystem | JointedSystem  # of `multiply`, without derivative
    joints: Float[Array, "j 6 2 6"] | None  # their slopes

    @classmethod
    def of(cls, scene: Scene, state: State) -> "Constrained":
        """Of the constraints from `state.time` on."""
        rod, both = scene.rod, projectors(scene, state.time)
        kinematics = strains(rod, state.position, state.quaternion)
        rigid = jnp.ones_like(kinematics.stretch)
        if rod.compliance is not None:
            rigid = jnp.where(rod.compliance > 0, 0.0, 1.0)
        matrix = _inertia_matrix(scene, state)
        scales = Scales(rod.mean_length, jnp.mean(matrix.own[:, 0, 0]) * rod.mean_length)
        tangent = balance.constraint_tangent(rod, kinematics)
        blocks = _release(assemble(rod, tangent, matrix, both, scene.held_nodes, scales), rigid)
        system = CoupledSystem(lax.stop_gradient(blocks))
        joints = None
        if scene.joints:
            motion = at_rest(state.time, state.position, state.quaternion)
            joints = joint_terms.slopes(scene, motion)
            at = both, scene.held_nodes, scales
            border = joint_terms.border_of(scene, joints, None, *at)
            system = JointedSystem(
                BorderedSystem(system, lax.stop_gradient(border)), len(scene.joints)
            )
        return cls(scene, state, kinematics, rigid, both, scales, matrix, system, joints)

    def multiply(self, x: Float[Array, "rows 9"]) -> Float[Array, "rows 9"]:
        """The matrix times scaled rates and multipliers, without the matrix.

        The solution is differentiated through this, which costs less than through the blocks.
        """
        rows, scales = x, self.scales
        x = self._of_nodes(rows)
        rate = scales.change(x)
        wrench = self.mass.multiply(rate) + balance.constraint_wrench(
            self.scene.rod, self.kinematics, scales.internal_force(x)
        )
        if self.joints is not None:
            forces = joint_terms.gathered(rows[len(x) :]) * scales.wrench[None]
            lacking = jnp.einsum("jikl,ji->jkl", self.joints, forces)
            wrench = wrench + joint_terms.on_nodes(self.scene, lacking)
        nodes = self.scene.held_nodes
        moved = rows_at(rate, nodes) / scales.motion[None]
        wrench = impose(wrench / scales.wrench[None], moved, self.projectors, nodes)
        stretching = self._stretching(rate, jnp.zeros_like(rate), 1)[0]
        constraint = self.rigid * stretching + (1 - self.rigid) * x[1:, 3:6]
        result = residual_rows(x, constraint, wrench)
        if self.joints is None:
            return result
        gap = jnp.einsum("jikl,jkl->ji", self.joints, joint_terms.at_points(self.scene, rate))
        own = joint_terms.rows_of(self.scene, gap, forces, scales)
        return jnp.concatenate([result, own.at[:, 3:6].set(rows[len(x) :, 3:6])])

    def _of_nodes(self, x):
        return x[: self.scene.rod.elements + 1] if self.scene.joints else x

    def solve(self, b: Float[Array, "rows 9"]) -> Float[Array, "rows 9"]:
        """Solution of the scaled system."""
        return _refined(self.system, b)

    def solve_transpose(self, b: Float[Array, "rows 9"]) -> Float[Array, "rows 9"]:
        """Solution of the transposed one."""
        return _refined(self.system.transpose(), b)

    def rates(self, wrench, constraint, prescribed, joints=None):
        """Rates (n+1, 6), multipliers of elements (n, 3) and of joints (j, 6) or None, for right
        sides of balances, constraint, ends and joints.
        """
        scales = self.scales
        goals = jnp.stack(prescribed) / scales.motion[None]
        nodes = self.scene.held_nodes
        right = impose(wrench / scales.wrench[None], goals, self.projectors, nodes)
        pad = jnp.zeros_like(constraint[:1])
        b = jnp.concatenate([jnp.concatenate([pad, constraint]), right], 1)
        if joints is not None:
            b = jnp.concatenate([b, joint_terms.spread(joints / scales.motion[None])])
        x = newton.solve_linear(_LinearEquations(self, b))
        nodes = self._of_nodes(x)
        forces = None
        if joints is not None:
            forces = joint_terms.gathered(x[len(nodes) :]) * scales.wrench[None]
        return scales.change(nodes), scales.internal_force(nodes), forces

    def joint_derivatives(self, rate, acceleration, order):
        """What joints ask of the rates of this order: minus the derivative that motion gives."""
        if not self.scene.joints:
            return None
        state = self.state
        motion = at_rest(state.time, state.position, state.quaternion)
        return -joint_terms.rates_of_gaps(self.scene, motion, rate, acceleration, order)

    def stretch_derivatives(self, rate, acceleration, order):
        """See `stretch_rates`; with what actuation adds."""
        rod = self.scene.rod
        found = self._stretching(rate, acceleration, order)
        if rod.torque_per_tension is None or rod.actuation is None:
            return found
        driven = stretch_rates.driven(rod, self.state.time, order)
        return [own + added for own, added in zip(found, driven, strict=True)]

    def _stretching(self, rate, acceleration, order):
        """That of the motion alone."""
        return stretch_rates.derivatives(
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
        joints = self.joint_derivatives(rate, still, 1)
        new = rate + self.rates(still, -self.rigid * stretching, gap, joints)[0]
        energy = lambda rate: inertia.kinetic_energy(self.scene, self.moving(rate))
        return new, energy(rate) - energy(new)


class _LinearEquations(eqx.Module):
    """Matrix times x equals `right`, as `newton.solve_linear` takes them."""

    matrix: Constrained
    right: Float[Array, "rows 9"]

    def residual(self, x):
        return self.matrix.multiply(x) - self.right

    def linearize(self, x) -> Constrained:
        return self.matrix

    def lift(self, x, dx):
        return dx


def _refined(
    system: CoupledSystem | JointedSystem, b: Float[Array, "rows 9"]
) -> Float[Array, "rows 9"]:
    """Solution with one step of iterative refinement."""
    eliminated = system.eliminate()
    refine = lambda _, x: x + eliminated.solve(b - system.multiply(x))
    return lax.fori_loop(0, 2, refine, jnp.zeros_like(b))


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


def _inertia_matrix(scene: Scene, state: State) -> NodeBlocks:
    """Mass matrix of the nodes; for a rod without inertia the matrix of its linear drag.

    Where rotations have no inertia (or drag) of their own they get that of a short segment,
    which decides nothing but how the fastest, unobservable rates are started.
    """
    rod = scene.rod
    resting = NodeMotion(
        state.time,
        state.position,
        state.quaternion,
        jnp.zeros_like(state.velocity),
        jnp.zeros_like(state.angular_velocity),
    )
    zero = jnp.zeros_like(state.rate)
    if rod.mass is None:

        def wrench(rate):
            moving = resting._replace(velocity=rate[:, :3], angular_velocity=rate[:, 3:])
            return -total_wrench(scene.loads, rod, moving)
    else:
        wrench = lambda rate: inertia.inertial_wrench(scene, resting, rate)
    between = rod.mass is None and scene.between_nodes
    blocks = node_blocks(wrench, zero, between)
    matrix = blocks.own
    segment = jnp.trace(matrix[:, :3, :3], axis1=1, axis2=2) / 3 * rod.node_length**2 / 12
    angular = jnp.diagonal(matrix[:, 3:, 3:], axis1=1, axis2=2)
    add = jnp.where(angular > 0, 0.0, segment[:, None])
    own = matrix.at[:, 3:, 3:].add(add[:, :, None] * jnp.eye(3, dtype=matrix.dtype)[None])
    return blocks._replace(own=own)
