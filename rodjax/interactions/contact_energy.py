"""Energy of self-contact: what strands at rest have stored in the law between them.

Forces between points along the line that joins them, by their distance alone, have a potential:
those of any law in all space, its damping apart. A screening aperture turns the force with the
chords' directions and leaves it without one.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from rodjax.interactions.contact import Contact
from rodjax.interactions.contact_law import PairProperties, continued_potential
from rodjax.interactions.pair_points import smooth_step
from rodjax.interactions.screening import BLOCK, NearPairs, search
from rodjax.interactions.sites import Sites, along, interpolate, sites_of
from rodjax.rods.rod import Rod

# of Gauss, in (0, 1)
_POINTS, _WEIGHTS = (
    0.5 * np.asarray(v) + shift
    for v, shift in zip(np.polynomial.legendre.leggauss(16), (0.5, 0.0), strict=True)
)


def has_potential(contact: Contact) -> bool | Bool[Array, ""]:
    """Whether the forces at rest have a potential: whether they act in all space."""
    aperture = contact.acting_aperture
    if aperture is None:
        return True
    limit = jnp.sin(0.5 * aperture) ** 2
    return limit > 1 - 10 * jnp.finfo(limit.dtype).eps


def pair_energy(contact: Contact, distance, pair: PairProperties):
    """Integral of psi(x, 0) window(x) from d to the cut-off, per length of either [J/m^2].

    By parts, with u = (1 - x/cutoff)/edge on which the window S(u) depends:
    phi(d) S(u_d) - integral of phi(x(u)) S'(u) from 0 to u_d, phi counted from the cut-off.
    """
    dtype, law = distance.dtype, contact.law
    end, edge = contact.cutoff.astype(dtype), contact.edge.astype(dtype)
    zero = continued_potential(law, jnp.broadcast_to(end, distance.shape), pair)
    potential = continued_potential(law, distance, pair) - zero
    if law.extent(pair) is not None:
        return potential
    last = jnp.clip((1 - distance / end) / edge, 0.0, 1.0)
    wide = jax.tree.map(lambda v: v[..., None], pair)
    points, weights = (
        jnp.asarray(v, dtype).reshape((1,) * distance.ndim + (-1,)) for v in (_POINTS, _WEIGHTS)
    )
    u = last[..., None] * points
    fading = continued_potential(law, end * (1 - edge * u), wide) - zero[..., None]
    fading = weights * 30 * (u * (1 - u)) ** 2 * fading
    return potential * smooth_step(last) - last * jnp.sum(fading, -1)


def contact_energy(
    contact: Contact,
    rod: Rod,
    position: Float[Array, "nodes 3"],
    closed: bool | Bool[Array, ""] = False,
) -> Float[Array, ""]:
    """Energy of the contact of a configuration [J], zero where nothing is within the cut-off.

    Its negative derivative by the nodes is the contact force on them at rest. Not a number where
    an aperture leaves the force without potential. `closed` is that of the scene.
    """
    contact = contact.fitted(rod)
    sites = sites_of(contact, rod, closed)
    return stored(contact, sites, search(contact, sites, position), position)


def stored(
    contact: Contact, sites: Sites, pairs: NearPairs, position: Float[Array, "nodes 3"]
) -> Float[Array, ""]:
    """`contact_energy` for a list of pairs found before."""
    vertices = interpolate(sites, position)
    count = contact.points_per_segment
    part = (jnp.arange(count, dtype=position.dtype) + 0.5) / count
    padded = -(-pairs.first.shape[0] // BLOCK) * BLOCK
    index = jnp.arange(padded, dtype=pairs.count.dtype).reshape(-1, BLOCK)

    def points(segment):
        a, b = vertices[segment][:, None], vertices[segment + 1][:, None]
        return a + part[None, :, None] * (b - a)

    def evaluate(at):
        first, second = pairs.first[at], pairs.second[at]
        at_a, at_b = lambda v: v[first][:, :, None], lambda v: v[second][:, None, :]
        r = points(second)[:, None, :] - points(first)[:, :, None]
        squared = jnp.sum(r**2, -1)
        s, mean = sites.arc_length, lambda v: 0.5 * (at_a(v) + at_b(v))
        acts = along(sites, at_a(s), at_b(s)) >= contact.excluded
        acts = acts & (at < pairs.count)[:, None, None] & (squared > 0)
        acts = acts & (squared < contact.cutoff**2)
        distance = jnp.sqrt(jnp.where(acts, squared, contact.cutoff**2))
        mass = None if sites.mass is None else mean(sites.mass)
        energy = pair_energy(contact, distance, PairProperties(mean(sites.diameter), mass))
        return jnp.sum(sites.weigh(at_a, at_b) * jnp.where(acts, energy, 0.0))

    def block(total, at):
        again = jax.checkpoint(evaluate, prevent_cse=False)
        none = lambda at: jnp.zeros((), position.dtype)
        return total + lax.cond(at[0] < pairs.count, again, none, at), None

    total = lax.scan(block, jnp.zeros((), position.dtype), index)[0]
    return jnp.where(has_potential(contact), total, jnp.nan)
