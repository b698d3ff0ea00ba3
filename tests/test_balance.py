"""Nodal balance and its tangent against the derivative of the discrete energy."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import UNIT_SECTION, random_arrays, random_configuration, relative_difference
from hypothesis import given, settings
from hypothesis import strategies as st

from rodjax import rotations
from rodjax.equations.assembly import Scales, assemble
from rodjax.rods import balance
from rodjax.rods.builders import straight_rod
from rodjax.rods.node_blocks import NodeBlocks
from rodjax.rods.section import Section
from rodjax.rods.state import at_rest
from rodjax.rods.strains import curvature, element_quaternions, strains

ELEMENTS = 5
BOTH = (0, ELEMENTS)  # nodes that ends hold
COMPLIANT = Section(stiffness=(1.0, 1.3, lambda s: 0.8 + s), mass=1.0, compliance=(0.02, 0.0, 0.01))
few = settings(max_examples=25, deadline=None)
seeds = st.integers(0, 2**31)


@functools.cache
def rod_of(section):
    return straight_rod(
        2.0, ELEMENTS, section, natural_curvature=(0.1, lambda s: 0.2 * s, 0.3), jumps=(0.3,)
    )


def moved(position, quaternion, z):
    """Configuration after displacements and body rotations z (n+1, 6)."""
    turned = rotations.multiply(quaternion, rotations.exponential(z[:, 3:]))
    return position + z[:, :3], turned


def energy(rod, position, quaternion, force, z):
    """Bending and torsion energy plus the constraint times its multiplier."""
    found = strains(rod, *moved(position, quaternion, z))
    change = found.rotation / rod.length[:, None] - rod.natural_curvature
    density = 0.5 * rod.stiffness * change**2 + force * found.stretch
    return jnp.sum(rod.length[:, None] * density)


def stacked(rod, position, quaternion, force):
    inner = balance.internal(rod, at_rest(jnp.zeros(()), position, quaternion), force)
    return jnp.concatenate([inner.force, inner.moment], 1), inner.constraint


@jax.jit
def compare(rod, position, quaternion, force):
    """Nodal wrench and the gradient of the energy."""
    nothing = jnp.zeros((ELEMENTS + 1, 6))
    gradient = jax.grad(lambda z: energy(rod, position, quaternion, force, z))(nothing)
    return stacked(rod, position, quaternion, force), gradient


@few
@given(seeds, st.sampled_from([0.0, 1e-9, 0.05, 0.4, 1.2]))
def test_internal_is_the_gradient_of_the_energy(seed, size):
    rod = rod_of(UNIT_SECTION)
    configuration = random_configuration(rod, seed, size)
    (wrench, constraint), gradient = compare(rod, *configuration)
    assert relative_difference(wrench, gradient) < 1e-11
    stretch = strains(rod, *configuration[:2]).stretch
    np.testing.assert_allclose(constraint, stretch - jnp.asarray([[0.0, 0.0, 1.0]]), atol=1e-15)


def test_strains_by_matrices():
    rod = rod_of(UNIT_SECTION)
    position, quaternion, _ = random_configuration(rod, 3)
    found = strains(rod, position, quaternion)
    frames = rotations.matrix(quaternion)
    for i in range(ELEMENTS):
        turn = frames[i].T @ frames[i + 1]
        np.testing.assert_allclose(
            rotations.matrix(rotations.exponential(found.rotation[i])), turn, atol=1e-14
        )
        half = rotations.matrix(rotations.exponential(0.5 * found.rotation[i]))
        np.testing.assert_allclose(found.frame[i], frames[i] @ half, atol=1e-14)
        edge = (position[i + 1] - position[i]) / rod.length[i]
        np.testing.assert_allclose(found.stretch[i], found.frame[i].T @ edge, atol=1e-13)
    np.testing.assert_allclose(
        rotations.matrix(element_quaternions(quaternion)), found.frame, atol=1e-14
    )
    np.testing.assert_allclose(
        curvature(rod, quaternion), found.rotation / rod.length[:, None], atol=1e-14
    )


# Tangent


def dense(matrix):
    """The block-tridiagonal matrix as one array."""
    n, b = matrix.diagonal.shape[:2]
    full = np.zeros((n, b, n, b))
    for i in range(n):
        full[i, :, i] = matrix.diagonal[i]
        if i:
            full[i, :, i - 1] = matrix.lower[i]
            full[i - 1, :, i] = matrix.upper[i - 1]
    return full.reshape(n * b, n * b)


@jax.jit
def assembled(rod, position, quaternion, force):
    zero = jnp.zeros((6, 6))
    tangent = balance.element_tangent(rod, at_rest(jnp.zeros(()), position, quaternion), force)
    scales = Scales(jnp.asarray(1.0), jnp.asarray(1.0))
    none = NodeBlocks(jnp.zeros((ELEMENTS + 1, 6, 6)))
    return assemble(rod, tangent, none, jnp.stack([zero, zero]), BOTH, scales)


@jax.jit
def machine_jacobian(rod, position, quaternion, force):
    """jacfwd of `internal` in the block order of `assemble`: rows and columns of 9 a node."""

    def rows(x):
        z = jnp.concatenate([x[:, :3], x[:, 6:]], 1)
        wrench, constraint = stacked(rod, *moved(position, quaternion, z), force + x[1:, 3:6])
        return jnp.concatenate([jnp.concatenate([x[:1, 3:6], constraint]), wrench], 1)

    size = 9 * (ELEMENTS + 1)
    return jax.jacfwd(rows)(jnp.zeros((ELEMENTS + 1, 9))).reshape(size, size)


@pytest.mark.parametrize("section", [UNIT_SECTION, COMPLIANT], ids=["inextensible", "compliant"])
def test_tangent_is_the_derivative_of_internal(section):
    rod = rod_of(section)
    for seed, size in ((0, 0.0), (1, 1e-9), (2, 0.2), (3, 0.7), (4, 1.3)):
        arguments = (rod, *random_configuration(rod, seed, size))
        expected = machine_jacobian(*arguments)
        assert relative_difference(dense(assembled(*arguments)), expected) < 1e-11


def test_tangent_at_the_straight_unstrained_rod():
    # closed form: EA-like chain, bending springs B/ds and nothing else
    rod = straight_rod(1.0, ELEMENTS, UNIT_SECTION)
    arguments = (rod, rod.position, rod.quaternion, jnp.zeros((ELEMENTS, 3)))
    found = dense(assembled(*arguments))
    assert np.all(np.isfinite(found))
    assert relative_difference(found, machine_jacobian(*arguments)) < 1e-14
    spins = found.reshape(ELEMENTS + 1, 9, ELEMENTS + 1, 9)[2, 6:, :, 6:]
    springs = np.asarray([1.0, 1.3, 0.8]) * ELEMENTS
    np.testing.assert_allclose(spins[:, 2], np.diag(2 * springs), rtol=1e-13)
    np.testing.assert_allclose(spins[:, 1], np.diag(-springs), rtol=1e-13)
    np.testing.assert_allclose(spins[:, 4], 0.0, atol=1e-15)


def test_scales_and_projectors_of_assemble():
    rod = rod_of(COMPLIANT)
    configuration = random_configuration(rod, 5)
    node = random_arrays(6, (ELEMENTS + 1, 6, 6))[0]
    direction = jnp.asarray([0.6, 0.0, 0.8])
    slider = jnp.eye(6).at[:3, :3].add(-jnp.outer(direction, direction))
    zero = jnp.zeros((6, 6))
    tangent = balance.element_tangent(
        rod, at_rest(jnp.zeros(()), *configuration[:2]), configuration[2]
    )
    plain = Scales(jnp.asarray(1.0), jnp.asarray(1.0))
    raw = dense(assemble(rod, tangent, NodeBlocks(node), jnp.stack([zero, zero]), BOTH, plain))
    length, force = 0.3, 7.0
    scales = Scales(jnp.asarray(length), jnp.asarray(force))
    found = dense(assemble(rod, tangent, NodeBlocks(node), jnp.stack([zero, slider]), BOTH, scales))
    columns = np.tile(np.repeat([length, force, 1.0], 3), ELEMENTS + 1)
    rows = np.tile(np.repeat([1.0, 1 / force, 1 / (force * length)], 3), ELEMENTS + 1)
    expected = rows[:, None] * raw * columns[None, :]
    expected[:3] = 0  # the dummy force before the first node is set to zero
    expected[:3, 3:6] = np.eye(3)
    keep = np.eye(6) - np.asarray(slider)
    expected[-6:] = keep @ expected[-6:]
    last = [-9, -8, -7, -3, -2, -1]
    expected[-6:, last] += slider
    np.testing.assert_allclose(found, expected, atol=1e-12 * np.max(np.abs(expected)))
    # the mass matrix in `node` sits on the nodes' own columns
    without = dense(
        assemble(rod, tangent, NodeBlocks(0 * node), jnp.stack([zero, zero]), BOTH, plain)
    )
    difference = (raw - without).reshape(ELEMENTS + 1, 9, ELEMENTS + 1, 9)
    picked = difference[2, 3:, 2][:, [0, 1, 2, 6, 7, 8]]
    np.testing.assert_allclose(picked, node[2], atol=1e-12)


def test_constraint_tangent_is_the_tangent_without_stress():
    rod = straight_rod(2.0, ELEMENTS, UNIT_SECTION)
    position, quaternion, _ = random_configuration(rod, 8)
    nothing = rod.stiffness * 0
    unstressed = jax.tree.map(lambda x: x, rod)
    object.__setattr__(unstressed, "stiffness", nothing)
    full = balance.element_tangent(
        unstressed, at_rest(jnp.zeros(()), position, quaternion), jnp.zeros((ELEMENTS, 3))
    )
    alone = balance.constraint_tangent(rod, strains(rod, position, quaternion))
    assert full.constraint_edge is None and alone.constraint_edge is None
    for name, value, expected in zip(full._fields[:-1], alone[:-1], full[:-1], strict=True):
        np.testing.assert_allclose(value, expected, atol=1e-14, err_msg=name)


# Objectivity and momentum


@few
@given(seeds)
def test_rigid_motion_leaves_strains_and_turns_wrenches(seed):
    rod = rod_of(COMPLIANT)
    position, quaternion, force = random_configuration(rod, seed)
    shift, turn = random_arrays(seed + 1, (3,), (3,))
    q = rotations.exponential(2 * turn)
    everywhere = jnp.broadcast_to(q, quaternion.shape)
    moved_position = rotations.rotate(everywhere, position) + 10 * shift[None, :]
    moved_frames = rotations.multiply(everywhere, quaternion)
    (wrench, constraint), _ = compare(rod, position, quaternion, force)
    (moved_wrench, moved_constraint), _ = compare(rod, moved_position, moved_frames, force)
    np.testing.assert_allclose(moved_constraint, constraint, atol=1e-13)
    np.testing.assert_allclose(moved_wrench[:, 3:], wrench[:, 3:], atol=1e-12)
    turned = rotations.rotate(everywhere, wrench[:, :3])
    np.testing.assert_allclose(moved_wrench[:, :3], turned, atol=1e-12)


@few
@given(seeds)
def test_internal_wrenches_have_no_resultant(seed):
    rod = rod_of(UNIT_SECTION)
    position, quaternion, force = random_configuration(rod, seed)
    (wrench, _), _ = compare(rod, position, quaternion, force)
    scale = float(jnp.max(jnp.abs(wrench)))
    np.testing.assert_allclose(jnp.sum(wrench[:, :3], 0), 0.0, atol=1e-13 * scale)
    moment = rotations.rotate(quaternion, wrench[:, 3:]) + jnp.cross(position, wrench[:, :3])
    np.testing.assert_allclose(jnp.sum(moment, 0), 0.0, atol=1e-13 * scale)


def test_derivatives_at_the_straight_rod_are_finite_to_second_order():
    rod = straight_rod(1.0, ELEMENTS, UNIT_SECTION)
    z, weight = random_arrays(9, (ELEMENTS + 1, 6), (ELEMENTS + 1, 6))
    nothing, force = jnp.zeros((ELEMENTS + 1, 6)), jnp.zeros((ELEMENTS, 3))

    def work(at, stiffness):
        varied = jax.tree.map(lambda x: x, rod)
        object.__setattr__(varied, "stiffness", stiffness)
        wrench, constraint = stacked(varied, *moved(rod.position, rod.quaternion, at), force)
        return jnp.sum(wrench * weight) + jnp.sum(constraint**2)

    @jax.jit
    def derivatives(at):
        gradient = jax.grad(work, (0, 1))(at, rod.stiffness)
        slope = lambda t: jax.grad(work)(at + t * z, rod.stiffness)
        return gradient, jax.jvp(slope, (0.0,), (1.0,))[1]

    gradient, second = derivatives(nothing)
    for leaf in jax.tree.leaves((gradient, second)):
        assert np.all(np.isfinite(leaf))
    width = 1e-6
    change = derivatives(width * z)[0][0] - derivatives(-width * z)[0][0]
    assert relative_difference(second, change / (2 * width)) < 1e-7
