"""Shapes of obstacles, what they refuse, and what is passed or safe beside them."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rodjax as rx


def torus(radii, point):
    around = jnp.sqrt(jnp.sum(point[:2] ** 2)) - radii[0]
    return jnp.sqrt(around**2 + point[2] ** 2) - radii[1]


SLOPES = np.add.outer(0.3 * np.arange(5), -0.2 * np.arange(7))
SHAPES = {
    "plane": (rx.Plane((0, 0, 1), (0, 3, 4)), (5.0, 2.0, 3.0), 2.8, (0, 0.6, 0.8)),
    "sphere": (rx.Sphere((1, 0, 0), 2.0), (1.0, 3.0, 4.0), 3.0, (0, 0.6, 0.8)),
    "bowl": (rx.Sphere((1, 0, 0), 7.0, inside=True), (1.0, 3.0, 4.0), 2.0, (0, -0.6, -0.8)),
    "drum": (rx.Cylinder((0, 0, 0), (2, 0, 0), 1.0), (9.0, 3.0, 4.0), 4.0, (0, 0.6, 0.8)),
    "pipe": (rx.Cylinder((0, 0, 0), (2, 0, 0), 6.0, True), (9.0, 3.0, 4.0), 1.0, (0, -0.6, -0.8)),
    "own": (rx.SignedDistance(torus, [5.0, 1.0]), (9.0, 0.0, 3.0), 4.0, (0.8, 0.0, 0.6)),
    # z = 1 + 0.6 (x + 1) - 0.1 (y - 2), an inclined plane
    "field": (
        rx.HeightField(1.0 + SLOPES, (-1.0, 2.0), (0.5, 2.0)),
        (0.0, 7.0, 3.0),
        1.9 / np.sqrt(1.37),
        np.array([-0.6, 0.1, 1.0]) / np.sqrt(1.37),
    ),
}


@pytest.mark.parametrize("name", SHAPES)
def test_distances_and_normals(name):
    shape, point, distance, normal = SHAPES[name]
    found = shape.distance_and_normal(jnp.asarray(point))
    np.testing.assert_allclose(found[0], distance, rtol=1e-12)
    np.testing.assert_allclose(found[1], normal, atol=1e-12)
    np.testing.assert_allclose(shape.distance(jnp.asarray(point)), distance, rtol=1e-12)


def test_a_height_field_is_smooth_and_goes_on_level():
    heights = np.random.default_rng(0).normal(size=(5, 6))
    field = rx.HeightField(heights, spacing=(0.5, 0.25))
    np.testing.assert_allclose(field.height(jnp.asarray([1.0, 0.75])), heights[2, 3], rtol=1e-12)
    slope = jax.grad(field.height)
    before, after = (slope(jnp.asarray([1.0 + d, 0.6])) for d in (-1e-9, 1e-9))
    np.testing.assert_allclose(before, after, atol=1e-6)
    for outside in ([-3.0, 0.75], [0.0, 0.75]):
        np.testing.assert_allclose(field.height(jnp.asarray(outside)), heights[0, 3], rtol=1e-12)


def rod(**changes):
    section = rx.circular_section(0.02, 1e7, 4e6, density=1500.0)
    made = rx.straight_rod(1.0, 4, section, direction=(1, 0, 0), origin=(0, 0, 0.01))
    return dataclasses.replace(made, **changes)


REFUSED = {
    "inside": (lambda: rx.Obstacle(rx.Plane((0, 0, 0.1)), 1e4), "shape: the rod starts inside"),
    "no normal": (lambda: rx.Obstacle(rx.Plane(normal=(0, 0, 0)), 1e4), "normal: must not be zero"),
    "no stiffness": (lambda: rx.Obstacle(rx.Plane(), 0.0), "stiffness: must be positive"),
    "pushes": (
        lambda: rx.Obstacle(rx.Plane(), 1e4, relaxation=-1.0),
        "relaxation: must be finite and not neg",
    ),
    "mu < 0": (lambda: rx.Friction(-0.1), "coefficient: must be finite and not neg"),
    "mu < 0, by speed": (
        lambda: rx.SlidingFriction(-0.1, 1e-3),
        "coefficient: must be finite and not",
    ),
    "no speed": (lambda: rx.SlidingFriction(0.1, 0.0), "slip_speed: must be positive"),
    "a vector": (lambda: rx.SignedDistance(lambda p, x: x), "function: must return one number"),
    "a row": (lambda: rx.HeightField([1.0, 2.0]), "heights: give a grid"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_obstacles_that_cannot_be_are_refused(case):
    make, message = REFUSED[case]
    with pytest.raises(ValueError, match=message):
        rx.Scene(rod(), loads=(make(),))


def test_a_rod_without_diameter_is_refused():
    bare = rx.straight_rod(1.0, 4, rx.Section((1.0, 1.0, 0.8), mass=1.0))
    with pytest.raises(ValueError, match="diameter: an Obstacle needs"):
        rx.Scene(bare, loads=(rx.Obstacle(rx.Plane((0, 0, -5)), 1e4),))


def test_no_increment_comes_through_and_what_did_is_told():
    """A ball and a hollow: an increment may end half a radius of the rod in them."""
    one, places = rod(), np.zeros((5, 3))
    ball = rx.Obstacle(rx.Sphere((0, 0, 0), 1.0), 1e4)
    places[:, 2], change = 3.0, np.zeros((5, 3))
    change[1, 2] = -5.0
    at = jnp.asarray(places)
    safe = ball.safe_fraction(one, at, jnp.asarray(change), None)
    np.testing.assert_allclose(safe, 2.005 / 5, rtol=1e-12)
    assert float(ball.safe_fraction(one, at, jnp.asarray(0.2 * change), None)) == 1.0
    assert int(ball.verdict(one, at, at + change, None)) == rx.Result.OBSTACLE_PASSED
    assert int(ball.verdict(one, at, at + 0.2 * change, None)) == rx.Result.SUCCESS
    bowl = rx.Obstacle(rx.Sphere((0, 0, 0), 3.5, inside=True), 1e4)
    change[1, 2] = 1.0
    safe = bowl.safe_fraction(one, at, jnp.asarray(change), None)
    np.testing.assert_allclose(safe, 0.505, rtol=1e-12)
    assert int(bowl.verdict(one, at, at + change, None)) == rx.Result.OBSTACLE_PASSED
