"""Equations of a rod at rest: the step's without inertia, along a path of loads.

With the path's parameter p from 0 to 1 the residual is

    inner(x) - p loads(x, t(p)) - (1 - p) inner(x_0) = 0,    t(p) = t_0 + p (t - t_0),

with `inner` the internal forces less those of self-contact, and the ends have moved by what their
schedules say at t(p). The start x_0 solves it at p = 0 whatever it is.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from rodjax.constraints import ends
from rodjax.equations.anchored import AnchoredSystem
from rodjax.equations.coupled import CoupledSystem
from rodjax.equations.coupling import couple, find_nearby
from rodjax.inputs.argument_types import Number
from rodjax.interactions import contact_forces, screening
from rodjax.interactions.loads import total_wrench
from rodjax.numerics import rotations
from rodjax.numerics.results import Result
from rodjax.rods import balance
from rodjax.rods.balance import Internal, Scales
from rodjax.rods.inertia import node_jacobian
from rodjax.rods.state import NodeMotion, State
from rodjax.scenes.scene import Scene, projectors

Factor = Number | Float[Array, ""]


class Ramp(NamedTuple):
    """Where on the path: its parameter and what is left of what the start was out of balance by."""

    factor: Float[Array, ""]
    lacking: Internal


def ramp_at(factor: Float[Array, ""], start: Internal) -> Ramp:
    """The ramp at this parameter of a path whose start is out of balance by so much."""
    return Ramp(factor, jax.tree.map(lambda rows: (1 - factor) * rows, start))


class StaticEquations(eqx.Module):
    """Balance, constraint and ends at rest, in scaled unknowns.

    Row i of x (n+1, 9) holds, for node i, its displacement from `position` over l, the internal
    force of the element before it over F (none for i = 0), and its rotation vector from
    `quaternion`. Ends have moved from `start` as their schedules say at `time`, under the
    constraints in force at the start.
    """

    scene: Scene
    start: State
    position: Float[Array, "nodes 3"]
    quaternion: Float[Array, "nodes 4"]
    time: Float[Array, ""]
    max_rotation: Float[Array, ""]
    ramp: Ramp
    resistance: Float[Array, "nodes 6"] | None = None

    @property
    def scales(self) -> Scales:
        """Mean element length, and a force that makes the bending of an element about 1."""
        rod = self.scene.rod
        length = jnp.mean(rod.length)
        return Scales(length, jnp.mean(rod.stiffness[:, :2]) / length**2)

    def guess(self, force: Float[Array, "n 3"]) -> Float[Array, "nodes 9"]:
        """x for the reference configuration with an internal force."""
        before = balance.scatter(jnp.zeros_like(force), force) / self.scales.force
        zero = jnp.zeros_like(before)
        return jnp.concatenate([zero, before, zero], 1)

    def force(self, x) -> Float[Array, "n 3"]:
        """Internal force of the elements [N]."""
        return x[1:, 3:6] * self.scales.force

    def motion(self, x) -> NodeMotion:
        """Nodes of the configuration x, at rest."""
        turn = rotations.exponential(x[:, 6:])
        position = self.position + x[:, :3] * self.scales.length
        return at_rest(self.time, position, rotations.multiply(self.quaternion, turn))

    def _gaps(self, motion: NodeMotion) -> Float[Array, "2 6"]:
        """What the ends lack, scaled: displacement over l, rotation as the body spin to undo."""
        both = lambda rows: jnp.stack([rows[0], rows[-1]])
        origin = both(self.start.quaternion)
        moved = jnp.stack(
            [
                ends.increments(end, self.start.time, self.time, quaternion)
                for end, quaternion in zip(self.scene.ends, origin, strict=True)
            ]
        )
        aim = rotations.multiply(origin, rotations.exponential(moved[:, 3:]))
        turn = rotations.multiply(rotations.conjugate(aim), both(motion.quaternion))
        shift = both(motion.position - self.start.position) - moved[:, :3]
        return jnp.concatenate([shift / self.scales.length, rotations.logarithm(turn)], 1)

    def residual(self, x):
        scene, scales, ramp = self.scene, self.scales, self.ramp
        motion = self.motion(x)
        wrench, constraint = static_balance(scene, motion, self.force(x), ramp.factor)
        wrench = wrench - jnp.concatenate([ramp.lacking.force, ramp.lacking.moment], 1)
        if self.resistance is not None:
            change = jnp.concatenate([x[:, :3] * scales.length, x[:, 6:]], 1)
            wrench = wrench + self.resistance * change
        constraint = constraint - ramp.lacking.constraint
        unit = jnp.repeat(jnp.stack([scales.force, scales.force * scales.length]), 3)
        wrench = wrench / unit[None]
        wrench = ends.impose(wrench, self._gaps(motion), projectors(scene, self.start.time))
        constraint = jnp.concatenate([x[:1, 3:6], constraint])
        return jnp.concatenate([constraint, wrench], 1)

    def linearize(self, x) -> CoupledSystem | AnchoredSystem:
        """Derivative of the residual by the increments that `lift` takes."""
        scene, scales = self.scene, self.scales
        motion = self.motion(x)
        tangent = balance.element_tangent(
            scene.rod, motion.position, motion.quaternion, self.force(x)
        )
        node = load_tangent(scene, motion, self.ramp.factor)
        if self.resistance is not None:
            resistance = jax.vmap(jnp.diag)(self.resistance)
            turned = rotations.tangent_inverse(x[:, 6:])
            node = node + resistance.at[:, 3:, 3:].set(resistance[:, 3:, 3:] @ turned)
        both = projectors(scene, self.start.time)
        blocks = balance.assemble(scene.rod, tangent, node, both, scales)
        nearby = None if scene.contact is None else find_nearby(scene, motion.position)
        coupled = lambda blocks, projectors: CoupledSystem(
            blocks,
            couple(scene.contact, nearby, motion, jnp.zeros_like(scales.force), projectors, scales)[
                1
            ],
        )
        system = coupled(blocks, both)
        if not isinstance(scene.first_end, ends.Clamped):
            eye = jnp.eye(6, dtype=x.dtype)
            other = jnp.stack([eye, jnp.zeros_like(eye)])
            held = balance.assemble(scene.rod, tangent, node, other, scales)
            system = AnchoredSystem(system, coupled(held, other))
        return system

    def newton_increment(self, x):
        """Newton's increment."""
        return self.linearize(x).solve(-self.residual(x))

    def lift(self, x, dx):
        """Increment of x for solved increments, whose rotations are body spins."""
        return dx.at[:, 6:].set(rotations.tangent_inverse_apply(x[:, 6:], dx[:, 6:]))

    def retract(self, x, dx):
        return x + self.lift(x, dx)

    def overflow(self, x) -> Int[Array, ""]:
        """A code that tells whether pairs in contact were left out."""
        if self.scene.contact is None:
            return jnp.asarray(Result.SUCCESS, jnp.int32)
        near = find_nearby(self.scene, self.motion(x).position).near
        return jnp.where(near.overflow, Result.CAPACITY_OVERFLOW, Result.SUCCESS).astype(jnp.int32)

    def limit(self, x, dx):
        """No node may turn by more than `max_rotation` in an iteration, no strands pass."""
        largest = jnp.sqrt(jnp.max(jnp.sum(dx[:, 6:] ** 2, 1)))
        scale = jnp.minimum(1.0, self.max_rotation / jnp.maximum(largest, self.max_rotation))
        if self.scene.contact is None:
            return scale
        position, change = self.motion(x).position, dx[:, :3] * self.scales.length
        nearby = find_nearby(self.scene, position, change)
        return jnp.minimum(
            scale, screening.approach_limit(self.scene.contact, *nearby, position, change)
        )

    def size(self, dx):
        """Largest displacement over the rod's length, or rotation [rad]."""
        shift = jnp.max(jnp.abs(dx[:, :3])) / self.scene.rod.elements
        return jnp.maximum(shift, jnp.max(jnp.abs(dx[:, 6:])))


def moving_weight(scene: Scene) -> Float[Array, "nodes 6"]:
    """Weights of the norm of motions: the integral of |displacement|^2/L^2 + |spin|^2 [1/m, m]."""
    rod = scene.rod
    spin = jnp.repeat(rod.node_length[:, None], 3, 1)
    return jnp.concatenate([spin / jnp.sum(rod.length) ** 2, spin], 1)


def resisting_weight(scene: Scene) -> Float[Array, "nodes 6"]:
    """What resists the motions of a descent: `moving_weight`, but hardly a spin about the tangent.

    Twist hardly ever is what makes a rod unstable. Resisted in full it would come to rest, beyond
    the critical turns, in some thousand steps only.
    """
    return moving_weight(scene).at[:, 5].multiply(1e-2)


def at_rest(time, position, quaternion) -> NodeMotion:
    """Nodes without velocity."""
    zero = jnp.zeros_like(position)
    return NodeMotion(time, position, quaternion, zero, zero)


def static_balance(
    scene: Scene, motion: NodeMotion, force: Float[Array, "n 3"], factor: Factor = 1.0
):
    """Internal - factor external - contact wrench of every node (n+1, 6), and the constraint."""
    inner = balance.internal(scene.rod, motion.position, motion.quaternion, force)
    wrench = jnp.concatenate([inner.force, inner.moment], 1)
    if scene.loads:
        wrench = wrench - factor * total_wrench(scene.loads, scene.rod, motion)
    if scene.contact is not None:
        at = motion.position, motion.velocity
        pushed = contact_forces.report(scene.contact, scene.rod, *at, scene.closed)
        wrench = wrench.at[:, :3].add(-pushed.force)
    return wrench, inner.constraint


def imbalance(scene: Scene, state: State, factor: Factor = 0.0) -> Internal:
    """What the wrenches of a state lack at rest, with this part of the loads."""
    motion = at_rest(state.time, state.position, state.quaternion)
    wrench, constraint = static_balance(scene, motion, state.force, factor)
    return Internal(wrench[:, :3], wrench[:, 3:], constraint)


def load_tangent(
    scene: Scene, motion: NodeMotion, factor: Factor = 1.0
) -> Float[Array, "nodes 6 6"]:
    """Derivative of minus the loads on each node by its displacement and body spin."""
    zero = jnp.zeros((scene.rod.elements + 1, 6), motion.position.dtype)
    if not scene.loads:
        return jnp.zeros((*zero.shape, 6), zero.dtype)

    def wrench(z):
        return -factor * total_wrench(scene.loads, scene.rod, moved(motion, z))

    return node_jacobian(wrench, zero)


def moved(motion: NodeMotion, z: Float[Array, "nodes 6"]) -> NodeMotion:
    """The motion displaced by z: displacements and body spins."""
    turned = rotations.multiply(motion.quaternion, rotations.exponential(z[:, 3:]))
    return motion._replace(position=motion.position + z[:, :3], quaternion=turned)
