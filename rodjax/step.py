"""One step of the motion: equations of the step's end, their Newton system, and restarts."""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, Bool, Float, Int

from rodjax import balance, contact_forces, ends, newton, rotations, screening
from rodjax.balance import Scales
from rodjax.batching import one_by_one, only_where
from rodjax.consistency import project
from rodjax.coupled import CoupledSystem, Nearby, couple, find_nearby
from rodjax.generalized_alpha import (
    GeneralizedAlpha,
    advance,
    coefficients,
    local_error,
    opening,
    predicted_increment,
)
from rodjax.inertia import inertial_wrench, node_jacobian
from rodjax.loads import NodeMotion, total_wrench
from rodjax.results import Result, join
from rodjax.scene import Scene, projectors
from rodjax.state import State
from rodjax.strains import relative_rotation


class StepInfo(NamedTuple):
    """What a step reports besides the new state."""

    result: Int[Array, ""]
    iterations: Int[Array, ""]
    error_position: Float[Array, ""]  # largest local error of a displacement [m]
    error_bending: Float[Array, ""]  # of a rotation of the tangent [rad]
    error_twisting: Float[Array, ""]  # and of a rotation about it [rad]
    growth_position: Float[Array, ""]  # largest displacement of the step [m]
    growth_bending: Float[Array, ""]  # rotation of a tangent [rad]
    growth_twisting: Float[Array, ""]  # rotation about one [rad]
    projection_loss: Float[Array, ""]  # kinetic energy lost where a constraint began [J]
    settling: Bool[Array, ""]  # damped most, just after a constraint began


def no_info(dtype) -> StepInfo:
    """A report of zeros, in the types of a step's."""
    number, integer = jnp.zeros((), dtype), jnp.zeros((), jnp.int32)
    numbers = (number, number, number, number, number, number, number)
    return StepInfo(integer, integer, *numbers, jnp.asarray(False))


# Steps after a constraint began that are taken with spectral radius 0: its shock excites modes
# that no step of practical size resolves, and without damping they ring on in the forces.
SETTLING_STEPS = 4

# Real part of an element's relative rotation beyond which it is refused: 0.9 of a revolution.
_FULLY_WOUND = -0.95

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
        wrench = wrench / scale
        unit = jnp.repeat(jnp.stack([scales.length, jnp.ones_like(scales.length)]), 3)
        prescribed = [
            ends.increments(end, self.state.time, self.stop, self.state.quaternion[index])
            for index, end in zip((0, -1), scene.ends, strict=True)
        ]
        gaps = _gap(jnp.stack([increment[0], increment[-1]]), jnp.stack(prescribed)) / unit
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
        both, by_velocity = projectors(self.scene, self.state.time), self.coefficients.by_velocity
        _, coupling = couple(
            self.scene.contact, self.nearby, motion, by_velocity, both, self.scales
        )
        return CoupledSystem(blocks, coupling)

    def newton_increment(self, x):
        """Newton's increment; without contact by a single elimination."""
        if self.nearby is not None:
            return self.linearize(x).solve(-self.residual(x))
        motion, acceleration, increment = self.motion(x)
        blocks = self._blocks(x, motion, acceleration, increment)
        return blocks.solve(-self._balance(x, motion, acceleration, increment, None))

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


def prepare(scene: Scene, state: State) -> State:
    """The state with the count of settling steps that a scene with switches needs."""
    if scene.switch_times and state.settling is None:
        return dataclasses.replace(state, settling=jnp.asarray(0, jnp.int32))
    return state


def step(
    scene: Scene,
    state: State,
    stop: Float[Array, ""],
    method: GeneralizedAlpha | None = None,
) -> tuple[State, StepInfo]:
    """Advance the motion from `state.time` to `stop`.

    Pure and differentiable; if a constraint begins at the step's start, velocities are first
    projected onto it. A failed step is reported in `StepInfo.result`, never raised. So is one that
    strides over the time at which a constraint changes: a step must end exactly there (`rollout`
    sees to rounding).
    """
    method = GeneralizedAlpha() if method is None else method
    state = prepare(scene, state)
    stop = jnp.asarray(stop, state.time.dtype)
    if not scene.switch_times:
        return advance_to(scene, state, stop, method)
    state, loss = only_where(
        switching(scene, state),
        lambda s: begin_constraint(scene, s, project),
        lambda s: (s, jnp.zeros_like(s.time)),
        state,
    )
    missed = jnp.any(jnp.stack([(state.time < t) & (t < stop) for t in scene.switch_times]))
    state, info = advance_to(scene, state, stop, method)
    code = join(info.result, jnp.where(missed, Result.SWITCH_MISSED, Result.SUCCESS))
    return state, info._replace(projection_loss=loss, result=code)


def switching(scene: Scene, state: State) -> Bool[Array, ""]:
    """Whether a constraint changes at the state's time."""
    return jnp.any(jnp.stack([t == state.time for t in scene.switch_times]))


def begin_constraint(scene: Scene, state: State, project) -> tuple[State, Float[Array, ""]]:
    """The state with velocities consistent with a constraint that begins, and the loss [J].

    Its first steps are damped most, which makes them independent of the accelerations before:
    those are zeroed, since the jolt's own are of modes that no step resolves.
    """
    moving, loss = project(scene, dataclasses.replace(state, settling=None, jerk=None))[:2]
    zero = jnp.zeros_like(state.rate)
    new = dataclasses.replace(
        moving,
        acceleration=zero,
        auxiliary=zero,
        force=state.force,
        settling=jnp.asarray(SETTLING_STEPS, jnp.int32),
        jerk=None if state.jerk is None else zero,
    )
    return new, loss


def advance_to(
    scene: Scene, state: State, stop: Float[Array, ""], method: GeneralizedAlpha
) -> tuple[State, StepInfo]:
    """`step` from a state that is consistent with its constraints."""
    settling = state.settling
    # settings are in the default precision, whatever the rod's
    radius = method.spectral_radius.astype(state.position.dtype)
    if settling is not None:
        radius = jnp.where(settling > 0, 0.0, radius)
    if state.jerk is not None:
        c = coefficients(radius, stop - state.time)
        rate, auxiliary = opening(c, state.rate, state.auxiliary, state.jerk)
        jerk = jnp.zeros_like(state.jerk)
        state = dataclasses.replace(state, rate=rate, auxiliary=auxiliary, jerk=jerk)
    equations = StepEquations(scene, state, stop, radius)
    guess = equations.guess()
    if scene.contact is not None:
        expected = equations.increment(guess)[:, :3]
        nearby = find_nearby(scene, state.position, expected)
        nearby = nearby._replace(near=checkpoint_name(nearby.near, newton.SOLUTION))
        equations = StepEquations(scene, state, stop, radius, nearby)
    guess = equations.limited(guess)
    tolerance = method.newton_tolerance(state.position.dtype)
    x, solved = newton.solve(equations, guess, tolerance, method.max_iterations)
    increment = equations.increment(x)
    c = equations.coefficients
    rate, acceleration, auxiliary = advance(
        c, state.rate, state.acceleration, state.auxiliary, equations.correction(x)
    )
    turned = rotations.multiply(state.quaternion, rotations.exponential(increment[:, 3:]))
    new = State(
        stop,
        state.position + increment[:, :3],
        rotations.normalize(turned),
        rate,
        acceleration,
        auxiliary,
        equations.force(x),
        None if settling is None else jnp.maximum(settling - 1, 0).astype(jnp.int32),
        state.jerk,
    )
    error = local_error(c, state.auxiliary, auxiliary)
    largest = lambda v: jnp.sqrt(jnp.max(jnp.sum(lax.stop_gradient(v) ** 2, 1)))
    contact_code = jnp.asarray(Result.SUCCESS, jnp.int32)
    if scene.contact is not None:
        assert equations.nearby is not None
        passed = screening.passage_suspected(*equations.nearby, state.position, new.position)
        contact_code = join(
            jnp.where(passed, Result.STRAND_PASSAGE, Result.SUCCESS),
            jnp.where(equations.nearby.near.overflow, Result.CAPACITY_OVERFLOW, Result.SUCCESS),
        )
    # beyond one revolution an element's rotation vector jumps to the other side
    wound = jnp.min(relative_rotation(new.quaternion)[:, 0]) < _FULLY_WOUND
    turned_far = (largest(increment[:, 3:]) > jnp.pi) | wound
    code = jnp.where(turned_far, Result.ROTATION_TOO_LARGE, Result.SUCCESS)
    code = join(solved.result, contact_code, code)
    info = StepInfo(
        result=checkpoint_name(code, newton.SOLUTION),
        iterations=solved.iterations,
        error_position=largest(error[:, :3]),
        error_bending=largest(error[:, 3:5]),
        error_twisting=largest(error[:, 5:]),
        growth_position=largest(increment[:, :3]),
        growth_bending=largest(increment[:, 3:5]),
        growth_twisting=largest(increment[:, 5:]),
        projection_loss=jnp.zeros_like(state.time),
        settling=jnp.asarray(False) if settling is None else settling > 0,
    )
    return new, info
