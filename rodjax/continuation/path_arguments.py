"""What functions of paths are given, checked before anything is compiled."""

from collections.abc import Mapping
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rodjax.continuation.family import Family, function_of
from rodjax.equations.rigid_motions import check_held
from rodjax.inputs.user_functions import check_function
from rodjax.inputs.validation import all_known, check_finite, check_integer, check_positive
from rodjax.rods.state import State
from rodjax.scenes.arguments import check_motion
from rodjax.scenes.scene import Scene


class Bounds(NamedTuple):
    """Values of the parameter."""

    start: float
    stop: float
    unit: float


class Settings(NamedTuple):
    """How a path is walked."""

    points: int
    first_step: float
    longest_step: float
    modes: int
    targets: dict[str, float]


def check_bounds(start, stop, unit) -> Bounds:
    """Raise ValueError unless these are two values and a unit."""
    check_finite(start=start, stop=stop)
    start, stop = float(start), float(stop)
    if start == stop:
        raise ValueError(f"stop: must differ from start, both are {start:g}")
    unit = abs(stop - start) if unit is None else unit
    check_positive(unit=unit)
    return Bounds(start, stop, float(unit))


def check_settings(points, first_step, longest_step, modes, measures, targets) -> Settings:
    """Raise ValueError unless these fit each other."""
    check_integer(2, points=points)
    check_integer(3, 40, modes=modes)
    check_positive(first_step=first_step, longest_step=longest_step)
    for name, given in (("measures", measures), ("targets", targets)):
        if given is not None and not isinstance(given, Mapping):
            raise ValueError(f"{name}: give a dictionary by name, got {given!r}")
    for name, measure in (measures or {}).items():
        check_function(**{f"measures[{name!r}]": measure})
    for name in targets or {}:
        if name not in (measures or {}):
            raise ValueError(f"targets[{name!r}]: is none of the measures; name it there too")
    values = {name: float(value) for name, value in (targets or {}).items()}
    first = min(float(first_step), float(longest_step))
    return Settings(int(points), first, float(longest_step), int(modes), values)


def checked_family(scene_of, state: State, start: float | Float[Array, "2"]) -> Family:
    """The family, of scenes that have paths of equilibria.

    Raises:
        ValueError: they have none, or the function gives no scenes.
    """
    scene_of = function_of(scene_of)
    if not callable(scene_of):
        raise ValueError(
            "scene_of: give a function of the parameter that returns a Scene, or a Scene whose"
            " schedules' time is the parameter"
        )
    family = Family(scene_of, state)
    found = scene_of(jnp.asarray(start, state.position.dtype))
    scene = found[0] if isinstance(found, tuple) and len(found) == 2 else found
    if not isinstance(scene, Scene):
        raise ValueError(
            f"scene_of: must return a Scene, or a Scene and a time, got {type(scene).__name__}"
        )
    check_motion(scene, state)
    if scene.remembers or scene.rubs:
        raise ValueError(
            "scene_of: what a material or friction remembers makes rest depend on how it was"
            " reached, so there is no path of equilibria; take memory and friction out, or follow"
            " a load path by rx.equilibrium"
        )
    if not all_known(state.position) or not np.all(np.isfinite(np.asarray(state.position))):
        raise ValueError("state: must hold numbers, outside traced code")
    check_held(scene, state, spin_free=True)
    return family
