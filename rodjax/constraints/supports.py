"""What holds a rod between its ends, or one of several at any node: as an end would."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Int

from rodjax.constraints.ends import AbstractEnd, check_end
from rodjax.inputs.validation import as_node, check_integer, check_node, known
from rodjax.rods.rod import Part


class Support(eqx.Module):
    """Directions that are taken away at one node, and their prescribed motion.

    `end` says which, as it does at the ends of a rod: `Pinned()` a ball joint with what is around,
    `Clamped()` a weld, `Slider(axis)` a block that slides along the axis, `Free()` nothing;
    `Switched` lets it begin or end at a time, its `displacement` and `rotation` drive it. What it
    exerts on the rod is in `energy.reactions`, after the ends.

    Attributes:
        node: its number, from 1 to the last but one; negative from the end s = L (-1 is the last
            node, which is an end's). One that the rod lacks is refused by the scene, and gives
            NaN where it is traced.
        end: what it takes away, and how it moves.
        rod: which of the rods of the scene it holds, from 0.

    Example:
        >>> bridge = rx.Scene(rod, rx.Pinned(), supports=(rx.Support(10, rx.Pinned()),))
    """

    node: Int[Array, ""] = eqx.field(converter=as_node)
    end: AbstractEnd
    rod: int = eqx.field(static=True, default=0)

    def __check_init__(self):
        check_integer(0, 10_000, rod=self.rod)
        check_node(self.node)
        check_end(end=self.end)

    def place(self, part: Part) -> int | Int[Array, ""]:
        """The node among those of the scene, of a rod that stands there; a number where known."""
        if known(self.node):
            node = int(self.node)
            return node + (part.last + 1 if node < 0 else part.first)
        counted = self.node + part.first if part.first else self.node
        return jnp.where(self.node < 0, self.node + part.last + 1, counted)
