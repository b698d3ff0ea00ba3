"""How a rod touches an obstacle: at the points where it acts, and as is told of its nodes."""

from typing import NamedTuple

from jaxtyping import Array, Bool, Float

from rodjax.interactions.friction import Rubbing


class Touch(NamedTuple):
    """How points of a rod touch an obstacle.

    Attributes:
        gap: between the surfaces [m], negative where they are in each other.
        normal: of the obstacle.
        arm: from the centreline to the surfaces' point of contact [m].
        elastic: normal force per length without damping [N/m].
        load: with it [N/m].
        rubbing: what friction sees.
    """

    gap: Float[Array, " points"]
    normal: Float[Array, "points 3"]
    arm: Float[Array, "points 3"]
    elastic: Float[Array, " points"]
    load: Float[Array, " points"]
    rubbing: Rubbing


class ObstacleContact(NamedTuple):
    """What passes between the nodes and an obstacle, see `measures.obstacle_contact`.

    Forces on points between nodes are shared out to these; all else is at the nodes themselves.

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
