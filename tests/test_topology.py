"""Twist and linking number against references and the turns applied."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
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
from scipy.spatial.transform import Rotation

from rodjax import rotations, topology

compiled_twist = jax.jit(topology.twist)
compiled_linking_number = jax.jit(topology.linking_number)


def about_e3(angle):
    zero = jnp.zeros_like(angle)
    return rotations.exponential(jnp.stack([zero, zero, angle], -1))


def framed(positions, angles):
    """Frames whose third axes are the edges: e3 swung onto each edge, after a turn about e3."""
    edges = jnp.diff(positions, axis=0)
    edges = edges / jnp.linalg.norm(edges, axis=1, keepdims=True)
    zero = jnp.zeros(len(edges))
    swing = jnp.stack([1 + edges[:, 2], -edges[:, 1], edges[:, 0], zero], axis=1)
    return rotations.multiply(rotations.normalize(swing), about_e3(angles))


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
        stations = ds * (jnp.arange(float(elements)) + 0.5)
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
