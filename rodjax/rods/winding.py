"""Twist and writhe of states: those of `topology`, with the frames of a rod's ends."""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from rodjax.numerics import rotations
from rodjax.rods import topology
from rodjax.rods.chain import alone
from rodjax.rods.state import State
from rodjax.rods.strains import element_quaternions

# Length of that edge over the shortest of the polygon.
_EDGE = 1e-5


def twist(state: State) -> Float[Array, ""]:
    """Twist of a state between the frames of its ends [turns]: Tw of Tw + Wr = Lk.

    That of the polygon of nodes.

    Right as long as no element is twisted by a revolution (a step refuses 0.9 of one).
    """
    alone(state, "twist")
    return topology.twist(
        state.position,
        element_quaternions(state.quaternion),
        start_frame=state.quaternion[0],
        end_frame=state.quaternion[-1],
        signed=True,
    )


def writhe(state: State, extension: Float[Array, ""] | float | None = None) -> Float[Array, ""]:
    """Writhe of a state extended straight along its end tangents, by `extension` [m] if finite.

    See `topology.writhe`.
    """
    alone(state, "writhe")
    return topology.writhe(
        state.position,
        extension=extension,
        start_direction=rotations.tangent_director(state.quaternion[0]),
        end_direction=rotations.tangent_director(state.quaternion[-1]),
    )


def writhe_of(
    closed: bool | Bool[Array, ""],
    state: State,
    extension: Float[Array, ""] | float | None = None,
) -> Float[Array, ""]:
    """Writhe of a state: of the closed line of a ring, else extended straight at both ends [-].

    Args:
        closed: whether the state is one of a ring, as `scene.closed` tells.
        state: one state.
        extension: that of `topology.writhe` [m], without meaning for a ring.
    """
    if closed is False:
        return writhe(state, extension)

    def ring():
        # a short edge along the tangent where the ends meet, which the twist begins and ends with
        inner = state.position[1:-1]
        edges = jnp.diff(state.position, axis=0)
        short = _EDGE * jnp.min(jnp.sqrt(jnp.sum(edges**2, 1)))
        along = short * rotations.tangent_director(state.quaternion[0])
        junction = state.position[:1] + jnp.stack([-along, along])
        return topology.writhe(jnp.concatenate([junction[1:], inner, junction[:1]]), closed=True)

    return lax.cond(closed, ring, lambda: writhe(state, extension))
