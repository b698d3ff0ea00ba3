"""What holds a rod between its ends: at any node, as an end would."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Int

from rodjax.constraints.ends import AbstractEnd, check_end
from rodjax.inputs.validation import as_node, check_node, known


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
    """

    node: Int[Array, ""] = eqx.field(converter=as_node)
    end: AbstractEnd

    def __check_init__(self):
        check_node(self.node)
        check_end(end=self.end)

    def place(self, elements: int) -> int | Int[Array, ""]:
        """The node counted from s = 0, of a rod with so many elements; a number where known."""
        if known(self.node):
            node = int(self.node)
            return node + elements + 1 if node < 0 else node
        return jnp.where(self.node < 0, self.node + elements + 1, self.node)
