"""What the search of contact finds, and strands that come too near or pass."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import DIAMETER, LAWS, PAIR, hairpin

from rodjax.interactions import pair_points, screening
from rodjax.interactions import sites as sites_module
from rodjax.interactions.contact import Contact
from rodjax.rods.builders import straight_rod
from rodjax.rods.section import circular_section
from rodjax.scenes.scene import Scene


def test_points_find_their_partners(bent):
    scene, _, near = bent
    where, found = near
    count = int(found.count)
    assert 10 < count < 60 and not found.overflow
    first, second = found.first[:count], found.second[:count]
    assert np.all(np.asarray(first) < np.asarray(second))
    # the two legs face each other
    s = np.asarray(where.arc_length).mean(1)
    assert np.all(np.abs(s[first] + s[second] - 1) < 0.25)
    assert {2, 17} <= {int(j) for j in first} | {int(j) for j in second}


def test_search_misses_no_pair_that_acts(bent):
    """Every pair of points with a force, found by brute force, is in the list."""
    scene, state, near = bent
    where, found = near
    vertices = np.asarray(sites_module.interpolate(where, state.position))
    part = (np.arange(2) + 0.5) / 2
    points = vertices[:-1, None] + part[:, None] * (vertices[1:, None] - vertices[:-1, None])
    chord = vertices[1:] - vertices[:-1]
    chord /= np.linalg.norm(chord, axis=1, keepdims=True)
    listed = set(zip(*(np.asarray(x)[: int(found.count)].tolist() for x in found[:2]), strict=True))
    acting = set()
    for a in range(20):
        for b in range(a + 1, 20):
            r = points[b][None] - points[a][:, None]
            d = np.linalg.norm(r, axis=-1)
            cosines = [np.sum(r * chord[segment], -1) / d for segment in (a, b)]
            apart = np.abs(where.arc_length[b][None] - where.arc_length[a][:, None])
            gate = pair_points.window(scene.contact, d, PAIR, cosines)
            if np.any((gate > 0) & (apart >= scene.contact.excluded)):
                acting.add((a, b))
    assert len(acting) > 5 and acting <= listed


def test_limit_keeps_strands_apart(bent):
    scene, state, near = bent
    # one leg moved right through the other
    change = jnp.zeros_like(state.position).at[:10, 0].set(0.2)
    limit = screening.approach_limit(scene.contact, *near, state.position, change)
    assert 0 < limit < 0.5
    assert screening.approach_limit(scene.contact, *near, state.position, -change) == 1


@pytest.mark.parametrize("pieces", [1, 40])
def test_passage_is_seen_fast_or_slow(pieces):
    """One leg tilted and moved through the other, in one step or in many; not beside it."""
    contact = Contact(LAWS["damped"], segments=20, cutoff=0.1)
    scene = Scene(hairpin(), contact=contact)
    place = scene.rod.position
    place = place.at[14:, 2].add(0.3 * (jnp.arange(11.0) - 6) / 11)  # the legs cross when projected

    @eqx.filter_jit
    def seen(before, after):
        found = scene.find_contact(before, after - before)
        return screening.passage_suspected(*found, before, after)

    def passed(shift):
        way = [place.at[14:].add(part * shift) for part in jnp.linspace(0, 1, pieces + 1)]
        return any(bool(seen(a, b)) for a, b in zip(way, way[1:], strict=False))

    assert passed(jnp.asarray([-0.16, 0.0, 0.0]))
    assert not passed(jnp.asarray([-0.06, 0.0, 0.0]))
    assert not passed(jnp.asarray([0.16, 0.0, 0.0]))
    assert not passed(jnp.asarray([-0.16, 0.0, 0.6]))


@pytest.mark.parametrize("bend", [0.0, 1e-9, 0.3])
def test_no_passage_is_seen_along_one_strand(bend):
    """Segments as long as the cut-off: neighbours are listed, and cross by rounding if at all."""
    section = circular_section(DIAMETER, 1e6, 5e5, 1500.0)
    rod = straight_rod(1.0, 40, section, direction=(0.3, 1.0, 0.7))
    scene = Scene(rod, contact=Contact(LAWS["damped"], 20, cutoff=0.06, points_per_segment=10))
    s = np.asarray(rod.arc_length)
    random = np.random.default_rng(0)

    @eqx.filter_jit
    def seen(before, after):
        found = scene.find_contact(before, after - before)
        return found.pairs.count, screening.passage_suspected(*found, before, after)

    def shape():
        wave = np.outer(np.sin(3 * s + random.uniform(0, 6)), random.normal(size=3))
        noise = random.normal(size=rod.position.shape)
        return rod.position + jnp.asarray(bend * wave + 1e-12 * noise)

    for _ in range(20):
        count, passage = seen(shape(), shape())
        assert count > 15 and not passage
