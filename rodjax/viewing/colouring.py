"""What the tubes of a view are coloured by: measures of elements and nodes, by name."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from rodjax.dynamics.coarseness import turns_of_elements
from rodjax.inputs.units import Units
from rodjax.interactions.roles import Role
from rodjax.measuring import energy
from rodjax.measuring.blocks import over_states
from rodjax.rods.state import State, node_motion
from rodjax.scenes.scene import Scene


class Measure(NamedTuple):
    """A measure of all elements or nodes at all times.

    Attributes:
        name: under which it is chosen.
        unit: its name.
        scale: "linear", "log", or "signed" about zero.
        values: a row a state.
    """

    name: str
    unit: str
    scale: str
    values: Float[np.ndarray, "k n"]


class _Kind(NamedTuple):
    unit: str  # a template in the fields of `Units`
    scale: str
    values: Callable[[Scene, State], np.ndarray]


def _turn_rates(scene: Scene, states: State) -> np.ndarray:
    length = np.asarray(scene.rod.gauge_length)[None, :, None]
    turns = turns_of_elements(np.asarray(states.quaternion))
    # so that rounding is not spread over the colours where nothing turns
    return np.where(np.abs(turns) < 1e3 * np.finfo(turns.dtype).eps, 0.0, turns) / length


@over_states
def _energy_density(state: State, scene: Scene):
    return energy.strain_energy_density(scene.rod, state)


@over_states
def _contact_force(state: State, scene: Scene):
    scene = scene.recalling(state.memory)
    motion, found = node_motion(state), scene.find(state.position)
    force = jnp.zeros_like(state.position)
    for one, its in zip(scene.interactions, found.each, strict=True):
        if one.role is Role.CONTACT:
            force = force + one.exerted(scene.rod, motion, its)[:, :3]
    return jnp.sqrt(jnp.sum(force**2, 1)) / scene.rod.node_length


_KINDS = {
    "strain energy density": _Kind(
        "{energy}/{length}", "log", lambda scene, states: _energy_density(states, scene)
    ),
    "curvature": _Kind(
        "rad/{length}",
        "linear",
        lambda scene, states: np.linalg.norm(_turn_rates(scene, states)[..., :2], axis=-1),
    ),
    "twist": _Kind(
        "rad/{length}", "signed", lambda scene, states: _turn_rates(scene, states)[..., 2]
    ),
    "tension": _Kind("{force}", "signed", lambda scene, states: np.asarray(states.force)[..., 2]),
    "contact force": _Kind(
        "{force}/{length}", "linear", lambda scene, states: _contact_force(states, scene)
    ),
    "speed": _Kind(
        "{length}/{time}",
        "linear",
        lambda scene, states: np.linalg.norm(np.asarray(states.rate)[..., :3], axis=-1),
    ),
}


def names_of(scene: Scene) -> list[str]:
    """What there is to measure of a scene; contact forces only where something may touch."""
    touches = any(one.role is Role.CONTACT for one in scene.interactions)
    return [name for name in _KINDS if touches or name != "contact force"]


def measures_of(
    scene: Scene, states: State, units: Units, only: Sequence[str] | None = None
) -> list[Measure]:
    """All of them, or only those of these names, of stacked states."""
    names = units._asdict() | {"energy": units.energy}
    found = []
    for name in names_of(scene) if only is None else only:
        kind = _KINDS[name]
        values = np.array(kind.values(scene, states), float)
        if values.shape[1] == scene.rod.elements:
            values[:, list(scene.rod.breaks)] = np.nan
        found.append(Measure(name, kind.unit.format(**names), kind.scale, values))
    return found


def bounds(measure: Measure) -> tuple[float, float]:
    """From which value to which colours go; of a logarithmic scale their logarithms."""
    known = measure.values[np.isfinite(measure.values)]
    top, bottom = np.max(known, initial=0.0), np.min(known, initial=0.0)
    if measure.scale == "signed":
        most = max(top, -bottom) or 1.0
        return -most, most
    if measure.scale == "log":
        top = top or 1.0  # of unstrained rods any scale will do
        least = np.min(known, initial=top)
        return tuple(np.log10([min(max(least, 1e-3 * top), 0.3 * top), top]).tolist())
    if known.size and np.min(known) > 0:
        bottom = np.min(known)
    if not top - bottom > 1e-9 * max(abs(top), abs(bottom)):  # all of one value
        bottom, top = min(0.0, bottom), max(top, 0.0)
    return float(bottom), float(top if top > bottom else bottom + 1.0)


def scaled(measure: Measure) -> np.ndarray:
    """The values as they are spread over the colours."""
    if measure.scale != "log":
        return measure.values
    low, _ = bounds(measure)
    with np.errstate(invalid="ignore"):
        return np.log10(np.maximum(measure.values, 10.0**low))


def _mixed(*stops: str) -> list[list[int]]:
    """Red, green and blue of colours as pages write them."""
    return [[int(stop[i : i + 2], 16) for i in (0, 2, 4)] for stop in stops]


# viridis without its darkest fifth, on which a black stripe would not show; a diverging map that is
# light in the middle
_VIRIDIS = "414487", "355f8d", "2a788e", "21918c", "22a884", "44bf70", "7ad151", "bddf26", "fde725"
_DIVERGING = "3b4cc0", "6f92f3", "aac7fd", "dddddd", "f7b89c", "e7745b", "b40426"
COLOURS = {"one": _mixed(*_VIRIDIS), "signed": _mixed(*_DIVERGING)}
