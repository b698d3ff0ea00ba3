"""Derivatives of what acts on a node by its own motion, and by that of its neighbours."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rodjax.rods.inertia import node_jacobian


class NodeBlocks(NamedTuple):
    """Derivatives of the wrenches on the nodes by displacements and spins.

    Attributes:
        own: by those of the same node.
        before, after: by those of the node before and behind; None where nothing hangs on them.
            What is before the first node and behind the last is zero.
    """

    own: Float[Array, "nodes 6 6"]
    before: Float[Array, "nodes 6 6"] | None = None
    after: Float[Array, "nodes 6 6"] | None = None

    def multiply(self, z: Float[Array, "nodes 6"]) -> Float[Array, "nodes 6"]:
        """The wrenches of a motion."""
        found = jnp.einsum("nij,nj->ni", self.own, z)
        if self.before is None or self.after is None:
            return found
        found = found.at[1:].add(jnp.einsum("nij,nj->ni", self.before[1:], z[:-1]))
        return found.at[:-1].add(jnp.einsum("nij,nj->ni", self.after[:-1], z[1:]))


def node_blocks(function, z: Float[Array, "nodes 6"], between_nodes: bool) -> NodeBlocks:
    """Derivative of a function of the nodes.

    Args:
        between_nodes: whether its rows depend on the rows of z beside them too, or on the same
            ones only. Then every third node is moved at a time, so that each row feels but one.
    """
    if not between_nodes:
        return NodeBlocks(node_jacobian(function, z))
    push = lambda direction: jax.jvp(function, (z,), (direction,))[1]
    nodes = np.arange(len(z))
    marked = jnp.asarray(nodes[None] % 3 == np.arange(3)[:, None], z.dtype)
    directions = marked[:, None, :, None] * jnp.eye(6, dtype=z.dtype)[None, :, None]
    # (colours, directions, nodes, components)
    pushed = jax.vmap(jax.vmap(push))(directions)
    of = lambda shift: jnp.swapaxes(pushed[(nodes + shift) % 3, :, nodes], 1, 2)
    return NodeBlocks(of(0), of(-1), of(1))
