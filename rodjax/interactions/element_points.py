"""The nodes and points between them, where something acts on a rod.

A point on the chord of an element moves with its two nodes by linear weights. By the same weights
what acts on it goes to these nodes, so that its power, and the slope of its energy, are theirs.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Shaped

from rodjax.rods.rod import Rod


class ElementPoints(NamedTuple):
    """The nodes of a rod in their order, then the points between them, element by element.

    Attributes:
        rod: whose.
        per_element: parts into which they divide each element; 1 for the nodes alone.
    """

    rod: Rod
    per_element: int

    @property
    def parts(self) -> Float[np.ndarray, "n p"]:
        """How far along their elements the points between nodes are.

        Where there is no element they are at the node before, lest they be found in anything.
        """
        parts = np.tile(np.arange(1, self.per_element) / self.per_element, (self.rod.elements, 1))
        parts[list(self.rod.breaks)] = 0.0
        return parts

    def at(self, rows: Float[Array, "nodes k"]) -> Float[Array, "points k"]:
        """What the nodes have, at the points."""
        if self.per_element == 1:
            return rows
        parts = jnp.asarray(self.parts, rows.dtype)[:, :, None]
        between = (1 - parts) * rows[:-1, None] + parts * rows[1:, None]
        return jnp.concatenate([rows, between.reshape(-1, rows.shape[1])])

    def to_nodes(self, rows: Float[Array, "points k"]) -> Float[Array, "nodes k"]:
        """What acts on the points, on the nodes."""
        if self.per_element == 1:
            return rows
        count = self.rod.elements + 1
        parts = jnp.asarray(self.parts, rows.dtype)[:, :, None]
        between = rows[count:].reshape(*self.parts.shape, rows.shape[1])
        first, second = jnp.sum((1 - parts) * between, 1), jnp.sum(parts * between, 1)
        return rows[:count] + jnp.pad(first, ((0, 1), (0, 0))) + jnp.pad(second, ((1, 0), (0, 0)))

    @property
    def length(self) -> Float[Array, " points"]:
        """Rest length that belongs to each; nothing where there is no element."""
        if self.per_element == 1:
            return self.rod.node_length
        between = jnp.repeat(self.rod.length, self.per_element - 1)
        return jnp.concatenate([self.rod.node_length, between]) / self.per_element

    @property
    def radius(self) -> Float[Array, " points"]:
        """Half the diameter."""
        rod = self.rod
        assert rod.diameter is not None  # what asks has seen to it
        length, amount = rod.node_length, rod.to_nodes(rod.diameter)
        if rod.bodies:  # which have none
            length = length.at[np.array(rod.bodies)].set(1.0, unique_indices=True)
            amount = amount.at[np.array(rod.bodies)].set(rod.diameter[0], unique_indices=True)
        nodes = 0.5 * amount / length
        return nodes if self.per_element == 1 else self.at(nodes[:, None])[:, 0]

    def of_rods(self, rows: Shaped[Array, "points *k"]) -> Shaped[Array, "r *k"]:
        """The rows of points that are no bodies by themselves, whose nodes come last."""
        count = len(self.rod.bodies)
        if not count:
            return rows
        nodes = self.rod.elements + 1
        if self.per_element == 1:
            return rows[: nodes - count]
        between = np.arange(self.parts.size).reshape(self.parts.shape)
        between = np.delete(between, list(self.rod.breaks), 0).ravel()
        return rows[np.concatenate([np.arange(nodes - count), nodes + between])]

    def name(self, point: int) -> str:
        """Where one of them is, for messages."""
        beyond = point - self.rod.elements - 1
        if beyond < 0:
            return f"node {point}"
        element = beyond // (self.per_element - 1)
        return f"between nodes {element} and {element + 1}"
