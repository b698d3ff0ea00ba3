"""Free flight and vibrations against what is conserved and known frequencies."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import ARC, PRECISE, UNIT_SECTION, advance_to, final_state, stretch_error, time

from rodjax import rotations
from rodjax.constraints.ends import Clamped, Free
from rodjax.dynamics.consistency import start
from rodjax.equations.generalized_alpha import GeneralizedAlpha
from rodjax.rods.builders import curved_rod, straight_rod
from rodjax.rods.inertia import node_inertia
from rodjax.rods.section import circular_section
from rodjax.scenes.scene import Scene

# Free flight


@pytest.fixture(scope="module")
def tumbling():
    """A bent rod in free flight that moves, tumbles and vibrates."""
    scene = Scene(curved_rod(ARC, 1.0, 8, UNIT_SECTION, stress_free=False))
    position = scene.rod.position
    spin = jnp.asarray([0.4, 1.0, -0.6])
    drift = jnp.asarray([[0.3, -0.2, 0.5]])
    velocity = drift + jnp.cross(jnp.broadcast_to(spin, position.shape), position)
    body = rotations.rotate_inverse(scene.rod.quaternion, jnp.broadcast_to(spin, position.shape))
    return scene, start(scene, velocity=velocity, angular_velocity=body)


def momenta(scene, state):
    mass, rotary = node_inertia(scene.rod)
    linear = mass[:, None] * state.velocity
    spin = rotations.rotate(state.quaternion, rotary * state.angular_velocity)
    angular = spin + jnp.cross(state.position, linear)
    centre = jnp.sum(mass[:, None] * state.position, 0) / jnp.sum(mass)
    return np.asarray(jnp.sum(linear, 0)), np.asarray(jnp.sum(angular, 0)), np.asarray(centre)


@pytest.mark.slow
def test_free_flight_conserves_momentum(tumbling):
    scene, state = tumbling
    linear, angular, centre = momenta(scene, state)
    assert np.linalg.norm(angular) > 0.05
    errors = []
    # 50 steps do not resolve the waves of the release, whose energy then grows at this radius
    for count in (100, 200, 400):
        final = final_state(scene, state, 1.0, count, PRECISE)
        assert stretch_error(scene, final) < 1e-12
        now = momenta(scene, final)
        np.testing.assert_allclose(now[0], linear, atol=1e-11)
        np.testing.assert_allclose(now[2], centre + linear, atol=1e-11)  # the mass is 1
        errors.append(np.linalg.norm(now[1] - angular))
    assert np.max(np.abs(final.position - state.position)) > 0.3
    # angular momentum is not an invariant of the scheme, but of its limit, at second order
    assert errors[-1] < 1e-3 * np.linalg.norm(angular)
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.25)
    assert errors[1] / errors[2] == pytest.approx(4, rel=0.25)


@pytest.mark.slow
def test_spinning_rod_spins_on(tumbling):
    scene, _ = tumbling
    rod = straight_rod(1.0, 8, UNIT_SECTION)
    scene = eqx.tree_at(lambda s: s.rod, scene, rod)
    spin = jnp.tile(jnp.asarray([[0.0, 0.0, 3.0]]), (9, 1))
    drift = jnp.tile(jnp.asarray([[0.1, 0.2, -0.3]]), (9, 1))
    state = start(scene, velocity=drift, angular_velocity=spin)
    np.testing.assert_allclose(state.acceleration, 0.0, atol=1e-12)
    np.testing.assert_allclose(state.force, 0.0, atol=1e-12)
    final = final_state(scene, state, 2.0, 50, PRECISE)
    np.testing.assert_allclose(final.position, rod.position + 2 * drift, atol=1e-11)
    np.testing.assert_allclose(final.rate, state.rate, atol=1e-11)
    turned = rotations.exponential(2 * spin)
    found = np.sign(turned[:, :1] * final.quaternion[:, :1]) * final.quaternion
    np.testing.assert_allclose(found, turned, atol=1e-11)


# Vibrations


@pytest.fixture(scope="module")
def cantilever():
    section = circular_section(1e-2, 1.25e7, 5e6, 1500.0)
    return Scene(straight_rod(1.0, 40, section), Clamped(), Free())


def frequency(scene, state, expected, value):
    """Angular frequency by the phase of an undamped oscillation through zero, after a quarter."""
    count = 100
    quarter = 0.5 * np.pi / expected
    final, worst = advance_to(
        scene, state, time(quarter), jnp.asarray(count), GeneralizedAlpha(0.95)
    )
    assert int(worst) == 0
    position, rate = value(final)
    # x = sin(w t)/w, x' = cos(w t) from the start x = 0, x' = 1
    phase = np.arctan2(position * expected, rate)
    return phase / quarter


@pytest.mark.slow
def test_cantilever_frequency(cantilever):
    scene = cantilever
    bend, mass = float(scene.rod.stiffness[0, 0]), float(scene.rod.mass[0])
    expected = 3.51602 * np.sqrt(bend / mass)
    root, s = 1.8751040687119611, scene.rod.arc_length
    ratio = (np.cosh(root) + np.cos(root)) / (np.sinh(root) + np.sin(root))
    shape = (
        jnp.cosh(root * s) - jnp.cos(root * s) - ratio * (jnp.sinh(root * s) - jnp.sin(root * s))
    )
    slope = root * (
        jnp.sinh(root * s) + jnp.sin(root * s) - ratio * (jnp.cosh(root * s) - jnp.cos(root * s))
    )
    size = 1e-4 * expected
    zero = jnp.zeros_like(s)
    state = start(
        scene,
        velocity=size * jnp.stack([shape, zero, zero], 1),
        angular_velocity=size * jnp.stack([zero, slope, zero], 1),
    )
    norm = float(state.velocity[-1, 0])
    value = lambda final: (final.position[-1, 0] / norm, final.velocity[-1, 0] / norm)
    assert frequency(scene, state, expected, value) == pytest.approx(expected, rel=1e-3)


@pytest.mark.slow
def test_torsion_waves(cantilever):
    scene = cantilever
    speed = np.sqrt(5e6 / 1500)
    assert speed == pytest.approx(57.735, rel=1e-5)
    expected = 0.5 * np.pi * speed  # clamped-free: a quarter of a wave on the length 1
    s = scene.rod.arc_length
    spin = 1e-3 * jnp.sin(0.5 * np.pi * s)
    zero = jnp.zeros_like(s)
    state = start(scene, angular_velocity=jnp.stack([zero, zero, spin], 1))

    def value(final):
        turn = rotations.logarithm(final.quaternion[-1])[2]
        return turn / 1e-3, final.angular_velocity[-1, 2] / 1e-3

    assert frequency(scene, state, expected, value) == pytest.approx(expected, rel=5e-4)
