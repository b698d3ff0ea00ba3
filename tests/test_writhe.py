"""Writhe against references, invariances and finite differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from jax import lax
from sample_curves import (
    approx,
    clamped_curve,
    compiled_writhe,
    helix,
    quick,
    random_polygon,
    seeds,
    value_and_gradient,
)

from rodjax import topology


def random_rotation(generator):
    q, r = np.linalg.qr(generator.normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q * np.linalg.det(q)


def torus_curve(vertices):
    t = 2 * jnp.pi * jnp.arange(float(vertices)) / vertices
    ring = 2 + jnp.cos(3 * t)
    return jnp.stack([ring * jnp.cos(2 * t), ring * jnp.sin(2 * t), jnp.sin(3 * t)], axis=1)


def arcsine_writhe(vertices, closed=False):
    """Klenin & Langowski's method 1a over all pairs of a polygon, in plain loops."""
    total, count = 0.0, len(vertices) - 1
    for i in range(count):
        for j in range(i + 2, count - (closed and i == 0)):
            p1, p2, p3, p4 = vertices[i], vertices[i + 1], vertices[j], vertices[j + 1]
            sides = [p3 - p1, p4 - p1, p4 - p2, p3 - p2]
            normals = [np.cross(sides[k], sides[(k + 1) % 4]) for k in range(4)]
            normals = [n / np.linalg.norm(n) for n in normals]
            angle = sum(np.arcsin(normals[k] @ normals[(k + 1) % 4]) for k in range(4))
            total += angle * np.sign(np.cross(p4 - p3, p2 - p1) @ (p3 - p1))
    return total / (2 * np.pi)


# Values


def test_open_polyline_with_finite_extension():
    points = jnp.array([[0.0, 0, 0], [0, 0, 1], [0, 1, 1], [0, 1, 0], [1, 1, 0]])
    assert compiled_writhe(points, extension=10.0) == approx(-0.477268070084, abs=1e-12)


def test_closed_smooth_curve_at_second_order():
    coarse, medium, fine = (compiled_writhe(torus_curve(n), closed=True) for n in (101, 202, 404))
    assert fine + (fine - medium) / 3 == approx(-3.518239, abs=1e-6)
    assert (medium - coarse) / (fine - medium) == approx(4, rel=0.02)


def test_long_helix():
    # far from the ends a turn of a helix has the writhe 1 - sin(pitch angle)
    sine = 3.0 / np.hypot(3.0, 2 * np.pi)
    per_turn = (compiled_writhe(helix(30)) - compiled_writhe(helix(20))) / 10
    assert per_turn == approx(1 - sine, abs=2e-3)
    assert compiled_writhe(helix(20, hand=-1.0)) == approx(-compiled_writhe(helix(20)))


def test_planar_and_spherical_closed_curves():
    t = 2 * jnp.pi * jnp.arange(200.0) / 200
    radius = 1 + 0.4 * jnp.cos(3 * t) + 0.2 * jnp.sin(5 * t)
    planar = jnp.stack([radius * jnp.cos(t), radius * jnp.sin(t), jnp.zeros(200)], axis=1)
    tilted = planar @ jnp.array(random_rotation(np.random.default_rng(3)))
    assert abs(compiled_writhe(tilted, closed=True)) < 1e-12
    wavy = planar.at[:, 2].set(0.6 * jnp.sin(2 * t) + 0.3 * jnp.cos(3 * t))
    spherical = wavy / jnp.linalg.norm(wavy, axis=1, keepdims=True)
    assert abs(compiled_writhe(spherical, closed=True)) < 1e-4
    assert abs(compiled_writhe(wavy, closed=True)) > 1e-2  # off the sphere it is not zero


@pytest.mark.parametrize(
    ("vertices", "block_pairs"),
    [(3, 1000), (4, 1000), (5, 1000), (8, 1000), (8, 1), (11, 1000), (11, 20)],
)
def test_pair_sum_against_arcsine_form(vertices, block_pairs, monkeypatch):
    monkeypatch.setattr(topology, "PAIRS", block_pairs)
    points = random_polygon(vertices, vertices)
    start, end = np.array([0.6, 0.0, 0.8]), np.array([0.0, -0.6, 0.8])
    extended = np.concatenate([points[:1] - 7 * start, points, points[-1:] + 7 * end])
    directions = {"start_direction": jnp.array(start), "end_direction": jnp.array(end)}
    function = jax.jit(lambda x, **arguments: topology.writhe(x, extension=7.0, **arguments))
    found = function(jnp.array(points), **directions)
    assert found == approx(arcsine_writhe(extended), abs=1e-9)
    expected = arcsine_writhe(np.concatenate([points, points[:1]]), closed=True)
    assert topology.writhe(jnp.array(points), closed=True) == approx(expected, abs=1e-9)


def test_extension_tends_to_infinity():
    points = jnp.array(random_polygon(5))
    errors = [
        compiled_writhe(points, extension=10.0**k) - compiled_writhe(points) for k in (4, 5, 12)
    ]
    assert 1e-7 < abs(errors[0]) < 1e-2
    assert errors[0] / errors[1] == approx(10, rel=1e-2)
    assert abs(errors[2]) < 1e-11


@quick
@given(seed=seeds, scale=st.floats(1e-6, 1e6), closed=st.booleans())
def test_rigid_motion_scale_reversal_and_mirror(seed, scale, closed):
    generator = np.random.default_rng(seed)
    points = generator.normal(size=(10, 3))
    moved = scale * (points @ random_rotation(generator).T + generator.normal(size=3))
    value = compiled_writhe(jnp.array(points), closed=closed)
    assert compiled_writhe(jnp.array(moved), closed=closed) == approx(value, abs=1e-10)
    assert compiled_writhe(jnp.array(points[::-1]), closed=closed) == approx(value, abs=1e-10)
    mirrored = points * np.array([1.0, 1.0, -1.0])
    assert compiled_writhe(jnp.array(mirrored), closed=closed) == approx(-value, abs=1e-10)


# Derivatives


DIRECTIONS = {
    "start_direction": jnp.array([0.6, 0.0, 0.8]),
    "end_direction": jnp.array([0.0, -0.6, 0.8]),
}
ARGUMENTS = {
    "closed": {"closed": True},
    "open": {},
    "finite": {"extension": 5.0},
    "directed": DIRECTIONS,
    "side by side": {
        "extension": 5.0,
        "start_direction": jnp.array([0.6, 0.0, 0.8]),
        "end_direction": jnp.array([-0.6, 0.0, -0.8]),
    },
}


def central_difference(function, point, step, width=1e-5):
    return (function(point + width * step) - function(point - width * step)) / (2 * width)


@pytest.mark.parametrize("arguments", ARGUMENTS.values(), ids=ARGUMENTS)
def test_gradient_against_differences(arguments):
    points, step = jnp.array(random_polygon(12)), jnp.array(random_polygon(21))
    _, gradient = value_and_gradient(points, **arguments)
    expected = central_difference(lambda x: compiled_writhe(x, **arguments), points, step)
    assert abs(expected) > 1e-3
    assert jnp.vdot(gradient, step) == approx(expected, rel=1e-6, abs=1e-8)


@pytest.mark.parametrize("closed", [True, False])
def test_forward_and_second_derivatives(closed):
    points, step = jnp.array(random_polygon(12)), jnp.array(random_polygon(21))
    arguments = {"closed": True} if closed else DIRECTIONS

    @jax.jit
    def along_the_step(x):
        gradient = jax.grad(lambda x: topology.writhe(x, **arguments))
        return jax.jvp(gradient, (x,), (step,))[1]

    @jax.jit
    def slope(x):
        return jax.jvp(lambda x: topology.writhe(x, **arguments), (x,), (step,))[1]

    _, gradient = value_and_gradient(points, **arguments)
    assert slope(points) == approx(jnp.vdot(gradient, step), rel=1e-10)
    expected = central_difference(slope, points, step)
    assert abs(expected) > 1e-3
    assert jnp.vdot(along_the_step(points), step) == approx(expected, rel=1e-6)


@pytest.mark.parametrize("extension", [None, 5.0])
def test_derivative_in_the_directions_and_length_of_the_extensions(extension):
    points = jnp.array(random_polygon(12))

    @jax.jit
    def function(directions, extension):
        start, end = directions / jnp.linalg.norm(directions, axis=1, keepdims=True)
        return topology.writhe(
            points, extension=extension, start_direction=start, end_direction=end
        )

    directions, step = jnp.array(random_polygon(3, 2)), jnp.array(random_polygon(4, 2))
    expected = central_difference(lambda x: function(x, extension), directions, step)
    assert abs(expected) > 1e-3
    gradient = jax.jit(jax.grad(function))(directions, extension)
    assert jnp.vdot(gradient, step) == approx(expected, rel=1e-6)
    if extension is not None:
        expected = central_difference(lambda x: function(directions, x), extension, 1.0)
        assert abs(expected) > 1e-5
        assert jax.jit(jax.grad(function, 1))(directions, extension) == approx(expected, rel=1e-5)


@pytest.mark.parametrize("direction", [(0, 0, 1), (0, 0, -1), (0, 1, 0), (0.3, -0.5, -0.7)])
@pytest.mark.parametrize("extension", [None, 5.0])
def test_straight_rod_has_no_writhe_and_finite_derivatives(direction, extension):
    stations = np.linspace(0, 1, 10)[:, None] ** 1.3  # collinear and unequal segments
    points = jnp.array(stations * np.array(direction, dtype=float))
    step = jnp.array(random_polygon(1))
    arguments = {} if extension is None else {"extension": extension}
    value, gradient = value_and_gradient(points, **arguments)
    assert abs(value) < 1e-14
    assert jnp.max(jnp.abs(gradient)) < 1e-12
    # the writhe of a nearly straight rod is quadratic in the deflection, or almost so
    width = 1e-5
    value, gradient = value_and_gradient(points + width * step, **arguments)
    assert abs(value) > 1e-11
    assert jnp.vdot(gradient, width * step) == approx(2 * value, rel=2e-2)


def test_transforms_and_single_precision():
    frames = jnp.stack([clamped_curve(seed) for seed in range(3)])
    expected = jnp.stack([compiled_writhe(frame) for frame in frames])
    assert jnp.max(jnp.abs(expected)) > 0.1
    mapped = jax.jit(lambda x: lax.map(topology.writhe, x))(frames)
    np.testing.assert_allclose(mapped, expected, rtol=1e-12)
    batched, gradients = jax.jit(jax.vmap(jax.value_and_grad(topology.writhe)))(frames)
    np.testing.assert_allclose(batched, expected, rtol=1e-12)
    np.testing.assert_allclose(gradients[1], value_and_gradient(frames[1])[1], rtol=1e-9)
    single = compiled_writhe(frames[0].astype(jnp.float32))
    assert single.dtype == jnp.float32
    assert single == approx(expected[0], abs=1e-5)


def test_memory_is_proportional_to_the_nodes():
    function = jax.jit(jax.value_and_grad(topology.writhe))
    compiled = function.lower(jax.ShapeDtypeStruct((3201, 3), jnp.float64)).compile()
    assert compiled.memory_analysis().temp_size_in_bytes < 8 * 3200**2 / 10
