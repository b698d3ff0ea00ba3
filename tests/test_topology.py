"""Writhe, twist and linking number against references, invariances and finite differences."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jax import lax
from scipy.spatial.transform import Rotation

from rodjax import rotations, topology

seeds = st.integers(0, 2**32 - 1)
quick = settings(max_examples=15, deadline=None)

compiled_writhe = jax.jit(topology.writhe, static_argnames="closed")
compiled_twist = jax.jit(topology.twist)
compiled_linking_number = jax.jit(topology.linking_number)


value_and_gradient = jax.jit(jax.value_and_grad(topology.writhe), static_argnames="closed")


def approx(expected, **tolerance):
    return pytest.approx(float(expected), **tolerance)


def random_polygon(seed, vertices=10):
    return np.random.default_rng(seed).normal(size=(vertices, 3))


def random_rotation(generator):
    q, r = np.linalg.qr(generator.normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q * np.linalg.det(q)


def helix(turns, per_turn=40, radius=1.0, pitch=3.0, hand=1.0):
    angle = 2 * np.pi * np.arange(turns * per_turn + 1) / per_turn
    columns = [radius * np.cos(angle), hand * radius * np.sin(angle), pitch * angle / (2 * np.pi)]
    return jnp.array(np.stack(columns, axis=1))


def torus_curve(vertices):
    t = 2 * jnp.pi * jnp.arange(vertices) / vertices
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


def about_e3(angle):
    return rotations.exponential(jnp.asarray(angle)[..., None] * jnp.array([0.0, 0.0, 1.0]))


def framed(positions, angles):
    """Frames whose third axes are the edges: e3 swung onto each edge, after a turn about e3."""
    edges = jnp.diff(positions, axis=0)
    edges = edges / jnp.linalg.norm(edges, axis=1, keepdims=True)
    zero = jnp.zeros(len(edges))
    swing = jnp.stack([1 + edges[:, 2], -edges[:, 1], edges[:, 0], zero], axis=1)
    return rotations.multiply(rotations.normalize(swing), about_e3(angles))


def clamped_curve(seed, nodes=81, size=0.3):
    """A random curve, straight along e3 near its ends; e3 . r increases, so it is unknotted."""
    generator = np.random.default_rng(seed)
    s = np.linspace(0, 1, nodes)
    window = np.where((s > 0.05) & (s < 0.95), np.sin(np.pi * (s - 0.05) / 0.9) ** 2, 0.0)
    sideways = sum(
        generator.normal(size=2) * np.cos(2 * np.pi * k * s[:, None] + generator.uniform(0, 6, 2))
        for k in range(1, 6)
    )
    return jnp.array(np.concatenate([size * window[:, None] * sideways, s[:, None]], axis=1))


def turned_rod(positions, turns):
    """Element, start and end frames of a rod whose end s = 0 is turned by -turns."""
    nodal = 2 * jnp.pi * turns * (jnp.linspace(0, 1, len(positions)) - 1)
    frames = framed(positions, 0.5 * (nodal[1:] + nodal[:-1]))
    return frames, {"start_frame": about_e3(nodal[0]), "end_frame": about_e3(nodal[-1])}


def loop_curve(gap, nodes=121):
    """A nearly planar loop in a straight rod along e1; its strands pass in e2 at a `gap`."""
    s = np.linspace(-1, 1, nodes)
    window = np.maximum(1 - (s / 0.8) ** 2, 0.0) ** 3
    return jnp.array(np.stack([s - 3 * s * window, gap * s * window, window], axis=1))


def frames_around_e2(edges):
    """Frames with third axes along the edges and first axes as near to e2 as they can be."""
    third = edges / np.linalg.norm(edges, axis=1, keepdims=True)
    first = np.array([0.0, 1.0, 0.0]) - third[:, 1:2] * third
    first = first / np.linalg.norm(first, axis=1, keepdims=True)
    matrix = np.stack([first, np.cross(third, first), third], axis=2)
    return jnp.array(Rotation.from_matrix(matrix).as_quat(scalar_first=True))


# Writhe


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
    t = 2 * jnp.pi * jnp.arange(200) / 200
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
    monkeypatch.setattr(topology, "_BLOCK_PAIRS", block_pairs)
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


# Derivatives of the writhe

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


# Twist


def test_twist_of_a_straight_rod():
    positions = clamped_curve(0, size=0.0)
    frames, ends = turned_rod(positions, 3.7)
    assert compiled_twist(positions, frames, **ends) == approx(3.7, abs=1e-13)
    assert compiled_twist(positions, frames) == approx(3.7 * 79 / 80, abs=1e-13)
    assert compiled_twist(positions, -frames) == approx(3.7 * 79 / 80, abs=1e-13)
    signs = jnp.where(jnp.arange(80) % 3 == 0, -1.0, 1.0)[:, None]
    assert compiled_twist(positions, signs * frames, **ends) == approx(3.7, abs=1e-13)


@pytest.mark.parametrize(("angle", "turns"), [(0.9, 0.45), (1.1, -0.45), (-0.7, -0.35)])
def test_twist_of_a_vertex_stays_within_half_a_turn(angle, turns):
    positions = jnp.arange(3.0)[:, None] * jnp.array([[0.0, 0.0, 1.0]])
    frames = about_e3(jnp.pi * jnp.array([0.3, 0.3 + angle]))
    assert compiled_twist(positions, frames) == approx(turns, abs=1e-14)


def test_parallel_transported_frames_have_no_twist():
    # the smallest rotations from edge to edge, applied one after the other
    positions = helix(2)
    edges = np.diff(positions, axis=0)
    frame = Rotation.align_vectors(edges[:1], [[0, 0, 1]])[0]
    frames = [frame]
    for before, after in zip(edges[:-1], edges[1:], strict=True):
        normal = np.cross(before, after)
        angle = np.arctan2(np.linalg.norm(normal), before @ after)
        frame = Rotation.from_rotvec(angle * normal / np.linalg.norm(normal)) * frame
        frames.append(frame)
    quaternions = jnp.array([frame.as_quat(scalar_first=True) for frame in frames])
    assert abs(compiled_twist(positions, quaternions)) < 1e-13
    turned = rotations.multiply(quaternions, about_e3(jnp.linspace(0, 1.0, len(frames))))
    assert compiled_twist(positions, turned) == approx(1 / (2 * np.pi), abs=1e-13)


def test_twist_integral_agrees_at_second_order():
    curvature = jnp.array([1.5, -0.7, 2.0])

    @partial(jax.jit, static_argnums=0)
    def pair(elements):
        ds = 1 / elements
        stations = ds * (jnp.arange(elements) + 0.5)
        frames = rotations.exponential(stations[:, None] * curvature[None, :])
        edges = ds * rotations.tangent_director(frames)
        positions = jnp.concatenate([jnp.zeros((1, 3)), jnp.cumsum(edges, axis=0)])
        lengths = jnp.full(elements, ds).at[:1].set(0.0)  # twist runs from first to last midpoint
        integral = topology.twist_integral(jnp.tile(curvature[None, :], (elements, 1)), lengths)
        return compiled_twist(positions, frames), integral

    (coarse, expected), (fine, expected_fine) = pair(20), pair(40)
    assert expected == approx(2.0 * 19 / 20 / (2 * np.pi), rel=1e-12)
    ratio = (coarse / expected - 1) / (fine / expected_fine - 1)
    assert ratio == approx(4, rel=1e-2)


# Linking number


@quick
@given(seed=seeds, turns=st.floats(-6, 6), size=st.sampled_from([0.1, 0.5, 5.0]))
def test_linking_number_is_the_turns_applied(seed, turns, size):
    positions = clamped_curve(seed, size=size)
    frames, ends = turned_rod(positions, turns)
    assert compiled_linking_number(positions, frames, **ends) == approx(turns, abs=1e-12)
    # to the printed digits also for extensions of 1e4 times the length
    length = jnp.sum(jnp.linalg.norm(jnp.diff(positions, axis=0), axis=1))
    finite = compiled_linking_number(positions, frames, **ends, extension=1e4 * length)
    assert finite == approx(turns, abs=1e-8)
    # and for cross-sections that are not normal to the edges, as in a shearable rod
    tilt = rotations.exponential(0.1 * jnp.array(random_polygon(seed, len(frames))))
    tilted = rotations.multiply(tilt, frames)
    assert compiled_linking_number(positions, tilted, **ends) == approx(turns, abs=1e-12)


def test_linking_number_with_end_tangents_off_the_segments():
    # bending that goes on into the ends: only the end frames stay, the first edges turn
    s = jnp.linspace(0, 1, 41)
    found = []
    for size in (0.1, 0.3):
        x, y = size * jnp.sin(9 * s), size * jnp.cos(7 * s)
        positions = jnp.stack([x, y, s], axis=1)
        frames, ends = turned_rod(positions, 2.2)
        writhe = compiled_writhe(positions)
        found.append((compiled_linking_number(positions, frames, **ends), writhe))
    assert found[0][0] == approx(2.2, abs=1e-12)
    assert found[1][0] == approx(2.2, abs=1e-12)
    assert abs(found[1][1] - found[0][1]) > 0.1


def test_strand_passage_changes_the_linking_number_by_two():
    errors = []
    for gap in (0.3, 0.01, -0.01, -0.3):
        positions = loop_curve(gap)
        frames = frames_around_e2(np.diff(positions, axis=0))
        end = frames_around_e2(np.array([[1.0, 0.0, 0.0]]))[0]
        twist = compiled_twist(positions, frames, start_frame=end, end_frame=end)
        writhe = compiled_writhe(positions)
        errors.append(float(topology.linking_error(jnp.array(1.0), twist, writhe)))
    assert errors[1] == approx(errors[0], abs=1e-12)
    assert errors[3] == approx(errors[2], abs=1e-12)
    assert abs(errors[2] - errors[1]) == approx(2, abs=1e-12)


def test_linking_number_depends_on_the_end_frames_only():
    positions = clamped_curve(2)
    frames, ends = turned_rod(positions, 1.3)

    def function(positions, frames, angle):
        start = rotations.multiply(ends["start_frame"], about_e3(angle))
        return topology.linking_number(
            positions, frames, start_frame=start, end_frame=ends["end_frame"]
        )

    gradient = jax.jit(jax.grad(function, (0, 1, 2)))
    by_position, by_frame, by_angle = gradient(positions, frames, 0.0)
    spin = rotations.multiply(frames, jnp.tile(jnp.array([[0.0, 1.0, -2.0, 0.5]]), (80, 1)))
    assert jnp.max(jnp.abs(value_and_gradient(positions)[1])) > 0.1
    assert jnp.max(jnp.abs(by_position)) < 1e-10
    assert jnp.max(jnp.abs(jnp.sum(by_frame * spin, axis=1))) < 1e-12
    assert by_angle == approx(-1 / (2 * np.pi), rel=1e-12)
