"""Loads without potential: frequencies, growth and flutter against the continuous theory.

The theory, for the complex deflection w = x + i y of a straight rod, is solved on its own: in
closed form, and by collocation at Chebyshev's points.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from numpy.polynomial import chebyshev
from scipy.optimize import brentq

from rodjax import rotations
from rodjax.constraints.ends import Clamped, Slider
from rodjax.equilibria.linear_stability import stability
from rodjax.equilibria.small_vibration import vibration
from rodjax.inputs.schedules import Constant
from rodjax.interactions.loads import DistributedLoad, LinearDrag, MorisonDrag, PointLoad
from rodjax.rods.builders import straight_rod
from rodjax.rods.section import Section
from rodjax.scenes.placing import placing
from rodjax.scenes.scene import Scene

N = 24
BECK = 20.0509  # A/L^2 (Beck 1952)
LEIPHOLZ = 40.0537  # A/L^3, of a tangential load per length (Leipholz 1962)


def theory(thrust=0.0, distributed=0.0, moment=0.0, dead_moment=False, degree=22):
    """omega^2 of a clamped-free rod of unit A, m, L, by ascending real part.

    w'''' + (thrust + distributed (1 - s)) w'' - i moment w''' = omega^2 w, the loads following the
    tangent; free end: w'' = 0 (w'' - i moment w' = 0 if the moment is dead), and its derivative.
    """
    points = 0.5 * (1 - np.cos(np.pi * np.arange(degree + 1) / degree))
    eye = np.eye(degree + 1)
    at = lambda x, k: (
        2.0**k
        * np.stack([chebyshev.chebval(2 * x - 1, chebyshev.chebder(row, k)) for row in eye], -1)
    )
    inner = points[2:-2]
    rows = at(inner, 4) + (thrust + distributed * (1 - inner))[:, None] * at(inner, 2)
    rows = rows - 1j * moment * at(inner, 3)
    end = np.ones(1)
    turn = moment if dead_moment else 0.0
    conditions = [at(0 * end, 0), at(0 * end, 1)]
    conditions += [at(end, 2 + k) - 1j * turn * at(end, 1 + k) for k in (0, 1)]
    left = np.concatenate([rows, *conditions])
    right = np.concatenate([at(inner, 0), np.zeros((4, degree + 1))])
    values = scipy.linalg.eigvals(left, right)
    values = values[np.isfinite(values) & (abs(values) < 1e6)]
    return values[np.argsort(values.real)]


def beck_frequency(thrust, low, high):
    """Root of Beck's characteristic equation, in closed form."""

    def characteristic(omega):
        a, b = np.sqrt(np.sqrt(thrust**2 / 4 + omega**2) + np.array([0.5, -0.5]) * thrust)
        circular = 2 * omega**2 * (1 + np.cos(a) * np.cosh(b))
        return circular + thrust**2 + omega * thrust * np.sin(a) * np.sinh(b)

    return brentq(characteristic, low, high)


def foundation(sizes, s, motion):
    """Force per length: circulatory, size e_3 x displacement, and Winkler's spring."""
    swirl, spring = sizes
    x, y, _ = motion.position.T
    force = jnp.stack([-swirl * y - spring * x, swirl * x - spring * y, 0 * x], 1)
    return jnp.concatenate([force, 0 * force], 1)


LOADS = {
    "thrust": 0.0,  # following the tip
    "dead_thrust": 0.0,
    "moment": 0.0,  # about the tip's tangent
    "dead_moment": 0.0,  # about the axis
    "swirl": 0.0,
    "spring": 0.0,
    "drag": 1e-6,  # a little, for the spin: linear, of all three coefficients
    "current": 0.0,  # towards the clamp, with the load per length that its drag makes
}


def cantilever(*, n=N, stiffness=(1.0, 1.0, 0.8), mass=1.0, **given):
    """A straight cantilever of unit A, m, L in equilibrium with loads that leave it straight.

    All have the same structure, so that a program serves them all.
    """
    load = {**LOADS, **given}
    axis = jnp.asarray([0.0, 0.0, 1.0])
    along = lambda size: Constant(axis * size)
    loads = (
        PointLoad(-1, along(-load["thrust"]), along(load["moment"]), follower=True),
        PointLoad(-1, along(-load["dead_thrust"]), along(load["dead_moment"])),
        DistributedLoad(foundation, jnp.stack([load["swirl"], load["spring"]])),
        LinearDrag(load["drag"], load["drag"], load["drag"]),
        # pi/2 rho D C_t U^2 per length
        MorisonDrag(1.0, 0.0, load["current"] / (0.05 * np.pi), current=-axis),
    )
    section = Section(stiffness, mass=mass, diameter=0.1)
    rod = straight_rod(1.0, n, section, first_director=(1, 0, 0))
    scene = Scene(rod, Clamped(), loads=loads)
    thrust = load["thrust"] + load["dead_thrust"] + load["current"] * (1 - rod.midpoints)
    twist = (load["moment"] + load["dead_moment"]) / rod.stiffness[:, 2] * rod.length
    angle = jnp.concatenate([jnp.zeros(1), jnp.cumsum(twist)])
    state = placing(scene)
    turn = rotations.exponential(angle[:, None] * axis[None])
    turned = rotations.multiply(state.quaternion, turn)
    force = -thrust[:, None] * axis[None]
    return scene, eqx.tree_at(lambda s: (s.quaternion, s.force), state, (turned, force))


def test_theory_against_the_literature():
    for load, critical in (("thrust", BECK), ("distributed", LEIPHOLZ)):
        lowest = lambda factor, load=load, critical=critical: theory(**{load: factor * critical})[0]
        assert abs(lowest(0.999).imag) < 1e-3
        assert abs(lowest(1.001).imag) > 1.0
    np.testing.assert_allclose(theory()[:2].real, [3.51602**2, 22.03449**2], rtol=1e-5)
    np.testing.assert_allclose(
        np.sqrt(theory(thrust=10.0)[:2].real),
        [beck_frequency(10.0, 3.0, 8.0), beck_frequency(10.0, 15.0, 21.0)],
        rtol=1e-6,
    )


@pytest.mark.slow
@pytest.mark.parametrize("thrust", [0.0, 2.0, 10.0, 16.0])
def test_frequencies_of_becks_column_below_flutter(thrust):
    scene, state = cantilever(thrust=thrust)
    found = vibration(scene, state, 4)
    # an isotropic rod has every frequency twice, for its two planes
    expected = np.repeat([beck_frequency(thrust, 3.0, 10.5), beck_frequency(thrust, 12.5, 23.0)], 2)
    np.testing.assert_allclose(found.frequency, expected, rtol=5e-3)
    np.testing.assert_allclose(found.growth_rate, 0.0, atol=1e-4)
    assert bool(found.symmetric) == (thrust == 0)
    held = stability(scene, state)
    assert bool(held.stable)
    assert bool(held.symmetric) == (thrust == 0)
    assert (float(held.antisymmetry) > 0.1) == (thrust > 0)


def test_becks_column_flutters():
    for factor in (0.99, 1.01):
        scene, state = cantilever(thrust=factor * BECK)
        assert bool(stability(scene, state).stable) == (factor < 1)
    found = vibration(*cantilever(thrust=25.0), 4)
    exact = np.sqrt(theory(thrust=25.0)[0])
    np.testing.assert_allclose(found.frequency, abs(exact.real), rtol=1e-2)
    np.testing.assert_allclose(found.growth_rate, abs(exact.imag), rtol=2e-2)
    assert not found.symmetric


def test_a_dead_thrust_is_found_symmetric_and_diverges():
    for thrust in (1.0, 3.0):
        found = stability(*cantilever(dead_thrust=thrust))
        assert found.symmetric
        assert float(found.antisymmetry) < 1e-9
        # bending, or torsion for a small thrust
        expected = min(np.pi**2 / 4 - thrust, 0.8 * np.pi**2 / 4)
        np.testing.assert_allclose(found.eigenvalues[0], expected, rtol=1e-2)
        assert bool(found.stable) == (expected > 0)


@pytest.mark.parametrize("factor", [0.5, 0.9, 1.1])
def test_a_current_along_the_rod_is_leipholz_load(factor):
    # drag along the rod follows it
    load = factor * LEIPHOLZ
    found = vibration(*cantilever(current=load), 4)
    exact = np.sqrt(theory(distributed=load)[0])
    assert not found.symmetric
    np.testing.assert_allclose(found.frequency[:2], abs(exact.real), rtol=1e-2)
    np.testing.assert_allclose(found.growth_rate[:2], abs(exact.imag), rtol=5e-2, atol=1e-4)


@pytest.mark.parametrize("name", ["moment", "dead_moment"])
def test_a_moment_about_the_axis_of_a_cantilever(name):
    # no such moment has a potential: any makes the isotropic undamped cantilever flutter
    exact = np.sqrt(theory(moment=1.0, dead_moment=name == "dead_moment")[:2])
    found = vibration(*cantilever(**{name: 1.0}), 4)
    assert not found.symmetric
    np.testing.assert_allclose(found.frequency, np.repeat(abs(exact.real), 2), rtol=5e-3)
    np.testing.assert_allclose(found.growth_rate, np.repeat(abs(exact.imag), 2), rtol=2e-2)
    # a drag takes drag / 2m off every growth rate, of which the second mode's is the largest
    for factor in (0.9, 1.1):
        damped = cantilever(**{name: 1.0}, drag=2 * factor * abs(exact[1].imag))
        assert bool(stability(*damped).stable) == (factor > 1)


def test_users_loads_with_and_without_potential():
    size = 10.0
    found = vibration(*cantilever(swirl=size), 4)
    assert not found.symmetric
    # omega^2 = omega_0^2 + i k/m and its conjugate, for the discrete rod's own omega_0
    alone = vibration(*cantilever(), 4)
    np.testing.assert_allclose(found.squared, alone.squared, rtol=2e-3)
    np.testing.assert_allclose(sorted(found.imaginary[:2]), [-size, size], rtol=2e-3)
    sprung = vibration(*cantilever(spring=size), 4)
    assert sprung.symmetric
    np.testing.assert_allclose(sprung.squared, alone.squared + size, rtol=2e-3)


def test_overdamped_rods_are_judged_by_their_drag():
    # D x' + K x = 0 grows only by a negative real part: a swirl turns, it does not drive
    for load in ({"swirl": 10.0}, {"thrust": 15.0}):
        found = stability(*cantilever(mass=None, drag=1.0, **load))
        assert not found.symmetric
        assert found.stable


@pytest.mark.slow
def test_derivatives_below_and_above_flutter():
    def measured(thrust):
        found = vibration(*cantilever(thrust=thrust, stiffness=(1.0, 2.0, 0.8), n=10), 1)
        return jnp.stack([found.frequency[0], found.growth_rate[0]])

    derivatives = jax.jit(lambda x: (jax.jacfwd(measured)(x), jax.jacrev(measured)(x)))
    measured_ = jax.jit(measured)
    for thrust in (10.0, 25.0):
        h = 1e-4
        slope = (measured_(thrust + h) - measured_(thrust - h)) / (2 * h)
        assert abs(slope[0]) > 1e-2
        forward, reverse = derivatives(thrust)
        np.testing.assert_allclose(forward, slope, rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(reverse, forward, rtol=1e-9, atol=1e-12)


@pytest.mark.slow
def test_values_that_coincide_have_their_mean_derivative():
    # stiffening one plane of an isotropic rod: half of what stiffening both does
    def frequency(by):
        scene, state = cantilever(thrust=10.0, n=10)
        stiffness = scene.rod.stiffness * (1 + jnp.stack([by[0], by[1], jnp.zeros(())])[None])
        scene = eqx.tree_at(lambda s: s.rod.stiffness, scene, stiffness)
        return vibration(scene, state).frequency[0]

    slopes = jax.grad(frequency)(jnp.zeros(2))
    both = (frequency(jnp.full(2, 1e-4)) - frequency(jnp.full(2, -1e-4))) / 2e-4
    np.testing.assert_allclose(slopes, 0.5 * both, rtol=1e-4)


@pytest.mark.slow
def test_modes_without_mass_leave_values_and_derivatives_alone():
    # three elements between a clamp and a slider have one mode with mass in either plane
    rod = straight_rod(1.0, 3, Section((1.0, 1.0, 0.8), mass=1.0))

    def squared(mass, count):
        scene = Scene(eqx.tree_at(lambda r: r.mass, rod, mass), Clamped(), Slider((0, 0, 1)))
        return vibration(scene, placing(scene), count).squared

    value, slope = jax.value_and_grad(lambda mass: squared(mass, 1)[0])(rod.mass)
    assert 0 < float(value) < np.inf
    # omega^2 goes as 1/m
    np.testing.assert_allclose(jnp.sum(slope), -value, rtol=1e-9)
    assert np.all(np.asarray(squared(rod.mass, 2)) < np.inf)
