"""Rings in equilibrium by Metropolis' method, without drag, noise or steps of time.

Of a ring of elements whose edges yield as thermal rods do, the density of frames Q_i and edges is

    exp(-E/kT),  E = sum phi_i . B phi_i/(2 ds) + contact,  edge_i = ds t_i + h_i,  sum edge_i = 0,

phi_i the relative rotations, t_i the tangent half way, and h_i normal with the variance ds kT c of
each component (c the compliance). Of the edges whose sum is none, the h_i are those of the free
ring less the mean of all edges, and frames are left with exp(-|sum ds t_i|^2/(2 n ds kT c)). One
frame after the other is turned a little; then all h_i are partly drawn anew. Contact is the energy
of the scene's, over its own points: its forces and its search are not used.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

import rodjax as rx
from rodjax.interactions.contact_energy import pair_energy
from rodjax.interactions.contact_law import PairProperties
from rodjax.rods import topology

_TURN, _KEPT = 0.25, 0.8  # size of a frame's turn [rad], what is kept of h
_KNOWN = 4000  # distances in the table of the contact's energy


def writhes(scene: rx.Scene, kt: float, chains: int, sweeps: int, seed: int) -> np.ndarray:
    """Writhe of the ring after each of so many sweeps, (sweeps, chains), a third dropped first."""
    state = rx.placing(scene)
    one = partial(_chain, scene, kt, state.quaternion, sweeps + sweeps // 2)
    found = rx.jit(jax.vmap(one))(jax.random.split(jax.random.key(seed), chains))
    return np.asarray(found).T[sweeps // 2 :]


def _chain(scene, kt, frames, sweeps, key):
    """One chain of samples, from the frames given; the last is the first, turned by the weld."""
    rod = scene.rod
    n, spacing, compliance = rod.elements, rod.length[0], rod.compliance[0, 0]
    weld = rx.rotations.multiply(rx.rotations.conjugate(frames[0]), frames[-1])
    scale = jnp.sqrt(spacing * kt * compliance)
    stiffness = rod.stiffness[0]

    def placed(frames, loose):
        last = rx.rotations.multiply(frames[:1], weld[None])
        following = jnp.concatenate([frames[1:], last])
        relative = rx.rotations.multiply(rx.rotations.conjugate(frames), following)
        phi = rx.rotations.logarithm(relative)
        half = rx.rotations.multiply(frames, rx.rotations.exponential(0.5 * phi))
        tangents = spacing * rx.rotations.tangent_director(half)
        gap = jnp.sum(tangents, 0)
        energy = 0.5 * jnp.sum(stiffness[None] * phi**2) / spacing / kt
        energy = energy + 0.5 * jnp.sum(gap**2) / (n * scale**2)
        edges = tangents + scale * loose
        edges = edges - jnp.mean(edges, 0, keepdims=True)
        position = jnp.concatenate([jnp.zeros((1, 3)), jnp.cumsum(edges, 0)])
        return energy + _repelled(scene, position) / kt, position

    def tried(carry, drawn):
        frames, loose, energy = carry
        site, turn, level = drawn
        turned = rx.rotations.multiply(frames[site], rx.rotations.exponential(_TURN * turn))
        new = frames.at[site].set(turned)
        other = placed(new, loose)[0]
        taken = level < energy - other
        pick = lambda a, b: jnp.where(taken, a, b)
        return (pick(new, frames), loose, pick(other, energy)), None

    def sweep(carry, key):
        frames, loose, _ = carry
        turns, levels, fresh, last = jax.random.split(key, 4)
        new = _KEPT * loose + np.sqrt(1 - _KEPT**2) * jax.random.normal(fresh, (n, 3))
        energy, other = placed(frames, loose)[0], placed(frames, new)[0]
        taken = jnp.log(jax.random.uniform(last)) < energy - other
        loose, energy = jnp.where(taken, new, loose), jnp.where(taken, other, energy)
        drawn = (
            jnp.arange(n),
            jax.random.normal(turns, (n, 3)),
            jnp.log(jax.random.uniform(levels, (n,))),
        )
        carry, _ = jax.lax.scan(tried, (frames, loose, energy), drawn)
        position = placed(*carry[:2])[1]
        return carry, topology.writhe(position[:-1], closed=True)

    begun = frames[:-1], jnp.zeros((n, 3)), jnp.zeros(())
    return jax.lax.scan(sweep, begun, jax.random.split(key, sweeps))[1]


def _repelled(scene: rx.Scene, position):
    """Energy of the contact over its own points, by a table of its law's energy by distance."""
    contact, rod = scene.contact, scene.rod
    n, count = rod.elements, contact.points_per_segment
    spacing = float(np.asarray(rod.length)[0])
    at = (np.arange(count * n) + 0.5) / count
    apart = np.abs(at[:, None] - at)
    near = np.minimum(apart, n - apart) * spacing < float(contact.exclusion)
    first, second = np.nonzero(np.triu(~near))
    part = (jnp.arange(count, dtype=position.dtype) + 0.5)[None, :, None] / count
    points = position[:-1, None] + part * jnp.diff(position, axis=0)[:, None]
    points = points.reshape(count * n, 3)
    distance = jnp.sqrt(jnp.sum((points[first] - points[second]) ** 2, 1))
    known = np.linspace(0.05, float(contact.cutoff), _KNOWN)
    pair = PairProperties(jnp.full(_KNOWN, rod.diameter[0]), None)
    energy = pair_energy(contact, jnp.asarray(known), pair)
    place = jnp.clip((distance - known[0]) / (known[1] - known[0]), 0.0, _KNOWN - 1.001)
    below, over = place.astype(int), place % 1.0
    found = energy[below] * (1 - over) + energy[below + 1] * over
    within = jnp.where(distance < known[-1], found, 0.0)
    return jnp.sum(within) * (spacing / count) ** 2
