"""Contact forces: the law summed over the points of near pairs of segments, and its derivative."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from rodjax.interactions import strand_friction
from rodjax.interactions.contact import Contact
from rodjax.interactions.friction import Dual
from rodjax.interactions.pair_points import Points, blocks_of, points_of, vertices_of
from rodjax.interactions.screening import BLOCK, NearPairs
from rodjax.interactions.sites import Sites, interpolate, spread
from rodjax.numerics import rotations
from rodjax.numerics.batching import largest, one_by_one
from rodjax.rods.state import NodeMotion


class Rubbed(NamedTuple):
    """Sums over all pairs of points of what friction does."""

    force: Float[Array, ""]  # of its magnitudes [N]
    limit: Float[Array, ""]  # of its limits [N]
    power: Float[Array, ""]  # that it takes away [W]


class PairForces(NamedTuple):
    """Interaction of a list of pairs of segments.

    The four vertices of a pair are those of its first, then of its second segment; entries beyond
    `NearPairs.count` are zero.
    """

    force: Float[Array, "j w"]  # on the vertices [N], and with friction moments [N m]
    derivative: Float[Array, "q 4 4 w w"] | None  # of minus the force, vertex by vertex [N/m]
    smallest: Float[Array, ""]  # least d/D of the points that act; infinite without one
    total: Float[Array, ""]  # sum of the magnitudes of all forces between points [N]
    rubbed: Rubbed | None = None  # by friction, if there is any
    acts: Bool[Array, " q"] | None = None  # whether a pair's derivative is not zero


@eqx.filter_custom_jvp
def forces_and_derivative(
    contact: Contact,
    sites: Sites,
    pairs: NearPairs,
    vertices: Float[Array, "j 3"],
    rates: Float[Array, "j w"],
    by_velocity: Float[Array, ""],
) -> PairForces:
    """`pair_forces` with the derivative, at a cost that follows the number of pairs in use."""
    # what is no array in a law, as a network's activation, does not pass through `one_by_one`
    arrays, rest = eqx.partition(contact, eqx.is_array)

    def of(function):
        whole = lambda vertices, arrays, *given: function(
            vertices, eqx.combine(arrays, rest), *given
        )
        return whole

    in_use = one_by_one(of(_pairs_in_use), together=(of(_nothing_near), of(_no_pairs)))
    return in_use(vertices, arrays, sites, pairs, rates, by_velocity)


def _pairs_in_use(vertices, contact, sites, pairs, rates, by_velocity) -> PairForces:
    evaluate, rows, empty = _blocks(contact, sites, pairs, vertices, rates, by_velocity)

    def body(i, found):
        now = evaluate(jax.tree.map(lambda leaf: leaf[i], rows))
        return jax.tree.map(lambda buffer, value: buffer.at[i].set(value), found, now)

    def some():
        buffers = jax.tree.map(
            lambda leaf: jnp.broadcast_to(leaf, (len(rows[0]), *leaf.shape)), empty
        )
        used = (pairs.count + BLOCK - 1) // BLOCK
        return _joined(pairs, vertices, lax.fori_loop(0, used, body, buffers))

    none = lambda: _no_pairs(vertices, contact, sites, pairs, rates, by_velocity)
    return lax.cond(pairs.count > 0, some, none)


def _no_pairs(vertices, contact, sites, pairs, rates, by_velocity) -> PairForces:
    dtype = vertices.dtype
    zero, width = jnp.zeros((), dtype), contact.width
    return PairForces(
        jnp.zeros((vertices.shape[0], width), dtype),
        jnp.zeros((pairs.first.shape[0], 4, 4, width, width), dtype),
        jnp.asarray(jnp.inf, dtype),
        zero,
        None if contact.friction is None else Rubbed(zero, zero, zero),
        jnp.zeros(pairs.first.shape, bool),
    )


def _nothing_near(vertices, contact, sites, pairs, rates, by_velocity) -> Bool[Array, ""]:
    return pairs.count == 0


@forces_and_derivative.def_jvp
def _forces_and_derivative_jvp(primals, tangents):
    # a loop of unknown length has no reverse mode: derivatives take the scan
    return forces_and_derivative(*primals), eqx.filter_jvp(pair_forces, primals, tangents)[1]


def pair_forces(
    contact: Contact,
    sites: Sites,
    pairs: NearPairs,
    vertices: Float[Array, "j 3"],
    rates: Float[Array, "j w"],
    by_velocity: Float[Array, ""] | None = None,
) -> PairForces:
    """Forces of all near pairs and, if `by_velocity` is given, their exact derivative.

    With points a, b at x_a = sum_i u_i X_i on the chords, the force on b from a is P n,
    P = psi(d, c) window h^2, n from a to b, t the unit vectors along the chords. Its derivative by
    x_b - x_a, velocities following positions by the factor `by_velocity`, is
        n g^T + (P/d)(I - n n^T),   g = (P_d - by_velocity P_c) n
            + (-P_c (w - d' n) + P_a (t_a - (n.t_a) n) + P_b (t_b - (n.t_b) n)) / d
    with w the relative velocity and P_a, P_b the derivatives by the cosines of the apertures, if
    there are any; by the chord l t_a it is n P_a (n - (n.t_a) t_a)^T / l. Blocks of the list that
    are not in use are skipped.
    """
    evaluate, rows, empty = _blocks(contact, sites, pairs, vertices, rates, by_velocity)
    count = largest(pairs.count)
    skip = lambda _: empty
    # recomputed in a reverse pass: stored block by block, its values fill a hundred arrays
    again = jax.checkpoint(evaluate, prevent_cse=False)
    block = lambda _, row: (None, lax.cond(row[0] < count, again, skip, row))
    return _joined(pairs, vertices, lax.scan(block, None, rows)[1])


def _joined(pairs: NearPairs, vertices, found: PairForces) -> PairForces:
    """The blocks' results as those of the list; forces, by blocks of the pairs, at vertices."""
    flat = lambda v: v.reshape(-1, *v.shape[2:])[: pairs.first.shape[0]]
    return PairForces(
        gather(pairs, flat(found.force), vertices.shape[0]),
        None if found.derivative is None else flat(found.derivative),
        jnp.min(found.smallest),
        jnp.sum(found.total),
        jax.tree.map(jnp.sum, found.rubbed),
        None if found.acts is None else flat(found.acts),
    )


class _Slopes(NamedTuple):
    """Derivatives of the force between the points of a block.

    Attributes:
        force: between points [N].
        over: force/distance.
        by_apart: by r, less `over` times the normal; velocities follow.
        by_chords: by the chords that count.
        friction: with its own.
    """

    force: Float[Array, "q a b"]
    over: Float[Array, "q a b"]
    by_apart: Float[Array, "3 q a b"]
    by_chords: tuple[Float[Array, "3 q a b"], ...]
    friction: strand_friction.Slopes | None


def _stored(used: Bool[Array, ""], function: Callable):
    """What the function gives of a block that is in use, as any that is evaluated is.

    What a branch returns is stored, and XLA would otherwise evaluate it anew for every one of the
    numbers made of it.
    """
    nothing = lambda: jax.tree.map(jnp.zeros_like, jax.eval_shape(function))
    return lax.cond(used, function, nothing)


def _law_slopes(contact, points: Points) -> tuple[Array, ...]:
    """The force between points, and its derivatives by what `Points.magnitude` takes."""
    p, pull = jax.vjp(partial(points.magnitude, contact), *points.inputs)
    return tuple(jnp.where(points.acts, x, 0.0) for x in (p, *pull(jnp.ones_like(p))))


def _slopes(contact, points: Points, law_slopes, by_velocity, dual: Dual | None) -> _Slopes:
    distance, n, w = points.distance, points.passing.normal, points.passing[2]
    p, p_d, p_c, *by_cosines = law_slopes
    over = p / distance
    # numbers of the pairs of points beside vectors, whose components lead
    p_d, p_c, opened = (x[None] for x in (p_d, p_c, points.opening))
    across, by_chords = -p_c * (w - opened * n), ()
    if points.tangents:
        assert points.lengths is not None
        p_a, p_b, c_a, c_b = (x[None] for x in (*by_cosines, *points.cosines))
        ta, tb = points.tangents
        size_a, size_b = (points.lengths[None, :, k, None, None] for k in (0, 1))
        across = p_a * (ta - c_a * n) + p_b * (tb - c_b * n) - p_c * (w - opened * n)
        by_chords = (p_a * (n - c_a * ta) / size_a, p_b * (n - c_b * tb) / size_b)
    g = (p_d - by_velocity * p_c) * n + across / distance[None]
    rubbed = None
    if contact.friction is not None:
        given = contact.friction, p, points.passing, distance, by_velocity, dual
        rubbed = strand_friction.slopes(*given)
    return _Slopes(p, over, g - over[None] * n, by_chords, rubbed)


def _blocks(contact, sites, pairs, vertices, rates, by_velocity):
    """What evaluates a block of pairs; the blocks (first place, vertices, dual); an empty result.

    Forces are those on the four vertices of every pair.
    """

    def evaluate(row):
        first, index, dual = row
        points = points_of(contact, sites, pairs, vertices, rates, (first, index))
        mix, n, friction = points.mix, points.passing.normal, contact.friction
        if by_velocity is None:
            p = jnp.where(points.acts, points.magnitude(contact, *points.inputs), 0.0)
            h, acts, rubbed = None, None, None
            if friction is not None:
                rubbed = strand_friction.traction(friction, p, points.passing)
        else:
            used = first < pairs.count
            law = _stored(used, lambda: _law_slopes(contact, points))
            found = _stored(used, lambda: _slopes(contact, points, law, by_velocity, dual))
            p, h, rubbed = found.force, _by_vertices(mix, n, found), None
            if found.friction is not None:
                assert points.share is not None
                by_load = _load_by(mix, n, found)
                own = points.share, points.passing, found.friction
                h = jnp.pad(h, 3 * ((0, 0),) + 2 * ((0, 3),))
                h = h + strand_friction.by_vertices(mix, *own, by_load)
                rubbed = jnp.moveaxis(found.friction.force, -1, 0)
            acts = jnp.any(h != 0, (1, 2, 3, 4))
        force = jnp.einsum("abi,kqab->qik", mix, p[None] * n)
        ratio = jnp.min(jnp.where(p != 0, points.distance / points.pair.diameter, jnp.inf))
        total, sums = jnp.sum(jnp.abs(p)), None
        if rubbed is not None:
            assert points.share is not None and friction is not None
            force = jnp.pad(force, ((0, 0), (0, 0), (0, 3)))
            force = force + strand_friction.on_vertices(mix, points.share, points.passing, rubbed)
            # a zero has no derivative of its magnitude
            size = jnp.sqrt(lax.stop_gradient(jnp.sum(rubbed**2, 0)))
            pressed = jnp.sum(jnp.maximum(p, 0.0))
            power = -jnp.sum(rubbed * points.passing.slip)
            sums = Rubbed(jnp.sum(size), friction.coefficient * pressed, power)
        return PairForces(force, h, ratio, total, sums, acts)

    zeros, width = lambda *shape: jnp.zeros(shape, vertices.dtype), contact.width
    derivative = None if by_velocity is None else zeros(BLOCK, 4, 4, width, width)
    sums = None if contact.friction is None else Rubbed(zeros(), zeros(), zeros())
    none = None if by_velocity is None else jnp.zeros((BLOCK,), bool)
    empty = PairForces(zeros(BLOCK, 4, width), derivative, zeros() + jnp.inf, zeros(), sums, none)
    return evaluate, (*blocks_of(pairs), contact.dual), empty


def _load_by(mix, n, found: _Slopes) -> Float[Array, "q a b 4 3"]:
    """Derivative of the force between points by displacements of the four vertices."""
    g = jnp.moveaxis(found.by_apart + found.over[None] * n, 0, -1)
    by = mix[None, :, :, :, None] * g[:, :, :, None, :]
    if found.by_chords:
        by_a, by_b = (jnp.moveaxis(v, 0, -1) for v in found.by_chords)
        by = by + jnp.stack([-by_a, by_a, -by_b, by_b], 3)
    return by


def _by_vertices(mix, n, found: _Slopes) -> Float[Array, "q 4 4 3 3"]:
    """Minus the derivative of a block's forces by its vertices, without friction.

    By vertex j the force on vertex i changes by minus the sum over the points of
    mix_i n (mix_j g + c_j)^T + mix_i mix_j over I, c_j that by the chord with an end at j, if any.
    """
    block, points = n.shape[1], n.shape[2] * n.shape[3]
    mix = mix.reshape(points, 4)
    flat = lambda v: v.reshape(-1, block, points)
    n, g = flat(n), flat(found.by_apart)
    at_j = mix.T[:, None, None, :]
    by_j = at_j * g[None]
    if found.by_chords:
        by_a, by_b = (flat(v) for v in found.by_chords)
        by_j = by_j + jnp.stack([-by_a, by_a, -by_b, by_b])  # (j, l, q, x)
    left = jnp.einsum("ikqx->qikx", at_j * n[None]).reshape(block, 12, points)
    right = jnp.einsum("jlqx->qxjl", by_j).reshape(block, points, 12)
    outer = (left @ right).reshape(block, 4, 3, 4, 3)
    products = (mix[:, :, None] * mix[:, None, :]).reshape(points, 16)
    across = (flat(found.over)[0] @ products).reshape(block, 4, 4, 1, 1)
    return -(jnp.swapaxes(outer, 2, 3) + across * jnp.eye(3, dtype=n.dtype)[None, None, None])


def gather(pairs: NearPairs, force: Float[Array, "q 4 w"], vertices: int) -> Float[Array, "j w"]:
    """Sum over the pairs at every vertex."""
    index = jnp.stack(vertices_of(pairs), 1)
    return jnp.zeros((vertices, force.shape[2]), force.dtype).at[index].add(force)


def rates_of(contact: Contact, motion: NodeMotion) -> Float[Array, "nodes w"]:
    """Of the nodes, what contact asks for: velocities, and with friction spins (inertial axes)."""
    if contact.friction is None:
        return motion.velocity
    spin = rotations.rotate(motion.quaternion, motion.angular_velocity)
    return jnp.concatenate([motion.velocity, spin], 1)


def forces(
    contact: Contact,
    sites: Sites,
    pairs: NearPairs,
    motion: NodeMotion,
) -> Float[Array, "nodes w"]:
    """Contact forces on the nodes [N], for a list of pairs found before.

    With friction its moments follow them (inertial axes) [N m].
    """
    rates = interpolate(sites, rates_of(contact, motion))
    found = pair_forces(contact, sites, pairs, interpolate(sites, motion.position), rates)
    return spread(sites, found.force, motion.position.shape[0])
