"""Building rods: geometry, properties, units of the section, and every refusal."""

import dataclasses

import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest
from helpers import UNIT_SECTION, relative_difference
from hypothesis import given, settings
from hypothesis import strategies as st

from rodjax import rotations
from rodjax.rods.builders import curved_rod, straight_rod
from rodjax.rods.framing import grid
from rodjax.rods.rod import Rod
from rodjax.rods.section import Section, circular_section, sample
from rodjax.rods.strains import curvature, strains

few = settings(max_examples=40, deadline=None)
number = st.floats(-10, 10)
vectors = st.tuples(number, number, number).filter(lambda v: np.linalg.norm(v) > 1e-3)


# Grid


@few
@given(
    st.floats(1e-9, 1e9),
    st.integers(2, 60),
    st.lists(st.floats(0.02, 0.98), max_size=4, unique_by=lambda x: round(x, 2)),
)
def test_grid_has_every_jump_and_nearly_equal_elements(length, elements, fractions):
    jumps = [length * f for f in fractions]
    if len(jumps) + 1 > elements:
        with pytest.raises(ValueError, match="elements"):
            grid(length, elements, jumps)
        return
    nodes = grid(length, elements, jumps)
    assert nodes.shape == (elements + 1,)
    assert nodes[0] == 0 and nodes[-1] == length and np.all(np.diff(nodes) > 0)
    for jump in jumps:
        assert jump in nodes
    # each piece has the elements that its length asks for, rounded, but at least one
    marks = np.array([0.0, *sorted(jumps), length])
    count = np.diff(np.searchsorted(nodes, marks))
    share = np.diff(marks) / length * elements
    slack = 1 + len(jumps)
    assert np.all(count >= 1) and np.all(np.abs(count - share) <= slack)


def test_grid_without_jumps_is_uniform():
    np.testing.assert_allclose(np.diff(grid(2.0, 5)), 0.4, rtol=1e-15)
    np.testing.assert_array_equal(grid(1.0, 4, (0.5, 0.25)), [0, 0.25, 0.5, 0.75, 1.0])


# Straight and curved placings


@few
@given(vectors, vectors, vectors)
def test_straight_rod_lies_along_its_direction(direction, first_director, origin):
    direction = np.asarray(direction) / np.linalg.norm(direction)
    if np.linalg.norm(np.cross(direction, first_director)) < 1e-2 * np.linalg.norm(first_director):
        first_director = None
    rod = straight_rod(
        2.0, 4, UNIT_SECTION, direction=direction, first_director=first_director, origin=origin
    )
    expected = np.asarray(origin) + np.linspace(0, 2, 5)[:, None] * direction
    np.testing.assert_allclose(rod.position, expected, atol=1e-13)
    frame = np.asarray(rotations.matrix(rod.quaternion[2]))
    np.testing.assert_allclose(frame[:, 2], direction, atol=1e-14)
    np.testing.assert_allclose(frame.T @ frame, np.eye(3), atol=1e-14)
    assert np.linalg.det(frame) == pytest.approx(1.0, abs=1e-13)
    if first_director is not None:
        assert frame[:, 0] @ np.asarray(first_director) > 0
        assert abs(frame[:, 1] @ np.asarray(first_director)) < 1e-12 * 20


def test_lengths_and_lumping():
    rod = straight_rod(1.0, 4, UNIT_SECTION, jumps=(0.1,))
    np.testing.assert_allclose(rod.arc_length, [0, 0.1, 0.4, 0.7, 1.0], atol=1e-15)
    np.testing.assert_allclose(rod.midpoints, [0.05, 0.25, 0.55, 0.85], atol=1e-15)
    np.testing.assert_allclose(rod.node_length, [0.05, 0.2, 0.3, 0.3, 0.15], atol=1e-15)
    assert float(jnp.sum(rod.to_nodes(rod.midpoints))) == pytest.approx(0.5, abs=1e-15)
    density = jnp.asarray([[1.0, 2.0]] * 4)
    np.testing.assert_allclose(jnp.sum(rod.to_nodes(density), 0), [1.0, 2.0], atol=1e-15)
    assert rod.elements == 4


def helix(s):
    """Radius 0.3 and pitch 2 pi 0.4 by arc length: curvature 0.3/0.25, torsion 0.4/0.25."""
    angle = s / 0.5
    return np.array([0.3 * np.cos(angle), 0.3 * np.sin(angle), 0.4 * angle])


@pytest.mark.parametrize("stress_free", [True, False])
def test_curved_rod_is_unstretched_and_follows_its_curve(stress_free):
    errors = []
    for elements in (20, 40, 80):
        rod = curved_rod(helix, 2.0, elements, UNIT_SECTION, stress_free=stress_free)
        stretch = strains(rod, rod.position, rod.quaternion).stretch
        np.testing.assert_allclose(stretch, np.tile([0.0, 0, 1], (elements, 1)), atol=1e-12)
        along = np.stack([helix(s) for s in rod.arc_length])
        errors.append(np.max(np.abs(rod.position - along)))
        bending = np.linalg.norm(curvature(rod, rod.quaternion)[:, :2], axis=1)
        np.testing.assert_allclose(bending, 1.2, rtol=2 / elements**2 * 4)
        natural = curvature(rod, rod.quaternion) if stress_free else 0 * rod.natural_curvature
        np.testing.assert_allclose(rod.natural_curvature, natural, atol=1e-13)
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.1)
    assert errors[1] / errors[2] == pytest.approx(4, rel=0.1)
    # frames are carried along without twist
    np.testing.assert_allclose(curvature(rod, rod.quaternion)[:, 2], 0.0, atol=1e-12)


def test_curved_rod_may_end_in_a_half_turn():
    arc = lambda s: np.array([1 - np.cos(s), 0.0, np.sin(s)])
    rod = curved_rod(arc, np.pi, 10, UNIT_SECTION, first_director=(0, 1, 0), jumps=(0.4,))
    ends = rotations.tangent_director(rod.quaternion)
    np.testing.assert_allclose(ends[0], [0, 0, 1], atol=1e-6)
    np.testing.assert_allclose(ends[-1], [0, 0, -1], atol=1e-6)
    np.testing.assert_allclose(
        rotations.matrix(rod.quaternion)[:, :, 0], [[0, 1, 0]] * 11, atol=1e-9
    )
    assert 0.4 in np.asarray(rod.arc_length)


def test_frames_of_any_sign_are_those_of_one():
    """q and -q are one frame; other libraries give either."""
    rod = curved_rod(helix, 2.0, 6, UNIT_SECTION)
    signs = jnp.asarray([1.0, -1, -1, 1, -1, 1, 1])[:, None]
    mixed = dataclasses.replace(rod, quaternion=signs * rod.quaternion)
    np.testing.assert_array_equal(mixed.quaternion, rod.quaternion)
    # the first is kept
    other = dataclasses.replace(rod, quaternion=-signs * rod.quaternion)
    np.testing.assert_array_equal(other.quaternion, -rod.quaternion)
    np.testing.assert_array_equal(
        curvature(other, other.quaternion), curvature(rod, rod.quaternion)
    )
    with pytest.raises(ValueError, match="^quaternion: must be finite"):
        dataclasses.replace(rod, quaternion=rod.quaternion.at[2, 1].set(jnp.inf))


def test_rows_of_traced_numbers_are_a_curvature():
    build = lambda k: straight_rod(1.0, 4, UNIT_SECTION, natural_curvature=[(k, 0.0, 2 * k)] * 4)
    wanted = np.tile([0.3, 0.0, 0.6], (4, 1))
    np.testing.assert_allclose(jax.jit(lambda k: build(k).natural_curvature)(0.3), wanted)
    slope = jax.jacfwd(lambda k: build(k).natural_curvature)(0.3)
    np.testing.assert_allclose(slope, wanted / 0.3)


# Properties


def test_sample_takes_constants_arrays_and_functions():
    middle = np.array([0.1, 0.3, 0.5])
    np.testing.assert_array_equal(sample(2, middle, "x"), [2.0, 2.0, 2.0])
    np.testing.assert_array_equal(sample(np.array([1, 2, 3]), middle, "x"), [1.0, 2.0, 3.0])
    np.testing.assert_allclose(sample(lambda s: 2 * s, middle, "x"), [0.2, 0.6, 1.0])
    assert sample(2, middle, "x").dtype == jnp.float64
    assert sample(jnp.asarray([1, 2, 3]), middle, "x").dtype == jnp.float64


@few
@given(st.floats(1e-6, 1e6), st.floats(1e-3, 1e12), st.floats(1e-3, 1e12), st.floats(1e-3, 1e5))
def test_circular_section(diameter, youngs, shear, density):
    rod = straight_rod(
        10 * diameter,
        3,
        circular_section(diameter, youngs, shear, density, extensible=True, shear_factor=0.9),
    )
    area, second = np.pi * diameter**2 / 4, np.pi * diameter**4 / 64
    np.testing.assert_allclose(rod.area, area, rtol=1e-14)
    stiffness = [youngs * second, youngs * second, 2 * shear * second]
    np.testing.assert_allclose(rod.stiffness[1], stiffness, rtol=1e-14)
    np.testing.assert_allclose(rod.mass, density * area, rtol=1e-14)
    rotary = density * second * np.array([1, 1, 2])
    np.testing.assert_allclose(rod.rotary_inertia[0], rotary, rtol=1e-14)
    compliance = [1 / (0.9 * shear * area)] * 2 + [1 / (youngs * area)]
    np.testing.assert_allclose(rod.compliance[2], compliance, rtol=1e-14)


def test_what_is_left_out_is_none():
    plain = straight_rod(1.0, 3, circular_section(0.1, 1.0, 1.0, 1.0, rotary_inertia=False))
    assert plain.rotary_inertia is None and plain.compliance is None
    light = straight_rod(1.0, 3, circular_section(0.1, 1.0, 1.0, None))
    assert light.mass is None and light.rotary_inertia is None


def test_a_neck_jumps_exactly_at_nodes():
    neck = lambda s: np.where(np.abs(s - 0.5) < 0.125, 0.09, 0.1)
    rod = straight_rod(1.0, 10, circular_section(neck, 1.0, 1.0, 1.0), jumps=(0.375, 0.625))
    inside = (rod.arc_length[:-1] >= 0.375) & (rod.arc_length[1:] <= 0.625)
    np.testing.assert_allclose(rod.diameter, np.where(inside, 0.09, 0.1), rtol=1e-15)
    assert float(jnp.sum(jnp.where(inside, rod.length, 0.0))) == pytest.approx(0.25, abs=1e-15)


def test_properties_can_be_differentiated_and_mapped():
    def weight(stiffness, kappa):
        section = Section(stiffness=(stiffness, stiffness, 0.8), mass=1.0)
        rod = straight_rod(1.0, 4, section, natural_curvature=(kappa, 0.0, 0.0))
        return jnp.sum(rod.stiffness[:, 0] * rod.natural_curvature[:, 0] ** 2)

    by_stiffness, by_kappa = jax.jit(jax.grad(weight, (0, 1)))(2.0, 3.0)
    assert float(by_stiffness) == pytest.approx(36.0)
    assert float(by_kappa) == pytest.approx(48.0)
    mapped = jax.vmap(lambda k: straight_rod(1.0, 4, UNIT_SECTION, natural_curvature=(k, 0.0, 0.0)))
    rods = mapped(jnp.asarray([1.0, 2.0]))
    np.testing.assert_array_equal(rods.natural_curvature[:, 0, 0], [1.0, 2.0])
    round_section = lambda d: straight_rod(1.0, 4, circular_section(d, 1.0, 1.0, 1.0)).mass[0]
    assert float(jax.grad(round_section)(0.2)) == pytest.approx(np.pi * 0.1)


# Refusals

S = UNIT_SECTION


def with_section(**change):
    given = {
        "stiffness": S.stiffness,
        "mass": S.mass,
        "rotary_inertia": S.rotary_inertia,
        "diameter": S.diameter,
        "area": S.area,
    }
    return lambda: straight_rod(1.0, 4, Section(**{**given, **change}))


NAN, INF = float("nan"), float("inf")
REFUSALS = {
    "length zero": ("length", lambda: straight_rod(0.0, 4, S)),
    "length nan": ("length", lambda: straight_rod(NAN, 4, S)),
    "length infinite": ("length", lambda: straight_rod(INF, 4, S)),
    "length vector": ("length", lambda: straight_rod(np.ones(4), 4, S)),
    "one element": ("elements", lambda: straight_rod(1.0, 1, S)),
    "negative elements": ("elements", lambda: straight_rod(1.0, -3, S)),
    "half an element": ("elements", lambda: straight_rod(1.0, 4.5, S)),
    "elements nan": ("elements", lambda: straight_rod(1.0, NAN, S)),
    "too few for the jumps": ("elements", lambda: straight_rod(1.0, 2, S, jumps=(0.2, 0.4))),
    "jump outside": ("jumps", lambda: straight_rod(1.0, 4, S, jumps=(1.5,))),
    "jump at an end": ("jumps", lambda: straight_rod(1.0, 4, S, jumps=(0.0,))),
    "jump twice": ("jumps", lambda: straight_rod(1.0, 4, S, jumps=(0.5, 0.5))),
    "jump nan": ("jumps", lambda: straight_rod(1.0, 4, S, jumps=(NAN,))),
    "direction zero": ("direction", lambda: straight_rod(1.0, 4, S, direction=(0, 0, 0))),
    "direction plane": ("direction", lambda: straight_rod(1.0, 4, S, direction=(0, 1))),
    "direction nan": ("direction", lambda: straight_rod(1.0, 4, S, direction=(0, NAN, 1))),
    "direction infinite": ("direction", lambda: straight_rod(1.0, 4, S, direction=(0, INF, 1))),
    "origin short": ("origin", lambda: straight_rod(1.0, 4, S, origin=(1.0,))),
    "origin nan": ("origin", lambda: straight_rod(1.0, 4, S, origin=(NAN, 0, 0))),
    "director along": ("first_director", lambda: straight_rod(1.0, 4, S, first_director=(0, 0, 2))),
    "director nan": ("first_director", lambda: straight_rod(1.0, 4, S, first_director=(NAN, 1, 0))),
    "curvature of two": (
        "natural_curvature",
        lambda: straight_rod(1.0, 4, S, natural_curvature=(0.0, 1.0)),
    ),
    "curvature of five": (
        "natural_curvature",
        lambda: straight_rod(1.0, 4, S, natural_curvature=(np.ones(5), 0.0, 0.0)),
    ),
    "curvature nan": (
        "natural_curvature",
        lambda: straight_rod(1.0, 4, S, natural_curvature=(NAN, 0.0, 0.0)),
    ),
    "stiffness of two": ("stiffness", with_section(stiffness=(1.0, 1.0))),
    "stiffness zero": ("stiffness", with_section(stiffness=(1.0, 0.0, 1.0))),
    "stiffness negative": ("stiffness", with_section(stiffness=(1.0, lambda s: s - 0.5, 1.0))),
    "stiffness nan": ("stiffness", with_section(stiffness=(NAN, 1.0, 1.0))),
    "stiffness of five": ("stiffness", with_section(stiffness=(np.ones(5), 1.0, 1.0))),
    "mass zero": ("mass.*mass=None", with_section(mass=0.0)),
    "mass negative": ("mass", with_section(mass=-1.0)),
    "mass infinite": ("mass", with_section(mass=INF)),
    "mass of five": ("mass", with_section(mass=np.ones(5))),
    "no mass but rotary": ("rotary_inertia", with_section(mass=None)),
    "rotary negative": ("rotary_inertia", with_section(rotary_inertia=(1.0, -1.0, 1.0))),
    "rotary of two": ("rotary_inertia", with_section(rotary_inertia=(1.0, 1.0))),
    "compliance negative": ("compliance", with_section(compliance=(0.0, 0.0, -1.0))),
    "compliance nan": ("compliance", with_section(compliance=(0.0, 0.0, NAN))),
    "diameter zero": ("diameter", with_section(diameter=0.0)),
    "diameter of five": ("diameter", with_section(diameter=np.ones(5))),
    "area negative": ("area", with_section(area=-1.0)),
    "round zero": ("diameter", lambda: straight_rod(1.0, 4, circular_section(0.0, 1.0, 1.0, 1.0))),
    "round nan": ("diameter", lambda: straight_rod(1.0, 4, circular_section(NAN, 1.0, 1.0, 1.0))),
    "round modulus": ("youngs_modulus", lambda: circular_section(1.0, -1.0, 1.0, 1.0)),
    "round shear": ("shear_modulus", lambda: circular_section(1.0, 1.0, 0.0, 1.0)),
    "round shear nan": ("shear_modulus", lambda: circular_section(1.0, 1.0, NAN, 1.0)),
    "round density": ("density", lambda: circular_section(1.0, 1.0, 1.0, -1.0)),
    "round density nan": ("density", lambda: circular_section(1.0, 1.0, 1.0, NAN)),
    "round factor": (
        "shear_factor",
        lambda: circular_section(1.0, 1.0, 1.0, 1.0, extensible=True, shear_factor=0.0),
    ),
    "curve by angle": ("curve", lambda: curved_rod(lambda s: 2 * helix(s), 1.0, 8, S)),
    "curve in a plane": ("curve", lambda: curved_rod(lambda s: helix(s)[:2], 1.0, 8, S)),
    "curve nan": ("curve", lambda: curved_rod(lambda s: NAN * helix(s), 1.0, 8, S)),
    "curve director": (
        "first_director",
        lambda: curved_rod(lambda s: np.array([0, 0, s]), 1.0, 8, S, first_director=(0, 0, 1)),
    ),
}


@pytest.fixture
def unchecked():
    """Without the tests' run-time type checks, which would come before the package's own."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("case", REFUSALS)
def test_refusals_name_the_argument(case):
    match, build = REFUSALS[case]
    with pytest.raises(ValueError, match=rf"^{match}"):
        build()


@pytest.mark.parametrize(
    "name", ["position", "quaternion", "length", "stiffness", "natural_curvature", "mass"]
)
def test_rod_itself_refuses_nan(name):
    rod = straight_rod(1.0, 4, UNIT_SECTION)
    fields = {**vars(rod), name: getattr(rod, name).at[1].set(NAN)}
    with pytest.raises(ValueError, match=f"^{name}: must be finite"):
        Rod(**fields)


@pytest.mark.usefixtures("unchecked")
def test_rod_itself_refuses_frames_of_other_length_and_two_nodes():
    rod = straight_rod(1.0, 4, UNIT_SECTION)
    with pytest.raises(ValueError, match="^quaternion: must have unit length"):
        Rod(**{**vars(rod), "quaternion": 2 * rod.quaternion})
    short = {
        name: None if leaf is None else leaf[: len(leaf) - 3] for name, leaf in vars(rod).items()
    }
    with pytest.raises(ValueError, match="^elements"):
        Rod(**short)


def test_units_of_the_section_are_free():
    metres = straight_rod(1.0, 4, circular_section(1e-3, 1e7, 4e6, 1500.0))
    # millimetres, grams, milliseconds: forces in kN
    other = straight_rod(1e3, 4, circular_section(1.0, 1e-2, 4e-3, 1.5e-3))
    assert relative_difference(other.stiffness, metres.stiffness * 1e3) < 1e-13
    assert relative_difference(other.mass, metres.mass) < 1e-13
