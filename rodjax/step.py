"""One step of the motion: equations of the step's end, their Newton system, and restarts."""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from rodjax import balance, contact, ends, newton, rotations
from rodjax.balance import Scales
from rodjax.consistency import restart
from rodjax.coupled import CoupledSystem, Coupling, coupled_or_not, solve_coupled
from rodjax.generalized_alpha import (
    GeneralizedAlpha,
    advance,
    coefficients,
    local_error,
    predicted_increment,
)
from rodjax.inertia import inertial_wrench, node_jacobian
from rodjax.loads import NodeMotion, total_wrench
from rodjax.results import Result, join
from rodjax.scene import Scene, projectors
from rodjax.state import State


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


# Steps after a constraint began that are taken with spectral radius 0: its shock excites modes
# that no step of practical size resolves, and without damping they ring on in the forces.
SETTLING_STEPS = 4


class Nearby(NamedTuple):
    """Contact sites and the outcome of the search, fixed over a step."""

    where: contact.Sites
    active: contact.ActiveSet


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
        return motion, acceleration, increment

    def _balance(self, x, motion, acceleration, increment, contact_force):
        """Scaled residual, the ends imposed; `contact_force` on the nodes or None."""
        scene, scales = self.scene, self.scales
        wrench, constraint = free_balance(scene, motion, acceleration, self.force(x))
        if contact_force is not None:
            wrench = wrench.at[:, :3].add(-contact_force)
        scale = jnp.repeat(jnp.stack([scales.force, scales.force * scales.length]), 3)
        wrench = wrench / scale
        both = projectors(scene, self.state.time)
        unit = jnp.repeat(jnp.stack([scales.length, jnp.ones_like(scales.length)]), 3)
        for index, end, projector in zip((0, -1), scene.ends, both, strict=True):
            start = self.state.quaternion[index]
            prescribed = ends.increments(end, self.state.time, self.stop, start)
            gap = _gap(increment[index], prescribed) / unit
            row = wrench[index] + projector @ (gap - wrench[index])
            wrench = wrench.at[index].set(row)
        # the element before node 0 does not exist: its force is a dummy, zero
        constraint = jnp.concatenate([x[:1, 3:6], constraint])
        return jnp.concatenate([constraint, wrench], 1)

    def residual(self, x):
        """Scaled residual of the step."""
        motion, acceleration, increment = self.motion(x)
        push = None
        if self.nearby is not None:
            assert self.scene.contact is not None
            push = contact.forces(
                self.scene.contact, self.scene.rod, *self.nearby, motion.position, motion.velocity
            )
        return self._balance(x, motion, acceleration, increment, push)

    def _blocks(self, x, motion, acceleration, increment):
        scene, rod, c = self.scene, self.scene.rod, self.coefficients
        tangent = balance.element_tangent(rod, motion.position, motion.quaternion, self.force(x))
        node = node_tangent(
            scene, motion, acceleration, increment[:, 3:], c.by_velocity, c.by_acceleration
        )
        both = tuple(projectors(scene, self.state.time))
        return balance.assemble(rod, tangent, node, both, self.scales)

    def linearize(self, x) -> CoupledSystem:
        """Derivative of the residual by the increments that `lift` takes."""
        motion, acceleration, increment = self.motion(x)
        blocks = self._blocks(x, motion, acceleration, increment)
        return CoupledSystem(blocks, self._coupling(motion))

    def newton_increment(self, x):
        """Newton's increment, contact forces and their derivative evaluated once."""
        motion, acceleration, increment = self.motion(x)
        blocks = self._blocks(x, motion, acceleration, increment)
        residual = self._balance(x, motion, acceleration, increment, None)
        coupling = self._coupling(motion)
        if coupling is None:
            return blocks.solve(-residual)

        def some(size):
            def branch(b, factors):
                force, derivative = coupling.evaluate(size)
                b = b + coupling.enter(size, force) / self.scales.force
                return solve_coupled(factors, coupling, size, derivative, b)

            return branch

        none = lambda b: blocks.solve(b)  # noqa: PLW0108 (cond hashes a bound method)
        return coupled_or_not(blocks, coupling, none, some, -residual)

    def _coupling(self, motion) -> Coupling | None:
        if self.nearby is None or self.scene.contact is None:
            return None
        where, active = self.nearby
        dtype = motion.position.dtype
        eye = jnp.zeros((9, 3), dtype).at[3:6].set(jnp.eye(3, dtype=dtype))
        left = jnp.broadcast_to(eye, (motion.position.shape[0], 9, 3))
        for index, projector in zip((0, -1), projectors(self.scene, self.state.time), strict=True):
            left = left.at[index, 3:].add(-projector[:, :3])
        return Coupling(
            self.scene.contact,
            where,
            active,
            contact.interpolate(where, motion.position),
            contact.interpolate(where, motion.velocity),
            self.coefficients.by_velocity,
            self.scales.length / self.scales.force,
            left=left,
            right=jnp.broadcast_to(jnp.roll(eye, -3, axis=0), left.shape),
        )

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
        return contact.approach_limit(
            self.scene.contact, *self.nearby, position, dx[:, :3] * self.scales.length
        )

    def limited(self, x):
        """The guess x with its increment scaled down where strands would close too much."""
        full = self.increment(x)
        assert self.scene.contact is not None and self.nearby is not None
        scale = contact.approach_limit(
            self.scene.contact, *self.nearby, self.state.position, full[:, :3]
        )
        change = (scale - 1) * full
        return x.at[:, :3].add(change[:, :3] / self.scales.length).at[:, 6:].add(change[:, 3:])

    def size(self, dx):
        return jnp.maximum(jnp.max(jnp.abs(dx[:, :3])), jnp.max(jnp.abs(dx[:, 6:])))


def _gap(increment, prescribed):
    """What an end's increment lacks, the rotation as the body spin still to go."""
    turn = rotations.multiply(
        rotations.conjugate(rotations.exponential(prescribed[3:])),
        rotations.exponential(increment[3:]),
    )
    return jnp.concatenate([increment[:3] - prescribed[:3], rotations.logarithm(turn)])


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


def nodal_balance(scene: Scene, motion: NodeMotion, acceleration, force):
    """`free_balance` less the contact forces, by a search of its own."""
    wrench, constraint = free_balance(scene, motion, acceleration, force)
    if scene.contact is not None:
        pushed = contact.report(
            scene.contact, scene.rod, motion.position, motion.quaternion, motion.velocity
        ).force
        wrench = wrench.at[:, :3].add(-pushed)
    return wrench, constraint


def find_nearby(scene: Scene, motion: NodeMotion, displacement) -> Nearby:
    """Search for contact before a step of the expected displacement; tangents of `motion`."""
    assert scene.contact is not None
    where = contact.sites(scene.contact, scene.rod)
    active = contact.search(
        scene.contact, scene.rod, where, motion.position, motion.quaternion, displacement
    )
    return Nearby(where, active)


def node_tangent(scene, motion, acceleration, turn, by_velocity, by_acceleration):
    """Derivative of inertia and loads of each node by its displacement and body spin, (n+1, 6, 6).

    Rates follow increments by generalised-alpha; `turn` is the rotation vector of the step, whose
    increment for a spin d is J(turn)^-1 d.
    """
    dtype = motion.position.dtype

    def wrench(z):
        vector = rotations.tangent_inverse_apply(turn, z[:, 3:])
        half = jnp.concatenate([jnp.zeros_like(z[:, :1]), 0.5 * z[:, 3:]], 1)
        moved = NodeMotion(
            motion.time,
            motion.position + z[:, :3],
            motion.quaternion + rotations.multiply(motion.quaternion, half),
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
    projected onto it and accelerations and forces made consistent. A failed step is reported in
    `StepInfo.result`, never raised.
    """
    method = GeneralizedAlpha() if method is None else method
    loss = jnp.zeros((), state.position.dtype)
    radius, settling = method.spectral_radius, None
    if scene.switch_times:
        state = prepare(scene, state)
        left = state.settling
        assert left is not None
        switches = jnp.any(jnp.stack([t == state.time for t in scene.switch_times]))
        state, loss = lax.cond(switches, lambda s: restart(scene, s), lambda s: (s, loss), state)
        settling = jnp.where(switches, SETTLING_STEPS, left)
        radius = jnp.where(settling > 0, 0.0, radius)
    equations = StepEquations(scene, state, stop, radius)
    guess = equations.guess()
    if scene.contact is not None:
        # tangents for the apertures: predicted, which keeps second order without coupling
        # rotations into the contact forces
        expected = equations.increment(guess)
        turned = rotations.multiply(state.quaternion, rotations.exponential(expected[:, 3:]))
        motion = NodeMotion(stop, state.position, turned, state.velocity, state.angular_velocity)
        nearby = find_nearby(scene, motion, expected[:, :3])
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
    )
    error = local_error(c, state.auxiliary, auxiliary)
    largest = lambda v: jnp.sqrt(jnp.max(jnp.sum(lax.stop_gradient(v) ** 2, 1)))
    contact_code = jnp.asarray(Result.SUCCESS, jnp.int32)
    if scene.contact is not None:
        assert equations.nearby is not None
        passed = contact.passage_suspected(
            scene.contact, *equations.nearby, state.position, new.position
        )
        overflow = equations.nearby.active.overflow > 0
        contact_code = join(
            jnp.where(passed, Result.STRAND_PASSAGE, Result.SUCCESS),
            jnp.where(overflow, Result.CAPACITY_OVERFLOW, Result.SUCCESS),
        )
    info = StepInfo(
        result=join(
            solved.result,
            contact_code,
            jnp.where(
                largest(increment[:, 3:]) > jnp.pi, Result.ROTATION_TOO_LARGE, Result.SUCCESS
            ),
        ),
        iterations=solved.iterations,
        error_position=largest(error[:, :3]),
        error_bending=largest(error[:, 3:5]),
        error_twisting=largest(error[:, 5:]),
        growth_position=largest(increment[:, :3]),
        growth_bending=largest(increment[:, 3:5]),
        growth_twisting=largest(increment[:, 5:]),
        projection_loss=loss,
        settling=jnp.asarray(False) if settling is None else settling > 0,
    )
    return new, info
