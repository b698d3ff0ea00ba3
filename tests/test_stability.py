"""Critical loads, frequencies and growth rates against the continuous theory."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import order_of

from rodjax import rotations
from rodjax.constraints.ends import Clamped, Free, Pinned, Slider
from rodjax.equilibria.linear_stability import stability
from rodjax.equilibria.small_vibration import vibration
from rodjax.inputs.schedules import Constant
from rodjax.interactions.loads import LinearDrag, PointLoad
from rodjax.rods.builders import straight_rod
from rodjax.rods.section import Section
from rodjax.scenes.placing import placing
from rodjax.scenes.scene import Scene

# multiples of eight: elements of equal length with the neck's ends on nodes
GRIDS = (16, 32, 64)
FINE = 128

UNIFORM_MOMENT, NECKED_MOMENT = 8.986819, 7.531815
"""M L/A at which the straight rod buckles under torsion, tan x = x with x = M L/2A; and necked."""
UNIFORM_FREQUENCY = {0: 22.37329, 4: 20.57263, 6: 17.74402, 7: 15.34705, 8: 11.52657}
NECKED_GROWTH = {8: 9.8404, 9: 19.4983, 10: 28.7864}


def twisted_rod(n, necked):
    """A rod of unit A, m and L between a clamp and a slider; the neck is 0.9 D thick."""
    diameter = lambda s: np.where(necked & (abs(s - 0.5) < 0.125), 0.9, 1.0)
    section = lambda s: Section(
        (diameter(s) ** 4, diameter(s) ** 4, 0.8 * diameter(s) ** 4), mass=diameter(s) ** 2
    )
    return Scene(straight_rod(1.0, n, section), Clamped(), Slider((0, 0, 1)))


def twisted(scene, moment):
    """The straight equilibrium under a torque."""
    rod, state = scene.rod, placing(scene)
    angle = jnp.cumsum(moment / rod.stiffness[:, 2] * rod.length)
    vectors = jnp.concatenate([jnp.zeros((1,)), angle])[:, None] * jnp.asarray([[0.0, 0.0, 1.0]])
    turned = rotations.multiply(state.quaternion, rotations.exponential(vectors))
    return eqx.tree_at(lambda s: s.quaternion, state, turned)


def critical_moment(scene, guess):
    """Where the lowest eigenvalue vanishes, by the secant rule."""
    lowest = lambda moment: float(stability(scene, twisted(scene, moment)).eigenvalues[0])
    a, b = 0.98 * guess, 1.02 * guess
    at_a, at_b = lowest(a), lowest(b)
    assert at_a > 0 > at_b
    for _ in range(6):
        a, b, at_a = b, b - at_b * (b - a) / (at_b - at_a), at_b
        if abs(b - a) < 1e-8 * guess:
            return b
        at_b = lowest(b)
    raise AssertionError("the secant rule did not converge")


def check_order(value, reference, within, grids=GRIDS):
    """Second order on several grids, and an error on the finest below a bound."""
    errors = [abs(value(n) / reference - 1) for n in grids]
    assert abs(order_of(1 / np.array(grids), errors) - 2) < 0.1
    assert errors[-1] < within


@pytest.mark.slow
@pytest.mark.parametrize("necked", [False, True])
def test_torsional_buckling(necked):
    reference = NECKED_MOMENT if necked else UNIFORM_MOMENT
    value = lambda n: critical_moment(twisted_rod(n, necked), reference)
    check_order(value, reference, 1e-3)
    assert abs(value(FINE) / reference - 1) < 1e-4


@pytest.mark.slow
@pytest.mark.parametrize("moment", UNIFORM_FREQUENCY)
def test_frequency_of_a_twisted_rod(moment):
    def value(n):
        scene = twisted_rod(n, False)
        return float(vibration(scene, twisted(scene, float(moment))).frequency[0])

    check_order(value, UNIFORM_FREQUENCY[moment], 1e-3)


@pytest.mark.parametrize("moment", NECKED_GROWTH)
def test_growth_rate_of_a_necked_rod(moment):
    def value(n):
        scene = twisted_rod(n, True)
        found = vibration(scene, twisted(scene, float(moment)))
        assert float(found.frequency[0]) == 0.0
        return float(found.growth_rate[0])

    # near the threshold sigma^2 is a small difference, so the rate's error is large: 1e-3 needs
    # 116 elements at M = 8, and 106 at M = 10
    check_order(value, NECKED_GROWTH[moment], 1e-3, grids=(32, FINE))


def column(n, thrust=0.0, compliance=None):
    """A cantilever under a thrust, and its straight equilibrium."""
    section = Section((1.0, 2.0, 0.8), mass=1.0, compliance=compliance)
    load = PointLoad(-1, Constant(jnp.asarray([0.0, 0.0, -1.0]) * thrust))
    scene = Scene(
        straight_rod(1.0, n, section, first_director=(1, 0, 0)), Clamped(), Free(), (load,)
    )
    state = placing(scene)
    pressed = jnp.broadcast_to(jnp.asarray([0.0, 0.0, -1.0]) * thrust, (n, 3))
    return scene, eqx.tree_at(lambda s: s.force, state, pressed)


def test_eigenvalue_is_the_thrust_left_until_buckling():
    for thrust in (0.0, 1.5, 3.0):
        found = stability(*column(64, thrust), 2)
        # bending about a_1 (twice as stiff about a_2), then torsion for a small thrust
        expected = sorted([np.pi**2 / 4 - thrust, np.pi**2 / 2 - thrust, 0.8 * np.pi**2 / 4])[:2]
        np.testing.assert_allclose(found.eigenvalues, expected, rtol=1e-3, atol=1e-4)
        assert bool(found.stable) == (thrust < np.pi**2 / 4)


@pytest.mark.slow
def test_frequency_of_a_cantilever_is_of_second_order():
    check_order(lambda n: float(vibration(*column(n)).frequency[0]), 3.51602, 1e-3)


def test_frequency_and_mode_of_a_cantilever():
    scene, state = column(64)
    found = vibration(scene, state, 3)
    np.testing.assert_allclose(found.frequency[0], 3.51602, rtol=1e-3)
    # bent about the softer axis a_1; clamped; of unit mass
    mode = np.asarray(found.modes[0])
    assert np.max(np.abs(mode[0])) < 1e-9
    assert np.max(np.abs(mode[:, 0])) < 1e-6 * np.max(np.abs(mode[:, 1]))
    weight = np.asarray(scene.rod.node_length)
    np.testing.assert_allclose(np.sum(weight[:, None] * mode[:, :3] ** 2), 1.0, rtol=1e-9)
    np.testing.assert_allclose(found.frequency[1] / found.frequency[0], np.sqrt(2), rtol=1e-9)


@pytest.mark.slow
def test_compliance_zero_is_the_rigid_limit():
    plain, state = column(16, 1.0)
    zero, _ = column(16, 1.0, (0.0, 0.0, 0.0))
    mixed, _ = column(16, 1.0, (0.0, 0.05, 0.0))
    eigenvalues = lambda scene: np.asarray(stability(scene, state, 3).eigenvalues)
    np.testing.assert_allclose(eigenvalues(zero), eigenvalues(plain), rtol=1e-7)
    # shear along a_2 goes with bending about a_1, the first mode: it must become softer
    assert eigenvalues(mixed)[0] < eigenvalues(plain)[0] - 1e-3


def test_shear_lowers_the_frequency_as_timoshenko_says():
    # a rod too short and stiff to bend: pure shear, omega = (pi/2) sqrt(GA/m)
    section = Section((1e4, 1e4, 1e4), mass=1.0, compliance=(1.0, 1.0, 0.0))
    rod = straight_rod(1.0, 24, section)
    scene = Scene(rod, Clamped(), Free())
    np.testing.assert_allclose(vibration(scene, placing(scene)).frequency[0], np.pi / 2, rtol=1e-3)


@pytest.mark.slow
def test_derivative_of_an_eigenvalue():
    scene, state = column(12, 1.0)
    (direction,) = [np.random.default_rng(0).normal(size=scene.rod.stiffness.shape)]

    @jax.jit
    def values(h):
        stiffness = scene.rod.stiffness * (1 + h * direction)
        moved = eqx.tree_at(lambda s: s.rod.stiffness, scene, stiffness)
        return stability(moved, state).eigenvalues[0], vibration(moved, state).frequency[0]

    h = 1e-4
    slopes = [(a - b) / (2 * h) for a, b in zip(values(h), values(-h), strict=True)]
    forward = jax.jvp(values, (0.0,), (1.0,))[1]
    reverse = [jax.grad(lambda h, k=k: values(h)[k])(0.0) for k in (0, 1)]
    np.testing.assert_allclose(forward, slopes, rtol=1e-5)
    np.testing.assert_allclose(reverse, forward, rtol=1e-9)


def test_bad_input_is_refused():
    scene, state = column(8)
    loose = eqx.tree_at(lambda s: (s.first_end, s.last_end), scene, (Pinned(), Pinned()))
    massless = Scene(
        eqx.tree_at(lambda r: r.mass, scene.rod, None),
        Clamped(),
        Free(),
        (LinearDrag(1.0, 1.0, 1.0),),
    )
    for function in (stability, vibration):
        with pytest.raises(ValueError, match="1 rigid motion"):
            function(loose, state)
        with pytest.raises(ValueError, match="count"):
            function(scene, state, 0)
    with pytest.raises(ValueError, match="mass=None"):
        vibration(massless, state)
