"""Equations of a step's end: balance, constraint and ends, and their Newton system."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from rodjax.constraints import ends
from rodjax.equations.coupled import CoupledSystem
from rodjax.equations.coupling import Coupling, Nearby, couple
from rodjax.equations.generalized_alpha import advance, coefficients, predicted_increment
from rodjax.interactions import contact_forces, screening
from rodjax.interactions.loads import total_wrench
from rodjax.numerics import newton, rotations
from rodjax.numerics.batching import one_by_one
from rodjax.rods import balance
from rodjax.rods.balance import Scales
from rodjax.rods.inertia import inertial_wrench, node_jacobian
from rodjax.rods.state import NodeMotion, State
from rodjax.scenes.scene import Scene, projectors

# Largest rotation of a node that Newton's iteration may begin with [rad].
_LARGEST_TURN = 1.0


class StepEquations(eqx.Module):
    """Balance, constraint and ends at t_{n+1}, in scaled unknowns.

    Row i of x (n+1, 9) holds, for node i, the correction of its displacement over l, the internal
    force of the element before it over F (none for i = 0), and the correction of its rotation.
    Corrections are beta dt^2 a_{n+1} (see `generalized_alpha.advance`).
    """

    scene: Scene
    state: State
    stop: Float[Array, ""]
    spectral_radius: Float[Array, ""]
    nearby: Nearby | None = None

    @property
    def coefficients(self):
        return coefficients(self.spectral_radius, self.stop - self.state.time)

    @property
    def scales(self) -> Scales:
        """Mean element length; a force that makes inertia plus bending of an element about 1."""
        rod = self.scene.rod
        length = jnp.mean(rod.length)
        force = jnp.mean(rod.stiffness[:, :2]) / length**2
        if rod.mass is not None:
            mass = jnp.mean(rod.mass) * length
            force = force + self.coefficients.by_acceleration * mass * length
        return Scales(length, force)

    def guess(self) -> Float[Array, "nodes 9"]:
        """x for the accelerations and forces of the step's start."""
        c, scales = self.coefficients, self.scales
        correction = c.beta * c.dt**2 * self.state.auxiliary
        return jnp.concatenate(
            [
                correction[:, :3] / scales.length,
                balance.scatter(jnp.zeros_like(self.state.force), self.state.force) / scales.force,
                correction[:, 3:],
            ],
            1,
        )

    def increment(self, x):
        """Displacement [m] and rotation vector [rad] of the step, (n+1, 6)."""
        predicted = predicted_increment(self.coefficients, self.state.rate, self.state.auxiliary)
        return predicted + self.correction(x)

    def correction(self, x):
        return jnp.concatenate([x[:, :3] * self.scales.length, x[:, 6:]], 1)

    def force(self, x):
        return x[1:, 3:6] * self.scales.force

    def motion(self, x):
        """Nodes at the step's end, their accelerations, and the rotation of the step."""
        increment = self.increment(x)
        rate, acceleration, _ = advance(
            self.coefficients,
            self.state.rate,
            self.state.acceleration,
            self.state.auxiliary,
            self.correction(x),
        )
        motion = NodeMotion(
            self.stop,
            self.state.position + increment[:, :3],
            rotations.multiply(self.state.quaternion, rotations.exponential(increment[:, 3:])),
            rate[:, :3],
            rate[:, 3:],
        )
        # the barrier keeps XLA from evaluating all this anew in every kernel that reads it
        return lax.optimization_barrier((motion, acceleration, increment))

    def _balance(self, x, motion, acceleration, increment, contact_force):
        """Scaled residual, the ends imposed; `contact_force` on the nodes or None."""
        scene, scales = self.scene, self.scales
        wrench, constraint = free_balance(scene, motion, acceleration, self.force(x))
        if contact_force is not None:
            wrench = wrench.at[:, :3].add(-contact_force)
        scale = jnp.repeat(jnp.stack([scales.force, scales.force * scales.length]), 3)
        wrench = wrench / scale[None]
        unit = jnp.repeat(jnp.stack([scales.length, jnp.ones_like(scales.length)]), 3)
        prescribed = [
            ends.increments(end, self.state.time, self.stop, self.state.quaternion[index])
            for index, end in zip((0, -1), scene.ends, strict=True)
        ]
        gaps = _gap(jnp.stack([increment[0], increment[-1]]), jnp.stack(prescribed)) / unit[None]
        wrench = ends.impose(wrench, gaps, projectors(scene, self.state.time))
        # the element before node 0 does not exist: its force is a dummy, zero
        constraint = jnp.concatenate([x[:1, 3:6], constraint])
        return jnp.concatenate([constraint, wrench], 1)

    def residual(self, x):
        """Scaled residual of the step."""
        motion, acceleration, increment = self.motion(x)
        push = None
        if self.nearby is not None:
            assert self.scene.contact is not None
            push = contact_forces.forces(
                self.scene.contact, self.scene.rod, *self.nearby, motion.position, motion.velocity
            )
        return self._balance(x, motion, acceleration, increment, push)

    def _blocks(self, x, motion, acceleration, increment):
        scene, rod, c = self.scene, self.scene.rod, self.coefficients
        tangent = balance.element_tangent(rod, motion.position, motion.quaternion, self.force(x))
        node = node_tangent(
            scene, motion, acceleration, increment[:, 3:], c.by_velocity, c.by_acceleration
        )
        return balance.assemble(rod, tangent, node, projectors(scene, self.state.time), self.scales)

    def linearize(self, x) -> CoupledSystem:
        """Derivative of the residual by the increments that `lift` takes."""
        motion, acceleration, increment = self.motion(x)
        blocks = self._blocks(x, motion, acceleration, increment)
        return CoupledSystem(blocks, self._contact(motion)[1])

    def newton_increment(self, x):
        """Newton's increment, contact forces and their derivative evaluated once."""
        motion, acceleration, increment = self.motion(x)
        blocks = self._blocks(x, motion, acceleration, increment)
        push, coupling = self._contact(motion)
        residual = self._balance(x, motion, acceleration, increment, push)
        if coupling is None:
            return blocks.solve(-residual)
        return CoupledSystem(blocks, coupling).solve(-residual)

    def _contact(self, motion) -> tuple[Array | None, Coupling | None]:
        """Contact forces on the nodes [N], and their derivative in the Newton system."""
        both, by_velocity = projectors(self.scene, self.state.time), self.coefficients.by_velocity
        return couple(self.scene.contact, self.nearby, motion, by_velocity, both, self.scales)

    def iterate(self, x, tolerance, max_iterations):
        """Newton's iteration, with a held derivative where pairs are near.

        The lanes of a batch go together while nothing is near in any of them, else one by one.
        """
        if self.nearby is None:
            return newton.iterate(self, x, tolerance, max_iterations)
        arrays, rest = eqx.partition(self, eqx.is_array)
        given = (x, tolerance, max_iterations)

        def touching(arrays, *given):
            return newton.iterate_held(eqx.combine(arrays, rest), *given)

        def apart(arrays, *given):
            equations = dataclasses.replace(eqx.combine(arrays, rest), nearby=None)
            return newton.iterate(equations, *given)

        def one(arrays, *given):
            return lax.cond(arrays.nearby.near.count > 0, touching, apart, arrays, *given)

        easy = lambda arrays, *given: arrays.nearby.near.count == 0
        return one_by_one(one, (easy, apart))(arrays, *given)

    def lift(self, x, dx):
        """Increment of x for solved increments, whose rotations are body spins."""
        turn = self.increment(x)[:, 3:]
        return dx.at[:, 6:].set(rotations.tangent_inverse_apply(turn, dx[:, 6:]))

    def retract(self, x, dx):
        return x + self.lift(x, dx)

    def limit(self, x, dx):
        if self.nearby is None or self.scene.contact is None:
            return jnp.ones((), x.dtype)
        position = self.state.position + self.increment(x)[:, :3]
        return screening.approach_limit(
            self.scene.contact, *self.nearby, position, dx[:, :3] * self.scales.length
        )

    def limited(self, x):
        """The guess x with its increment scaled down where it turns a node or closes a gap too far.

        After a jolt, nodes beside the end spin so fast that they would be predicted to turn over.
        """
        full = self.increment(x)
        turn = jnp.sqrt(jnp.max(jnp.sum(lax.stop_gradient(full[:, 3:]) ** 2, 1)))
        scale = _LARGEST_TURN / jnp.maximum(turn, _LARGEST_TURN)
        if self.nearby is not None and self.scene.contact is not None:
            approach = screening.approach_limit(
                self.scene.contact, *self.nearby, self.state.position, full[:, :3]
            )
            scale = jnp.minimum(scale, approach)
        change = (scale - 1) * full
        return x.at[:, :3].add(change[:, :3] / self.scales.length).at[:, 6:].add(change[:, 3:])

    def size(self, dx):
        return jnp.maximum(jnp.max(jnp.abs(dx[:, :3])), jnp.max(jnp.abs(dx[:, 6:])))


def _gap(increment, prescribed):
    """What the ends' increments lack, rotations as the body spins still to go."""
    turn = rotations.multiply(
        rotations.conjugate(rotations.exponential(prescribed[:, 3:])),
        rotations.exponential(increment[:, 3:]),
    )
    shift = increment[:, :3] - prescribed[:, :3]
    return jnp.concatenate([shift, rotations.logarithm(turn)], 1)


def free_balance(scene: Scene, motion: NodeMotion, acceleration, force):
    """Inertia + internal - external wrench of every node (n+1, 6), and the constraint (n, 3).

    Without contact.
    """
    inner = balance.internal(scene.rod, motion.position, motion.quaternion, force)
    wrench = jnp.concatenate([inner.force, inner.moment], 1)
    if scene.rod.mass is not None:
        wrench = wrench + inertial_wrench(scene, motion, acceleration)
    if scene.loads:
        wrench = wrench - total_wrench(scene.loads, scene.rod, motion)
    return wrench, inner.constraint


def node_tangent(scene, motion, acceleration, turn, by_velocity, by_acceleration):
    """Derivative of inertia and loads of each node by its displacement and body spin, (n+1, 6, 6).

    Rates follow increments by generalised-alpha; `turn` is the rotation vector of the step, whose
    increment for a spin d is J(turn)^-1 d.
    """
    dtype = motion.position.dtype
    # of a quaternion by a body spin: its products with half of i, j, k
    units = 0.5 * jnp.eye(4, dtype=dtype)[1:]
    product = lambda unit: rotations.multiply(
        motion.quaternion, jnp.broadcast_to(unit, motion.quaternion.shape)
    )
    by_spin = jax.vmap(product, out_axes=2)(units)

    def wrench(z):
        vector = rotations.tangent_inverse_apply(turn, z[:, 3:])
        moved = NodeMotion(
            motion.time,
            motion.position + z[:, :3],
            motion.quaternion + jnp.einsum("nij,nj->ni", by_spin, z[:, 3:]),
            motion.velocity + by_velocity * z[:, :3],
            motion.angular_velocity + by_velocity * vector,
        )
        total = jnp.zeros_like(z)
        if scene.rod.mass is not None:
            rate = by_acceleration * jnp.concatenate([z[:, :3], vector], 1)
            total = total + inertial_wrench(scene, moved, acceleration + rate)
        if scene.loads:
            total = total - total_wrench(scene.loads, scene.rod, moved)
        return total

    return node_jacobian(wrench, jnp.zeros((scene.rod.elements + 1, 6), dtype))
