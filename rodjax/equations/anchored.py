"""Systems without inertia whose first end is not clamped.

Block elimination starts at node 0 and pivots inside a block only, but without inertia the
equations of a part of a rod that begins with a free, pinned or sliding end are singular. So the
elimination is done for a cantilever, clamped at node 0 and free at the other end, of which every
part is held (and nothing is held twice, as a straight inextensible rod between two clamps would
be); the motion of node 0 and the wrench on the other end then follow from the ends' own equations.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.equations.coupled import CoupledSystem


class AnchoredSystem(eqx.Module):
    """A system solved through the one that differs from it by its ends.

    With E^T picking the last six rows of the first and the last block, and R = E^T system,
    H = E^T cantilever: system = cantilever + E (R - H).
    """

    system: CoupledSystem
    cantilever: CoupledSystem

    def multiply(self, b: Float[Array, "nodes 9"]) -> Float[Array, "nodes 9"]:
        """Matrix times vector."""
        return self.system.multiply(b)

    def solve(self, b: Float[Array, "nodes 9"]) -> Float[Array, "nodes 9"]:
        """Solution x = y + Z z with cantilever y = b, cantilever Z = E, R (y + Z z) = E^T b."""
        columns = jnp.concatenate([b[None], _units(b)])
        columns = jax.vmap(self.cantilever.solve)(columns)
        rows = _pick(jax.vmap(self.system.multiply)(columns))
        z = jnp.linalg.solve(rows[1:].T, _pick(b[None])[0] - rows[0])
        return columns[0] + jnp.einsum("k,knr->nr", z, columns[1:])

    def solve_once(self, b: Float[Array, "nodes 9"]) -> Float[Array, "nodes 9"]:
        """As `solve`."""
        return self.solve(b)

    def solve_transpose(self, b: Float[Array, "nodes 9"]) -> Float[Array, "nodes 9"]:
        """Solution x = y - T z + E z of the transposed system.

        cantilever^T y = b, cantilever^T T = R^T, and E^T x = z.
        """
        rows = jax.vmap(self.system.transpose().multiply)(_units(b))
        columns = jax.vmap(self.cantilever.solve_transpose)(jnp.concatenate([b[None], rows]))
        ends = _pick(columns)
        z = jnp.linalg.solve(ends[1:].T, ends[0])
        x = columns[0] - jnp.einsum("k,knr->nr", z, columns[1:])
        return x.at[0, 3:].set(z[:6]).at[-1, 3:].set(z[6:])


def _units(like: Float[Array, "nodes 9"]) -> Float[Array, "12 nodes 9"]:
    """The columns of E."""
    eye = jnp.eye(6, dtype=like.dtype)
    units = jnp.zeros((12, *like.shape), like.dtype)
    return units.at[:6, 0, 3:].set(eye).at[6:, -1, 3:].set(eye)


def _pick(columns: Float[Array, "k nodes 9"]) -> Float[Array, "k 12"]:
    """E^T of every column."""
    return jnp.concatenate([columns[:, 0, 3:], columns[:, -1, 3:]], 1)
