"""The search under laws of all space: all pairs that act are listed, straight neighbours not."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

import rodjax as rx
from rodjax.interactions import screening
from rodjax.interactions.sites import interpolate, sites_of
from rodjax.numerics.compilation import compiled

SECTION = rx.circular_section(0.03, 1e6, 0.4e6, density=1500.0)
ROD = rx.straight_rod(1.0, 40, SECTION)
CONTACT = dataclasses.replace(rx.Contact.solid(ROD, 10.0), segments=40, points_per_segment=4)
RING = rx.ring(1.0, 40, SECTION)


@compiled
def found_at(position, displacement, closed):
    contact = CONTACT.fitted(ROD)
    sites = sites_of(contact, ROD, closed)
    pairs = screening.search(contact, sites, position, displacement)
    after = interpolate(sites, position + displacement)
    return pairs, sites.arc_length, after


def acting(vertices, arc_length, around):
    """Pairs of segments with points that are near each other but not along the rod."""
    part = (np.arange(4) + 0.5) / 4
    points = vertices[:-1, None] + part[:, None] * (vertices[1:, None] - vertices[:-1, None])
    points, s = points.reshape(-1, 3), arc_length.reshape(-1)
    distance = np.linalg.norm(points[:, None] - points[None], axis=-1)
    along = np.abs(s[:, None] - s[None])
    along = np.minimum(along, around - along)
    acts = (distance < float(CONTACT.cutoff)) & (along >= float(CONTACT.excluded))
    acts = acts.reshape(40, 4, 40, 4).any((1, 3))
    return {(a, b) for a, b in zip(*np.nonzero(acts), strict=True) if a < b}


def listed(pairs):
    count = int(pairs.count)
    return set(zip(pairs.first[:count].tolist(), pairs.second[:count].tolist(), strict=True))


def curled(seed, tightness, stretch, closed):
    """Nodes of a random smooth curve, of elements that are stretched or compressed."""
    rng = np.random.default_rng(seed)
    s = np.linspace(0, 1, 41)
    waves = [np.cos(2 * np.pi * k * s[:, None] + rng.uniform(0, 7, 3)) for k in (1, 2, 3, 4)]
    points = sum(rng.normal(size=3) * wave / (k + 1) for k, wave in enumerate(waves))
    if not closed:
        points = points + s[:, None] * rng.normal(size=3) * 3
    edges = np.diff(points, axis=0)
    lengths = np.linalg.norm(edges, axis=1, keepdims=True)
    if closed:  # as it is, of the right length in all
        return jnp.asarray(points / lengths.sum() * tightness)
    sizes = 1 + stretch * rng.uniform(-1, 1, (40, 1))
    edges = edges / lengths * sizes / 40
    return jnp.asarray(np.concatenate([np.zeros((1, 3)), np.cumsum(edges, axis=0)]) * tightness)


@settings(max_examples=40, deadline=None)
@example(seed=1223, tightness=1.0, stretch=0.0, closed=True, moved=0.0)
@given(
    seed=st.integers(0, 10**6),
    tightness=st.floats(0.3, 1.1),
    stretch=st.floats(0.0, 0.5),
    closed=st.booleans(),
    moved=st.floats(0.0, 0.05),
)
def test_all_pairs_that_act_are_listed(seed, tightness, stretch, closed, moved):
    position = curled(seed, tightness, stretch, closed)
    rng = np.random.default_rng(seed)
    turn = rng.normal(size=(3, 3))
    displacement = moved * jnp.asarray(np.asarray(position) @ (turn - turn.T) + rng.normal(size=3))
    pairs, arc_length, after = found_at(position, displacement, jnp.asarray(closed))
    if bool(pairs.overflow):
        return
    around = 1.0 if closed else np.inf
    missed = acting(np.asarray(after), np.asarray(arc_length), around) - listed(pairs)
    assert not missed


RODS = (rx.straight_rod(0.5, 20, SECTION), rx.ring(0.5, 20, SECTION))
WELD = rx.Weld(rx.Point(0, rod=1), rx.Point(-1, rod=1))
SCENE = rx.Scene(rods=RODS, contact=CONTACT, joints=(WELD,))


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10**6), near=st.floats(0.0, 0.1))
def test_all_pairs_of_two_rods_are_listed(seed, near):
    """However they lie to each other, in one line among others; each pair of points once."""
    rng = np.random.default_rng(seed)
    ring = np.asarray(RODS[1].position) @ np.linalg.qr(rng.normal(size=(3, 3)))[0]
    rod = np.asarray(RODS[0].position) - np.asarray(RODS[0].position)[-1]
    way = near * rng.normal(size=3) + rng.choice([0.0, 0.1]) * np.array([0.0, 0.0, 1.0])
    position = jnp.asarray(np.concatenate([rod, ring - ring[0] + way]))
    found, sites = found_in(SCENE, position)
    vertices, s = np.asarray(interpolate(sites, position)), np.asarray(sites.arc_length)
    part = (np.arange(4) + 0.5) / 4
    points = vertices[:-1, None] + part[:, None] * (vertices[1:, None] - vertices[:-1, None])
    expected = set()
    idle, rod_of = SCENE.contact.idle, np.cumsum(SCENE.contact.idle)
    cutoff, excluded = float(CONTACT.cutoff), float(CONTACT.excluded)
    busy = np.flatnonzero(~idle)
    for i, a in enumerate(busy):
        for b in busy[i + 1 :]:
            apart = np.linalg.norm(points[a][:, None] - points[b][None], axis=-1)
            along = np.abs(s[a][:, None] - s[b][None])
            if rod_of[a] == rod_of[b] == 1:
                along = np.minimum(along, 0.5 - along)
            if np.any((apart < cutoff) & (along >= excluded)):
                expected.add((a, b))
    assert expected <= listed(found)


@compiled
def found_in(scene, position):
    found = scene.find_contact(position)
    return found.pairs, found.sites


def test_a_straight_rod_and_a_wide_ring_list_none():
    still = jnp.zeros((41, 3))
    assert int(found_at(ROD.position, still, jnp.asarray(False))[0].count) == 0
    # however fast it flies
    assert int(found_at(ROD.position, still + 0.5, jnp.asarray(False))[0].count) == 0
    assert int(found_at(RING.position, still, jnp.asarray(True))[0].count) == 0
    # open, its ends touch
    assert int(found_at(RING.position, still, jnp.asarray(False))[0].count) > 0


@pytest.mark.parametrize("closed", [True, False])
def test_the_examples_do_touch(closed):
    """So that the test above says something."""
    counts = []
    for seed in range(20):
        position = curled(seed, 0.5, 0.2, closed)
        _, arc_length, after = found_at(position, 0 * position, jnp.asarray(closed))
        counts.append(len(acting(np.asarray(after), np.asarray(arc_length), np.inf)))
    assert np.mean(np.asarray(counts) > 0) > 0.5
