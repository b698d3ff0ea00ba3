"""Closed rings: their placing, linking number, threshold and frequencies."""

import jax.numpy as jnp
import numpy as np
import pytest

import rodjax as rx
from rodjax.interactions.contact_report import report
from rodjax.rods.strains import strains
from rodjax.rods.winding import writhe_of

A, C = 1.0, 0.7
SECTION = rx.Section(
    stiffness=(A, A, C), mass=1.0, rotary_inertia=(1e-7, 1e-7, 2e-7), diameter=0.01
)
WELD = (rx.Weld(rx.Point(0), rx.Point(-1)),)


@pytest.mark.parametrize("turns", [0.0, 1.0, -2.5])
def test_it_closes_unstretched_with_its_linking_number(turns):
    rod = rx.ring(2.0, 12, SECTION, turns=turns, normal=(1.0, 2.0, -0.5), center=(3.0, 0.0, 1.0))
    np.testing.assert_allclose(rod.position[0], rod.position[-1], atol=1e-14)
    found = strains(rod, rod.position, rod.quaternion)
    np.testing.assert_allclose(found.stretch, [[0.0, 0.0, 1.0]] * 12, atol=1e-13)
    # all elements alike
    np.testing.assert_allclose(found.rotation[:, 2], found.rotation[0, 2], atol=1e-13)
    state = rx.placing(rx.Scene(rod, joints=WELD))
    linking = rx.measures.twist(state) + writhe_of(True, state)
    np.testing.assert_allclose(linking, turns, atol=1e-8)
    middle = np.mean(np.asarray(rod.position[:-1]), 0)
    np.testing.assert_allclose(middle, [3.0, 0.0, 1.0], atol=1e-13)
    along = np.cross(rod.position[0] - middle, rod.position[1] - middle)
    assert along @ [1.0, 2.0, -0.5] > 0


@pytest.mark.slow
def test_its_energy():
    """2 pi^2 A / L of bending and (2 pi Lk)^2 C/(2 L) of torsion, to second order."""
    errors = []
    for elements in (20, 40):
        rod = rx.ring(1.0, elements, SECTION, turns=1.5)
        state = rx.placing(rx.Scene(rod))
        scene = rx.Scene(rod)
        found = rx.energy.bending_energy(scene, state) + rx.energy.torsion_energy(scene, state)
        errors.append(found / (2 * np.pi**2 * A + 0.5 * C * (3 * np.pi) ** 2) - 1)
    assert abs(errors[1]) < 5e-3
    np.testing.assert_allclose(errors[0] / errors[1], 4.0, rtol=0.02)


def test_refusals():
    with pytest.raises(ValueError, match="elements"):
        rx.ring(1.0, 2, SECTION)
    with pytest.raises(ValueError, match="length"):
        rx.ring(-1.0, 12, SECTION)
    with pytest.raises(ValueError, match="normal"):
        rx.ring(1.0, 12, SECTION, normal=(0.0, 0.0, 0.0))


@pytest.mark.slow
def test_it_rests_and_moves_as_one_piece():
    """Twisted below the threshold it stays: no force of the weld drives it, and Lk is kept."""
    rod = rx.ring(1.0, 12, SECTION, turns=1.0)
    scene = rx.Scene(rod, joints=WELD)
    assert scene.closed is True
    velocity = jnp.zeros((13, 3)).at[:, 2].set(0.3 * jnp.sin(4 * jnp.pi * rod.arc_length))
    run = rx.rollout(scene, rx.start(scene, velocity=velocity), jnp.linspace(0, 0.1, 21)[1:])
    position = np.asarray(run.states.position)
    np.testing.assert_allclose(position[:, 0], position[:, -1], atol=1e-13)
    assert np.max(np.abs(position[-1] - position[0])) > 1e-3
    linking = rx.measures.linking(scene, run)
    np.testing.assert_allclose(linking.twist + linking.writhe, 1.0, atol=1e-7)
    # momentum: nothing from outside acts
    mass = np.asarray(rod.to_nodes(rod.mass))[:, None]
    momentum = np.sum(mass * np.asarray(run.states.velocity), 1)
    np.testing.assert_allclose(momentum - momentum[:1], 0.0, atol=1e-12)


def unstable(turns, elements):
    """Modes of the ring that its weld closes and one clamped section keeps from floating."""
    rod = rx.ring(1.0, elements, SECTION, turns=turns)
    scene = rx.Scene(rod, first_end=rx.Clamped(), joints=WELD)
    return scene, rx.start(scene)


@pytest.mark.slow
def test_michells_threshold():
    """sqrt(3) A/C turns: where the lowest eigenvalue but for the eversion's 0 changes its sign."""
    errors = []
    for elements in (40, 80):
        at = []
        for factor in (0.97, 1.03):
            turns = factor * np.sqrt(3) * A / C
            values = rx.stability(*unstable(turns, elements), count=3).eigenvalues
            np.testing.assert_allclose(np.min(np.abs(values)), 0.0, atol=1e-6)  # it everts
            at.append(float(sorted(values, key=abs)[1]))
        below, above = at
        assert below > 0 > above
        errors.append(0.97 + 0.06 * below / (below - above) - 1)
    assert abs(errors[1]) < 1e-3
    assert abs(errors[0] / errors[1]) > 3


@pytest.mark.slow
@pytest.mark.parametrize(("turns", "number"), [(2.0, 0), (3.0, 2)])
def test_unstable_modes_are_counted(turns, number):
    """By elimination as by the dense eigenvalues (of unequal stiffness, which does not evert)."""
    section = rx.Section(stiffness=(A, 1.05 * A, C), mass=1.0)
    rod = rx.ring(1.0, 20, section, turns=turns)
    scene = rx.Scene(rod, first_end=rx.Clamped(), joints=WELD)
    state, info = rx.equilibrium(scene, rx.placing(scene), relax=False)
    found = rx.stability(scene, state, count=4)
    assert info.unstable == number == int(np.sum(found.eigenvalues < -1e-6))


class Bed(rx.AbstractLoad):
    """Springs so soft that they only keep a ring from floating."""

    stiffness: jnp.ndarray

    @property
    def role(self):
        return rx.Role.STORED

    def energy(self, rod, motion):
        moved = motion.position - rod.position
        return 0.5 * self.stiffness * jnp.sum(rod.node_length[:, None] * moved**2)

    def wrench(self, rod, motion):
        force = -self.stiffness * rod.node_length[:, None] * (motion.position - rod.position)
        return jnp.concatenate([force, jnp.zeros_like(force)], 1)


@pytest.mark.slow
def test_frequencies_in_its_plane():
    """n (n^2 - 1)/sqrt(n^2 + 1) sqrt(A/m)/R^2, n = 2 to 7, each twice: second order, to 1e-3."""
    n = np.arange(2, 8)
    theory = np.repeat(n * (n**2 - 1) / np.sqrt(n**2 + 1), 2)
    errors = []
    for elements in (60, 120):
        # about a_1, the plane's normal, it bends easily, out of its plane hardly
        section = rx.Section(stiffness=(A, 1e4 * A, 1e4), mass=1.0)
        rod = rx.ring(2 * np.pi, elements, section, stress_free=True)
        scene = rx.Scene(rod, loads=(Bed(jnp.asarray(1e-6)),), joints=WELD)
        found = np.asarray(rx.vibration(scene, rx.placing(scene), count=18).frequency)
        errors.append(found[found > 0.1][:12] / theory - 1)
    np.testing.assert_allclose(errors[0] / errors[1], 4.0, rtol=0.06)
    np.testing.assert_allclose((4 * errors[1] - errors[0]) / 3, 0.0, atol=1e-3)


@pytest.mark.slow
def test_rings_touch_each_other_but_not_their_own_neighbours():
    """Two that are linked, and a rod: beside a weld strands are neighbours, on any rod."""
    section = rx.circular_section(0.02, 1e6, 0.4e6, density=1500.0)
    one = rx.ring(1.0, 16, section, turns=0.5)
    other = rx.ring(0.8, 12, section, center=(1.0 / (2 * np.pi), 0.0, 0.0), normal=(0, 1, 0))
    rod = rx.straight_rod(0.3, 4, section, origin=(1.0, 0.0, 0.0))
    welds = tuple(rx.Weld(rx.Point(0, rod=i), rx.Point(-1, rod=i)) for i in (1, 2))
    contact = rx.Contact.solid(one, 10.0)
    scene = rx.Scene(rods=(rod, one, other), contact=contact, joints=welds)
    assert scene.contact.rings == (False, True, True)
    run = rx.rollout(scene, rx.start(scene), jnp.asarray([1e-4]))
    found = rx.measures.contacts(scene, run)
    np.testing.assert_array_equal(found.total, 0.0)
    # without the welds the ends of a ring are strands that meet
    loose = rx.Scene(rods=(rod, one, other), contact=contact)
    position, still = loose.rod.position, jnp.zeros_like(loose.rod.position)
    assert float(report(loose.contact, loose.rod, position, still).total) > 1.0
    # moved onto each other they push
    moved = position.at[scene.rod.parts[2].nodes, 0].add(0.8 / (2 * np.pi) - 0.016)
    pushed = report(scene.contact, scene.rod, moved, still)
    assert 0.3 < float(pushed.smallest) < 1 and float(pushed.total) > 1.0
