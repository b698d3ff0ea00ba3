"""Strands in contact eliminated as a dense system: few vertices, or any number of them.

Of A + L K R^T the block-tridiagonal A is eliminated, which leaves a dense system for the
displacements of the vertices in contact (Woodbury's identity in the form that needs no inverse of
K). Where the grid is coarser than the contact's segments, the nodes between which the vertices lie
take the vertices' place: they are fewer. Its cost grows with the cube of what touches. Of several
rods, which A does not couple, the columns of one right side serve one vertex of each.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from rodjax.equations.assembly import AS_COLUMNS
from rodjax.equations.coupling import Coupling
from rodjax.interactions.contact_capacities import Capacity
from rodjax.interactions.pair_points import vertices_of
from rodjax.interactions.sites import interpolate
from rodjax.numerics.batching import largest
from rodjax.numerics.block_tridiagonal import BlockTridiagonal, Factors
from rodjax.numerics.signs import determinant_signs, negative_in_all

# Vertices up to which their matrix is made first, and pairs that are added to it at once.
_FEW, _TOGETHER = 64, 16
_COLUMNS = 96  # of the response that are made at once


class DenseElimination(eqx.Module):
    """Factors of A, and of I + R^T A^-1 L K."""

    coupling: Coupling
    capacity: Capacity = eqx.field(static=True)
    factors: Factors
    lu: Float[Array, "k k"]
    order: Int[Array, " k"]  # of the rows of the latter

    @classmethod
    def of(
        cls, blocks: BlockTridiagonal, coupling: Coupling, factors: Factors, capacity: Capacity
    ) -> "DenseElimination":
        """Of blocks + coupling, whose vertices in contact the capacity must hold.

        The factors are those of the blocks.
        """
        derivative = _derivative(coupling, capacity)
        response = _response(factors, coupling, capacity, derivative)
        eye = jnp.eye(len(response), dtype=response.dtype)
        lu, _, order = lax.linalg.lu(eye + response)
        return cls(coupling, capacity, factors, lu, order)

    def solve(self, b: Float[Array, "nodes 9"]) -> Float[Array, "nodes 9"]:
        """Solution A^-1 (b - L K d), where d, displacements in contact, obey the dense system."""
        free = self.factors.solve(b[:, :, None])[:, :, 0]
        nodal = jnp.einsum("nrk,nr->nk", self.coupling.right, free)
        right = _read(self.coupling, nodal[:, :, None], self.capacity)[self.order]
        for lower in (True, False):
            right = lax.linalg.triangular_solve(
                self.lu, right, left_side=True, lower=lower, unit_diagonal=lower
            )
        moved = _vertices(self.coupling, right[:, 0], self.capacity)
        pushed = self.coupling.push(moved, self.capacity)
        return free - self.factors.solve(pushed[:, :, None])[:, :, 0]

    def sign(self, blocks: BlockTridiagonal) -> Float[Array, ""]:
        """Sign of the determinant, of what these `blocks` are part of."""
        later = self.order[None, :] < self.order[:, None]
        swaps = jnp.sum(jnp.triu(later, 1), dtype=jnp.int32)
        sign = jnp.where(swaps % 2 == 0, 1.0, -1.0) * jnp.prod(jnp.sign(jnp.diagonal(self.lu)))
        return sign * jnp.prod(determinant_signs(blocks.pivots(self.factors)))

    def negative(self, blocks: BlockTridiagonal) -> Int[Array, ""]:
        """Number of negative eigenvalues of a symmetric system, of blocks and the coupling.

        With the forces p of the contact and its displacements d as unknowns it is

            [A    R   0]
            [R^T  0  -I]
            [0   -I   K]

        of which [[0, -I], [-I, K]] has a negative eigenvalue for each p whatever K is, and leaves
        A + R K R^T when it is eliminated. So does A, and leaves [[-R^T A^-1 R, -I], [-I, K]]. By
        Haynsworth's theorem both have the same numbers in all.
        """
        coupling, capacity = self.coupling, self.capacity
        size = coupling.width * capacity.points
        eye = jnp.eye(size, dtype=self.lu.dtype)
        derivative = _derivative(coupling, capacity).reshape(size, size)
        units = eye.reshape(-1, coupling.width, size)
        given = _response(self.factors, coupling, capacity, units)
        matrix = jnp.block([[-given, -eye], [-eye, derivative]])
        pivots = blocks.pivots(self.factors)[:, np.array(AS_COLUMNS)]
        return negative_in_all(pivots) + negative_in_all(matrix[None]) - size

    def numbers(self) -> tuple[Float[Array, "nodes r"], Int[Array, " k"]]:
        """What it holds besides the coupling and the factors, in rows for the nodes; its order."""
        nodes = self.factors.inverse.shape[0]
        flat = self.lu.reshape(-1)
        return jnp.pad(flat, (0, -flat.size % nodes)).reshape(nodes, -1), self.order

    @classmethod
    def from_numbers(cls, coupling, factors, capacity, rows, order) -> "DenseElimination":
        """What gave these numbers."""
        k = coupling.width * capacity.points
        share = -(-k * k // rows.shape[0])
        lu = rows[:, :share].reshape(-1)[: k * k].reshape(k, k)
        return cls(coupling, capacity, factors, lu, order[:k])


def _derivative(coupling: Coupling, capacity: Capacity) -> Float[Array, "m w k"]:
    """Forces on the vertices in contact, or on their nodes, by displacements of these."""
    nodes, width = coupling.acting.involved.nodes, coupling.width
    if nodes is None:
        blocks = _between_vertices(coupling, capacity)
    elif capacity.vertices > _FEW and jax.default_backend() == "cpu":
        blocks = _between_nodes(coupling, capacity)
    else:
        blocks = _between_vertices(coupling, capacity)
        weight = _weights(coupling, capacity.vertices)[nodes[: capacity.nodes]]
        blocks = jnp.einsum("na,abij,mb->nmij", weight, blocks, weight)
    of_force, of_motion = coupling.units
    blocks = (of_force[:, None] * of_motion[None, :])[None, None] * blocks
    return jnp.swapaxes(blocks, 1, 2).reshape(-1, width, width * blocks.shape[0])


def _between_vertices(coupling: Coupling, capacity: Capacity) -> Float[Array, "v v w w"]:
    """Sum of the pairs' derivatives, by the vertices in contact."""
    size, width = capacity.vertices, coupling.width
    vertex, derivative = coupling.first_acting(capacity)
    rank = coupling.acting.involved.rank[vertex]
    # scattered by whole blocks, which is faster than by numbers
    blocks = jnp.zeros((size, size, width, width), coupling.derivative.dtype)
    index = (rank[:, :, None], rank[:, None, :])
    return blocks.at[index].add(derivative, mode="drop")


def _between_nodes(coupling: Coupling, capacity: Capacity) -> Float[Array, "n n w w"]:
    """The same by the nodes between which the vertices lie, at a cost that goes with the pairs.

    Of vertices in the hundreds the sum by vertices would be a large and nearly empty matrix, whose
    products with the weights cost more than all else of an elimination.
    """
    sites, acting, width = coupling.sites, coupling.acting, coupling.width
    number = jnp.arange(len(coupling.left), dtype=jnp.int32)
    rank = jnp.zeros_like(number).at[acting.involved.nodes].set(number)
    seat, weight = rank[sites.nodes], sites.weight
    room, corners = capacity.pairs, jnp.stack(vertices_of(coupling.pairs), 1)

    def added(part, blocks):
        listed = part * _TOGETHER + jnp.arange(_TOGETHER, dtype=jnp.int32)
        at = acting.place[jnp.minimum(listed, room - 1)]
        vertex = corners[at]
        # of nodes without weight nothing is added, though they may have no place
        used = (listed < acting.count)[:, None, None]
        own, by = jnp.where(used, weight[vertex], 0.0), weight[vertex]
        share = own[:, :, None, :, None] * by[:, None, :, None, :]
        values = share[..., None, None] * coupling.derivative[at][:, :, :, None, None]
        row, column = seat[vertex][:, :, None, :, None], seat[vertex][:, None, :, None, :]
        return blocks.at[row, column].add(values, mode="drop")

    blocks = jnp.zeros((capacity.points, capacity.points, width, width), weight.dtype)
    count = jnp.minimum(largest(acting.count), room)
    return lax.fori_loop(0, (count + _TOGETHER - 1) // _TOGETHER, added, blocks)


def _on_nodes(
    coupling: Coupling, capacity: Capacity, rows: Float[Array, "m w k"]
) -> Float[Array, "nodes w k"]:
    """Forces on all nodes from those on the vertices in contact, or on their nodes."""
    nodes = coupling.acting.involved.nodes
    if nodes is None:
        weight = _weights(coupling, capacity.vertices)
        return (weight @ rows.reshape(len(rows), -1)).reshape(-1, *rows.shape[1:])
    nothing = jnp.zeros((coupling.left.shape[0], *rows.shape[1:]), rows.dtype)
    return nothing.at[nodes[: capacity.nodes]].set(rows)


def _weights(coupling: Coupling, size: int) -> Float[Array, "nodes m"]:
    """Interpolation weights of the first vertices, those in contact among them, at the nodes."""
    sites, chosen = coupling.sites, coupling.acting.involved.order[:size]
    node = jnp.arange(coupling.left.shape[0], dtype=jnp.int32)[:, None, None]
    at = node == sites.nodes[chosen][None]
    return jnp.sum(jnp.where(at, sites.weight[chosen][None], 0.0), 2)


def _read(
    coupling: Coupling, nodal: Float[Array, "nodes w c"], capacity: Capacity
) -> Float[Array, "k c"]:
    """Displacements of the vertices in contact, or of their nodes, from those of all nodes."""
    sites, involved = coupling.sites, coupling.acting.involved
    if involved.nodes is None:
        chosen = involved.order[: capacity.vertices]
        at, weight = sites.nodes[chosen], sites.weight[chosen]
        # term by term, since XLA would store the gathered nodes of all terms
        terms = [weight[:, j, None, None] * nodal[at[:, j]] for j in range(at.shape[1])]
        found = sum(terms[1:], terms[0])
    else:
        found = nodal[involved.nodes[: capacity.nodes]]
    return found.reshape(-1, nodal.shape[2])


def _vertices(
    coupling: Coupling, displacement: Float[Array, " k"], capacity: Capacity
) -> Float[Array, "j w"]:
    """Displacements of all vertices from those of the vertices in contact, or of their nodes."""
    given, involved = displacement.reshape(-1, coupling.width), coupling.acting.involved
    if involved.nodes is None:
        every = jnp.zeros((involved.order.shape[0], coupling.width), given.dtype)
        return every.at[involved.order[: capacity.vertices]].set(given)
    nodal = jnp.zeros((coupling.left.shape[0], coupling.width), given.dtype)
    return interpolate(coupling.sites, nodal.at[involved.nodes[: capacity.nodes]].set(given))


class _Seats(NamedTuple):
    """The points, vertices or nodes, by the rods that they are of."""

    rod: Int[Array, " m"]
    seat: Int[Array, " m"]  # number among the points of this rod
    most: int  # seats of a rod


def _seats(coupling: Coupling, capacity: Capacity) -> _Seats | None:
    """Of the points in contact; None where one rod may have more than half of them."""
    involved, strands = coupling.acting.involved, coupling.strands
    if involved.nodes is None:
        points, counts = involved.order, [strand.vertices for strand in strands]
    else:
        points, counts = involved.nodes, [strand.nodes for strand in strands]
    most = max(counts, default=capacity.points)
    if 2 * most > capacity.points:
        return None
    rods = np.repeat(np.arange(len(counts), dtype=np.int32), counts)
    # bodies come last; they are in contact with nothing here
    rods = np.pad(rods, (0, len(points) - len(rods)), constant_values=len(counts))
    rod = jnp.asarray(rods)[points[: capacity.points]]
    own = rod[:, None] == jnp.arange(len(counts) + 1, dtype=jnp.int32)[None]
    before = jnp.cumsum(own.astype(jnp.int32), 0, dtype=jnp.int32) - 1
    seat = jnp.take_along_axis(before, rod[:, None], 1)[:, 0]
    return _Seats(rod, seat, most)


def _by_each(
    factors: Factors, coupling: Coupling, capacity: Capacity
) -> Float[Array, "k k"] | None:
    """R^T A^-1 L between the points in contact of several rods; None where that does not pay."""
    seats = _seats(coupling, capacity)
    if seats is None:
        return None
    width, size = coupling.width, capacity.points
    acting = jnp.arange(size, dtype=jnp.int32) < coupling.acting.involved.count
    unit = jnp.arange(seats.most, dtype=jnp.int32)[None] == seats.seat[:, None]
    unit = unit & acting[:, None]
    eye = jnp.eye(width, dtype=factors.inverse.dtype)
    forces = jnp.where(unit[:, None, :, None], eye[None, :, None, :], 0.0)
    forces = forces.reshape(size, width, seats.most * width)
    found = _responses(factors, coupling, capacity, forces)
    found = found.reshape(size, width, seats.most, width)[:, :, seats.seat]
    same = seats.rod[:, None] == seats.rod[None, :]
    return jnp.where(same[:, None, :, None], found, 0.0).reshape(size * width, size * width)


def _response(
    factors: Factors, coupling: Coupling, capacity: Capacity, derivative: Float[Array, "m w k"]
) -> Float[Array, "k k"]:
    """R^T A^-1 L K, of the points in contact."""
    # A^-1 (L K) and not (A^-1 L) K, a product of large matrices less, unless that has few columns
    by_each = _by_each(factors, coupling, capacity)
    if by_each is None:
        return _responses(factors, coupling, capacity, derivative)
    return by_each @ derivative.reshape(len(by_each), -1)


def _responses(
    factors: Factors, coupling: Coupling, capacity: Capacity, rows: Float[Array, "m w k"]
) -> Float[Array, "l k"]:
    """R^T A^-1 L times forces on the vertices in contact, or on their nodes: what these move by.

    A part of the columns after the other, as far as there are forces: what touches is first, and
    may be much less than the capacity holds. On accelerators all at once.
    """
    carried = jnp.concatenate([factors.inverse @ coupling.left, -factors.lower], 2)

    def moved(part):
        forces = _on_nodes(coupling, capacity, part)
        return _read(coupling, _displaced(factors, coupling, carried, forces), capacity)

    size = rows.shape[2]
    if size <= _COLUMNS or jax.default_backend() != "cpu":
        return moved(rows)
    rows = jnp.pad(rows, ((0, 0), (0, 0), (0, -size % _COLUMNS)))
    given = jnp.any(rows != 0, (0, 1))
    last = jnp.max(jnp.where(given, jnp.arange(1, len(given) + 1, dtype=jnp.int32), 0))

    def some(i, found):
        at = i * _COLUMNS
        part = lax.dynamic_slice_in_dim(rows, at, _COLUMNS, 2)
        return lax.dynamic_update_slice_in_dim(found, moved(part), at, 1)

    parts = (largest(last) + _COLUMNS - 1) // _COLUMNS
    height = rows.shape[0] * rows.shape[1]
    return lax.fori_loop(0, parts, some, jnp.zeros((height, len(given)), rows.dtype))[:, :size]


def _displaced(
    factors: Factors,
    coupling: Coupling,
    carried: Float[Array, "nodes 9 c"],
    forces: Float[Array, "nodes w k"],
) -> Float[Array, "nodes w k"]:
    """Displacements of the nodes by forces on them."""

    def forward(previous, row):
        carry, force = row
        current = carry @ jnp.concatenate([force, previous])
        return current, current

    def backward(following, row):
        upper, middle, read = row
        current = middle - upper @ following
        # only what is read is kept: all columns of a fine grid do not fit into the cache
        return current, read @ current

    zero = jnp.zeros((9, forces.shape[2]), forces.dtype)
    _, middle = lax.scan(forward, zero, (carried, forces))
    # transposed here: products with a transposed factor are slow ones
    rows = (factors.upper, middle, jnp.swapaxes(coupling.right, 1, 2))
    return lax.scan(backward, zero, rows, reverse=True)[1]
