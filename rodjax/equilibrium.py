"""Equilibrium of a scene: the step's equations without inertia, reached along a load path.

On the path with parameter p from 0 to 1 the residual is

    inner(x) - p loads(x, t(p)) - (1 - p) inner(x_0) = 0,    t(p) = t_0 + p (t - t_0),

with `inner` the internal forces less those of self-contact, and the ends have moved by what their
schedules say at t(p). The start x_0 solves it at p = 0 whatever it is; a start that is an
equilibrium already stays one; a rod placed at rest sees its loads grow from zero. Where Newton's
method fails the path's step is halved.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from rodjax import balance, contact_forces, ends, newton, results, rotations, screening
from rodjax.anchored import AnchoredSystem
from rodjax.balance import Internal, Scales
from rodjax.compilation import compiled
from rodjax.coupled import CoupledSystem, couple, find_nearby
from rodjax.inertia import node_jacobian
from rodjax.loads import DistributedLoad, NodeMotion, total_wrench
from rodjax.results import Result
from rodjax.rod import Number
from rodjax.scene import Scene, projectors
from rodjax.state import State

Factor = Number | Float[Array, ""]
# How often the path's step may be halved before the path is given up.
_HALVINGS = 12


class EquilibriumInfo(NamedTuple):
    """How the equilibrium was found."""

    result: Int[Array, ""]
    iterations: Int[Array, ""]  # Newton iterations in all
    load_steps: Int[Array, ""]  # accepted steps of the path
    rejected: Int[Array, ""]  # steps that were halved
    reached: Float[Array, ""]  # how far along the path, 1 at its end


class Ramp(NamedTuple):
    """Where on the path: its parameter and what the start was out of balance by."""

    factor: Float[Array, ""]
    imbalance: Internal


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
        start, left = ramp.imbalance, 1 - ramp.factor
        wrench = wrench - left * jnp.concatenate([start.force, start.moment], 1)
        constraint = constraint - left * start.constraint
        wrench = wrench / jnp.repeat(jnp.stack([scales.force, scales.force * scales.length]), 3)
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
        both = projectors(scene, self.start.time)
        blocks = balance.assemble(scene.rod, tangent, node, both, scales)
        nearby = None if scene.contact is None else find_nearby(scene, motion.position)
        coupled = lambda blocks, projectors: CoupledSystem(
            blocks,
            couple(scene, nearby, motion, jnp.zeros_like(scales.force), projectors, scales)[1],
        )
        system = coupled(blocks, both)
        if not isinstance(scene.first_end, ends.Clamped):
            eye = jnp.eye(6, dtype=x.dtype)
            other = jnp.stack([eye, jnp.zeros_like(eye)])
            held = balance.assemble(scene.rod, tangent, node, other, scales)
            system = AnchoredSystem(system, coupled(held, other))
        return system

    def newton_increment(self, x, needed=True):
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
        pushed = contact_forces.report(scene.contact, scene.rod, motion.position, motion.velocity)
        wrench = wrench.at[:, :3].add(-pushed.force)
    return wrench, inner.constraint


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


def placing(scene: Scene, time: Number | Float[Array, ""] = 0.0) -> State:
    """The rod at rest as it was built, without internal force: where a load path may start."""
    rod = scene.rod
    dtype = rod.position.dtype
    rate = jnp.zeros((rod.elements + 1, 6), dtype)
    force = jnp.zeros((rod.elements, 3), dtype)
    now = jnp.asarray(time, dtype)
    return State(now, rod.position, rod.quaternion, rate, rate, rate, force)


class _Path(NamedTuple):
    """Where the path has come to: x solves the equations at `reached` from `reference`."""

    step: Float[Array, ""]
    reference: tuple[Float[Array, "nodes 3"], Float[Array, "nodes 4"]]
    x: Float[Array, "nodes 9"]
    result: Int[Array, ""]
    iterations: Int[Array, ""]
    accepted: Int[Array, ""]
    rejected: Int[Array, ""]
    reached: Float[Array, ""]


def equilibrium(
    scene: Scene,
    state: State,
    *,
    time: Number | Float[Array, ""] | None = None,
    load_steps: int = 10,
    tolerance: Number | Float[Array, ""] | None = None,
    max_iterations: int = 30,
    max_rotation: Number = 0.6,
    throw: bool = True,
) -> tuple[State, EquilibriumInfo]:
    """Configuration in which all forces balance, found along a load path from `state`.

    Args:
        state: where the path starts, at rest; for instance `placing(scene)` or an earlier
            equilibrium. If it is not in equilibrium, loads and what it lacks are brought
            on in proportion (see the module). Ends move from where they are in it, as their
            schedules say from `state.time` to `time`. A constraint that changes does so where a
            path starts, so end one path and start the next at that time.
        time: when schedules are evaluated at the end of the path; `state.time` by default.
        load_steps: steps of the path; a step in which Newton fails is halved, up to 12 times.
        tolerance: predicted error after the last Newton update, in rotations [rad] and
            displacements over the rod's length; None takes 1e-10 in float64, 1e-4 in float32.
        max_iterations: Newton iterations allowed in a step of the path.
        max_rotation: largest rotation of a node in one Newton iteration [rad].
        throw: raise `SimulationError` if the path could not be followed to its end. Otherwise
            `EquilibriumInfo.result` tells, and the state is the last equilibrium on the path.

    Differentiable in every array of scene, state and time, in forward and reverse mode: by the
    implicit function theorem at the solution, without differentiating the path.

    Statics cannot tell whether the equilibrium is stable: see `stability`.

    Raises:
        ValueError: the ends leave the rod free to move, a schedule or a constraint's time does
            not fit, a value is not finite (checked outside traced code).
        SimulationError: the path ended early, as it does where the equilibrium becomes critical.
    """
    dtype = state.position.dtype
    stop = jnp.asarray(state.time if time is None else time, dtype)
    if tolerance is None:
        tolerance = 1e-10 if jnp.finfo(dtype).eps < 1e-12 else 1e-4
    numbers = {
        "load_steps": load_steps,
        "tolerance": tolerance,
        "max_iterations": max_iterations,
        "max_rotation": max_rotation,
    }
    for name, value in numbers.items():
        if not isinstance(value, jax.core.Tracer) and not np.all(np.asarray(value) > 0):
            raise ValueError(f"{name}: must be positive, got {value}")
    if not isinstance(tolerance, jax.core.Tracer) and tolerance < 10 * jnp.finfo(dtype).eps:
        raise ValueError(
            f"tolerance: {float(tolerance):g} is out of reach of {np.dtype(dtype).name}; use a"
            " larger one, or float64 (jax.config.update('jax_enable_x64', True))"
        )
    _check_path(scene, state, stop)
    check_held(scene, state)
    as_array = lambda value: jnp.asarray(value, dtype)
    new, info = _equilibrium(
        scene,
        state,
        stop,
        as_array(load_steps),
        as_array(tolerance),
        jnp.asarray(max_iterations, jnp.int32),
        as_array(max_rotation),
    )
    if throw:
        if isinstance(info.result, jax.core.Tracer):
            message = "no equilibrium was found; call with throw=False and look at `result`"
            new = eqx.error_if(new, info.result != Result.SUCCESS, message)
        else:
            where = (
                f"equilibrium, at {float(info.reached):.3g} of the load path (it ends where an"
                " equilibrium becomes critical: lessen the load or disturb the symmetry)"
            )
            results.raise_if_failed(info.result, where, (new, info))
    return new, info


@compiled
def _equilibrium(scene, state, stop, load_steps, tolerance, max_iterations, max_rotation):
    fixed, start, end = newton.constant((scene, state, stop))
    path = _follow(fixed, start, end, load_steps, tolerance, max_iterations, max_rotation)
    time = state.time + path.reached * (stop - state.time)
    ramp = Ramp(path.reached, _imbalance(scene, state))
    position, quaternion = path.reference
    equations = StaticEquations(scene, state, position, quaternion, time, max_rotation, ramp)
    x = newton.root(equations, path.x)
    motion = equations.motion(x)
    zero = jnp.zeros_like(state.rate)
    quaternion = rotations.normalize(motion.quaternion)
    new = State(time, motion.position, quaternion, zero, zero, zero, equations.force(x))
    return new, EquilibriumInfo(
        result=path.result,
        iterations=path.iterations,
        load_steps=path.accepted,
        rejected=path.rejected,
        reached=path.reached,
    )


def _imbalance(scene: Scene, state: State) -> Internal:
    """What internal forces lack at the start of a path."""
    motion = at_rest(state.time, state.position, state.quaternion)
    wrench, constraint = static_balance(scene, motion, state.force, 0.0)
    return Internal(wrench[:, :3], wrench[:, 3:], constraint)


def _follow(scene, state, stop, load_steps, tolerance, max_iterations, max_rotation) -> _Path:
    """The equilibrium at the end of the path, by steps of at most 1/load_steps."""
    imbalance = _imbalance(scene, state)
    first = 1 / load_steps

    def equations(target, reference):
        time = state.time + target * (stop - state.time)
        ramp = Ramp(target, imbalance)
        position, quaternion = reference
        return StaticEquations(scene, state, position, quaternion, time, max_rotation, ramp)

    def attempt(path: _Path) -> _Path:
        # no sliver of a step at the end
        target = path.reached + path.step
        target = jnp.where(target > 1 - 1e-3 * first, 1.0, target)
        before = equations(path.reached, path.reference)
        motion = before.motion(path.x)
        reference = motion.position, rotations.normalize(motion.quaternion)
        trial = equations(target, reference)
        guess = trial.guess(before.force(path.x))
        x, solved = newton.iterate(trial, guess, tolerance, max_iterations)
        turned = jnp.sqrt(jnp.max(jnp.sum(x[:, 6:] ** 2, 1)))
        far = jnp.where(turned > jnp.pi, Result.ROTATION_TOO_LARGE, Result.SUCCESS)
        result = results.join(solved.result, far, trial.overflow(x))
        good = result == Result.SUCCESS
        keep = lambda new, old: jnp.where(good, new, old)
        return _Path(
            jnp.where(good, jnp.minimum(2 * path.step, first), 0.5 * path.step),
            jax.tree.map(keep, reference, path.reference),
            keep(x, path.x),
            result,
            path.iterations + solved.iterations,
            path.accepted + good,
            path.rejected + ~good,
            keep(target, path.reached),
        )

    def unfinished(path: _Path):
        return (path.reached < 1) & (path.step > first * 0.5 ** (_HALVINGS + 0.5))

    none = jnp.zeros((), jnp.int32)
    nowhere = jnp.zeros_like(first)
    reference = state.position, state.quaternion
    x = equations(nowhere, reference).guess(state.force)
    begin = _Path(first, reference, x, none, none, none, none, nowhere)
    return lax.while_loop(unfinished, attempt, begin)


def _check_path(scene: Scene, state: State, stop) -> None:
    """Raise ValueError where schedules, switches or values do not fit the path."""
    for name in ("position", "quaternion", "force"):
        value = getattr(state, name)
        if not isinstance(value, jax.core.Tracer) and not np.all(np.isfinite(value)):
            raise ValueError(f"state.{name}: must be finite everywhere")
    if isinstance(stop, jax.core.Tracer) or isinstance(state.time, jax.core.Tracer):
        return
    if not float(stop) >= float(state.time):
        raise ValueError(f"time: {float(stop):g} lies before the state's {float(state.time):g}")
    scene.check_until(float(stop))
    for switch in scene.switch_times:
        if isinstance(switch, jax.core.Tracer):
            continue
        if float(state.time) < float(switch) < float(stop):
            raise ValueError(
                f"time: a constraint changes at {float(switch):g}; find the equilibrium at that"
                " time first and start from it"
            )


def check_held(scene: Scene, state: State) -> None:
    """Raise ValueError if the ends leave the rod free to move as a rigid body.

    A rod held in part passes if a `DistributedLoad` might hold the rest. Skipped for traced values.
    """
    leaves = jax.tree.leaves((projectors(scene, state.time), state, scene.rod.length))
    if any(isinstance(leaf, jax.core.Tracer) for leaf in leaves):
        return
    both = np.asarray(projectors(scene, state.time))
    if not np.any(both):
        raise ValueError(
            "first_end, last_end: a rod held at neither end has no unique equilibrium; hold one"
            " (ends.Clamped, or ends.Pinned and ends.Slider together)"
        )
    if any(isinstance(load, DistributedLoad) for load in scene.loads):
        return
    length = float(jnp.sum(scene.rod.length))
    rows = []
    for index, projector in zip((0, -1), both, strict=True):
        arm = np.asarray(state.position[index] - state.position[0]) / length
        frame = np.asarray(rotations.matrix(state.quaternion[index]))
        # rigid motion: translation a over L, rotation w about node 0
        translation = np.concatenate([np.eye(3), -np.asarray(rotations.hat(jnp.asarray(arm)))], 1)
        rotation = np.concatenate([np.zeros((3, 3)), frame.T], 1)
        rows.append(projector @ np.concatenate([translation, rotation]))
    rank = np.linalg.matrix_rank(np.concatenate(rows), tol=1e-6)
    if rank < 6:
        raise ValueError(
            f"first_end, last_end: they leave {6 - rank} rigid motion(s) of the rod free (a spin"
            " about the line through two pins, a slide along two sliders), so the equilibrium is"
            " not unique; hold the rod more"
        )
