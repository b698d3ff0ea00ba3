"""Self-contact: contact points, the search through the screening aperture, and pair forces.

Contact points lie at the middle of equal arcs of their own, whatever the grid; position and
velocity are interpolated from the two nodes beside each. The search marks the points that have a
partner within reach and inside both apertures; forces then act between all pairs of marked
points, as one dense array: no pair list that could overflow, and equal and opposite by
construction.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from rodjax import rotations
from rodjax.contact_laws import AbstractLaw, PairProperties, continued
from rodjax.rod import Rod


def _as_float(value):
    return jnp.asarray(value, jnp.result_type(float, jnp.asarray(value).dtype))


class Contact(eqx.Module):
    """Which points of the rod interact, and by what law.

    Args:
        law: the pair interaction.
        points: number of contact points; their spacing h = L/points must resolve the law (for a
            force ripple under 2 %: h <= sqrt(2 d w)/2, d the settled distance, w = |psi/psi'|, and
            h <= d/8, which resolves the edge of the aperture).
        cutoff: no force beyond this distance of the centrelines [m].
        aperture: screening aperture theta [rad] (Fig. 4): a pair acts if the line between the
            points lies within theta/2 of either cross-section plane. 0 is the plane, pi all
            space. The edge is smoothed over the outer `edge` of sin(theta/2), the cut-off over
            the outer `edge` of the distance.
        exclusion: points closer than this along the rod never interact [m]; default 1.5 cutoff.
            Must not be less than the cut-off, or a straight rod would repel itself.
        capacities: sizes of the active set that are compiled, increasing; the smallest that
            fits is used at each step, and a run that outgrows the largest says so. Default:
            32, 80, 160 and on by doubling up to all points, which cannot overflow. Under `vmap`
            give a single one.
    """

    law: AbstractLaw
    points: int = eqx.field(static=True)
    cutoff: Float[Array, ""] = eqx.field(converter=_as_float)
    aperture: Float[Array, ""] = eqx.field(converter=_as_float, default=np.pi / 2)
    edge: Float[Array, ""] = eqx.field(converter=_as_float, default=0.25)
    exclusion: Float[Array, ""] | None = eqx.field(
        converter=lambda x: None if x is None else _as_float(x), default=None
    )
    capacities: tuple[int, ...] | None = eqx.field(static=True, default=None)

    def __check_init__(self):
        if self.points < 2:
            raise ValueError(f"points: at least 2 contact points, got {self.points}")
        ranges = {
            "cutoff": (self.cutoff, 0, np.inf),
            "aperture": (self.aperture, 0, np.pi),
            "edge": (self.edge, 0, 1),
        }
        for name, (value, low, high) in ranges.items():
            if isinstance(value, jax.core.Tracer) or not hasattr(value, "shape"):
                continue
            if not np.all((np.asarray(value) > low) & (np.asarray(value) <= high)):
                raise ValueError(f"{name}: must be in ({low:g}, {high:g}], got {value}")
        traced = any(isinstance(x, jax.core.Tracer) for x in (self.exclusion, self.cutoff))
        concrete = self.exclusion is not None and not traced and hasattr(self.exclusion, "shape")
        if concrete and np.any(np.asarray(self.exclusion) < np.asarray(self.cutoff)):
            raise ValueError(
                f"cutoff: {self.cutoff} exceeds the excluded neighbour distance"
                f" {self.exclusion}; a straight rod would repel itself: raise `exclusion`"
            )
        if self.capacities is not None and list(self.capacities) != sorted(set(self.capacities)):
            raise ValueError(f"capacities: must increase, got {self.capacities}")

    def check(self, rod: Rod) -> None:
        """Raise ValueError where the rod lacks what contact needs."""
        if rod.diameter is None:
            raise ValueError("diameter: contact needs the rod's diameter; give it to the section")
        if self.law.uses_mass() and rod.mass is None:
            raise ValueError("mass: this contact law scales with the rod's mass per length")
        length = jnp.sum(rod.length)
        reach = self.excluded
        if any(isinstance(x, jax.core.Tracer) for x in (length, reach)):
            return
        if np.any(np.asarray(reach) >= np.asarray(length)):
            raise ValueError("exclusion: as long as the rod; no two points could interact")

    @property
    def excluded(self) -> Float[Array, ""]:
        """Arc distance below which points never interact."""
        return 1.5 * self.cutoff if self.exclusion is None else self.exclusion

    @property
    def sizes(self) -> tuple[int, ...]:
        """Sizes of the active set that are compiled."""
        if self.capacities is not None:
            return tuple(min(size, self.points) for size in self.capacities)
        sizes = [32, 80, 160]
        while sizes[-1] < self.points:
            sizes.append(2 * sizes[-1])
        # each size costs compile time: none that nearly is all points
        return (*[size for size in sizes if size < 0.6 * self.points], self.points)


class Sites(NamedTuple):
    """Where the contact points lie on the grid."""

    arc_length: Float[Array, " p"]
    element: Int[Array, " p"]
    weight: Float[Array, " p"]  # of the element's second node
    spacing: Float[Array, ""]
    diameter: Float[Array, " p"]
    mass: Float[Array, " p"] | None


class ActiveSet(NamedTuple):
    """Outcome of the search for one step."""

    order: Int[Array, " p"]  # all points, those with a partner first
    count: Int[Array, ""]  # how many have one
    level: Int[Array, ""]  # 0: none; k: the k-th size holds them
    overflow: Int[Array, ""]  # points left out
    tangents: Float[Array, "p 3"]  # of the points, for the apertures


def sites(contact: Contact, rod: Rod) -> Sites:
    """Middles of equal arcs, and the elements that hold them."""
    length = jnp.sum(rod.length)
    spacing = length / contact.points
    s = (jnp.arange(contact.points) + 0.5) * spacing
    nodes = rod.arc_length
    element = jnp.clip(jnp.searchsorted(nodes, s, side="right") - 1, 0, rod.elements - 1)
    weight = (s - nodes[element]) / rod.length[element]
    mass = None if rod.mass is None else rod.mass[element]
    assert rod.diameter is not None
    return Sites(s, element, weight, spacing, rod.diameter[element], mass)


def interpolate(where: Sites, nodal: Float[Array, "nodes k"]) -> Float[Array, "p k"]:
    """Values at the contact points."""
    weight = where.weight[:, None]
    return (1 - weight) * nodal[where.element] + weight * nodal[where.element + 1]


def spread(where: Sites, values: Float[Array, "p k"], nodes: int) -> Float[Array, "nodes k"]:
    """The transpose of `interpolate`: forces on points to forces on nodes."""
    weight = where.weight[:, None]
    out = jnp.zeros((nodes, values.shape[1]), values.dtype)
    out = out.at[where.element].add((1 - weight) * values)
    return out.at[where.element + 1].add(weight * values)


def _smooth_step(x):
    """0 below 0, 1 above 1, C2 between."""
    x = jnp.clip(x, 0.0, 1.0)
    return x**3 * (10 - 15 * x + 6 * x**2)


def window(contact: Contact, distance, cosine_a, cosine_b):
    """Smooth gate of a pair: near enough, and inside both apertures.

    `cosine` is n.t, n the unit vector between the points, t a point's tangent; inside means
    |n.t| <= sin(theta/2).
    """
    near = _smooth_step((1 - distance / contact.cutoff) / contact.edge)
    limit = jnp.sin(0.5 * contact.aperture) ** 2
    inside = lambda c: _smooth_step((1 - c**2 / limit) / contact.edge)
    # theta = pi is all space: no gate
    gate = jnp.where(limit > 1 - 1e-12, 1.0, inside(cosine_a) * inside(cosine_b))
    return near * gate


def search(
    contact: Contact,
    rod: Rod,
    where: Sites,
    position: Float[Array, "nodes 3"],
    quaternion: Float[Array, "nodes 4"],
    displacement: Float[Array, "nodes 3"] | None = None,
) -> ActiveSet:
    """Points that have a partner within reach and inside the apertures.

    `displacement` is the expected motion of the step; a pair's reach is the cut-off plus one and
    a half times its relative displacement, so that no strand tunnels between two searches. A first
    pass over groups of eight points sees cheaply that nothing is near; the second is all pairs.
    `quaternion` gives the tangents, which the step then holds.
    """
    points = lax.stop_gradient(interpolate(where, position))
    tangent = interpolate(where, rotations.tangent_director(quaternion))
    tangent = tangent / jnp.sqrt(jnp.sum(tangent**2, 1, keepdims=True))
    moved = None
    if displacement is not None:
        moved = 1.5 * lax.stop_gradient(interpolate(where, displacement))

    def between(x):
        return [x[None, :, k] - x[:, None, k] for k in range(3)]

    def squares(x):
        dx = between(x)
        return dx[0] ** 2 + dx[1] ** 2 + dx[2] ** 2

    def all_pairs(_):
        dx = between(points)
        squared = dx[0] ** 2 + dx[1] ** 2 + dx[2] ** 2
        distance = jnp.sqrt(squared)
        motion = 0.0 if moved is None else jnp.sqrt(squares(moved))
        # wider than the aperture, because the line between the points turns during the step
        slack = jnp.minimum(jnp.sin(0.5 * contact.aperture) + 0.25, 1.0) ** 2 * squared
        t = lax.stop_gradient(tangent)
        along_a = sum(dx[k] * t[:, None, k] for k in range(3)) ** 2
        along_b = sum(dx[k] * t[None, :, k] for k in range(3)) ** 2
        s = where.arc_length
        near = distance < contact.cutoff + motion
        near = near & (jnp.abs(s[:, None] - s[None, :]) >= contact.excluded)
        inside = (along_a <= slack) & (along_b <= slack)
        return jnp.any(near & (inside | (distance < 2 * motion)), 1)

    group = 8
    some = slice(group // 2, None, group)
    half = group * where.spacing
    motion = 0.0 if moved is None else jnp.sqrt(squares(moved[some])) + 2 * half
    arcs = where.arc_length[some]
    apart = jnp.abs(arcs[:, None] - arcs[None, :]) >= contact.excluded - 2 * half
    near = jnp.sqrt(squares(points[some])) < contact.cutoff + motion + 2 * half
    nothing = jnp.zeros((contact.points,), bool)
    marked = lax.cond(jnp.any(near & apart), all_pairs, lambda _: nothing, None)
    count = jnp.sum(marked).astype(jnp.int32)
    order = jnp.argsort(~marked, stable=True).astype(jnp.int32)
    sizes = jnp.asarray(contact.sizes, jnp.int32)
    level = jnp.minimum(jnp.searchsorted(sizes, count), len(contact.sizes) - 1) + 1
    level = jnp.where(count == 0, 0, level).astype(jnp.int32)
    overflow = jnp.maximum(count - sizes[-1], 0)
    return ActiveSet(order, count, level, overflow, tangent)


class Pairs(NamedTuple):
    """Interaction of all pairs of a set of m points; axis 0 the point acted on."""

    force: Float[Array, "m 3"]  # on every point [N]
    derivative: Float[Array, "m 3 m 3"] | None  # of minus the force by positions [N/m]
    distance: Float[Array, "m m"]
    acting: Bool[Array, "m m"]  # pairs with a force
    total: Float[Array, ""]  # sum of the magnitudes of all pair forces [N]


def pairs(
    contact: Contact,
    where: Sites,
    active: ActiveSet,
    size: int,
    points: Float[Array, "p 3"],
    velocities: Float[Array, "p 3"],
    by_velocity: Float[Array, ""] | None = None,
) -> Pairs:
    """Forces among the first `size` active points and, if asked, their exact derivative.

    The force on b from a is P n, P = psi(d, c) window h^2, with n from a to b. Its derivative by
    the positions, velocities following positions by the factor `by_velocity`, is
        n g^T + (P/d)(I - n n^T),   g = P_d n - P_c ((w - d' n)/d + by_velocity n) + sum P_c_i ...
    with w the relative velocity and the last terms from the apertures, tangents held.
    """
    chosen = active.order[:size]
    valid = jnp.arange(size) < active.count
    x, v, t = points[chosen], velocities[chosen], active.tangents[chosen]
    s = where.arc_length[chosen]
    mean = lambda p: 0.5 * (p[:, None] + p[None, :])
    pair = PairProperties(
        mean(where.diameter[chosen]), None if where.mass is None else mean(where.mass[chosen])
    )
    acts = (jnp.abs(s[:, None] - s[None, :]) >= contact.excluded) & valid[:, None] & valid[None, :]
    r = [x[None, :, k] - x[:, None, k] for k in range(3)]
    squared = r[0] ** 2 + r[1] ** 2 + r[2] ** 2
    acts = acts & (squared > 0)
    # pairs that do not act are put at the cut-off, where everything is zero and smooth
    distance = jnp.where(acts, jnp.sqrt(jnp.where(acts, squared, 1.0)), contact.cutoff)
    n = [jnp.where(acts, rk / distance, 0.0) for rk in r]
    w = [v[None, :, k] - v[:, None, k] for k in range(3)]
    opening = sum(nk * wk for nk, wk in zip(n, w, strict=True))
    ta, tb = [t[:, None, k] for k in range(3)], [t[None, :, k] for k in range(3)]
    cosine_a = sum(nk * tk for nk, tk in zip(n, ta, strict=True))
    cosine_b = sum(nk * tk for nk, tk in zip(n, tb, strict=True))

    def magnitude(d, c, ca, cb):
        psi = continued(contact.law, d, c, pair)
        return psi * window(contact, d, ca, cb) * where.spacing**2

    inputs = (distance, -opening, cosine_a, cosine_b)
    if by_velocity is None:
        p = jnp.where(acts, magnitude(*inputs), 0.0)
        force = -jnp.stack([jnp.sum(p * nk, 1) for nk in n], 1)
        return Pairs(force, None, distance, p != 0, 0.5 * jnp.sum(jnp.abs(p)))

    p, pull = jax.vjp(magnitude, *inputs)
    slopes = [jnp.where(acts, g, 0.0) for g in pull(jnp.ones_like(p))]
    p = jnp.where(acts, p, 0.0)
    # without the barrier XLA evaluates the law anew for each of the nine components below
    p, slopes, n = lax.optimization_barrier((p, slopes, n))
    p_d, p_c, p_a, p_b = slopes
    over = p / distance
    along = p_d - p_c * by_velocity
    g = [
        along * n[k]
        + (
            -p_c * (w[k] - opening * n[k])
            + p_a * (ta[k] - cosine_a * n[k])
            + p_b * (tb[k] - cosine_b * n[k])
        )
        / distance
        for k in range(3)
    ]
    # force on a is -P n; minus its derivative by x_b is +H, by x_a -H; axes (a, i, b, j). The
    # barrier keeps XLA from evaluating all the above anew for each of the nine components
    normal = jnp.stack(n, 1)  # (a, i, b)
    rest = jnp.stack([gk - over * nk for gk, nk in zip(g, n, strict=True)], 2)  # (a, b, j)
    normal, rest, over = lax.optimization_barrier((normal, rest, over))
    eye = jnp.eye(3, dtype=over.dtype)[:, None, :]
    h = normal[..., None] * rest[:, None] + over[:, None, :, None] * eye
    own = -jnp.sum(h, 2)
    index = jnp.arange(size)
    derivative = h.at[index, :, index, :].add(own)
    force = -jnp.stack([jnp.sum(p * nk, 1) for nk in n], 1)
    return Pairs(force, derivative, distance, p != 0, 0.5 * jnp.sum(jnp.abs(p)))


def forces(
    contact: Contact,
    rod: Rod,
    where: Sites,
    active: ActiveSet,
    position: Float[Array, "nodes 3"],
    velocity: Float[Array, "nodes 3"],
) -> Float[Array, "nodes 3"]:
    """Contact forces on the nodes [N], for an active set found before."""
    points, velocities = interpolate(where, position), interpolate(where, velocity)

    def some(size):
        def branch(_):
            force = pairs(contact, where, active, size, points, velocities).force
            full = jnp.zeros_like(points).at[active.order[:size]].set(force)
            return spread(where, full, rod.elements + 1)

        return branch

    return at_level(contact, active, lambda _: jnp.zeros_like(position), some, None)


def at_level(contact: Contact, active: ActiveSet, none, some, operand):
    """`none(operand)` without active points, else `some(size)(operand)` for the size in use."""
    branches = [none, *(some(size) for size in contact.sizes)]
    return lax.switch(active.level, branches, operand)


def _over_pairs(contact, where, active, reduce, start):
    """Fold `reduce(carry, rows, acts)` over blocks of active points (`rows`) against all points.

    `acts` (block, p) marks pairs of active points far enough apart along the rod. The number of
    blocks follows the number of active points; not differentiable in reverse mode.
    """
    block = min(32, contact.points)
    s = where.arc_length
    rank = (
        jnp.zeros((contact.points,), jnp.int32)
        .at[active.order]
        .set(jnp.arange(contact.points, dtype=jnp.int32))
    )
    partner = rank < active.count

    def body(i, carry):
        first = jnp.minimum(i * block, contact.points - block)
        rows = lax.dynamic_slice_in_dim(active.order, first, block)
        own = first + jnp.arange(block) < active.count
        acts = (jnp.abs(s[rows][:, None] - s[None, :]) >= contact.excluded) & partner
        return reduce(carry, rows, acts & own[:, None])

    blocks = (active.count + block - 1) // block
    return lax.fori_loop(0, blocks, body, start)


def approach_limit(
    contact: Contact,
    where: Sites,
    active: ActiveSet,
    position: Float[Array, "nodes 3"],
    change: Float[Array, "nodes 3"],
) -> Float[Array, ""]:
    """Largest fraction of a change of position that closes no gap by more than 70 %.

    The gap is counted from the law's smallest distance. Only the relative motion of active pairs
    is bounded, so a far part of the rod moves freely. No derivative passes through.
    """
    x = lax.stop_gradient(interpolate(where, position))
    dx = lax.stop_gradient(interpolate(where, change))
    diameter = lax.stop_gradient(where.diameter)
    law = lax.stop_gradient(contact.law)

    def reduce(limit, rows, acts):
        r = [x[None, :, k] - x[rows, None, k] for k in range(3)]
        w = [dx[None, :, k] - dx[rows, None, k] for k in range(3)]
        squared = r[0] ** 2 + r[1] ** 2 + r[2] ** 2
        distance = jnp.sqrt(jnp.where(squared > 0, squared, 1.0))
        closing = -(r[0] * w[0] + r[1] * w[1] + r[2] * w[2]) / distance
        mean = 0.5 * (diameter[rows][:, None] + diameter[None, :])
        floor = law.smallest(PairProperties(mean, None))
        gap = jnp.maximum(distance - floor, 0.05 * mean)
        ratio = 0.7 * gap / jnp.where(closing > 0, closing, 1.0)
        return jnp.minimum(limit, jnp.min(jnp.where(acts & (closing > 0), ratio, 1.0)))

    return _over_pairs(contact, where, active, reduce, jnp.ones((), position.dtype))


def passage_suspected(
    contact: Contact,
    where: Sites,
    active: ActiveSet,
    before: Float[Array, "nodes 3"],
    after: Float[Array, "nodes 3"],
):
    """Whether the line between two active points turned by more than a right angle in a step."""
    old = lax.stop_gradient(interpolate(where, before))
    new = lax.stop_gradient(interpolate(where, after))

    def reduce(passed, rows, acts):
        product = sum(
            (old[None, :, k] - old[rows, None, k]) * (new[None, :, k] - new[rows, None, k])
            for k in range(3)
        )
        return passed | jnp.any(acts & (product < 0))

    return _over_pairs(contact, where, active, reduce, jnp.asarray(False))


class ContactReport(NamedTuple):
    """Contact of one configuration."""

    force: Float[Array, "nodes 3"]  # on the nodes [N]
    total: Float[Array, ""]  # sum of the magnitudes of all pair forces [N]
    smallest: Float[Array, ""]  # least d/D of the pairs that act; infinite without one
    count: Int[Array, ""]  # active points


def report(
    contact: Contact,
    rod: Rod,
    position: Float[Array, "nodes 3"],
    quaternion: Float[Array, "nodes 4"],
    velocity: Float[Array, "nodes 3"],
) -> ContactReport:
    """Contact forces and the smallest gap of a configuration, by a search of its own."""
    where = sites(contact, rod)
    active = search(contact, rod, where, position, quaternion)
    points, velocities = interpolate(where, position), interpolate(where, velocity)
    zero = jnp.zeros((), position.dtype)

    def some(size):
        def branch(_):
            found = pairs(contact, where, active, size, points, velocities)
            chosen = active.order[:size]
            full = jnp.zeros_like(points).at[chosen].set(found.force)
            diameter = where.diameter[chosen]
            ratio = found.distance / (0.5 * (diameter[:, None] + diameter[None, :]))
            return (
                spread(where, full, rod.elements + 1),
                found.total,
                jnp.min(jnp.where(found.acting, ratio, jnp.inf)),
            )

        return branch

    none = lambda _: (jnp.zeros_like(position), zero, zero + jnp.inf)
    force, total, smallest = at_level(contact, active, none, some, None)
    return ContactReport(force, total, smallest, active.count)
