"""Loads against formulas by hand, their contract, and their derivatives at rest."""

import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest
from helpers import UNIT_SECTION, random_arrays
from hypothesis import given, settings
from hypothesis import strategies as st

from rodjax import rotations
from rodjax.constraints.ends import Clamped
from rodjax.inputs.schedules import Constant, Smooth
from rodjax.interactions.load import total_wrench
from rodjax.interactions.loads import (
    DistributedLoad,
    Gravity,
    LinearDrag,
    MorisonDrag,
    PointLoad,
)
from rodjax.rods.builders import straight_rod
from rodjax.rods.inertia import inertial_wrench, kinetic_energy, node_inertia, node_jacobian
from rodjax.rods.section import Section
from rodjax.rods.state import NodeMotion
from rodjax.scenes.scene import Scene

ELEMENTS = 4
UP = (0.0, 0.0, 1.0)
NAN = float("nan")
few = settings(max_examples=25, deadline=None)
CONE = Section(
    stiffness=(1.0, 1.0, 0.8),
    mass=lambda s: 1.0 + s,
    rotary_inertia=(0.01, 0.02, lambda s: 0.03 + 0.01 * s),
    diameter=lambda s: 0.2 - 0.1 * s,
    area=lambda s: 0.05 - 0.02 * s,
)
ROD = straight_rod(1.0, ELEMENTS, CONE, jumps=(0.1,))


def motion_of(seed, speed=1.0):
    turn, position, velocity, spin = random_arrays(seed, *[(ELEMENTS + 1, 3)] * 4)
    return NodeMotion(
        jnp.asarray(0.7), position, rotations.exponential(turn), speed * velocity, speed * spin
    )


def lumped(density):
    """Half of each element's amount to either node, in a plain loop."""
    amounts = np.zeros(ELEMENTS + 1)
    for i in range(ELEMENTS):
        half = 0.5 * float(ROD.length[i]) * float(density[i])
        amounts[i] += half
        amounts[i + 1] += half
    return amounts


# One by one


def test_gravity_and_buoyancy():
    g = np.array([0.0, -9.81, 2.0])
    found = Gravity(g).wrench(ROD, motion_of(0))
    np.testing.assert_allclose(found[:, :3], lumped(ROD.mass)[:, None] * g, atol=1e-13)
    np.testing.assert_array_equal(found[:, 3:], 0.0)
    afloat = Gravity(g, 12.0).wrench(ROD, motion_of(0))
    weight = lumped(ROD.mass - 12.0 * ROD.area)
    np.testing.assert_allclose(afloat[:, :3], weight[:, None] * g, atol=1e-13)
    balanced = Gravity(g, 20.0)  # m = rho_f A_c where 1 + s = 20 (0.05 - 0.02 s), at s = 0
    assert np.all(np.asarray(balanced.weight(ROD))[0] / lumped(ROD.mass)[0] * g > -1e-12)


@few
@given(st.integers(0, 2**31), st.booleans())
def test_morison_drag_by_hand(seed, moving_fluid):
    current = np.array([0.5, -1.0, 0.3]) if moving_fluid else None
    load = MorisonDrag(1.3, 0.9, 0.07, current)
    motion = motion_of(seed)
    found = np.asarray(load.wrench(ROD, motion))
    diameters = lumped(ROD.diameter)
    for i in range(ELEMENTS + 1):
        t = np.asarray(rotations.matrix(motion.quaternion[i]))[:, 2]
        v = np.asarray(motion.velocity[i]) - (0 if current is None else current)
        v_t = (v @ t) * t
        v_n = v - v_t
        expected = (
            -0.5
            * 1.3
            * diameters[i]
            * (0.9 * np.linalg.norm(v_n) * v_n + np.pi * 0.07 * np.linalg.norm(v_t) * v_t)
        )
        np.testing.assert_allclose(found[i, :3], expected, atol=1e-13)
        assert found[i, :3] @ v <= 0  # it only takes energy
    np.testing.assert_array_equal(found[:, 3:], 0.0)


def test_morison_drag_is_smooth_at_rest():
    load = MorisonDrag(1.3, 0.9, 0.07)
    still = motion_of(3, 0.0)
    force = lambda v: load.wrench(ROD, still._replace(velocity=v))
    power = lambda v: jnp.sum(force(v) ** 2)

    @jax.jit
    def derivatives(v):
        return force(v), jax.jacfwd(force)(v), jax.jacrev(force)(v), jax.jacfwd(jax.grad(power))(v)

    *quadratic, curved = derivatives(jnp.zeros((ELEMENTS + 1, 3)))
    for found in quadratic:
        np.testing.assert_array_equal(found, 0.0)  # no slope at rest
    assert np.all(np.isfinite(curved))
    # motion along the tangent alone: the normal part is at its zero, the tangential one is not
    along = rotations.tangent_director(still.quaternion)
    step = random_arrays(4, (ELEMENTS + 1, 3))[0]
    slope = jax.jit(lambda v, step: jax.jvp(force, (v,), (step,))[1])(along, step)
    width = 1e-7
    expected = (force(along + width * step) - force(along - width * step)) / (2 * width)
    np.testing.assert_allclose(slope, expected, atol=1e-7)


def test_morison_drag_scales_as_the_square_of_the_speed_in_any_units():
    load = MorisonDrag(1.3, 0.9, 0.07)
    one, tiny, large = (load.wrench(ROD, motion_of(5, s)) for s in (1.0, 1e-30, 1e30))
    np.testing.assert_allclose(tiny, one * 1e-60, rtol=1e-12)
    np.testing.assert_allclose(large, one * 1e60, rtol=1e-12)


def test_linear_drag_by_hand():
    load = LinearDrag(2.0, 0.7, 0.05)
    motion = motion_of(6)
    found = np.asarray(load.wrench(ROD, motion))
    lengths = lumped(np.ones(ELEMENTS))
    for i in range(ELEMENTS + 1):
        t = np.asarray(rotations.matrix(motion.quaternion[i]))[:, 2]
        v = np.asarray(motion.velocity[i])
        v_t = (v @ t) * t
        expected = -lengths[i] * (2.0 * (v - v_t) + 0.7 * v_t)
        np.testing.assert_allclose(found[i, :3], expected, atol=1e-14)
        axial = -lengths[i] * 0.05 * float(motion.angular_velocity[i, 2])
        np.testing.assert_allclose(found[i, 3:], [0.0, 0.0, axial], atol=1e-15)


@pytest.mark.parametrize("node", [0, 2, -1])
def test_point_load_dead_and_follower(node):
    force, moment = np.array([1.0, 2.0, -1.0]), np.array([0.5, -0.3, 0.2])
    ramp = lambda value: Smooth([0.0, 1.4], [np.zeros(3), 2 * value])  # the value at 0.7
    motion = motion_of(7)
    frame = np.asarray(rotations.matrix(motion.quaternion[node]))
    dead = np.asarray(PointLoad(node, ramp(force), ramp(moment)).wrench(ROD, motion))
    np.testing.assert_allclose(dead[node], [*force, *(frame.T @ moment)], atol=1e-14)
    follower = PointLoad(node, ramp(force), ramp(moment), follower=True).wrench(ROD, motion)
    np.testing.assert_allclose(follower[node], [*(frame @ force), *moment], atol=1e-14)
    others = np.delete(np.arange(ELEMENTS + 1), node)
    np.testing.assert_array_equal(dead[others], 0.0)
    only = PointLoad(node, moment=Constant(moment)).wrench(ROD, motion)
    np.testing.assert_array_equal(only[:, :3], 0.0)


def test_node_of_a_point_load_may_be_traced():
    """From either end; NaN at a number that the rod lacks, where it cannot be refused."""
    motion = motion_of(7)
    at = lambda node: PointLoad(node, Constant(UP)).wrench(ROD, motion)
    numbers = jnp.arange(-ELEMENTS - 2, ELEMENTS + 2)
    found = np.asarray(jax.jit(jax.vmap(at))(numbers))
    for number, wrench in zip(np.asarray(numbers), found, strict=True):
        if not -ELEMENTS - 1 <= number <= ELEMENTS:
            assert np.all(np.isnan(wrench))
            continue
        expected = np.zeros((ELEMENTS + 1, 6))
        expected[number, :3] = UP
        np.testing.assert_array_equal(wrench, expected)


@pytest.mark.parametrize("node", [1.0, True, None, "last", (0,), np.array([1]), 2 + 0j, np.nan])
def test_a_node_is_one_integer(node):
    with pytest.raises(ValueError, match="node: give the number of one node"):
        PointLoad(node, Constant(UP))


def test_numbers_of_a_distributed_load_are_traced():
    """Of full type, whatever they were; what is not a number stays."""
    given = {"a": 2.0, "b": 3, "c": np.float32(1), "d": jnp.asarray(1.0), "e": True, "f": "x"}
    held = DistributedLoad(lambda *_: None, given).parameters
    for name in "abcd":
        assert isinstance(held[name], jax.Array) and not held[name].weak_type
    assert held["a"].dtype == jnp.float64 and held["b"].dtype == jnp.int64
    assert held["e"] is True and held["f"] == "x"


def test_distributed_load_with_parameters():
    def wind(parameters, s, motion):
        force = parameters["speed"] * jnp.sin(s)[:, None] * jnp.asarray([[1.0, 0.0, 0.0]])
        return jnp.concatenate([force - motion.velocity, 0 * force], 1)

    motion = motion_of(8)
    lengths = lumped(np.ones(ELEMENTS))
    s = np.asarray(ROD.arc_length)
    found = DistributedLoad(wind, {"speed": jnp.asarray(3.0)}).wrench(ROD, motion)
    expected = 3.0 * np.sin(s)[:, None] * [[1.0, 0, 0]] - np.asarray(motion.velocity)
    np.testing.assert_allclose(found[:, :3], lengths[:, None] * expected, atol=1e-14)
    total = lambda v: jnp.sum(DistributedLoad(wind, {"speed": v}).wrench(ROD, motion)[:, 0])
    assert float(jax.grad(total)(3.0)) == pytest.approx(float(lengths @ np.sin(s)))


def test_added_mass_acts_across_the_tangent():
    load = MorisonDrag(2.0, 0.0, 0.0, added_mass_coefficient=0.6)
    scene = Scene(ROD, loads=(load,))
    motion = motion_of(9)
    acceleration = random_arrays(10, (ELEMENTS + 1, 6))[0]
    found = np.asarray(inertial_wrench(scene, motion, acceleration))
    mass, rotary = node_inertia(ROD)
    np.testing.assert_allclose(mass, lumped(ROD.mass), atol=1e-15)
    extra = 2.0 * 0.6 * lumped(ROD.area)
    energy = 0.0
    for i in range(ELEMENTS + 1):
        t = np.asarray(rotations.matrix(motion.quaternion[i]))[:, 2]
        a, v = np.asarray(acceleration[i, :3]), np.asarray(motion.velocity[i])
        expected = mass[i] * a + extra[i] * (a - (a @ t) * t)
        np.testing.assert_allclose(found[i, :3], expected, atol=1e-13)
        spin, inertia = np.asarray(motion.angular_velocity[i]), np.asarray(rotary[i])
        gyroscopic = np.cross(spin, inertia * spin)
        expected = inertia * np.asarray(acceleration[i, 3:]) + gyroscopic
        np.testing.assert_allclose(found[i, 3:], expected, atol=1e-14)
        energy += 0.5 * float(mass[i]) * v @ v + 0.5 * float(extra[i]) * (v @ v - (v @ t) ** 2)
        energy += 0.5 * spin @ (inertia * spin)
    assert float(kinetic_energy(scene, motion)) == pytest.approx(float(energy), rel=1e-13)


# The contract


def every_load():
    bend = lambda p, s, m: p * jnp.concatenate([m.position * s[:, None], m.angular_velocity], 1)
    return (
        Gravity((0.0, 0.0, -1.0), 3.0),
        MorisonDrag(1.3, 0.9, 0.07, (0.1, 0.2, 0.3), 0.5),
        LinearDrag(2.0, 0.7, 0.05),
        DistributedLoad(bend, jnp.asarray(2.0)),
        PointLoad(1, Constant((1.0, 2.0, 3.0)), Constant((0.3, 0.2, 0.1))),
        PointLoad(-1, Constant((1.0, 2.0, 3.0)), Constant((0.3, 0.2, 0.1)), follower=True),
    )


def moved(motion, z):
    return motion._replace(
        position=motion.position + z[:, :3],
        quaternion=rotations.multiply(motion.quaternion, rotations.exponential(z[:, 3:6])),
        velocity=motion.velocity + z[:, 6:9],
        angular_velocity=motion.angular_velocity + z[:, 9:],
    )


@pytest.mark.parametrize("load", every_load(), ids=lambda load: type(load).__name__)
def test_each_wrench_depends_on_its_own_node_only(load):
    motion = motion_of(11)
    wrench = lambda z: load.wrench(ROD, moved(motion, z))
    # so that one pass of six directions gives the derivative by positions and spins
    first = lambda z: wrench(jnp.concatenate([z, jnp.zeros_like(z)], 1))
    both = jax.jit(lambda z: (jax.jacfwd(wrench)(z), node_jacobian(first, z[:, :6])))
    full, blocks = both(jnp.zeros((ELEMENTS + 1, 12)))
    for i in range(ELEMENTS + 1):
        others = np.delete(np.arange(ELEMENTS + 1), i)
        np.testing.assert_array_equal(np.asarray(full)[i][:, others], 0.0)
    own = np.stack([np.asarray(full)[i, :, i, :6] for i in range(ELEMENTS + 1)])
    np.testing.assert_allclose(blocks, own, atol=1e-14)


def test_total_is_the_sum():
    motion, loads = motion_of(12), every_load()
    expected = sum(np.asarray(load.wrench(ROD, motion)) for load in loads)
    np.testing.assert_allclose(total_wrench(loads, ROD, motion), expected, atol=1e-13)


# Refusals

BARE = straight_rod(1.0, 3, Section(stiffness=(1.0, 1.0, 1.0), mass=1.0))
LIGHT = straight_rod(1.0, 3, Section(stiffness=(1.0, 1.0, 1.0)))
REFUSALS = {
    "gravity of two": ("acceleration", lambda: Gravity((0.0, 1.0))),
    "gravity of one": ("acceleration", lambda: Gravity(9.81)),
    "gravity nan": ("acceleration", lambda: Gravity((0.0, NAN, 0.0))),
    "buoyancy negative": ("fluid_density", lambda: Gravity(UP, -1.0)),
    "gravity without mass": ("mass", lambda: Scene(LIGHT, loads=(Gravity(UP),))),
    "buoyancy without area": ("area", lambda: Scene(BARE, loads=(Gravity(UP, 1.0),))),
    "fluid negative": ("fluid_density", lambda: MorisonDrag(-1.0, 1.0, 1.0)),
    "normal nan": ("normal_coefficient", lambda: MorisonDrag(1.0, NAN, 1.0)),
    "tangential negative": ("tangential_coefficient", lambda: MorisonDrag(1.0, 1.0, -1.0)),
    "tangential of three": ("tangential_coefficient", lambda: MorisonDrag(1.0, 1.0, np.ones(3))),
    "current of two": ("current", lambda: MorisonDrag(1.0, 1.0, 1.0, (1.0, 2.0))),
    "added negative": (
        "added_mass_coefficient",
        lambda: MorisonDrag(1.0, 1.0, 1.0, added_mass_coefficient=-1.0),
    ),
    "drag without diameter": (
        "diameter",
        lambda: Scene(BARE, loads=(MorisonDrag(1.0, 1.0, 1.0),)),
    ),
    "linear negative": ("normal", lambda: LinearDrag(-1.0, 1.0)),
    "linear nan": ("tangential", lambda: LinearDrag(1.0, NAN)),
    "linear rotational": ("rotational", lambda: LinearDrag(1.0, 1.0, -1.0)),
    "linear of three": ("normal", lambda: LinearDrag(np.ones(3), 1.0)),
    "point beyond": ("node", lambda: Scene(BARE, loads=(PointLoad(4, Constant(UP)),))),
    "point before": ("node", lambda: Scene(BARE, loads=(PointLoad(-5, Constant(UP)),))),
    "point force": ("force", lambda: PointLoad(0, Constant(1.0))),
    "point moment": ("moment", lambda: PointLoad(0, moment=Constant((1.0, 2.0)))),
    "not a tuple": ("loads", lambda: Scene(BARE, loads=LinearDrag(1.0, 1.0))),
    "light without drag": ("loads", lambda: Scene(LIGHT, Clamped())),
    "light without spin": (
        "rotational",
        lambda: Scene(LIGHT, Clamped(), loads=(LinearDrag(1.0, 1.0),)),
    ),
    "light without tangential": (
        "tangential",
        lambda: Scene(LIGHT, Clamped(), loads=(LinearDrag(1.0, 0.0, 1.0),)),
    ),
}


@pytest.mark.parametrize("case", REFUSALS)
def test_loads_refuse(case):
    match, build = REFUSALS[case]
    jaxtyping.config.update("jaxtyping_disable", True)  # the package's own checks, not the tests'
    try:
        with pytest.raises(ValueError, match=f"^{match}"):
            build()
    finally:
        jaxtyping.config.update("jaxtyping_disable", False)


def test_loads_fit_their_rods():
    scene = Scene(straight_rod(1.0, ELEMENTS, UNIT_SECTION), loads=every_load())
    assert len(scene.loads) == 6
