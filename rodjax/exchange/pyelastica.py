"""Motions that PyElastica computed, as scenes and runs to look at and to measure."""

import dataclasses
import os
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from rodjax.dynamics.coarseness import turns_of_elements
from rodjax.dynamics.run import Run, of_states
from rodjax.exchange.elastica_files import collected
from rodjax.exchange.node_frames import node_frames
from rodjax.inputs.units import SI, Units
from rodjax.inputs.validation import check_flag
from rodjax.numerics.results import ModelWarning
from rodjax.rods.builders import build_rod
from rodjax.rods.rod import Rod
from rodjax.rods.section import Section
from rodjax.rods.state import State
from rodjax.scenes.scene import Scene


class Motion(NamedTuple):
    """A motion that another program computed; `view`, `picture` and `to_csv` take it as it is.

    Attributes:
        scene: the rod, without what held or loaded it.
        run: its states, and no steps between them.
        report: what was not in the source, and what stands for it, a line each.
        units: names of the units.

    Example:
        >>> motion = rx.from_pyelastica("rod_00.npz", section)  # doctest: +SKIP
        >>> print(*motion.report)  # doctest: +SKIP
    """

    scene: Scene
    run: Run
    report: tuple[str, ...]
    units: Units

    def __repr__(self) -> str:
        return f"Motion({len(self.run.times)} states of {self.scene.rod.elements} elements)"

    def __str__(self) -> str:
        return "\n".join([repr(self), *(f"  {line}" for line in self.report)])


def from_pyelastica(
    source: str | os.PathLike | Mapping[str, Any] | Sequence,
    section: Section | Callable[[np.ndarray], Section] | None = None,
    *,
    rest_lengths: Any = None,
    stress_free: bool = False,
    units: Units = SI,
) -> Motion:
    """A motion out of what a callback of PyElastica collected.

    How things are called there, at t times and of n elements, and what becomes of them:

    - "time" (t,), "position" and "velocity" (t, 3, n+1) of the nodes: axes change places.
    - "directors" (t, 3, 3, n): of every element the matrix Q from inertial to body axes, whose rows
      d1, d2, d3 are the directors, d3 along the rod. They are the columns a_1, a_2, a_3 of the
      frames here, R = Q^T. PyElastica has frames on elements, rodjax on nodes: those of the nodes
      are the smooth ones between which those of the elements are halfway, see `node_frames`.
    - curvatures have the same signs, components and meaning; theirs are at inner nodes.
    - "omega" (t, 3, n), of the elements in body axes: the mean of two elements at a node.
    - "radius" (t, n): of the first state, the rod's where the section has no diameter.
    - "lengths" and "dilatation" (t, n): rest lengths are lengths/dilatation; without them the
      lengths of the first state.
    - forces: of a section with compliance, f = (gamma - e3)/compliance of the strain.

    What is not in the source, as velocities, is NaN in the states; so are accelerations. To go on
    with such a motion begin anew, `rx.start(scene, velocity=...)`.

    Args:
        source: the dictionary, the path of a file of it (.npz, .pkl), or several of them, one after
            the other. Pickles are read as arrays alone: nothing in them is run.
        section: of the rod; the source has no stiffness and no mass. Default: 1 for both, with a
            ModelWarning, since energies are then without meaning.
        rest_lengths: (n,) of the elements [m].
        stress_free: whether the first state is the shape at rest; else the rod is straight at rest.
        units: names of the units.

    Raises:
        ValueError: something is missing or of another shape, or the directors are no frames along
            the rod.
        FileNotFoundError: there is no such file.

    Example:
        >>> soft = rx.circular_section(0.04, 1e6, 3.6e5, 1000.0, extensible=True)
        >>> motion = rx.from_pyelastica("rod_00.npz", soft)  # doctest: +SKIP
        >>> shown = rx.view(motion)  # doctest: +SKIP
    """
    check_flag(stress_free=stress_free)
    data, report = collected(source), []
    _check(data)
    position = np.moveaxis(data["position"], 1, 2)
    matrices = np.moveaxis(data["directors"], -1, 1)  # rows are the directors
    length = _rest_lengths(data, position, rest_lengths, report)
    count, n = matrices.shape[:2]
    turned = Rotation.from_matrix(np.swapaxes(matrices, -1, -2).reshape(-1, 3, 3))
    element_frames = turned.as_quat(scalar_first=True).reshape(count, n, 4)
    quaternion = node_frames(element_frames, length)
    rod = _rod(data, position[0], quaternion[0], length, section, stress_free, report)
    rates, forces = _rates(data, report), _forces(rod, position, matrices, length, report)
    states = _states(data["time"], position, quaternion, rates, forces)
    return Motion(Scene(rod), of_states(states), tuple(report), units)


def _check(data: dict[str, np.ndarray]) -> None:
    """Raise ValueError unless these are positions and directors of one rod at these times."""
    time, position, directors = data["time"], data["position"], data["directors"]
    count, n = len(time), directors.shape[-1]
    if time.ndim != 1 or directors.shape != (count, 3, 3, n) or n < 2:
        raise ValueError(
            "source: directors must have shape (times, 3, 3, elements), as a CosseratRod's"
            f" director_collection; got {directors.shape} at {count} times"
        )
    if position.shape == (count, 3, n):
        raise ValueError(
            "source: it is a closed rod (as many nodes as elements), which is not read"
        )
    shapes = {"position": (count, 3, n + 1), "velocity": (count, 3, n + 1), "omega": (count, 3, n)}
    shapes |= {name: (count, n) for name in ("radius", "lengths", "dilatation")}
    for name, shape in shapes.items():
        if name in data and data[name].shape != shape:
            raise ValueError(
                f"source: {name} must have shape {shape} beside these directors, got"
                f" {data[name].shape}"
            )
    whole = np.all(np.isfinite(position), (1, 2)) & np.all(np.isfinite(directors), (1, 2, 3))
    if not np.all(whole):
        first = int(np.argmin(whole))
        raise ValueError(
            f"source: no numbers from t = {time[first]:g} on (its run failed); leave those out, as"
            f" {{name: values[:{first}] for name, values in data.items()}}"
        )
    matrices = np.moveaxis(directors, -1, 1)
    off = np.max(np.abs(matrices @ np.swapaxes(matrices, -1, -2) - np.eye(3)))
    if off > 1e-4 or np.min(np.linalg.det(matrices)) < 0:
        raise ValueError(f"source: directors are no right-handed frames (off by {off:.2g})")
    edge = np.diff(np.moveaxis(position, 1, 2), axis=1)
    along = np.sum(edge * matrices[:, :, 2], -1) / np.linalg.norm(edge, axis=-1)
    if not np.median(along) > 0.5:
        raise ValueError(
            "source: the third rows of the directors must point along the rod; if the matrices are"
            " transposed, give directors.swapaxes(1, 2)"
        )


def _rest_lengths(data, position, given: Any, report: list[str]) -> np.ndarray:
    n = position.shape[1] - 1
    if given is not None:
        length = np.asarray(given, float)
        if length.shape != (n,) or not np.all(length > 0):
            raise ValueError(f"rest_lengths: give {n} positive numbers, one an element")
        return length
    if "lengths" in data and "dilatation" in data:
        return data["lengths"][0] / data["dilatation"][0]
    report.append("rest lengths: those of the first state (rest_lengths= gives others)")
    return np.linalg.norm(np.diff(position[0], axis=0), axis=1)


def _rod(data, position, quaternion, length, section, stress_free, report: list[str]) -> Rod:
    nodes = np.concatenate([[0.0], np.cumsum(length)])
    diameter = 2 * data["radius"][0] if "radius" in data else None
    if section is None:
        report.append("stiffness and mass: 1, as they are not in it (section= gives them)")
        warnings.warn(
            "section: what PyElastica's callbacks collect holds no stiffness and no mass, so that"
            " energies are without meaning; give the section, as circular_section(diameter,"
            " youngs_modulus, shear_modulus, density)",
            ModelWarning,
            stacklevel=3,
        )
        section = Section(stiffness=(1.0, 1.0, 1.0), mass=1.0, diameter=diameter)
    curvature = np.zeros((len(length), 3))
    if stress_free:
        curvature = turns_of_elements(quaternion) / length[:, None]
    rod = build_rod(nodes, position, quaternion, section, tuple(curvature.T))
    if rod.diameter is None and diameter is not None:
        rod = dataclasses.replace(rod, diameter=jnp.asarray(diameter))
    return rod


def _rates(data, report: list[str]) -> np.ndarray:
    """Velocities and angular velocities of the nodes, NaN where they were not collected."""
    count, _, nodes = data["position"].shape
    rate = np.full((count, nodes, 6), np.nan)
    lacking = [name for name in ("velocity", "omega") if name not in data]
    if lacking:
        report.append(f"{' and '.join(lacking)}: not in it, NaN in the states")
    if "velocity" in data:
        rate[..., :3] = np.moveaxis(data["velocity"], 1, 2)
    if "omega" in data:
        omega = np.moveaxis(data["omega"], 1, 2)
        padded = np.concatenate([omega[:, :1], omega, omega[:, -1:]], 1)
        rate[..., 3:] = 0.5 * (padded[:, 1:] + padded[:, :-1])
    return rate


def _forces(rod: Rod, position, matrices, length, report: list[str]) -> np.ndarray:
    """f = (gamma - e3)/compliance where there is compliance, else NaN."""
    edge = np.diff(position, axis=1) / length[:, None]
    strain = np.einsum("knij,knj->kni", matrices, edge) - np.array([0.0, 0.0, 1.0])
    if rod.compliance is None:
        report.append("forces: NaN, as the section has no compliance")
        return np.full_like(strain, np.nan)
    compliance = np.asarray(rod.compliance, float)
    gives = compliance > 0
    return np.where(gives, strain / np.where(gives, compliance, 1.0), np.nan)


def _states(*stacked: np.ndarray) -> State:
    """Stacked states of times, positions, frames, rates and forces; of NaN accelerations."""
    time, position, quaternion, rate, force = map(jnp.asarray, stacked)
    unknown = jnp.full_like(rate, jnp.nan)
    moving = rate[0], unknown[0], unknown[0]
    first = State(time[0], position[0], quaternion[0], *moving, force[0])
    leaves = [time, position, quaternion, rate, unknown, unknown, force]
    return jax.tree.unflatten(jax.tree.structure(first), leaves)
