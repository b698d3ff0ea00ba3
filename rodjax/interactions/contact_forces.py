"""Contact forces: the law summed over the points of near pairs of segments, and its derivative."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from rodjax.interactions.contact import Contact
from rodjax.interactions.contact_laws import PairProperties, continued
from rodjax.interactions.screening import BLOCK, NearPairs, search
from rodjax.interactions.sites import Sites, along, interpolate, sites_of, spread
from rodjax.numerics.batching import largest, one_by_one
from rodjax.rods.rod import Rod


def smooth_step(x):
    """0 below 0, 1 above 1, C2 between."""
    x = jnp.clip(x, 0.0, 1.0)
    return x**3 * (10 - 15 * x + 6 * x**2)


def window(contact: Contact, distance, pair: PairProperties, cosines=()):
    """Smooth gate of a pair of points: near enough, and inside both apertures.

    A law that vanishes by itself is not touched by the cut-off. `cosines` are n.t, n the unit
    vector between the points, t the chord at either; inside means |n.t| <= sin(theta/2). It fades
    over the whole aperture: an edge would have to be resolved by the points, at several times
    their number for the same ripple of the force.
    """
    close = jnp.ones_like(distance)
    if contact.law.extent(pair) is None:
        close = smooth_step((1 - distance / contact.cutoff) / contact.edge)
    if contact.acting_aperture is None:
        return close
    limit = jnp.sin(0.5 * contact.acting_aperture) ** 2
    cosine_a, cosine_b = cosines
    inside = lambda c: smooth_step(1 - c**2 / limit)
    # theta = pi is all space: no gate
    gate = jnp.where(
        limit > 1 - 10 * jnp.finfo(limit.dtype).eps, 1.0, inside(cosine_a) * inside(cosine_b)
    )
    return close * gate


class PairForces(NamedTuple):
    """Interaction of a list of pairs of segments.

    The four vertices of a pair are those of its first, then of its second segment; entries beyond
    `NearPairs.count` are zero.
    """

    force: Float[Array, "j 3"]  # on the vertices [N]
    derivative: Float[Array, "q 4 4 3 3"] | None  # of minus the force, vertex by vertex [N/m]
    smallest: Float[Array, ""]  # least d/D of the points that act; infinite without one
    total: Float[Array, ""]  # sum of the magnitudes of all forces between points [N]


def vertices_of(pairs: NearPairs) -> tuple[Array, Array, Array, Array]:
    """Indices of the four vertices of every pair."""
    return pairs.first, pairs.first + 1, pairs.second, pairs.second + 1


@eqx.filter_custom_jvp
def forces_and_derivative(
    contact: Contact,
    sites: Sites,
    pairs: NearPairs,
    vertices: Float[Array, "j 3"],
    velocities: Float[Array, "j 3"],
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
    return in_use(vertices, arrays, sites, pairs, velocities, by_velocity)


def _pairs_in_use(vertices, contact, sites, pairs, velocities, by_velocity) -> PairForces:
    evaluate, rows, empty = _blocks(contact, sites, pairs, vertices, velocities, by_velocity)

    def body(i, found):
        now = evaluate(jax.tree.map(lambda leaf: leaf[i], rows))
        return jax.tree.map(lambda buffer, value: buffer.at[i].set(value), found, now)

    def some():
        buffers = jax.tree.map(
            lambda leaf: jnp.broadcast_to(leaf, (len(rows[0]), *leaf.shape)), empty
        )
        used = (pairs.count + BLOCK - 1) // BLOCK
        return _joined(pairs, vertices, lax.fori_loop(0, used, body, buffers))

    none = lambda: _no_pairs(vertices, contact, sites, pairs, velocities, by_velocity)
    return lax.cond(pairs.count > 0, some, none)


def _no_pairs(vertices, contact, sites, pairs, velocities, by_velocity) -> PairForces:
    dtype = vertices.dtype
    derivative = jnp.zeros((pairs.first.shape[0], 4, 4, 3, 3), dtype)
    return PairForces(
        jnp.zeros_like(vertices), derivative, jnp.asarray(jnp.inf, dtype), jnp.zeros((), dtype)
    )


def _nothing_near(vertices, contact, sites, pairs, velocities, by_velocity) -> Bool[Array, ""]:
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
    velocities: Float[Array, "j 3"],
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
    evaluate, rows, empty = _blocks(contact, sites, pairs, vertices, velocities, by_velocity)
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
    )


def _blocks(contact, sites, pairs, vertices, velocities, by_velocity):
    """What evaluates a block of pairs; the blocks (first place, vertices); an empty one's result.

    Forces are those on the four vertices of every pair.
    """
    count, screened = contact.points_per_segment, contact.acting_aperture is not None
    part = (jnp.arange(count, dtype=vertices.dtype) + 0.5) / count
    one, other = jnp.broadcast_arrays(part[:, None], part[None, :])
    # x_b - x_a = sum_i mix[a, b, i] X_i over the four vertices
    mix = jnp.stack([one - 1, -one, 1 - other, other], -1)
    index = jnp.stack(vertices_of(pairs), 1)
    room = index.shape[0]
    padded = -(-room // BLOCK) * BLOCK
    # filled up with a segment and itself, which does not act but has a length
    filling = jnp.broadcast_to(jnp.asarray([0, 1, 0, 1], index.dtype), (padded - room, 4))
    index = jnp.concatenate([index, filling])
    at_a = lambda v, i: v[i[:, 0]][:, :, None]
    at_b = lambda v, i: v[i[:, 2]][:, None, :]

    def evaluate(row):
        first, index = row
        # components lead: arrays with a last axis of three are slow on a CPU
        valid = first + jnp.arange(BLOCK, dtype=jnp.int32) < pairs.count
        s, mean = sites.arc_length, lambda v: 0.5 * (at_a(v, index) + at_b(v, index))
        pair = PairProperties(
            mean(sites.diameter), None if sites.mass is None else mean(sites.mass)
        )
        weight = lambda: sites.weigh(lambda v: at_a(v, index), lambda v: at_b(v, index))
        acts = along(sites, at_a(s, index), at_b(s, index)) >= contact.excluded
        between = lambda v: jnp.einsum("abi,qik->kqab", mix, v[index])
        r, w = between(vertices), between(velocities)
        squared = jnp.sum(r**2, 0)
        acts = acts & valid[:, None, None] & (squared > 0)
        # pairs that do not act are put at the cut-off, where everything is zero and smooth
        distance = jnp.where(acts, jnp.sqrt(jnp.where(acts, squared, 1.0)), contact.cutoff)
        n = jnp.where(acts[None], r / distance[None], 0.0)
        opening = jnp.sum(n * w, 0)
        cosines = ()
        if screened:
            corner = vertices[index]  # (q, 4, 3)
            chords = corner[:, 1::2] - corner[:, ::2]
            lengths = jnp.sqrt(jnp.sum(chords**2, -1))
            t = jnp.moveaxis(chords / lengths[..., None], 2, 0)[..., None, None]
            tangents = t[:, :, 0], t[:, :, 1]
            cosines = tuple(jnp.sum(n * t, 0) for t in tangents)

        def magnitude(d, c, *cosines):
            psi = continued(contact.law, d, c, pair)
            return psi * window(contact, d, pair, cosines) * weight()

        inputs = (distance, -opening, *cosines)
        if by_velocity is None:
            p, h = jnp.where(acts, magnitude(*inputs), 0.0), None
        else:

            def slopes():
                p, pull = jax.vjp(magnitude, *inputs)
                p_d, p_c, *by_cosines = (jnp.where(acts, g, 0.0) for g in pull(jnp.ones_like(p)))
                p = jnp.where(acts, p, 0.0)
                over = p / distance
                # numbers of the pairs of points beside vectors, whose components lead
                p_d, p_c, opened = (x[None] for x in (p_d, p_c, opening))
                across, by_chords = -p_c * (w - opened * n), []
                if screened:
                    p_a, p_b, c_a, c_b = (x[None] for x in (*by_cosines, *cosines))
                    ta, tb = tangents
                    size_a, size_b = (lengths[None, :, k, None, None] for k in (0, 1))
                    across = p_a * (ta - c_a * n) + p_b * (tb - c_b * n) - p_c * (w - opened * n)
                    by_chords = [p_a * (n - c_a * ta) / size_a, p_b * (n - c_b * tb) / size_b]
                g = (p_d - by_velocity * p_c) * n + across / distance[None]
                return p, over, g - over[None] * n, *by_chords

            point, vector = jnp.zeros_like(distance), jnp.zeros_like(n)
            nothing = lambda: (point, point, *(vector for _ in range(3 if screened else 1)))
            # always so; but what a branch returns is stored, and XLA would otherwise evaluate it
            # anew for every one of the numbers below
            p, over, g, *by_chords = lax.cond(first < pairs.count, slopes, nothing)
            h = _by_vertices(mix, n, over, g, by_chords)
        force = jnp.einsum("abi,kqab->qik", mix, p[None] * n)
        ratio = jnp.min(jnp.where(p != 0, distance / pair.diameter, jnp.inf))
        return PairForces(force, h, ratio, jnp.sum(jnp.abs(p)))

    rows = jnp.arange(0, padded, BLOCK, dtype=jnp.int32), index.reshape(-1, BLOCK, 4)
    zeros = lambda *shape: jnp.zeros(shape, vertices.dtype)
    derivative = None if by_velocity is None else zeros(BLOCK, 4, 4, 3, 3)
    empty = PairForces(zeros(BLOCK, 4, 3), derivative, zeros() + jnp.inf, zeros())
    return evaluate, rows, empty


def _by_vertices(mix, n, over, g, by_chords) -> Float[Array, "q 4 4 3 3"]:
    """Minus the derivative of a block's forces by its vertices, from those by distance and chords.

    By vertex j the force on vertex i changes by minus the sum over the points of
    mix_i n (mix_j g + c_j)^T + mix_i mix_j over I, c_j that by the chord with an end at j, if any.
    """
    block, points = n.shape[1], n.shape[2] * n.shape[3]
    mix = mix.reshape(points, 4)
    flat = lambda v: v.reshape(-1, block, points)
    n, g = flat(n), flat(g)
    at_j = mix.T[:, None, None, :]
    by_j = at_j * g[None]
    if by_chords:
        by_a, by_b = (flat(v) for v in by_chords)
        by_j = by_j + jnp.stack([-by_a, by_a, -by_b, by_b])  # (j, l, q, x)
    left = jnp.einsum("ikqx->qikx", at_j * n[None]).reshape(block, 12, points)
    right = jnp.einsum("jlqx->qxjl", by_j).reshape(block, points, 12)
    outer = (left @ right).reshape(block, 4, 3, 4, 3)
    products = (mix[:, :, None] * mix[:, None, :]).reshape(points, 16)
    across = (flat(over)[0] @ products).reshape(block, 4, 4, 1, 1)
    return -(jnp.swapaxes(outer, 2, 3) + across * jnp.eye(3, dtype=n.dtype)[None, None, None])


def gather(pairs: NearPairs, force: Float[Array, "q 4 3"], vertices: int) -> Float[Array, "j 3"]:
    """Sum over the pairs at every vertex."""
    index = jnp.stack(vertices_of(pairs), 1)
    return jnp.zeros((vertices, 3), force.dtype).at[index].add(force)


def forces(
    contact: Contact,
    rod: Rod,
    sites: Sites,
    pairs: NearPairs,
    position: Float[Array, "nodes 3"],
    velocity: Float[Array, "nodes 3"],
) -> Float[Array, "nodes 3"]:
    """Contact forces on the nodes [N], for a list of pairs found before."""
    return _report(contact, rod, sites, pairs, position, velocity).force


class ContactReport(NamedTuple):
    """Contact of one configuration.

    Attributes:
        force: on the nodes, inertial components [N].
        total: sum of the magnitudes of all forces between points [N].
        smallest: least d/D, distance over diameter, of the points that act; infinite without one.
        overflow: pairs were left out; raise the contact's `capacities` or `pairs_per_segment`.
    """

    force: Float[Array, "nodes 3"]  # on the nodes [N]
    total: Float[Array, ""]  # sum of the magnitudes of all forces between points [N]
    smallest: Float[Array, ""]  # least d/D of the points that act; infinite without one
    overflow: Bool[Array, ""]  # pairs were left out: raise the contact's capacities


def _report(contact, rod, sites, pairs, position, velocity) -> ContactReport:
    vertices, velocities = interpolate(sites, position), interpolate(sites, velocity)
    found = pair_forces(contact, sites, pairs, vertices, velocities)
    nodal = spread(sites, found.force, rod.elements + 1)
    return ContactReport(nodal, found.total, found.smallest, pairs.overflow)


def report(
    contact: Contact,
    rod: Rod,
    position: Float[Array, "nodes 3"],
    velocity: Float[Array, "nodes 3"],
    closed: bool | Bool[Array, ""] = False,
) -> ContactReport:
    """Contact forces and the smallest gap of a configuration, by a search of its own.

    Args:
        closed: whether the rod's ends are at one place, see `Scene.closed`.
    """
    contact = contact.fitted(rod)
    sites = sites_of(contact, rod, closed)
    pairs = search(contact, sites, position)
    return _report(contact, rod, sites, pairs, position, velocity)
