"""Systems without inertia whose first end is not clamped.

Block elimination starts at node 0 and pivots inside a block only, but without inertia the
equations of a part of a rod that begins with a free, pinned or sliding end are singular. So the
elimination is done for a cantilever, clamped at node 0 and free at the other end, of which every
part is held (and nothing is held twice, as a straight inextensible rod between two clamps would
be); the motion of node 0 and the wrenches on all else that is held then follow from the equations
of what holds it.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.equations.coupled import CoupledSystem
from rodjax.scenes.holds import Node, with_part


class AnchoredSystem(eqx.Module):
    """A system solved through the one that differs from it by what is held.

    With E^T picking the last six rows of the blocks of the `nodes` that are held otherwise,
    and R = E^T system, H = E^T cantilever: system = cantilever + E (R - H).
    """

    system: CoupledSystem
    cantilever: CoupledSystem
    nodes: tuple[Node, ...]

    def multiply(self, b: Float[Array, "nodes 9"]) -> Float[Array, "nodes 9"]:
        """Matrix times vector."""
        return self.system.multiply(b)

    def solve(self, b: Float[Array, "nodes 9"]) -> Float[Array, "nodes 9"]:
        """Solution x = y + Z z with cantilever y = b, cantilever Z = E, R (y + Z z) = E^T b."""
        columns = jnp.concatenate([b[None], self._units(b)])
        columns = jax.vmap(self.cantilever.solve)(columns)
        rows = self._pick(jax.vmap(self.system.multiply)(columns))
        z = jnp.linalg.solve(rows[1:].T, self._pick(b[None])[0] - rows[0])
        return columns[0] + jnp.einsum("k,knr->nr", z, columns[1:])

    def solve_once(self, b: Float[Array, "nodes 9"]) -> Float[Array, "nodes 9"]:
        """As `solve`."""
        return self.solve(b)

    def solve_transpose(self, b: Float[Array, "nodes 9"]) -> Float[Array, "nodes 9"]:
        """Solution x = y - T z + E z of the transposed system.

        cantilever^T y = b, cantilever^T T = R^T, and E^T x = z.
        """
        rows = jax.vmap(self.system.transpose().multiply)(self._units(b))
        columns = jax.vmap(self.cantilever.solve_transpose)(jnp.concatenate([b[None], rows]))
        ends = self._pick(columns)
        z = jnp.linalg.solve(ends[1:].T, ends[0])
        x = columns[0] - jnp.einsum("k,knr->nr", z, columns[1:])
        for node, part in zip(self.nodes, z.reshape(-1, 6), strict=True):
            x = with_part(x, part[None], (node, 3))
        return x

    def _units(self, like: Float[Array, "nodes 9"]) -> Float[Array, "k nodes 9"]:
        """The columns of E."""
        eye, parts = jnp.eye(6, dtype=like.dtype)[:, None], []
        for node in self.nodes:
            zero = jnp.zeros((6, *like.shape), like.dtype)
            parts.append(with_part(zero, eye, (0, node, 3)))
        return jnp.concatenate(parts)

    def _pick(self, columns: Float[Array, "c nodes 9"]) -> Float[Array, "c k"]:
        """E^T of every column."""
        return jnp.concatenate([columns[:, node, 3:] for node in self.nodes], 1)
