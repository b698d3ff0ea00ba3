"""What the next step needs to know, and nothing else; and what loads see of it."""

from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from rodjax.numerics import rotations


class Memory(NamedTuple):
    """What is remembered of the motion up to an accepted step.

    Attributes:
        loads: by each of the scene's loads, None by one that forgets.
        material: by the rod's material; None where it forgets.
    """

    loads: tuple[Any, ...] = ()
    material: Any = None


class State(eqx.Module):
    """Motion of the rod at one time.

    `rate` holds v in inertial and omega in body components, `acceleration` their derivatives,
    `auxiliary` the algorithmic acceleration of generalised-alpha, `force` the internal force f
    in the element frames. `settling` counts the steps still to be damped most after a constraint
    began (None in scenes whose constraints never change). `jerk` is the part of V'' that the
    constraints demand, where a start made the state, and zero after every step: with it the first
    step begins as generalised-alpha needs (None: do without, as a rod without inertia does).

    Attributes:
        time: [s].
        position: nodes in inertial components [m].
        quaternion: frames of the nodes, unit, scalar first, body to inertial.
        rate: (v1, v2, v3, omega1, omega2, omega3) [m/s, rad/s].
        acceleration, auxiliary, jerk: rates of those [m/s^2, rad/s^2; m/s^3, rad/s^3].
        force: (f1, f2, f3) of the elements, f3 along the tangent, tension positive [N].
        settling: a count of steps.
        memory: what loads and material remember; None in scenes where nothing does.
        joints: of each joint of the scene the force (inertial) and moment that it exerts on its
            first point [N, N m], see `constraints.joints`; None without joints.
        breaks: of several rods the elements that are none, see `Rod.breaks` and `states_of`.

    Example:
        >>> state = run.final
        >>> state.position.shape, state.rate.shape, state.force.shape
        ((21, 3), (21, 6), (20, 3))
    """

    time: Float[Array, ""]
    position: Float[Array, "nodes 3"]
    quaternion: Float[Array, "nodes 4"]
    rate: Float[Array, "nodes 6"]
    acceleration: Float[Array, "nodes 6"]
    auxiliary: Float[Array, "nodes 6"]
    force: Float[Array, "n 3"]
    settling: Int[Array, ""] | None = None
    jerk: Float[Array, "nodes 6"] | None = None
    memory: Memory | None = None
    joints: Float[Array, "j 6"] | None = None
    breaks: tuple[int, ...] = eqx.field(static=True, default=())

    @property
    def velocity(self) -> Float[Array, "... nodes 3"]:
        """v in inertial components [m/s]; of stacked states, those of a run, all of them."""
        return self.rate[..., :3]

    @property
    def angular_velocity(self) -> Float[Array, "... nodes 3"]:
        """omega in body components [rad/s]."""
        return self.rate[..., 3:]


class NodeMotion(NamedTuple):
    """Configuration and rates of the nodes that a load sees.

    Attributes:
        time: [s].
        position: (n+1, 3), inertial components [m].
        quaternion: (n+1, 4), real part first: frames of the nodes, body to inertial.
        velocity: (n+1, 3), inertial components [m/s].
        angular_velocity: (n+1, 3), body components [rad/s].
    """

    time: Float[Array, ""]
    position: Float[Array, "nodes 3"]
    quaternion: Float[Array, "nodes 4"]
    velocity: Float[Array, "nodes 3"]
    angular_velocity: Float[Array, "nodes 3"]


def node_motion(state: State) -> NodeMotion:
    """What loads see of a state."""
    return NodeMotion(
        state.time, state.position, state.quaternion, state.velocity, state.angular_velocity
    )


class Moving(NamedTuple):
    """Accelerations of the nodes, and how rates follow their increments in a step."""

    acceleration: Float[Array, "nodes 6"]
    turn: Float[Array, "nodes 3"]  # rotation vector; its increment for a spin d is J(turn)^-1 d
    by_velocity: Float[Array, ""]  # [1/s]
    by_acceleration: Float[Array, ""]  # [1/s^2]


def at_rest(time, position, quaternion) -> NodeMotion:
    """Nodes without velocity."""
    zero = jnp.zeros_like(position)
    return NodeMotion(time, position, quaternion, zero, zero)


def moved(motion: NodeMotion, z: Float[Array, "nodes 6"]) -> NodeMotion:
    """The motion displaced by z: displacements and body spins."""
    turned = rotations.multiply(motion.quaternion, rotations.exponential(z[:, 3:]))
    return motion._replace(position=motion.position + z[:, :3], quaternion=turned)
