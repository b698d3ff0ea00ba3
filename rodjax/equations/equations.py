"""Equations of a rod by any scheme: balance, constraint and ends, and their Newton system."""

from collections.abc import Callable
from functools import partial
from typing import Generic, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from rodjax.equations import joint_terms
from rodjax.equations.anchored import AnchoredSystem
from rodjax.equations.assembly import Scales, residual_rows
from rodjax.equations.coupled import CoupledSystem
from rodjax.equations.coupling import Coupling, Following, couple
from rodjax.equations.generalized_alpha import coefficients
from rodjax.equations.goals import Goals, gaps, goals_of, scales_of
from rodjax.equations.imbalance import (
    Acting,
    imbalance,
    of_contact,
    of_loads,
)
from rodjax.equations.jointed import JointedSystem
from rodjax.equations.newton_system import Placed, newton_system
from rodjax.equations.schemes import AbstractScheme, Step
from rodjax.interactions.self_contact import FoundContact
from rodjax.numerics import newton, rotations
from rodjax.numerics.batching import one_by_one
from rodjax.rods.state import NodeMotion, State, at_rest
from rodjax.scenes.holds import impose, rows_at
from rodjax.scenes.scene import Found, Scene, projectors

# Largest rotation of a node that Newton's iteration may begin with [rad].
_LARGEST_TURN = 1.0


Scheme = TypeVar("Scheme", bound=AbstractScheme)


class Equations(eqx.Module, Generic[Scheme]):
    """Balance, constraint and ends of a scheme at one time, in scaled unknowns.

    The unknowns x (n+1, 9) are those of `assembly`: changes of the nodes as the scheme takes them,
    and internal forces. Made by `Equations.of`.

    Attributes:
        time: when loads and drives are evaluated [s].
        projectors: directions that ends and supports hold.
        goals: where they hold them.
        found: by what acts on the rod, held while Newton iterates; None: what is near at x.
    """

    scene: Scene
    scheme: Scheme
    time: Float[Array, ""]
    scales: Scales
    projectors: Float[Array, "h 6 6"]
    goals: Goals
    found: Found | None = None

    @classmethod
    def of(
        cls,
        scene: Scene,
        scheme: Scheme,
        start: State,
        time: Float[Array, ""],
        found: Found | None = None,
    ) -> "Equations[Scheme]":
        """At `time`, what holds the rod at `start` moved by its schedules since."""
        scene = scene.recalling(start.memory)
        if scheme.slopes() is None:
            scene = scene.resting
        goals = goals_of(scene, scheme, start, time)
        held = projectors(scene, start.time)
        return cls(scene, scheme, time, scales_of(scene, scheme), held, goals, found)

    def guess(
        self, force: Float[Array, "n 3"], joints: Float[Array, "j 6"] | None = None
    ) -> Float[Array, "rows 9"]:
        """x as the scheme expects it, with these forces of the elements, and of the joints."""
        nodes = self.scales.unknowns(self.scheme.expected(), force)
        if not self.scene.joints:
            return nodes
        if joints is None:
            joints = jnp.zeros((len(self.scene.joints), 6), nodes.dtype)
        return jnp.concatenate([nodes, joint_terms.spread(joints / self.scales.wrench[None])])

    def of_nodes(self, x) -> Float[Array, "nodes 9"]:
        """The rows of the nodes."""
        return x[: self.scene.rod.elements + 1] if self.scene.joints else x

    def joints(self, x) -> Float[Array, "j 6"] | None:
        """Multipliers of the joints, forces [N] and moments [N m]."""
        if not self.scene.joints:
            return None
        rows = x[self.scene.rod.elements + 1 :]
        return joint_terms.gathered(rows) * self.scales.wrench[None]

    def change(self, x) -> Float[Array, "nodes 6"]:
        """What x adds to the scheme's prediction, displacement [m] and rotation vector [rad]."""
        return self.scales.change(self.of_nodes(x))

    def increment(self, x) -> Float[Array, "nodes 6"]:
        """Displacement [m] and rotation vector [rad] of the nodes."""
        return self.scheme.increment(self.change(x))

    def force(self, x) -> Float[Array, "n 3"]:
        """Internal force of the elements [N]."""
        return self.scales.internal_force(self.of_nodes(x))

    def motion(self, x) -> NodeMotion:
        """The nodes at x."""
        return self._placed(x).motion

    def _placed(self, x) -> Placed:
        scheme, change = self.scheme, self.change(x)
        increment, (position, quaternion) = scheme.increment(change), scheme.origin()
        position = position + increment[:, :3]
        quaternion = rotations.multiply(quaternion, rotations.exponential(increment[:, 3:]))
        motion, acceleration = at_rest(self.time, position, quaternion), None
        found = scheme.rates(change)
        if found is not None:
            rate, acceleration = found
            motion = motion._replace(velocity=rate[:, :3], angular_velocity=rate[:, 3:])
        # the barrier keeps XLA from evaluating all this anew in every kernel that reads it
        return lax.optimization_barrier(Placed(motion, acceleration, change, increment))

    @property
    def found_contact(self) -> FoundContact | None:
        """Strands held to be near each other; None without contact, or where they are searched."""
        return None if self.found is None else self.found.contact

    @jax.named_scope("residual")
    def residual(self, x):
        """Scaled residual."""
        placed = self._placed(x)
        return self._residual(x, placed, of_contact(self.scene, placed.motion, self.found_contact))

    def _residual(self, x, placed: Placed, push: Acting):
        scene, motion = self.scene, placed.motion
        acting = (*of_loads(scene, motion, self.scheme.load_part()), *push)
        wrench, constraint = imbalance(scene, motion, self.force(x), acting, placed.acceleration)
        wrench, constraint = self.scheme.completed(placed.change, wrench, constraint)
        scales = self.scales
        nodes = self.scene.held_nodes
        lacking = gaps(self.goals, rows_at(placed.increment, nodes)) / scales.motion[None]
        joints = self.joints(x)
        if joints is not None:
            wrench = wrench - joint_terms.exerted(scene, motion, joints)
        balances = impose(wrench / scales.wrench[None], lacking, self.projectors, nodes)
        rows = residual_rows(self.of_nodes(x), constraint, balances)
        if joints is None:
            return rows
        gap = joint_terms.gaps(scene, motion)
        return jnp.concatenate([rows, joint_terms.rows_of(scene, gap, joints, scales)])

    @jax.named_scope("linearize")
    def linearize(self, x) -> CoupledSystem | AnchoredSystem | JointedSystem:
        """Derivative of the residual by the increments that `lift` takes."""
        placed = self._placed(x)
        return self._system(x, placed, *self._contact(placed))

    @jax.named_scope("linearize")
    def linearize_with_residual(self, x):
        """Both, contact forces and their derivative evaluated once."""
        placed = self._placed(x)
        push, coupling = self._contact(placed)
        return self._system(x, placed, push, coupling), self._residual(x, placed, push)

    def newton_increment(self, x):
        """Newton's increment."""
        system, residual = self.linearize_with_residual(x)
        return system.solve_once(-residual)

    def _contact(self, placed: Placed) -> tuple[Acting, Coupling | None]:
        """What contact exerts on the nodes, and its derivative in the Newton system."""
        motion = placed.motion
        contact, slopes = self.scene.contact, self.scheme.slopes()
        if contact is None:
            return (), None
        found_contact = self.found_contact
        if found_contact is None:
            found_contact = self.scene.find_contact(motion.position)
        held = self.projectors, self.scene.held_nodes
        following = None if slopes is None else Following(slopes.by_velocity, placed.increment)
        given = contact, self.scene.rod, found_contact, motion, following
        push, coupling = couple(*given, *held, self.scales)
        return (push,), coupling

    def _system(self, x, placed: Placed, push: Acting, coupling: Coupling | None):
        held = self.projectors, self.scales
        given = placed, self.force(x), self.joints(x), push, coupling
        return newton_system(self.scene, self.scheme, *held, *given)

    def iterate(self, x, tolerance, max_iterations):
        """Newton's iteration, with a held derivative where pairs are near.

        The lanes of a batch go together while nothing is near in any of them, else one by one.
        """
        if self.found_contact is None:
            return self._iterated(x, tolerance, max_iterations)
        arrays, rest = eqx.partition(self, eqx.is_array)
        given, rubs = (x, tolerance, max_iterations), self.scene.rubs

        def coupled(arrays, *given):
            whole = eqx.combine(arrays, rest)
            if rubs:
                return newton.iterate_dual(whole, *given, held=True)
            return newton.iterate_held(whole, *given)

        def uncoupled(arrays, *given):
            return eqx.combine(arrays, rest).without_contact()._iterated(*given)

        def one(arrays, *given):
            return lax.cond(
                arrays.found_contact.pairs.count > 0, coupled, uncoupled, arrays, *given
            )

        together = lambda arrays, *given: arrays.found_contact.pairs.count == 0
        return one_by_one(one, (together, uncoupled))(arrays, *given)

    def _iterated(self, x, tolerance, max_iterations):
        method = newton.iterate_dual if self.scene.rubs else newton.iterate
        return method(self, x, tolerance, max_iterations)

    def first_duals(self, x) -> tuple:
        """What friction's derivative begins with."""
        begun = self.scheme.beginning()
        return self._duals(x, lambda one: partial(one.first_dual, before=begun))

    def with_duals(self, duals: tuple) -> "Equations[Scheme]":
        """The equations whose derivative is that of these duals."""
        return eqx.tree_at(lambda one: one.scene, self, self.scene.with_duals(duals))

    def next_duals(self, x) -> tuple:
        """What follows them after an iteration to x."""
        return self._duals(x, lambda one: one.next_dual)

    def _duals(self, x, asked: Callable) -> tuple:
        scene, motion = self.scene, self.motion(x)
        found = scene.find(motion.position) if self.found is None else self.found
        each = zip(scene.interactions, found.each, strict=True)
        return tuple(asked(one)(scene.rod, motion, its) for one, its in each)

    def without_contact(self) -> "Equations[Scheme]":
        """The equations of strands that do not feel each other."""
        where = lambda equations: (equations.scene.contact, equations.found)
        left = None if self.found is None else self.found._replace(contact=None)
        return eqx.tree_at(where, self, (None, left), is_leaf=lambda leaf: leaf is None)

    def lift(self, x, dx):
        """Increment of x for solved increments, whose rotations are body spins."""
        turn = self.increment(x)[:, 3:]
        nodes = slice(None, len(turn)) if self.scene.joints else slice(None)
        return dx.at[nodes, 6:].set(rotations.tangent_inverse_apply(turn, dx[nodes, 6:]))

    def retract(self, x, dx):
        """x after a solved increment."""
        return x + self.lift(x, dx)

    def limit(self, x, dx):
        """How much of an increment turns no node too far and is safe for all that acts."""
        scale, dx = jnp.ones((), x.dtype), self.of_nodes(dx)
        most = self.scheme.turn_limit()
        if most is not None:
            largest = jnp.sqrt(jnp.max(jnp.sum(dx[:, 6:] ** 2, 1)))
            scale = jnp.minimum(scale, most / jnp.maximum(largest, most))
        if not self.scene.interactions:
            return scale
        position = self.scheme.origin()[0] + self.increment(x)[:, :3]
        return self._safe(scale, position, dx[:, :3] * self.scales.length)

    def _safe(self, scale, position, change):
        """The scale of a change of positions, or less where what acts asks for less."""
        scene = self.scene
        found = scene.find(position, change) if self.found is None else self.found
        for one, its in zip(scene.interactions, found.each, strict=True):
            safe = one.held_at(self.time).safe_fraction(scene.rod, position, change, its)
            if safe is not None:
                scale = jnp.minimum(scale, lax.stop_gradient(safe))
        return scale

    def limited(self, x):
        """The guess x with its increment scaled down where it turns a node or closes a gap too far.

        After a jolt, nodes beside the end spin so fast that they would be predicted to turn over.
        """
        full = self.increment(x)
        turn = jnp.sqrt(jnp.max(jnp.sum(lax.stop_gradient(full[:, 3:]) ** 2, 1)))
        scale = _LARGEST_TURN / jnp.maximum(turn, _LARGEST_TURN)
        scale = self._safe(scale, self.scheme.origin()[0], full[:, :3])
        change = (scale - 1) * full
        nodes = slice(None, len(full)) if self.scene.joints else slice(None)
        moved = x.at[nodes, :3].add(change[:, :3] / self.scales.length)
        return moved.at[nodes, 6:].add(change[:, 3:])

    def size(self, dx):
        """Largest rotation [rad], or displacement as the scheme compares it with that."""
        dx = self.of_nodes(dx)
        shift = jnp.max(jnp.abs(dx[:, :3])) / self.scheme.lever(self.scene.rod)
        return jnp.maximum(shift, jnp.max(jnp.abs(dx[:, 6:])))

    def rotation(self, dx):
        """Largest rotation [rad], all that the constraint of the elements is not linear in.

        Nothing where the scheme asks no more of the constraint than Newton's tolerance.
        """
        if not self.scheme.exact_constraint():
            return jnp.zeros((), dx.dtype)
        return jnp.sqrt(jnp.max(jnp.sum(self.of_nodes(dx)[:, 6:] ** 2, 1)))


def step_equations(
    scene: Scene,
    state: State,
    stop: Float[Array, ""],
    spectral_radius: Float[Array, ""],
    found: Found | None = None,
) -> Equations[Step]:
    """Equations of a step of generalised-alpha to `stop`."""
    scheme = Step(coefficients(spectral_radius, stop - state.time), state)
    return Equations.of(scene, scheme, state, stop, found)
