"""Energies of a state and reactions of the ends against closed forms and theory."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import UNIT_SECTION, random_configuration
from made_runs import AXIS, ELEMENTS, hanging, reactions, start, state_of

from rodjax import energy, rotations
from rodjax.constraints.ends import Clamped, Free, Pinned, Slider
from rodjax.interactions.loads import Gravity, LinearDrag, MorisonDrag
from rodjax.rods import builders
from rodjax.rods.section import Section
from rodjax.scenes.scene import Scene


def twisted(a_rod, turns):
    """A straight rod twisted uniformly, the end s = 0 by -turns."""
    angle = 2 * jnp.pi * turns * (a_rod.arc_length / a_rod.arc_length[-1] - 1)
    spin = rotations.exponential(angle[:, None] * AXIS[None])
    return state_of(a_rod, quaternion=rotations.multiply(a_rod.quaternion, spin))


def test_energy_of_pure_twist():
    """C (2 pi turns)^2 / 2 L, all of it torsion, spread evenly."""
    scene = Scene(builders.straight_rod(2.0, ELEMENTS, UNIT_SECTION))
    state = twisted(scene.rod, 1.5)
    expected = 0.8 * (3 * np.pi) ** 2 / (2 * 2.0)
    assert energy.torsion_energy(scene, state) == pytest.approx(expected, rel=1e-12)
    assert energy.bending_energy(scene, state) == pytest.approx(0, abs=1e-24)
    assert energy.axial_energy(scene, state) == 0
    density = energy.strain_energy_density(scene.rod, state)
    np.testing.assert_allclose(density, expected / 2.0, rtol=1e-12)


def test_energy_of_a_circle():
    """A straight rod bent to a circle: A (2 pi)^2 / 2 L exactly, also on the grid."""
    length, angle = 2.0, lambda s: 2 * np.pi * s / 2.0
    circle = lambda s: np.array([1 - np.cos(angle(s)), 0, np.sin(angle(s))]) * length / (2 * np.pi)
    bent = builders.curved_rod(
        circle, length, 20, UNIT_SECTION, first_director=(0, 1, 0), stress_free=False
    )
    scene, state = Scene(bent), state_of(bent)
    expected = 1.0 * (2 * np.pi) ** 2 / (2 * length)  # about a_1 = e_2
    assert energy.bending_energy(scene, state) == pytest.approx(expected, rel=1e-6)
    assert energy.torsion_energy(scene, state) == pytest.approx(0, abs=1e-9)
    at_rest = builders.curved_rod(circle, length, 20, UNIT_SECTION, stress_free=True)
    assert energy.bending_energy(Scene(at_rest), state_of(at_rest)) == pytest.approx(0, abs=1e-24)


def test_axial_energy_of_a_stretched_and_sheared_rod():
    """EA e^2 L/2 + GA g^2 L/2; a component without compliance stores nothing."""
    section = Section(stiffness=(1.0, 1.0, 1.0), compliance=(0.5, 0.0, 0.01))
    drag = LinearDrag(1.0, 1.0, 1.0)
    scene = Scene(builders.straight_rod(2.0, ELEMENTS, section), loads=(drag,))
    strain = jnp.array([0.02, 0.03, 0.1])
    state = state_of(scene.rod, position=scene.rod.arc_length[:, None] * (AXIS + strain)[None])
    frame = rotations.matrix(scene.rod.quaternion[0])
    local = frame.T @ strain
    expected = 2.0 * 0.5 * (local[0] ** 2 / 0.5 + local[2] ** 2 / 0.01)
    assert energy.axial_energy(scene, state) == pytest.approx(float(expected), rel=1e-12)
    assert energy.kinetic_energy(scene, state) == 0


def test_kinetic_and_gravity_energy_of_rigid_motion():
    """m v^2 / 2 and m g h, the latter less buoyancy; added mass only across the tangent."""
    fluid = MorisonDrag(2.0, 0.0, 0.0, added_mass_coefficient=1.5)
    gravity = Gravity((0.0, 0.0, -9.0), fluid_density=10.0)
    scene = Scene(builders.straight_rod(2.0, ELEMENTS, UNIT_SECTION), loads=(gravity, fluid))
    state = state_of(scene.rod)
    velocity = jnp.array([0.3, 0.0, 0.4])
    moving = eqx.tree_at(lambda s: s.rate, state, state.rate.at[:, :3].set(velocity))
    expected = 0.5 * 2.0 * 0.25 + 0.5 * (2.0 * 1.5 * 8e-3 * 2.0) * 0.09
    assert energy.kinetic_energy(scene, moving) == pytest.approx(expected, rel=1e-12)
    raised = eqx.tree_at(lambda s: s.position, state, state.position + 0.7 * AXIS[None])
    gain = energy.gravity_energy(scene, raised) - energy.gravity_energy(scene, state)
    assert gain == pytest.approx(2.0 * (1 - 10.0 * 8e-3) * 9.0 * 0.7, rel=1e-12)


def test_gradient_of_the_strain_energy_is_the_internal_moment():
    """Derivative by stiffness and by configuration against central differences."""
    scene = Scene(
        builders.straight_rod(1.0, ELEMENTS, UNIT_SECTION, natural_curvature=(0.1, 0.2, 0.3))
    )
    position, frames, _ = random_configuration(scene.rod, 3)
    total = jax.jit(
        lambda frames, scale: (
            energy.bending_energy(scene, state_of(scene.rod, position, rotations.normalize(frames)))
            + scale * energy.torsion_energy(scene, state_of(scene.rod, position, frames))
        )
    )
    direction = jnp.asarray(np.random.default_rng(0).normal(size=frames.shape))
    direction = direction - jnp.sum(direction * frames, 1, keepdims=True) * frames
    step = 1e-6
    by_hand = (total(frames + step * direction, 2.0) - total(frames - step * direction, 2.0)) / (
        2 * step
    )
    found = jnp.sum(jax.grad(total)(frames, 2.0) * direction)
    assert found == pytest.approx(float(by_hand), rel=1e-7)


def test_energies_under_vmap_and_jit():
    """A batch of states gives the same as one by one."""
    scene = Scene(builders.straight_rod(1.0, ELEMENTS, UNIT_SECTION))
    batch = jax.vmap(lambda turns: twisted(scene.rod, turns))(jnp.array([0.5, 1.0, 2.0]))
    values = jax.jit(jax.vmap(lambda s: energy.torsion_energy(scene, s)))(batch)
    np.testing.assert_allclose(values / values[0], [1, 4, 16], rtol=1e-12)


# Reactions


def test_torque_of_a_twisted_rod_is_that_of_theory():
    """C 2 pi turns / L about the tangent: +, on the end s = 0 that was turned by -turns."""
    scene = Scene(builders.straight_rod(2.0, ELEMENTS, UNIT_SECTION), Clamped(), Slider((0, 0, 1)))
    found = energy.reactions(scene, twisted(scene.rod, 0.5))
    torque = 0.8 * 2 * np.pi * 0.5 / 2.0
    np.testing.assert_allclose(found.torque, [-torque * AXIS, torque * AXIS], atol=1e-11)
    np.testing.assert_allclose(found.force, 0, atol=1e-11)


def test_reaction_of_a_clamp_in_inertial_and_body_axes():
    """A bent rod with frames all turned: torques agree by the end's frame, and with theory.

    A quarter circle held by end couples alone: the couple of every section is A/R.
    """
    radius = 2 / np.pi
    circle = lambda s: radius * np.array([1 - np.cos(s / radius), np.sin(s / radius), 0.0])
    bent = builders.curved_rod(
        circle, 1.0, 40, UNIT_SECTION, first_director=(0, 0, 1), stress_free=False
    )
    scene = Scene(bent, Clamped(), Clamped())
    found = energy.reactions(scene, state_of(bent))
    couple = np.array([0.0, 0.0, 1 / radius])  # on s = 0, bending stiffness 1 about a_1 = e_3
    np.testing.assert_allclose(found.torque[0], couple, atol=1e-2)
    np.testing.assert_allclose(found.torque[1], -couple, atol=1e-2)
    assert np.abs(found.torque[0][2]) > 1
    frames = bent.quaternion[jnp.array([0, -1])]
    back = rotations.rotate_inverse(frames, found.torque)
    np.testing.assert_allclose(found.body_torque, back, atol=1e-12)


def test_reactions_only_where_an_end_constrains():
    """A pin gives no torque, a slider no force along its axis, a free end nothing."""
    a_rod = builders.straight_rod(1.0, ELEMENTS, UNIT_SECTION, natural_curvature=(0.5, 0.4, 0.3))
    state = state_of(a_rod, force=jnp.ones((ELEMENTS, 3)))
    found = energy.reactions(Scene(a_rod, Pinned(), Slider((0, 0, 1))), state)
    np.testing.assert_array_equal(found.torque[0], 0)
    assert found.force[1, 2] == 0
    assert np.all(np.abs(found.force[0]) > 0.1)
    assert np.all(np.abs(found.force[1, :2]) > 0.1)
    assert np.all(np.abs(found.torque[1]) > 0.1)
    loose = energy.reactions(Scene(a_rod, Free(), Clamped()), state)
    np.testing.assert_array_equal([loose.force[0], loose.torque[0]], 0)


@pytest.mark.slow
def test_weight_of_a_hanging_rod():
    """The pin carries the weight and the load on the end."""
    scene = hanging((0.0, 0.0, 1.0), [0.0, 0.0, 2.0])
    found = reactions(scene, start(scene))
    np.testing.assert_allclose(found.force[0], [0, 0, -9.0 - 2.0], atol=1e-9)
    np.testing.assert_array_equal(found.force[1], 0)
