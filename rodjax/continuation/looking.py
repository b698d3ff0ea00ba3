"""What is found at every point of a path: modes, energy, reactions, measures of the user's."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from rodjax.continuation.family import Family, Parameter, Place
from rodjax.continuation.near_modes import Motions, NearModes, near_modes
from rodjax.equilibria.motion_norms import moving_weight
from rodjax.equilibria.unstable_modes import count_below, neutral
from rodjax.inputs.user_functions import called
from rodjax.interactions.roles import Role
from rodjax.measuring.energies import stored, strain_energy_density
from rodjax.measuring.reactions import Reactions, reactions
from rodjax.numerics.compilation import compiled
from rodjax.rods.state import State


class Look(NamedTuple):
    """What was found.

    Attributes:
        level: below which an eigenvalue is that of a motion that costs no energy [N].
    """

    state: State
    unstable: Int[Array, ""]
    near: NearModes
    level: Float[Array, ""]
    energy: Float[Array, ""]
    reactions: Reactions
    measures: dict[str, Any]


def look(
    family: Family,
    parameter: Parameter,
    place: Place,
    first: Motions,
    measures: dict[str, Callable],
) -> Look:
    """At an equilibrium; `first` is what modes are looked for from."""
    near = near_modes(family, parameter, place, first)
    state, unstable, level, energy, held = _look(family, parameter, place)
    named = _measured(family, parameter, state, measures) if measures else {}
    return Look(state, unstable, near, level, energy, held, named)


@compiled
def _measured(family: Family, parameter: Parameter, state: State, measures: dict[str, Callable]):
    """In one program: by itself, what has functions in it is compiled at each call."""
    scene = family.at(parameter)[0]
    return {
        name: called(f"measures[{name!r}]", measure, scene, state)
        for name, measure in measures.items()
    }


@compiled
def _look(family: Family, parameter: Parameter, place: Place):
    equations = family.equations(parameter, place)
    scene, x = equations.scene, family.guess(parameter, place)
    state = family.state(parameter, place)
    least = neutral(scene, state.force)
    unstable = count_below(equations, x, (least * moving_weight(scene))[None], 1)[0]
    energy = jnp.sum(scene.rod.length * strain_energy_density(scene.rod, state))
    for role in (Role.STORED, Role.CONTACT):
        energy = energy + stored(scene, state, role)
    return state, unstable, least, energy, reactions(scene, state)
