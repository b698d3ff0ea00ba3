"""Linking numbers of lines, and of rods, with each other."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rodjax as rx
from rodjax.rods import topology

BOTH = True, True


def torus_line(windings, phase, vertices=60):
    """A line that winds right-handed about a circle so many times while it goes round once."""
    turn = np.linspace(0, 2 * np.pi, vertices, endpoint=False)
    around = windings * turn + phase
    distance = 1 + 0.3 * np.cos(around)
    return np.stack([distance * np.cos(turn), distance * np.sin(turn), -0.3 * np.sin(around)], 1)


@pytest.mark.parametrize("windings", [1, 2, -3])
def test_torus_links(windings):
    """Two parallel lines on a torus, which wind about each other so often; right-handed is plus."""
    first, second = torus_line(windings, 0.0), torus_line(windings, np.pi, 47)
    found = topology.mutual_linking(first, second, closed=BOTH)
    np.testing.assert_allclose(found, windings, atol=1e-12)
    back = topology.mutual_linking(1e6 * second + 5.0, 1e6 * first + 5.0, closed=BOTH)
    np.testing.assert_allclose(back, windings, atol=1e-9)
    mirrored = topology.mutual_linking(second * [1, 1, -1], first * [1, 1, -1], closed=BOTH)
    np.testing.assert_allclose(mirrored, -windings, atol=1e-12)
    reversed_line = topology.mutual_linking(first[::-1], second, closed=BOTH)
    np.testing.assert_allclose(reversed_line, -windings, atol=1e-12)


def test_rings_apart_are_not_linked():
    ring = torus_line(0, 0.0)
    far = topology.mutual_linking(ring, ring + np.array([3.0, 0.1, 0.2]), closed=BOTH)
    np.testing.assert_allclose(far, 0.0, atol=1e-12)


def test_two_lines_that_cross():
    """Half of their crossing's sign, where they are long."""
    one = np.array([[-1e6, 0, 0], [0, 0, 0], [1e6, 0, 0]])
    other = np.array([[0, -1e6, 1.0], [0, 1e6, 1.0]])
    np.testing.assert_allclose(topology.mutual_linking(one, other), -0.5, atol=1e-5)
    np.testing.assert_allclose(topology.mutual_linking(one[::-1], other), 0.5, atol=1e-5)


def test_derivatives_of_open_lines():
    """Forward, reverse and differences, of random lines."""
    random = np.random.default_rng(3)
    one, other = (jnp.asarray(random.normal(size=(n, 3))) for n in (6, 5))
    way = jnp.asarray(random.normal(size=(6, 3)))
    moved = jax.jit(lambda x: topology.mutual_linking(one + x * way, other))
    zero = jnp.asarray(0.0)
    slope = jax.grad(moved)(zero)
    np.testing.assert_allclose(jax.jacfwd(moved)(zero), slope, rtol=1e-10)
    difference = (moved(jnp.asarray(1e-5)) - moved(jnp.asarray(-1e-5))) / 2e-5
    np.testing.assert_allclose(difference, slope, rtol=1e-6)


def test_rods_of_a_scene():
    """A ring and an open rod through it."""
    section = rx.Section((1.0, 1.0, 0.8), mass=1.0, rotary_inertia=(1e-4, 1e-4, 2e-4))
    ring = rx.ring(1.0, 12, section)
    middle, radius = np.mean(np.asarray(ring.position)[:-1], 0), 1 / (2 * np.pi)
    normal = np.cross(*(np.asarray(ring.position)[[0, 3]] - middle))
    normal = normal / np.linalg.norm(normal)
    below = tuple(middle - normal)
    across = rx.straight_rod(2.0, 4, section, direction=tuple(normal), origin=below)
    scene = rx.Scene(rods=(ring, across), joints=(rx.Weld(rx.Point(0), rx.Point(12)),))
    run = rx.rollout(scene, rx.start(scene), [1e-3])
    found = np.asarray(rx.measures.mutual_linking(scene, run))
    assert found.shape == (2, 2, 2) and not np.any(np.diagonal(found, axis1=1, axis2=2))
    # that of a line through the middle of a circle, 1/(1 + (R/h)^2)^(1/2), by the law of Ampere
    expected = 1 / np.sqrt(1 + radius**2)
    np.testing.assert_allclose(np.abs(found[:, 0, 1]), expected, rtol=2e-3)
    np.testing.assert_array_equal(found[:, 0, 1], found[:, 1, 0])
    alone = rx.Scene(across)
    with pytest.raises(ValueError, match="scene: it has one rod"):
        rx.measures.mutual_linking(alone, run)
