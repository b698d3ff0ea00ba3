"""Equations of a step of the paper's own scheme (see `paper_scheme`), and their linearisation."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from rodjax.constraints import ends
from rodjax.interactions.load import total_wrench
from rodjax.numerics import rotations
from rodjax.reference.paper_solvers import AbstractSolver, Linearized
from rodjax.rods.rod import Rod
from rodjax.rods.state import NodeMotion, State
from rodjax.scenes.scene import Scene, projectors


class Fields(eqx.Module):
    """Motion of the rod in the paper's variables, in body components at the nodes.

    `value` is Y = (v, omega, q, f), `rate` the algorithmic rate of (v, omega, q), which stands for
    that of a time (a_k - a_m) dt earlier; `state` is the motion as the rest of the library has it.
    """

    state: State
    value: Float[Array, "nodes 12"]
    rate: Float[Array, "nodes 9"]


class Weights(NamedTuple):
    """Coefficients of the first-order generalised-alpha method."""

    alpha_m: Float[Array, ""]  # weight of the old rate
    alpha_k: Float[Array, ""]  # weight of the old field
    gamma: Float[Array, ""]  # weight of the new rate in the increment


def weights(rho: Float[Array, ""]) -> Weights:
    """Coefficients for a spectral radius; 1 gives the box (implicit midpoint) scheme."""
    return Weights((3 * rho - 1) / (2 * (rho + 1)), rho / (rho + 1), 1 / (1 + rho))


class Point(NamedTuple):
    """What the equations take at nodes, or between them."""

    now: Float[Array, "k 12"]  # Y at t_n
    mean: Float[Array, "k 12"]  # Y at the weighted level
    rate: Float[Array, "k 9"]  # rates of (v, omega, q) there
    frame: Float[Array, "k 4"]  # quaternions there
    push: Float[Array, "k 3"]  # contact force per length, inertial

    @property
    def stepped(self) -> Float[Array, "k 12"]:
        """The fields whose slopes the equations take: v at t_n, the others weighted."""
        return jnp.concatenate([self.now[:, :3], self.mean[:, 3:]], 1)


def pieces(rod: Rod) -> Rod:
    """Every element as a rod by itself, along a leading axis."""

    def split(leaf):
        pairs = leaf.shape[0] == rod.elements + 1
        return jnp.stack([leaf[:-1], leaf[1:]], 1) if pairs else leaf[:, None]

    return jax.tree.map(split, rod)


class PaperEquations(eqx.Module):
    """Eq. (12) on every element and the ends' conditions at t_n, for scaled fields x (n+1, 12).

    The units make every term of the equations of order one: with the length
    l = (A dt^2 / m)^(1/4) of the waves that a step resolves, v is in l/dt, omega in 1/dt, q in
    A/l and f in A/l^2.
    """

    scene: Scene
    fields: Fields
    stop: Float[Array, ""]
    rho_time: Float[Array, ""]
    rho_space: Float[Array, ""]
    push: Float[Array, "nodes 3"]
    solver: AbstractSolver

    @property
    def dt(self) -> Float[Array, ""]:
        return self.stop - self.fields.state.time

    @property
    def length(self) -> Float[Array, ""]:
        """The unit of length l [m]."""
        rod = self.scene.rod
        assert rod.mass is not None
        return (jnp.mean(rod.stiffness[:, 0]) * self.dt**2 / jnp.mean(rod.mass)) ** 0.25

    @property
    def units(self) -> Float[Array, " 12"]:
        l, bend = self.length, jnp.mean(self.scene.rod.stiffness[:, 0])
        return jnp.repeat(jnp.stack([l / self.dt, 1 / self.dt, bend / l, bend / l**2]), 3)

    def guess(self) -> Float[Array, "nodes 12"]:
        """x for the rates of the step's start."""
        rate = jnp.pad(self.fields.rate, ((0, 0), (0, 3)))
        return (self.fields.value + self.dt * rate) / self.units[None]

    def new_rate(self, value: Float[Array, "nodes 12"]) -> Float[Array, "nodes 9"]:
        """Rates of (v, omega, q) at t_n."""
        gamma = weights(self.rho_time).gamma
        mean = (value[:, :9] - self.fields.value[:, :9]) / self.dt
        return (mean - (1 - gamma) * self.fields.rate) / gamma

    def turn(self, value: Float[Array, "nodes 12"]) -> Float[Array, "nodes 3"]:
        """Rotation vectors of the nodes over the step by their own angular velocities."""
        return 0.5 * self.dt * (self.fields.value[:, 3:6] + value[:, 3:6])

    def points(self, x: Float[Array, "nodes 12"]) -> Point:
        """The nodes at the weighted level."""
        w, old, value = weights(self.rho_time), self.fields, x * self.units[None]
        turn = (1 - w.alpha_k) * self.turn(value)
        return Point(
            now=value,
            mean=_mix(w.alpha_k, old.value, value),
            rate=_mix(w.alpha_m, old.rate, self.new_rate(value)),
            frame=rotations.multiply(old.state.quaternion, rotations.exponential(turn)),
            push=self.push,
        )

    def slopes_of(self, rod: Rod, at: Point) -> Float[Array, "n 12"]:
        """Right-hand sides of (10), (11), (9), (8) for the sections of the pieces `rod`."""
        mass, stiffness = rod.mass, rod.stiffness[:, 0]
        assert mass is not None and rod.rotary_inertia is not None
        rotary, natural = rod.rotary_inertia[:, 0], rod.natural_curvature[:, 0]
        v, spin, q, f = jnp.split(at.mean, 4, axis=1)
        v_rate, spin_rate, q_rate = jnp.split(at.rate, 3, axis=1)
        kappa = natural + q / stiffness
        force, moment = self._loads(rod, at)
        cross = jnp.cross
        axis = jnp.broadcast_to(jnp.asarray([0.0, 0.0, 1.0], v.dtype), v.shape)
        now = natural + at.now[:, 6:9] / stiffness
        inertia = rotary * spin_rate + cross(spin, rotary * spin)
        return jnp.concatenate(
            [
                cross(at.now[:, 3:6], axis) - cross(now, at.now[:, :3]),
                q_rate / stiffness - cross(kappa, spin),
                inertia + cross(f, axis) - moment - cross(kappa, q),
                mass * (v_rate + cross(spin, v)) - force - cross(kappa, f),
            ],
            1,
        )

    def _loads(self, rod: Rod, at: Point):
        """Force and moment per length, body components, from the load modules and contact.

        Each piece is a rod of one element, both nodes of which move as the point does.
        """
        force = at.push
        moment = jnp.zeros_like(force)
        if self.scene.loads:
            twice = lambda a: jnp.stack([a, a], 1)
            time = jnp.broadcast_to(self.stop, at.frame.shape[:1])
            motion = NodeMotion(
                time,
                rod.position,  # no load that is let in depends on it
                twice(at.frame),
                twice(rotations.rotate(at.frame, at.mean[:, :3])),
                twice(at.mean[:, 3:6]),
            )
            wrench = jax.vmap(lambda r, m: total_wrench(self.scene.loads, r, m))(rod, motion)
            wrench = jnp.sum(wrench, 1) / rod.length
            force, moment = force + wrench[:, :3], moment + wrench[:, 3:]
        return rotations.rotate_inverse(at.frame, force), moment

    def elements(self, first, last):
        """Residuals and slopes at the element ends, both (n, 12), for no slope carried along.

        Scaled: residuals and slopes in the units of the fields over l.
        """
        rod, w = pieces(self.scene.rod), weights(self.rho_space)
        before = jax.tree.map(lambda leaf: jnp.roll(leaf, 1, axis=0), rod)
        a = _take(first, slice(None, -1))
        b = _take(last, slice(1, None))
        station = Point(*(_mix(w.alpha_k, old, new) for old, new in zip(a, b, strict=True)))
        station = station._replace(frame=rotations.normalize(station.frame))
        # three evaluations in one, which halves the time of compilation
        many = lambda *trees: jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *trees)
        found = self.slopes_of(many(rod, rod, before), many(station, a, a))
        inside, jump, carried = jnp.split(found, 3)
        # where a slope begins, or jumps with the properties: what the equations say there
        jump = jump.at[1:].add(-carried[1:])
        rise = (b.stepped - a.stepped) / rod.length
        slope = (rise - (1 - w.gamma) * jump) / w.gamma
        residual = _mix(w.alpha_m, jump, slope) - inside
        scale = (self.length / self.units)[None]
        return residual * scale, slope * scale

    @property
    def memory(self) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """Derivatives of an element's residual and slope by the slope carried into it."""
        w = weights(self.rho_space)
        by_slope = -(1 - w.gamma) / w.gamma
        return w.alpha_m + (1 - w.alpha_m) * by_slope, by_slope

    def end(self, index: int, projector, y: Float[Array, " 12"]) -> Float[Array, " 6"]:
        """What one end lacks: its prescribed velocities, and no force where it is free."""
        state, value = self.fields.state, y * self.units
        turn = 0.5 * self.dt * (self.fields.value[index, 3:6] + value[3:6])
        frame = rotations.multiply(state.quaternion[index], rotations.exponential(turn))
        velocity = jnp.concatenate([rotations.rotate(frame, value[:3]), value[3:6]])
        wrench = jnp.concatenate([rotations.rotate(frame, value[9:]), value[6:9]])
        # the mean of both sides: at a corner of a drive the steps then add up to what it prescribes
        beside = (self.stop - 1e-6 * self.dt, self.stop + 1e-6 * self.dt)
        both = [ends.rates(self.scene.ends[index], time, frame)[0] for time in beside]
        prescribed = 0.5 * (both[0] + both[1])
        moving, pulling = self.units[:6], jnp.concatenate([self.units[9:], self.units[6:9]])
        free = wrench / pulling
        return free + projector @ ((velocity - prescribed) / moving - free)

    def linearize(self, x: Float[Array, "nodes 12"]) -> Linearized:
        """The equations at x and their derivatives."""

        def both(first, last):
            return self.elements(self.points(first), self.points(last))

        (residual, slope), push = jax.linearize(both, x, x)
        wide = lambda direction: jnp.broadcast_to(direction, x.shape)
        columns = lambda direction: push(wide(direction[:12]), wide(direction[12:]))
        by_fields, slope_by_fields = jax.vmap(columns, out_axes=2)(jnp.eye(24, dtype=x.dtype))
        memory, slope_memory = self.memory

        def carry(before, slope):
            return slope + slope_memory * before, before

        _, carried = lax.scan(carry, jnp.zeros_like(slope[0]), slope)
        projector = projectors(self.scene, self.fields.state.time)
        (first, lacking), (last, lacking_last) = (
            jax.jacfwd(lambda y, i=i: (self.end(i, projector[i], y),) * 2, has_aux=True)(x[i])
            for i in (0, -1)
        )
        return Linearized(
            by_fields[:, :, :12],
            by_fields[:, :, 12:],
            residual + memory * carried,
            slope_by_fields[:, :, :12],
            slope_by_fields[:, :, 12:],
            memory,
            slope_memory,
            first,
            lacking,
            last,
            lacking_last,
        )

    def newton_increment(self, x):
        """Newton's increment of x."""
        return self.solver.solve(self.linearize(x))

    def retract(self, x, dx):
        return x + dx

    def limit(self, x, dx):
        return jnp.ones((), x.dtype)

    def size(self, dx):
        return jnp.max(jnp.abs(dx))

    def rotation(self, dx):
        """Its constraint is one of rates, which no iteration keeps better than the tolerance."""
        return jnp.zeros((), dx.dtype)


def _mix(weight, old, new):
    return weight * old + (1 - weight) * new


def _take(point: Point, where) -> Point:
    return Point(*(leaf[where] for leaf in point))
