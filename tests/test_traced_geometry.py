"""Geometry of new rods as traced numbers: values and derivatives, and curves through points."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import UNIT_SECTION

from rodjax.numerics.results import ModelWarning
from rodjax.rods.builders import curved_rod, straight_rod
from rodjax.rods.curves import through
from rodjax.rods.section import Section, circular_section
from rodjax.rods.strains import strains

ELEMENTS = 6


def spiral(pitch):
    """Helix of radius 0.3 by arc length."""
    size = jnp.sqrt(0.09 + pitch**2)
    return lambda s: jnp.stack(
        [0.3 * jnp.cos(s / size), 0.3 * jnp.sin(s / size), pitch * s / size + 0.1 * pitch]
    )


KNEE = jnp.asarray([[0.0, 0.0, 0.0], [0.3, 0.1, 0.0], [0.5, 0.5, 0.2], [0.4, 0.9, 0.3]])
SIDE = jnp.asarray([1.0, 0.2, 0.3])
STRAIGHT = {
    "length": (lambda x: straight_rod(x, ELEMENTS, UNIT_SECTION, direction=SIDE), 1.3),
    "direction": (
        lambda x: straight_rod(1.0, ELEMENTS, UNIT_SECTION, direction=x),
        jnp.asarray([0.3, -2.0, 1.0]),
    ),
    "direction with director": (
        lambda x: straight_rod(1.0, 4, UNIT_SECTION, direction=(0, x, 1), first_director=SIDE),
        0.4,
    ),
    "half a turn": (  # where another component of the quaternion is the largest
        lambda x: straight_rod(1.0, 4, UNIT_SECTION, direction=x, first_director=(-1, 0.1, 0)),
        jnp.asarray([0.1, 0.2, -1.0]),
    ),
    "origin": (lambda x: straight_rod(1.0, 4, UNIT_SECTION, origin=x), jnp.asarray([1.0, 2, 3])),
    "first_director": (lambda x: straight_rod(1.0, 4, UNIT_SECTION, first_director=x), SIDE),
    "natural_curvature": (
        lambda x: straight_rod(1.0, ELEMENTS, UNIT_SECTION, natural_curvature=x),
        jnp.arange(18.0).reshape(6, 3),
    ),
    "diameter": (
        lambda x: straight_rod(1.0, ELEMENTS, circular_section(x, 1e6, 4e5, 1e3)),
        0.02,
    ),
    "diameters by element": (
        lambda x: straight_rod(1.0, ELEMENTS, circular_section(x, 1e6, 4e5, 1e3, extensible=True)),
        jnp.linspace(0.01, 0.02, 6),
    ),
    "profile and length": (
        lambda x: straight_rod(x[0], 4, circular_section(lambda s: x[1] * (1 + s), 1e6, 4e5, 1e3)),
        jnp.asarray([1.2, 0.01]),
    ),
}
CURVED = {
    "curve": (lambda x: curved_rod(spiral(x), 1.0, ELEMENTS, UNIT_SECTION), 0.2),
    "curve and length": (lambda x: curved_rod(spiral(x), 3 * x, ELEMENTS, UNIT_SECTION), 0.2),
    "known curve of traced length": (
        lambda x: curved_rod(spiral(0.2), x, ELEMENTS, UNIT_SECTION),
        1.0,
    ),
    "director of a curve": (
        lambda x: curved_rod(spiral(0.2), 1.0, ELEMENTS, UNIT_SECTION, first_director=x),
        SIDE,
    ),
    "points": (lambda x: curved_rod(x, None, ELEMENTS, UNIT_SECTION), KNEE),
    "length of points": (lambda x: curved_rod(KNEE, x, ELEMENTS, UNIT_SECTION), 1.26),
}
BUILDERS = STRAIGHT | CURVED


def flat(build):
    """All numbers of a rod but those without scale, over their size."""
    return lambda x: jnp.concatenate(
        [jnp.ravel(leaf) for leaf in jax.tree.leaves(build(x)) if leaf.size]
    )


SHORT = ["half a turn", "profile and length", "curve and length"]
LONG = [pytest.param(name, marks=pytest.mark.slow) for name in BUILDERS if name not in SHORT]


@pytest.mark.parametrize("name", SHORT + LONG)
def test_traced_geometry(name):
    """Values of the traced builder are the known one's; derivatives are differences of those."""
    build, x = BUILDERS[name]
    x = jnp.asarray(x)
    values = flat(build)
    expected = np.asarray(values(x))
    size = np.maximum(np.abs(expected), 1.0)
    both = jax.jit(lambda x: (values(x), jax.jacfwd(values)(x), jax.grad(total)(x)))
    total = lambda x: jnp.sum(values(x) / size)
    found, slopes, back = both(x)
    np.testing.assert_allclose(found / size, expected / size, atol=1e-9)
    slopes = np.asarray(slopes).reshape(len(expected), -1)
    width = 1e-5 * max(1e-2, float(jnp.max(jnp.abs(x))))
    for j in range(x.size):
        shift = width * np.reshape(np.eye(x.size)[j], x.shape)
        change = np.asarray(values(x + shift) - values(x - shift)) / (2 * width)
        reach = np.maximum(np.abs(change), size)
        np.testing.assert_allclose(slopes[:, j] / reach, change / reach, atol=3e-6)
    by_rows = np.sum(slopes / size[:, None], 0)
    np.testing.assert_allclose(np.ravel(back), by_rows, atol=1e-9 * np.max(np.abs(by_rows)))


@pytest.mark.parametrize("name", ["direction", pytest.param("curve", marks=pytest.mark.slow)])
def test_geometry_without_jit(name):
    """jacfwd, grad and vmap of the builders by themselves."""
    build, x = BUILDERS[name]
    x = jnp.asarray(x)
    tip = lambda x: build(x).position[-1]
    wanted = jax.jit(jax.jacfwd(tip))(x)
    np.testing.assert_allclose(jax.jacfwd(tip)(x), wanted, atol=1e-10)
    np.testing.assert_allclose(jax.grad(lambda x: tip(x)[1])(x), wanted[1], atol=1e-10)
    rows = jax.vmap(build)(jnp.stack([x, 1.01 * x]))
    np.testing.assert_allclose(rows.position[1], build(1.01 * x).position, atol=1e-12)


def test_derivatives_of_a_straight_rod_by_theory():
    end = lambda length: straight_rod(length, 4, UNIT_SECTION, direction=(3, 0, 4)).position[-1]
    np.testing.assert_allclose(jax.jacfwd(end)(2.0), [0.6, 0.0, 0.8], atol=1e-15)
    turn = lambda d: straight_rod(2.0, 4, UNIT_SECTION, direction=d).position[-1]
    d = jnp.asarray([0.0, 0.0, 5.0])
    np.testing.assert_allclose(jax.jacrev(turn)(d), np.diag([0.4, 0.4, 0.0]), atol=1e-15)
    stiff = lambda d: straight_rod(1.0, 2, circular_section(d, 1e7, 4e6, 1e3)).stiffness[0, 2]
    expected = 4e6 * np.pi * 4 * 0.1**3 / 32
    assert float(jax.grad(stiff)(0.1)) == pytest.approx(expected, rel=1e-13)


def test_what_cannot_be_traced_says_so():
    with pytest.raises(ValueError, match="^jumps: .* length is traced"):
        jax.jit(lambda x: straight_rod(x, 4, UNIT_SECTION, jumps=(0.5,)))(1.0)
    with pytest.raises(ValueError, match=r"^curve: the function `.*cannot be traced by jax"):
        jax.jit(lambda x: curved_rod(lambda s: np.array([0, 0, float(s)]), x, 4, UNIT_SECTION))(1.0)
    with pytest.raises(ValueError, match=r"^diameter: the function `.*cannot be traced by jax"):
        profile = circular_section(lambda s: 0.1 * np.sin(s), 1.0, 1.0, 1.0)
        jax.jit(lambda x: straight_rod(x, 4, profile))(1.0)


# Curves through points


def circle(count, turn=1.9 * np.pi):
    angle = np.linspace(0.0, turn, count) ** 1.05  # unequally spaced
    angle *= turn / angle[-1]
    return np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1)


def test_points_are_measured_and_followed_to_fourth_order():
    errors, slopes, lengths = [], [], []
    for count in (20, 40, 80):
        at, length = through(circle(count))
        s = np.linspace(0.0, float(length), 50)
        exact = np.stack([np.cos(s), np.sin(s), 0 * s], 1)
        errors.append(np.max(np.abs(at(s)[0] - exact)))
        lengths.append(abs(float(length) - 1.9 * np.pi))
        tangents = np.stack([-np.sin(s), np.cos(s), 0 * s], 1)
        slopes.append(np.max(np.abs(at(s)[1] - tangents)))
    assert errors[0] < 1e-3 and errors[0] / errors[2] > 100
    assert slopes[0] < 3e-2 and slopes[0] / slopes[2] > 30
    assert lengths[0] < 1e-3 and lengths[2] < 1e-6


def test_few_points():
    at, length = through([[0.0, 0, 0], [3.0, 4.0, 0]])
    assert float(length) == pytest.approx(5.0, abs=1e-14)
    np.testing.assert_allclose(at(np.array([2.5]))[0], [[1.5, 2.0, 0.0]], atol=1e-14)
    # three points of a parabola, equally spaced by their chords
    at, length = through([[-1.0, 1, 0], [0.0, 0, 0], [1.0, 1, 0]])
    expected = np.sqrt(5) + np.arcsinh(2) / 2
    assert float(length) == pytest.approx(expected, rel=1e-6)
    np.testing.assert_allclose(at(np.array([expected / 2]))[0], np.zeros((1, 3)), atol=1e-7)


def test_a_rod_through_points():
    rod = curved_rod(circle(60), 1.9 * np.pi, 30, UNIT_SECTION)
    np.testing.assert_allclose(np.linalg.norm(rod.natural_curvature, axis=1), 1.0, rtol=3e-3)
    np.testing.assert_allclose(np.linalg.norm(rod.position, axis=1), 1.0, atol=6e-3)
    stretch = strains(rod, rod.position, rod.quaternion).stretch
    np.testing.assert_allclose(stretch, np.tile([0.0, 0, 1], (30, 1)), atol=1e-12)
    own = curved_rod(circle(60), None, 30, UNIT_SECTION, stress_free=False)
    assert float(jnp.sum(own.length)) == pytest.approx(1.9 * np.pi, rel=1e-6)
    np.testing.assert_array_equal(own.natural_curvature, 0.0)
    with pytest.raises(ValueError, match=r"^length: .* 5.969\d* long, not 6.5; give length=None"):
        curved_rod(circle(60), 6.5, 30, UNIT_SECTION)


@pytest.mark.parametrize(
    "points", [np.zeros((31, 3)), np.ones(3), np.ones((5, 2)), np.ones((1, 3)), [[0, 0, 0]], "abc"]
)
def test_points_that_make_no_curve(points):
    with pytest.raises(ValueError, match="^curve: "):
        curved_rod(points, 1.0, 4, UNIT_SECTION)


# Single precision


def by_parts(s):
    """Numpy and `if` cannot be differentiated, whatever they return."""
    return jnp.array([np.cos(s), np.sin(s), 0.0]) if s < 10 else jnp.zeros(3)


@pytest.mark.parametrize(
    ("curve", "traced"),
    [
        (lambda s: jnp.stack([jnp.cos(s), jnp.sin(s), 0 * s]), True),
        (lambda s: np.array([np.cos(s), np.sin(s), 0.0]), False),
        (lambda s: np.array([np.cos(s), np.sin(s), 0.0], np.float32), False),
        (by_parts, False),
    ],
    ids=["jax", "numpy", "single numpy", "untraceable"],
)
def test_the_curvature_of_a_circle_in_single_precision(curve, traced):
    with jax.enable_x64(False):
        build = lambda length: curved_rod(curve, length, 200, UNIT_SECTION).natural_curvature
        for found in (build(6.0), *([jax.jit(build)(6.0)] if traced else [])):
            assert found.dtype == jnp.float32
            np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1.0, rtol=3e-4)


def test_a_curve_without_a_finite_derivative_is_taken_by_differences():
    """Of a root at its start, and where jax knows no forward mode."""

    @jax.custom_vjp
    def own(s):
        return jnp.stack([jnp.cos(s), jnp.sin(s), 0 * s])

    own.defvjp(lambda s: (own(s), s), lambda s, g: (jnp.sum(g),))
    rooted = lambda s: own(s) + 0 * jnp.sqrt(jnp.abs(s))
    for curve in (own, rooted):
        rod = curved_rod(curve, 1.0, 4, UNIT_SECTION)
        np.testing.assert_allclose(rod.natural_curvature[:, 2], 0.0, atol=1e-8)
        np.testing.assert_allclose(np.linalg.norm(rod.natural_curvature, axis=1), 1.0, rtol=1e-7)


# Components


def test_curvature_and_stiffness_by_element():
    kappa = np.arange(18.0).reshape(6, 3)
    for given in (kappa, kappa.tolist(), jnp.asarray(kappa), tuple(kappa.T), list(kappa.T)):
        rod = straight_rod(1.0, 6, UNIT_SECTION, natural_curvature=given)
        np.testing.assert_array_equal(rod.natural_curvature, kappa)
    rod = straight_rod(1.0, 6, Section(stiffness=1 + kappa, mass=1.0, compliance=kappa))
    np.testing.assert_array_equal(rod.stiffness, 1 + kappa)
    np.testing.assert_array_equal(rod.compliance, kappa)
    three = np.arange(9.0).reshape(3, 3)
    rod = straight_rod(1.0, 3, UNIT_SECTION, natural_curvature=tuple(three.T))
    np.testing.assert_array_equal(rod.natural_curvature, three)
    with pytest.raises(ValueError, match="^natural_curvature: .* rows or its columns"):
        straight_rod(1.0, 3, UNIT_SECTION, natural_curvature=three)


# Thickness


def test_a_rod_as_thick_as_long_is_told():
    with pytest.warns(ModelWarning, match="^diameter: 10 is no small part of the length 1"):
        straight_rod(1.0, 4, circular_section(10.0, 1e7, 4e6, 1e3))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        straight_rod(1.0, 4, circular_section(0.5, 1e7, 4e6, 1e3))
