"""States as columns of numbers at the nodes, of which tables and meshes are written."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from rodjax.rods.rod import Rod
from rodjax.viewing.colouring import measures_of
from rodjax.viewing.shown import Shown
from rodjax.viewing.tubes import matrices


class Column(NamedTuple):
    """What has a value at every node at every time.

    Attributes:
        name: in words.
        unit: its name, or nothing.
        values: numbers (k, nodes), or vectors (k, nodes, 3).
    """

    name: str
    unit: str
    values: Float[np.ndarray, "k nodes *components"] | Int[np.ndarray, "k nodes"]

    @property
    def label(self) -> str:
        """Name and unit, as "tension [N]"."""
        return f"{self.name} [{self.unit}]" if self.unit else self.name


def columns_of(shown: Shown, measures: bool) -> list[Column]:
    """Velocity, and with `measures` what there is to measure; that of elements at the nodes."""
    rod, states, units = shown.scene.rod, shown.states, shown.units
    speed = f"{units.length}/{units.time}"
    found = [Column("velocity", speed, np.asarray(states.rate, float)[..., :3])]
    if not measures or not len(states.time):
        return found
    for measure in measures_of(shown.scene, states, units):
        of_elements = measure.values.shape[1] == rod.elements
        values = at_nodes(rod, measure.values) if of_elements else measure.values
        found.append(Column(measure.name, measure.unit, values))
    return found


def frames_of(shown: Shown) -> list[Column]:
    """The unit vectors a_1, a_2 and a_3, in inertial components."""
    directors = matrices(np.asarray(shown.states.quaternion, float))
    return [Column(f"a{i + 1}", "", directors[..., i]) for i in range(3)]


def at_nodes(rod: Rod, values: Float[np.ndarray, "k n"]) -> Float[np.ndarray, "k nodes"]:
    """Values of elements at the nodes: the mean of those beside, weighed by their lengths.

    At the ends that of the one element; at a body by itself, beside which there is none, NaN.
    """
    length = np.asarray(rod.length, float)
    weighed = np.where(length > 0, length * values, 0.0)
    padded = lambda one: np.pad(one, [(0, 0)] * (one.ndim - 1) + [(1, 1)])
    both = lambda one: padded(one)[..., :-1] + padded(one)[..., 1:]
    with np.errstate(invalid="ignore"):
        return both(weighed) / both(length)


def part_of_nodes(rod: Rod) -> Int[np.ndarray, " nodes"]:
    """Which of the rods a node is of, from 0; bodies count on from them."""
    counts = [part.last - part.first + 1 for part in rod.parts]
    return np.repeat(np.arange(len(counts)), counts)
