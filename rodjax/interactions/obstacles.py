"""Obstacles: what a rod runs into, lies on or is wound over, with friction on its surface."""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from rodjax.inputs.schedules import AbstractSchedule, Constant, check_schedule
from rodjax.inputs.validation import (
    all_known,
    as_float,
    check_flag,
    check_instance,
    check_integer,
    check_not_negative,
    check_positive,
    check_scalar,
    given,
)
from rodjax.interactions import obstacle_passages
from rodjax.interactions.element_points import ElementPoints
from rodjax.interactions.friction import AbstractFriction, Dual, Rubbing, continued
from rodjax.interactions.load import AbstractLoad
from rodjax.interactions.obstacle_touch import ObstacleContact, Touch
from rodjax.interactions.roles import Role
from rodjax.interactions.shapes import AbstractShape
from rodjax.numerics import newton, rotations
from rodjax.numerics.results import Result
from rodjax.rods.rod import Rod
from rodjax.rods.state import NodeMotion


class Anchors(NamedTuple):
    """What friction remembers of the points at which an obstacle acts.

    Attributes:
        place: of the nodes, as the obstacle sees them [m].
        quaternion: their frames.
        stretch: tangential displacement of the points' surface from the anchors [m].
        lost: by slipping, since the start [J].
    """

    place: Float[Array, "nodes 3"]
    quaternion: Float[Array, "nodes 4"]
    stretch: Float[Array, "points 3"]
    lost: Float[Array, " points"]


# Part of its limit from which on friction counts as sliding.
_AT_LIMIT = 1 - 1e-6


class Obstacle(AbstractLoad):
    """A body that a rod cannot enter, at rest or moved.

    The gap is the signed distance of a node from the surface less half the rod's diameter there.
    Where it is negative the obstacle pushes along its normal by k (e + relaxation de/dt) per
    length, e the depth with a soft beginning: with width = softness D it is depth^2/(2 width) up
    to the width, depth - width/2 beyond it. Friction acts where the surfaces touch, D/2 from
    the centreline, and so turns the rod.

    It acts at the nodes, and at points between them if you say so: their distance must be short
    beside the obstacle's curvature. What is thinner comes between two of them; where it then is
    inside the rod and more than twice as deep as they see, a run fails (OBSTACLE_PASSED).

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
        points_per_element: k: it acts at the nodes and at k - 1 points of every element between
            them, in a straight line. For what is thinner than an element; costs more per step
            than 1, the nodes alone.
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
    points_per_element: int = eqx.field(static=True, default=1)
    memory: Anchors | None = eqx.field(default=None, repr=False)
    dual: Dual | None = eqx.field(default=None, repr=False)

    def __check_init__(self):
        check_instance(AbstractShape, "give a shape such as Plane()", shape=self.shape)
        numbers = {"stiffness": self.stiffness, "softness": self.softness}
        check_scalar(relaxation=self.relaxation, **numbers)
        check_positive(**numbers)
        check_not_negative(relaxation=self.relaxation)
        check_flag(suction=self.suction)
        check_integer(1, 1000, points_per_element=self.points_per_element)
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
            obstacle_passages.check_outside(self.shape, self._points(rod))

    @property
    def role(self):
        return Role.CONTACT

    @property
    def may_hold(self):
        return True

    @property
    def between_nodes(self):
        return self.points_per_element > 1

    @property
    def schedules(self):
        return given(displacement=self.displacement)

    @property
    def remembers(self):
        return self.friction is not None and self.friction.remembers

    def _points(self, rod: Rod) -> ElementPoints:
        """Where it acts on a rod."""
        return ElementPoints(rod, self.points_per_element)

    def _relative(self, motion: NodeMotion) -> tuple[Float[Array, "nodes 3"], ...]:
        """Positions and velocities of the nodes as the obstacle sees them."""
        if self.displacement is None:
            return motion.position, motion.velocity
        second = jnp.ones_like(motion.time)
        shift, rate = jax.jvp(self.displacement, (motion.time,), (second,))
        return motion.position - shift[None], motion.velocity - rate[None]

    def touch(self, rod: Rod, motion: NodeMotion) -> Touch:
        """How the points touch it."""
        points, (place, velocity) = self._points(rod), self._relative(motion)
        at = points.at(place)
        distance, normal = jax.vmap(self.shape.distance_and_normal)(at)
        velocity, radius = points.at(velocity), points.radius
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
        rubbing = self._rubbing(points, motion, place, velocity, normal, arm, load)
        return Touch(gap, normal, arm, elastic, load, rubbing)

    def _rubbing(
        self, points: ElementPoints, motion: NodeMotion, place, velocity, normal, arm, load
    ) -> Rubbing:
        """What friction sees of the points; `place` is of the nodes."""
        tangential = lambda v: v - jnp.sum(v * normal, 1, keepdims=True) * normal
        spin = points.at(rotations.rotate(motion.quaternion, motion.angular_velocity))
        velocity = tangential(velocity + jnp.cross(spin, arm))
        stretch = jnp.zeros_like(velocity)
        if self.memory is not None:
            before = rotations.conjugate(self.memory.quaternion)
            half = rotations.multiply(motion.quaternion, before)[:, 1:]
            # the rotation vector but for its fifth power, at less than half of its cost
            turn = half * (2.0 + jnp.sum(half**2, 1, keepdims=True) / 3.0)
            moved = points.at(place - self.memory.place) + jnp.cross(points.at(turn), arm)
            stretch = tangential(self.memory.stretch + moved)
        load = jnp.maximum(load, 0.0)
        dual = None if self.dual is None else self.dual.estimate
        return Rubbing(load, self.stiffness, velocity, stretch, dual)

    def wrench(self, rod, motion):
        touch, points = self.touch(rod, motion), self._points(rod)
        length = points.length[:, None]
        force = points.to_nodes(length * touch.load[:, None] * touch.normal)
        if self.friction is None:
            return jnp.concatenate([force, jnp.zeros_like(force)], 1)
        return self._rubbed(rod, motion, touch) + jnp.concatenate([force, jnp.zeros_like(force)], 1)

    def _rubbed(self, rod: Rod, motion: NodeMotion, touch: Touch) -> Float[Array, "nodes 6"]:
        """Wrenches of friction."""
        assert self.friction is not None
        points = self._points(rod)
        force = points.length[:, None] * self.friction.traction(touch.rubbing)
        couple = points.to_nodes(jnp.cross(touch.arm, force))
        moment = rotations.rotate_inverse(motion.quaternion, couple)
        return jnp.concatenate([points.to_nodes(force), moment], 1)

    def contact(self, rod: Rod, motion: NodeMotion) -> ObstacleContact:
        """What passes between it and the nodes."""
        touch, points = self.touch(rod, motion), self._points(rod)
        normal, friction = points.length * touch.load, jnp.zeros_like(motion.position)
        touches = touch.rubbing.load > 0
        holds = jnp.zeros_like(touches)
        if self.friction is not None:
            traction = self.friction.traction(touch.rubbing)
            friction = points.to_nodes(points.length[:, None] * traction)
            most = _AT_LIMIT * self.friction.coefficient * touch.rubbing.load
            holds = jnp.sqrt(jnp.sum(traction**2, 1)) < most
            holds = holds & self.friction.remembers
        normal = points.to_nodes(normal[:, None])[:, 0]
        nodes = slice(rod.elements + 1)  # the first of the points
        slip = touch.rubbing.velocity[nodes]
        sticks, slides = (touches & holds)[nodes], (touches & ~holds)[nodes]
        return ObstacleContact(touch.gap[nodes], normal, friction, slip, sticks, slides)

    def energy(self, rod, motion):
        touch, points = self.touch(rod, motion), self._points(rod)
        radius = points.radius
        depth, width = jnp.maximum(-touch.gap, 0.0), 2 * self.softness * radius
        beyond = jnp.maximum(depth - width, 0.0)
        soft = jnp.minimum(depth, width) ** 3 / (6 * width)
        density = self.stiffness * (soft + 0.5 * beyond * (beyond + width))
        if self.friction is not None:
            density = density + self.friction.stored(touch.rubbing)
        return jnp.sum(points.length * density)

    def lost(self, rod, motion, found, exerted):
        touch, points = self.touch(rod, motion), self._points(rod)
        length = points.length[:, None]
        damping = points.to_nodes(length * (touch.load - touch.elastic)[:, None] * touch.normal)
        lost = jnp.concatenate([damping, jnp.zeros_like(damping)], 1)
        if self.friction is None or self.friction.remembers:  # what slips is in the memory
            return lost
        return lost + self._rubbed(rod, motion, touch)

    def first_memory(self, rod, motion):
        if not self.remembers:
            return None
        place = self._relative(motion)[0]
        none = jnp.zeros_like(self._points(rod).at(place))
        return Anchors(place, motion.quaternion, none, none[:, 0])

    def next_memory(self, rod, motion):
        if self.friction is None or self.memory is None:
            return None
        rubbing, before = self.touch(rod, motion).rubbing, self.memory
        lost = self._points(rod).length * self.friction.slipped(rubbing, before.stretch)
        place, stretch = self._relative(motion)[0], self.friction.stretch(rubbing)
        return Anchors(place, motion.quaternion, stretch, before.lost + lost)

    @property
    def rubs(self):
        return self.friction is not None

    def first_dual(self, rod, motion, found, before):
        friction = self.friction
        if friction is None:
            return None
        dual = lambda motion: friction.dual(self.touch(rod, motion).rubbing)
        return dual(motion) if before is None else continued(dual(before), dual(motion))

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

    def displaced(self, time):
        return None if self.displacement is None else self.displacement(time)

    def held_at(self, time):
        if self.displacement is None:
            return self
        shift = Constant(self.displacement(time))
        return eqx.tree_at(lambda one: one.displacement, self, shift)

    def _shift(self, dtype) -> Float[Array, "3"]:
        """By how much it is moved, held at a time."""
        shift = self.displaced(jnp.zeros(()))
        return jnp.zeros(3, dtype) if shift is None else shift.astype(dtype)

    def _apart(self, position: Float[Array, "points 3"]) -> Float[Array, " points"]:
        """Distances of points from the surface of what is held at a time."""
        return jax.vmap(self.shape.distance)(position - self._shift(position.dtype)[None])

    def safe_fraction(self, rod, position, change, found):
        points = self._points(rod)
        own = lambda rows: points.of_rods(points.at(rows))
        radius = points.of_rods(points.radius)
        return obstacle_passages.safe_fraction(self._apart, own(position), own(change), radius)

    def verdict(self, rod, before, after, found):
        """Whether a point went through the obstacle, or half a diameter into it at once, or it
        came between points.
        """
        return self._told(obstacle_passages.passed, rod, before, after)

    def path_verdict(self, rod, before, after):
        """Whether the obstacle came between points, which do not feel it there, or a point came
        through it.
        """
        if self.shape.convex_room:
            return None
        return self._told(obstacle_passages.jumped, rod, before, after)

    def _told(self, passed: Callable, rod: Rod, before, after) -> Int[Array, ""]:
        """The code of a step between these positions, by what is asked of the points' ways."""
        fixed, rod, before, after = newton.constant((self, rod, before, after))
        shape, points, shift = fixed.shape, fixed._points(rod), fixed._shift(before.dtype)[None]
        before, after = before - shift, after - shift
        own = lambda rows: points.of_rods(points.at(rows))
        ways = obstacle_passages.Ways(own(before), own(after), points.of_rods(points.radius))
        told = passed(shape, ways)
        if not shape.convex_room:
            looked = shape.distance_and_normal
            between = obstacle_passages.between_points(looked, points, before, after)
            told = told | jnp.any(between.lacking < 0)
            told = told | obstacle_passages.came_through(looked, ways)
        return jnp.where(told, Result.OBSTACLE_PASSED, Result.SUCCESS)
