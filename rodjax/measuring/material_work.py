"""What actuation puts into a rod between two states, and what its material loses."""

import dataclasses
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.measuring.energies import strain_energy
from rodjax.rods import balance
from rodjax.rods.constitution import natural_curvature, seen_by_material
from rodjax.rods.material import ElementMotion
from rodjax.rods.rod import Rod
from rodjax.rods.state import State, node_motion
from rodjax.rods.strains import strains


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
    """What the stored energy gains by kappa0, and by time in a material, at the strain held."""
    at = lambda state, time: strain_energy(rod, dataclasses.replace(state, time=time))
    gain = lambda state: at(state, after.time) - at(state, before.time)
    work = 0.5 * (gain(before) + gain(after))
    if rod.torque_per_tension is None or rod.actuation is None:
        return work
    # where nothing gives, the force does the work that the constraint asks for
    twist = natural_curvature(rod, after.time) - natural_curvature(rod, before.time)
    rigid = jnp.ones_like(rod.length)
    if rod.compliance is not None:
        rigid = jnp.where(rod.compliance[:, 2] > 0, 0.0, 1.0)
    force = 0.5 * (before.force[:, 2] + after.force[:, 2])
    moved = rigid * rod.torque_per_tension * twist[:, 2]
    return work - jnp.sum(rod.length * force * moved)


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
