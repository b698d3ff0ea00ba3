"""Linking of a ring (both ends clamped to one place), whose ends must not count as a crossing."""

import jax.numpy as jnp
import numpy as np
import pytest

import rodjax as rx
from rodjax import measures
from rodjax.dynamics import passages

RADIUS, TURNS = 0.1, 0.4
LENGTH = 2 * np.pi * RADIUS


@pytest.fixture(scope="module")
def twisted():
    """A ring turned at its first end, which leaves its plane, and its run."""
    circle = lambda s: jnp.stack(
        [RADIUS * jnp.sin(s / RADIUS), 0 * s, RADIUS - RADIUS * jnp.cos(s / RADIUS)]
    )
    section = rx.Section((1.0, 1.0, 0.8), mass=None, diameter=0.005)
    rod = rx.curved_rod(circle, LENGTH, 20, section)
    # a push out of the plane, which else nothing excites
    load = rx.PointLoad(10, rx.Constant((0.0, 1.0, 0.0)))
    turn = rx.Turn((1, 0, 0), rx.Smooth([0.0, 1.0], [0.0, -2 * np.pi * TURNS]))
    contact = rx.Contact.solid(rod, force=10.0)
    loads = (load, rx.LinearDrag(100.0, 100.0, 0.1))
    scene = rx.Scene(rod, rx.Clamped(rotation=turn), rx.Clamped(), loads=loads, contact=contact)
    run = rx.adaptive_rollout(scene, rx.start(scene), 1.0)
    return scene, run


@pytest.mark.slow
def test_turns_go_to_twist_and_writhe(twisted):
    scene, run = twisted
    assert scene.closed and int(run.result) == 0  # no passage is seen where the ends meet
    found = measures.linking(scene, run)
    assert float(found.turns[-1]) == pytest.approx(TURNS, abs=1e-9)
    assert abs(float(found.writhe[-1])) > 1e-3
    np.testing.assert_allclose(found.error, 0.0, atol=1e-6)


@pytest.mark.slow
def test_a_strand_that_passed_through_is_seen_in_a_ring(twisted):
    """A turn of the end that the drive did not make stands for it."""
    scene, run = twisted
    assert not passages.passed_unseen(scene, run.state(0), run.final)
    more = rx.Turn((1, 0, 0), rx.Smooth([0.0, 1.0], [0.0, -2 * np.pi * (TURNS + 2)]))
    other = rx.Scene(scene.rod, rx.Clamped(rotation=more), rx.Clamped(), scene.loads, scene.contact)
    assert passages.passed_unseen(other, run.state(0), run.final)
