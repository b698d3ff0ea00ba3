"""Obstacles: what a rod runs into, lies on or is wound over, with friction on its surface."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from rodjax.inputs.schedules import AbstractSchedule, Constant, check_schedule
from rodjax.inputs.validation import (
    all_known,
    as_float,
    check_flag,
    check_instance,
    check_not_negative,
    check_positive,
    check_scalar,
    given,
)
from rodjax.interactions.friction import AbstractFriction, Dual, Rubbing
from rodjax.interactions.load import AbstractLoad
from rodjax.interactions.roles import Role
from rodjax.interactions.shapes import AbstractShape
from rodjax.numerics import rotations
from rodjax.numerics.results import Result
from rodjax.rods.rod import Rod
from rodjax.rods.state import NodeMotion

# How deep an increment of Newton's method may bring a centreline into an obstacle, or deeper than
# it is, in radii of the rod. (Not less than nothing: a soft soil may be pressed in so far.)
_DEEPER = 0.5

# Places between two positions of a node that are looked at for an obstacle in the way.
_LOOKS = 8


class Anchors(NamedTuple):
    """What friction remembers of the nodes.

    Attributes:
        place: of the nodes, as the obstacle sees them [m].
        quaternion: their frames.
        stretch: tangential displacement of their surface from the anchors [m].
        lost: by slipping, since the start [J].
    """

    place: Float[Array, "nodes 3"]
    quaternion: Float[Array, "nodes 4"]
    stretch: Float[Array, "nodes 3"]
    lost: Float[Array, " nodes"]


class Touch(NamedTuple):
    """How the nodes touch an obstacle.

    Attributes:
        gap: between the surfaces [m], negative where they are in each other.
        normal: of the obstacle.
        arm: from the nodes to the points of contact [m].
        elastic: normal force per length without damping [N/m].
        load: with it [N/m].
        rubbing: what friction sees.
    """

    gap: Float[Array, " nodes"]
    normal: Float[Array, "nodes 3"]
    arm: Float[Array, "nodes 3"]
    elastic: Float[Array, " nodes"]
    load: Float[Array, " nodes"]
    rubbing: Rubbing


class ObstacleContact(NamedTuple):
    """What passes between the nodes and an obstacle, see `measures.obstacle_contact`.

    Attributes:
        gap: between the surfaces [m], negative where they are in each other.
        normal_force: with which the obstacle pushes the nodes [N].
        friction: on the nodes, inertial components [N].
        slip_velocity: of the rod's surface on the obstacle's, inertial components [m/s].
        sticks: where friction holds below its limit (by `SlidingFriction` nowhere).
        slides: where it is at its limit.
    """

    gap: Float[Array, "*k nodes"]
    normal_force: Float[Array, "*k nodes"]
    friction: Float[Array, "*k nodes 3"]
    slip_velocity: Float[Array, "*k nodes 3"]
    sticks: Bool[Array, "*k nodes"]
    slides: Bool[Array, "*k nodes"]


# Part of its limit from which on friction counts as sliding.
_AT_LIMIT = 1 - 1e-6


class Obstacle(AbstractLoad):
    """A body that a rod cannot enter, at rest or moved.

    The gap is the signed distance of a node from the surface less half the rod's diameter there.
    Where it is negative the obstacle pushes along its normal by k (e + relaxation de/dt) per
    length, e the depth with a soft beginning: with width = softness D it is depth^2/(2 width) up
    to the width, depth - width/2 beyond it. Friction acts where the surfaces touch, D/2 from
    the centreline, and so turns the rod.

    It acts at the nodes: elements must be short beside the obstacle's curvature.

    Attributes:
        shape: its surface, `Plane` for instance.
        stiffness: k, force per length and depth [N/m^2]. Of a soil with a stiffness per area
            [N/m^3] that times the rod's diameter.
        friction: `Friction` (holds without creep), `SlidingFriction` (smooth), or None.
        softness: width of the soft beginning [D].
        relaxation: [s]; damps motion along the normal. With the mass m per length on it, a
            relaxation of 2 z sqrt(m/k) is the part z of the critical damping.
        suction: whether damping may hold back what leaves. By default no obstacle pulls.
        displacement: schedule of three inertial components by which it is moved [m]; None: it
            rests. The velocity counts in damping and friction.
        memory, dual: set by the equations of a step, see `recalling` and `AbstractFriction.dual`.

    Example:
        >>> seabed = rx.Obstacle(rx.Plane(point=(0, 0, -1)), stiffness=1e5, relaxation=1e-3)
        >>> laid = rx.Scene(rod, rx.Clamped(), loads=(rx.Gravity((0, 0, -9.81)), seabed))
    """

    shape: AbstractShape
    stiffness: Float[Array, ""] = eqx.field(converter=as_float)
    friction: AbstractFriction | None = None
    softness: Float[Array, ""] = eqx.field(converter=as_float, default=0.05)
    relaxation: Float[Array, ""] = eqx.field(converter=as_float, default=0.0)
    suction: bool = eqx.field(static=True, default=False)
    displacement: AbstractSchedule | None = None
    memory: Anchors | None = eqx.field(default=None, repr=False)
    dual: Dual | None = eqx.field(default=None, repr=False)

    def __check_init__(self):
        check_instance(AbstractShape, "give a shape such as Plane()", shape=self.shape)
        numbers = {"stiffness": self.stiffness, "softness": self.softness}
        check_scalar(relaxation=self.relaxation, **numbers)
        check_positive(**numbers)
        check_not_negative(relaxation=self.relaxation)
        check_flag(suction=self.suction)
        if self.friction is not None:
            mend = "give a law such as Friction(0.3), or None for a smooth surface"
            check_instance(AbstractFriction, mend, friction=self.friction)
        mend = (
            "give a schedule of three components, PiecewiseLinear([0, 1], [(0, 0, 0), (1, 0, 0)])"
        )
        check_schedule((3,), mend, **given(displacement=self.displacement))

    def check(self, rod):
        if rod.diameter is None:
            raise ValueError("diameter: an Obstacle needs the rod's; give it to the rod's section")
        if not all_known((self, rod)):
            return
        with jax.ensure_compile_time_eval():
            distance = np.asarray(jax.vmap(self.shape.distance)(_of_rods(rod, rod.position)))
        if not np.all(np.isfinite(distance)):
            raise ValueError(
                f"shape: its distance from node {int(np.argmin(np.isfinite(distance)))} is no"
                " number; give a signed distance that is finite everywhere"
            )
        if np.any(distance < 0):
            node = int(np.argmin(distance))
            raise ValueError(
                f"shape: the rod starts inside the obstacle, node {node} by"
                f" {-float(distance[node]):.3g} m; place the rod or the obstacle elsewhere (the"
                " signed distance is positive where a rod may be: turn a plane's normal round, or"
                " give `inside`)"
            )

    @property
    def role(self):
        return Role.CONTACT

    @property
    def may_hold(self):
        return True

    @property
    def schedules(self):
        return given(displacement=self.displacement)

    @property
    def remembers(self):
        return self.friction is not None and self.friction.remembers

    def _relative(self, motion: NodeMotion) -> tuple[Float[Array, "nodes 3"], ...]:
        """Positions and velocities of the nodes as the obstacle sees them."""
        if self.displacement is None:
            return motion.position, motion.velocity
        second = jnp.ones_like(motion.time)
        shift, rate = jax.jvp(self.displacement, (motion.time,), (second,))
        return motion.position - shift[None], motion.velocity - rate[None]

    def touch(self, rod: Rod, motion: NodeMotion) -> Touch:
        """How the nodes touch it."""
        place, velocity = self._relative(motion)
        distance, normal = jax.vmap(self.shape.distance_and_normal)(place)
        radius = _radius(rod)
        gap = distance - radius
        closing = -jnp.sum(velocity * normal, 1)
        depth, width = jnp.maximum(-gap, 0.0), 2 * self.softness * radius
        begins = depth < width
        indentation = jnp.where(begins, 0.5 * depth**2 / width, depth - 0.5 * width)
        rate = jnp.where(begins, depth / width, 1.0) * closing
        elastic = self.stiffness * indentation
        load = elastic + self.stiffness * self.relaxation * rate
        if not self.suction:
            load = jnp.maximum(load, 0.0)
        arm = -radius[:, None] * normal
        rubbing = self._rubbing(motion, place, velocity, normal, arm, load)
        return Touch(gap, normal, arm, elastic, load, rubbing)

    def _rubbing(self, motion: NodeMotion, place, velocity, normal, arm, load) -> Rubbing:
        tangential = lambda v: v - jnp.sum(v * normal, 1, keepdims=True) * normal
        spin = rotations.rotate(motion.quaternion, motion.angular_velocity)
        velocity = tangential(velocity + jnp.cross(spin, arm))
        stretch = jnp.zeros_like(velocity)
        if self.memory is not None:
            before = rotations.conjugate(self.memory.quaternion)
            half = rotations.multiply(motion.quaternion, before)[:, 1:]
            # the rotation vector but for its fifth power, at less than half of its cost
            turn = half * (2.0 + jnp.sum(half**2, 1, keepdims=True) / 3.0)
            moved = place - self.memory.place + jnp.cross(turn, arm)
            stretch = tangential(self.memory.stretch + moved)
        load = jnp.maximum(load, 0.0)
        dual = None if self.dual is None else self.dual.estimate
        return Rubbing(load, self.stiffness, velocity, stretch, dual)

    def wrench(self, rod, motion):
        touch = self.touch(rod, motion)
        length = rod.node_length[:, None]
        force = length * touch.load[:, None] * touch.normal
        if self.friction is None:
            return jnp.concatenate([force, jnp.zeros_like(force)], 1)
        return self._rubbed(rod, motion, touch) + jnp.concatenate([force, jnp.zeros_like(force)], 1)

    def _rubbed(self, rod: Rod, motion: NodeMotion, touch: Touch) -> Float[Array, "nodes 6"]:
        """Wrenches of friction."""
        assert self.friction is not None
        force = rod.node_length[:, None] * self.friction.traction(touch.rubbing)
        moment = rotations.rotate_inverse(motion.quaternion, jnp.cross(touch.arm, force))
        return jnp.concatenate([force, moment], 1)

    def contact(self, rod: Rod, motion: NodeMotion) -> ObstacleContact:
        """What passes between it and the nodes."""
        touch = self.touch(rod, motion)
        normal, friction = rod.node_length * touch.load, jnp.zeros_like(motion.position)
        touches = touch.rubbing.load > 0
        holds = jnp.zeros_like(touches)
        if self.friction is not None:
            traction = self.friction.traction(touch.rubbing)
            friction = rod.node_length[:, None] * traction
            most = _AT_LIMIT * self.friction.coefficient * touch.rubbing.load
            holds = jnp.sqrt(jnp.sum(traction**2, 1)) < most
            holds = holds & self.friction.remembers
        slip = touch.rubbing.velocity
        sticks, slides = touches & holds, touches & ~holds
        return ObstacleContact(touch.gap, normal, friction, slip, sticks, slides)

    def energy(self, rod, motion):
        touch = self.touch(rod, motion)
        radius = _radius(rod)
        depth, width = jnp.maximum(-touch.gap, 0.0), 2 * self.softness * radius
        beyond = jnp.maximum(depth - width, 0.0)
        soft = jnp.minimum(depth, width) ** 3 / (6 * width)
        density = self.stiffness * (soft + 0.5 * beyond * (beyond + width))
        if self.friction is not None:
            density = density + self.friction.stored(touch.rubbing)
        return jnp.sum(rod.node_length * density)

    def lost(self, rod, motion, found, exerted):
        touch = self.touch(rod, motion)
        length = rod.node_length[:, None]
        damping = length * (touch.load - touch.elastic)[:, None] * touch.normal
        lost = jnp.concatenate([damping, jnp.zeros_like(damping)], 1)
        if self.friction is None or self.friction.remembers:  # what slips is in the memory
            return lost
        return lost + self._rubbed(rod, motion, touch)

    def first_memory(self, rod, motion):
        if not self.remembers:
            return None
        place = self._relative(motion)[0]
        none = jnp.zeros_like(place)
        return Anchors(place, motion.quaternion, none, none[:, 0])

    def next_memory(self, rod, motion):
        if self.friction is None or self.memory is None:
            return None
        rubbing, before = self.touch(rod, motion).rubbing, self.memory
        lost = rod.node_length * self.friction.slipped(rubbing, before.stretch)
        place, stretch = self._relative(motion)[0], self.friction.stretch(rubbing)
        return Anchors(place, motion.quaternion, stretch, before.lost + lost)

    @property
    def rubs(self):
        return self.friction is not None

    def first_dual(self, rod, motion, found):
        if self.friction is None:
            return None
        return self.friction.dual(self.touch(rod, motion).rubbing)

    def next_dual(self, rod, motion, found):
        if self.friction is None or self.dual is None:
            return None
        return self.friction.next_dual(self.dual, self.touch(rod, motion).rubbing)

    def lost_before(self):
        return None if self.memory is None else jnp.sum(self.memory.lost)

    def driving(self, exerted, time):
        if self.displacement is None:
            return None
        return jnp.sum(exerted[:, :3], 0), self.displacement(time)

    def held_at(self, time):
        if self.displacement is None:
            return self
        shift = Constant(self.displacement(time))
        return eqx.tree_at(lambda one: one.displacement, self, shift)

    def _apart(self, position: Float[Array, "nodes 3"]) -> Float[Array, " nodes"]:
        """Distances of the nodes from the surface of what is held at a time."""
        shift = jnp.zeros(3) if self.displacement is None else self.displacement(jnp.zeros(()))
        return jax.vmap(self.shape.distance)(position - shift[None].astype(position.dtype))

    def safe_fraction(self, rod, position, change, found):
        position, change = _of_rods(rod, position), _of_rods(rod, change)
        # of a convex obstacle the linear change is the most that a node comes nearer, of a hollow
        # that from end to end
        before, linear = jax.jvp(self._apart, (position,), (change,))
        closing = jnp.maximum(-linear, before - self._apart(position + change))
        most = jnp.maximum(before, 0.0) + _DEEPER * _of_rods(rod, _radius(rod))
        fraction = most / jnp.where(closing > most, closing, most)
        return jnp.min(fraction, initial=1.0)

    def verdict(self, rod, before, after, found):
        """Whether a node went through the obstacle, or half a diameter into it at once."""
        before, after = _of_rods(rod, before), _of_rods(rod, after)
        parts = jnp.linspace(0.0, 1.0, _LOOKS, dtype=before.dtype)
        at = lambda part: self._apart(before + part * (after - before))
        apart = jax.lax.map(at, parts)
        outside = jnp.minimum(apart[0], jnp.maximum(apart[-1], 0.0))
        deepest = jnp.min(apart, 0)
        passed = jnp.any((outside >= 0) & (deepest < -_of_rods(rod, _radius(rod))))
        return jnp.where(passed, Result.OBSTACLE_PASSED, Result.SUCCESS)


def _radius(rod: Rod) -> Float[Array, " nodes"]:
    """Half the diameter at the nodes."""
    assert rod.diameter is not None  # `check` has seen to it
    length, amount = rod.node_length, rod.to_nodes(rod.diameter)
    if rod.bodies:  # which no obstacle feels
        length = length.at[np.array(rod.bodies)].set(1.0, unique_indices=True)
        amount = amount.at[np.array(rod.bodies)].set(rod.diameter[0], unique_indices=True)
    return 0.5 * amount / length


def _of_rods(rod: Rod, rows: Float[Array, "nodes *k"]) -> Float[Array, "r *k"]:
    """The rows of nodes that are no bodies by themselves, which come last."""
    return rows[: len(rows) - len(rod.bodies)] if rod.bodies else rows
