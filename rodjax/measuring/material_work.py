"""What actuation puts into a rod between two states, and what its material loses."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.numerics import rotations
from rodjax.rods import balance
from rodjax.rods.constitution import internal_moment, natural_curvature, seen_by_material
from rodjax.rods.material import ElementMotion
from rodjax.rods.rod import Rod
from rodjax.rods.state import State, node_motion
from rodjax.rods.strains import element_rotation, strains


class MaterialWork(NamedTuple):
    """Between two states [J]."""

    actuation: Float[Array, ""]  # done by what changes kappa0
    lost: Float[Array, ""]  # to the material


def booked(rod: Rod) -> bool:
    """Whether a rod has work of this kind."""
    return rod.material is not None or rod.actuation is not None


def material_work(rod: Rod, before: State, after: State) -> MaterialWork:
    """Means of both states times what changes between them: second order in the time between."""
    return MaterialWork(_actuation(rod, before, after), _lost(rod, before, after))


def _actuation(rod: Rod, before: State, after: State) -> Float[Array, ""]:
    """The work of what changes kappa0, and of time in a material."""
    work = jnp.sum(rod.length * _driven(rod, before, after))
    if rod.torque_per_tension is None or rod.actuation is None:
        return work
    twist = natural_curvature(rod, after.time) - natural_curvature(rod, before.time)
    # the force does the work that its strain asks for; where something gives it is stored there
    moved = rod.torque_per_tension * twist[:, 2]
    force = 0.5 * (_force(rod, before) + _force(rod, after))
    return work - jnp.sum(rod.length * force * moved)


def _driven(rod: Rod, before: State, after: State) -> Float[Array, " n"]:
    if rod.material is not None:
        return rod.material.forgetting.driven(_seen(rod, before), _seen(rod, after))
    natural = [natural_curvature(rod, state.time) for state in (before, after)]
    turned = lambda state: rotations.logarithm(element_rotation(rod, state.quaternion))
    both = (before, after)
    moments = [internal_moment(rod, turned(state), node_motion(state)) for state in both]
    return -0.5 * jnp.sum((moments[0] + moments[1]) * (natural[1] - natural[0]), 1)


def _force(rod: Rod, state: State) -> Float[Array, " n"]:
    """The tension that is not lost to damping [N]."""
    if balance.stretch_time(rod) is None:
        return state.force[:, 2]
    return (state.force - _lost_force(rod, state))[:, 2]


def _lost(rod: Rod, before: State, after: State) -> Float[Array, ""]:
    """The work of what the stored energy does not account for."""
    if rod.material is None:
        return jnp.zeros_like(before.time)
    material = rod.material.forgetting
    lost = jnp.sum(rod.length * material.lost(_seen(rod, before), _seen(rod, after)))
    if balance.stretch_time(rod) is None:
        return lost
    gained = _force_strain(rod, after) - _force_strain(rod, before)
    both = _lost_force(rod, before) + _lost_force(rod, after)
    return lost + 0.5 * jnp.sum(rod.length[:, None] * both * gained)


def _seen(rod: Rod, state: State) -> ElementMotion:
    """What the material sees of a state, with what it remembers there."""
    memory = None if state.memory is None else state.memory.material
    return seen_by_material(rod, node_motion(state))._replace(memory=memory)


def _force_strain(rod: Rod, state: State) -> Float[Array, "n 3"]:
    kinematics = strains(rod, state.position, state.quaternion)
    return balance.force_strain(rod, kinematics, node_motion(state))


def _lost_force(rod: Rod, state: State) -> Float[Array, "n 3"]:
    """The part of f that resists the rate of stretch [N]."""
    time, compliance = balance.stretch_time(rod), rod.compliance
    assert time is not None and compliance is not None
    kinematics = strains(rod, state.position, state.quaternion)
    rate = balance.force_strain_rate(rod, kinematics, node_motion(state))
    return jnp.where(compliance > 0, time * rate / jnp.where(compliance > 0, compliance, 1.0), 0.0)
