"""Rods of other than a diagonal linear law against theory."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rodjax as rx
from rodjax.measuring.energy import ledger, strain_energy_density
from rodjax.numerics import rotations
from rodjax.rods.strains import curvature

ALONG = (0.0, 0.0, 1.0)
N = 4
FIXED = rx.Constant


def small_section(**changes):
    fields = {"mass": 1.0, "rotary_inertia": (1e-6, 1e-6, 2e-6)} | changes
    return rx.Section(**{"stiffness": (1.0, 1.0, 0.8), **fields})


# Twist-bend coupling


@pytest.mark.slow
def test_a_moment_along_an_eigenvector_of_the_stiffness_makes_a_helix():
    matrix = np.array([[1.0, 0.1, 0.2], [0.1, 1.3, -0.3], [0.2, -0.3, 0.8]])
    values, vectors = np.linalg.eigh(matrix)
    assert np.min(np.abs(vectors[:, 0])) > 0.1  # bends both ways and twists
    rod = rx.straight_rod(1.0, N, rx.Section(matrix, mass=1.0))
    pull = rx.PointLoad(-1, moment=FIXED(0.6 * vectors[:, 0]), follower=True)
    scene = rx.Scene(rod, rx.Clamped(), loads=(pull,))
    state, _ = rx.equilibrium(scene, rx.placing(scene), load_steps=2, relax=False)
    expected = np.broadcast_to(0.6 / values[0] * vectors[:, 0], (N, 3))
    np.testing.assert_allclose(curvature(rod, state.quaternion), expected, atol=1e-9)
    density = 0.5 * 0.6**2 / values[0]
    np.testing.assert_allclose(strain_energy_density(rod, state), density, rtol=1e-9)


def test_twist_that_is_free_softens_a_column():
    """The torque is zero, so the twist follows the bending: A - B23^2 / C bends."""
    section = small_section(stiffness=(1.0, 1e3, 0.8), coupling=(0.0, 0.5, 0.0))
    critical = (1.0 - 0.5**2 / 0.8) * 4 * N**2 * np.tan(np.pi / (4 * N)) ** 2  # of the chain
    assert abs(critical / ((1.0 - 0.5**2 / 0.8) * np.pi**2 / 4) - 1) < 0.03
    thrust = rx.PointLoad(-1, force=FIXED((0.0, 0.0, -critical)))
    scene = rx.Scene(rx.straight_rod(1.0, N, section), rx.Clamped(), loads=(thrust,))
    force = jnp.broadcast_to(jnp.asarray([[0.0, 0.0, -critical]]), (N, 3))
    found = rx.stability(scene, dataclasses.replace(rx.placing(scene), force=force))
    assert bool(found.symmetric)
    assert abs(found.eigenvalues[0]) < 1e-10


# Cables


def cable_section(extensible, **changes):
    compliance = (0.0, 0.0, 1 / 50.0) if extensible else None
    cable = {"torque_per_tension": 0.3, "compliance": compliance}
    return small_section(stiffness=(20.0, 20.0, 0.8), **cable, **changes)


@pytest.mark.slow
@pytest.mark.parametrize("extensible", [False, True])
def test_a_straight_cable_twists_and_lengthens_as_theory_says(extensible):
    """Torque against turns and tension against extension, ends turned and left to turn."""
    b, torsion, tension = 0.3, 0.8, 1.7
    give = 1 / 50.0 if extensible else 0.0
    rod = rx.straight_rod(1.0, N, cable_section(extensible))
    pull = rx.PointLoad(-1, force=FIXED((0.0, 0.0, tension)))
    settled = lambda scene: rx.equilibrium(
        scene, rx.placing(scene), time=1.0, load_steps=2, relax=False
    )[0]
    # left to turn: no torque
    free = rx.Scene(rod, rx.Clamped(), loads=(pull,))
    state = settled(free)
    twist = -b * tension / torsion
    np.testing.assert_allclose(curvature(rod, state.quaternion)[:, 2], twist, atol=1e-10)
    stretch = tension * give - b * twist
    np.testing.assert_allclose(state.position[-1, 2], 1 + stretch, atol=1e-10)
    stored = torsion * twist**2 / 2 + give * tension**2 / 2
    np.testing.assert_allclose(strain_energy_density(rod, state), stored, rtol=1e-9)
    # turned by an angle
    turn = rx.Turn(ALONG, rx.Smooth([0.0, 1.0], [0.0, 0.5]))
    held = rx.Scene(rod, rx.Clamped(rotation=turn), rx.Slider(ALONG), (pull,))
    state = settled(held)
    twist = -0.5
    np.testing.assert_allclose(state.position[-1, 2], 1 + tension * give - b * twist, atol=1e-10)
    torque = rx.energy.reactions(held, state).torque[1, 2]
    np.testing.assert_allclose(torque, torsion * twist + b * tension, rtol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("extensible", [False, True])
def test_waves_of_twist_and_stretch_in_a_cable(extensible):
    """Coupled frequencies by the dispersion of the chain, and a motion from rates that disagree."""
    b, torsion, axial, mass, inertia = 0.3, 0.8, 50.0, 1.0, 0.05
    section = cable_section(extensible, rotary_inertia=(0.05, 0.05, inertia))
    rod = rx.straight_rod(1.0, N, section)
    scene = rx.Scene(rod, rx.Clamped())
    state = rx.placing(scene)
    if extensible:
        stiff = np.array([[axial, axial * b], [axial * b, torsion + axial * b**2]])
        speeds = np.sqrt(np.linalg.eigvals(stiff / np.array([[mass], [inertia]])))
        speed = np.min(speeds)
    else:
        speed = np.sqrt(torsion / (inertia + mass * b**2))
    expected = 2 * N * speed * np.sin(np.pi / (4 * N))
    frequency = rx.vibration(scene, state).frequency[0]
    np.testing.assert_allclose(frequency, expected, rtol=1e-9)
    if extensible:
        return
    # spins of the mode, velocities left to the projection: a sine in time
    shape = np.sin(0.5 * np.pi * np.asarray(rod.arc_length))
    spin = jnp.asarray(0.1 * shape[:, None] * np.array([[0.0, 0.0, 1.0]]))
    begun = rx.start(scene, angular_velocity=spin)
    share = inertia / (inertia + mass * b**2)  # of the spin that the projection leaves
    np.testing.assert_allclose(begun.angular_velocity[:, 2], 0.1 * share * shape, atol=1e-12)
    np.testing.assert_allclose(begun.velocity[:, 2], -b * 0.1 * share * shape, atol=1e-12)
    steps = np.linspace(0.0, 1.0, 81)[1:]
    run = rx.rollout(scene, begun, steps)
    tip = 0.1 * share * b / expected * np.sin(expected * steps)
    np.testing.assert_allclose(1 - run.states.position[1:, -1, 2], tip, atol=2e-3 * np.max(tip))


@pytest.mark.slow
def test_unstable_modes_of_coupled_cables_are_counted_as_they_are():
    """By elimination as by eigenvalues, below and beyond the thrust at which a column buckles."""
    coupled, bound = {"coupling": (0.05, 0.2, 0.3)}, 3.0
    # the other twists as it is thrust, and bends where that is coupled: not a column then
    cable = {"torque_per_tension": 0.2, "compliance": (0.0, 0.0, 1e-3)}
    for changes in (coupled, cable):
        section = small_section(**changes)
        scene = lambda thrust, section=section: rx.Scene(
            rx.straight_rod(1.0, N, section),
            rx.Clamped(),
            loads=(rx.PointLoad(-1, force=FIXED((0.0, 0.0, -thrust))),),
        )
        counts = []
        for thrust in (0.5 * bound, bound):
            state, info = rx.equilibrium(
                scene(thrust), rx.placing(scene(thrust)), load_steps=1, relax=False
            )
            found = rx.stability(scene(thrust), state, count=N)
            assert bool(found.symmetric)
            assert int(info.unstable) == int(np.sum(np.asarray(found.eigenvalues) < 0))
            counts.append(int(info.unstable))
        assert counts[0] == 0 and counts[1] > 0


# Damping in the strain rates


@pytest.mark.slow
def test_a_mode_of_a_beam_decays_as_theory_says():
    """zeta = T omega / 2; its loss is in the ledger."""
    damping = 0.04
    rod = rx.straight_rod(1.0, 6, small_section(stiffness=(1.0, 4.0, 3.0)))
    plain = rx.Scene(rod, rx.Clamped())
    found = rx.vibration(plain, rx.placing(plain))
    omega = float(found.frequency[0])
    material = rx.KelvinVoigt(2 * damping / omega)
    scene = dataclasses.replace(plain, rod=dataclasses.replace(rod, material=material))
    np.testing.assert_allclose(rx.vibration(scene, rx.placing(scene)).frequency[0], omega)
    rate = 1e-3 * found.modes[0] / jnp.max(jnp.abs(found.modes[0, -1, :3]))
    begun = rx.start(scene, velocity=rate[:, :3], angular_velocity=rate[:, 3:])
    times = np.linspace(0.0, 2 * np.pi / omega, 121)
    run = rx.rollout(scene, begun, times[1:])
    across = int(np.argmax(np.abs(rate[-1, :2])))
    damped = omega * np.sqrt(1 - damping**2)
    expected = np.exp(-damping * omega * times) * np.sin(damped * times) / damped
    expected = float(rate[-1, across]) * expected
    error = np.max(np.abs(run.states.position[:, -1, across] - expected))
    assert error < 2e-3 * np.max(np.abs(expected))
    booked = ledger(scene, run)
    assert booked.material_loss is not None
    lost = 1 - np.exp(-4 * np.pi * damping / np.sqrt(1 - damping**2))
    np.testing.assert_allclose(booked.material_loss[-1] / booked.kinetic[0], lost, rtol=5e-3)
    assert np.max(np.abs(booked.residual)) < 5e-3 * booked.kinetic[0]


@pytest.mark.slow
@pytest.mark.parametrize("axis", [(0.0, 2.0, 0.0), (0.0, 0.0, 3.0)])
def test_a_free_rod_that_spins_is_not_damped(axis):
    section = small_section(material=rx.KelvinVoigt(0.5), rotary_inertia=(1e-3, 1e-3, 2e-3))
    scene = rx.Scene(rx.straight_rod(1.0, N, section, origin=(0, 0, -0.5)))
    turning = jnp.broadcast_to(jnp.asarray(axis), scene.rod.position.shape)
    body = rotations.rotate_inverse(scene.rod.quaternion, turning)
    velocity = jnp.cross(turning, scene.rod.position)
    begun = rx.start(scene, velocity=velocity, angular_velocity=body)
    method = rx.GeneralizedAlpha(0.9, tolerance=1e-12)
    booked = ledger(scene, rx.rollout(scene, begun, np.linspace(0.05, 1.0, 20), method))
    assert booked.material_loss is not None
    assert np.max(np.abs(booked.material_loss)) < 1e-9 * booked.kinetic[0]
    np.testing.assert_allclose(booked.kinetic, booked.kinetic[0], rtol=1e-4)


# Actuation


@pytest.mark.slow
def test_an_actuated_rod_curls_into_an_arc_at_rest():
    curling = rx.Smooth([0.0, 1.0], [[0.0, 0.0, 0.0], [0.0, 2.0, 0.0]])
    rod = rx.straight_rod(1.0, N, small_section(), actuation=curling)
    scene = rx.Scene(rod, rx.Clamped())
    state, _ = rx.equilibrium(scene, rx.placing(scene), time=1.0, load_steps=2)
    np.testing.assert_allclose(curvature(rod, state.quaternion)[:, 1], 2.0, atol=1e-9)
    np.testing.assert_allclose(strain_energy_density(rod, state), 0.0, atol=1e-12)
    with pytest.raises(ValueError, match=r"rod\.actuation: its schedule ends at 1"):
        rx.adaptive_rollout(scene, rx.start(scene), 2.0)


@pytest.fixture(scope="module")
def waving():
    """A damped arm whose rest shape is driven, and its run with a corner inside."""
    driven = rx.PiecewiseLinear([0.0, 0.113, 5.0], [[0.0, 0.0, 0.0], [0.0, 1.0, 0.2], [0, 1, 0.2]])
    section = small_section(material=rx.KelvinVoigt(0.02), rotary_inertia=(1e-3, 1e-3, 2e-3))
    scene = rx.Scene(rx.straight_rod(1.0, N, section, actuation=driven), rx.Clamped())
    return scene, rx.adaptive_rollout(scene, rx.start(scene), 0.4)


@pytest.mark.slow
def test_the_work_of_actuation_is_booked(waving):
    scene, run = waving
    assert np.min(np.abs(np.asarray(run.times) - 0.113)) < 1e-12
    booked = ledger(scene, run)
    assert booked.actuation_work is not None and booked.material_loss is not None
    assert booked.actuation_work[-1] > 0.02 and booked.material_loss[-1] > 1e-3
    assert booked.balance_error < 1e-2


@pytest.mark.slow
def test_the_tip_has_a_gradient_by_the_values_of_the_schedule(waving):
    scene, _ = waving
    times = np.linspace(0.02, 0.1, 5)
    assert isinstance(scene.rod.actuation, rx.PiecewiseLinear)
    values = scene.rod.actuation.values

    def tip(scale, eta):
        driven = rx.PiecewiseLinear([0.0, 0.113, 5.0], scale * values)
        rod = dataclasses.replace(scene.rod, actuation=driven, material=rx.KelvinVoigt(eta))
        moved = dataclasses.replace(scene, rod=rod)
        method = rx.GeneralizedAlpha(0.9, tolerance=1e-12)
        return rx.rollout(moved, rx.start(moved), times, method, throw=False).final.position[-1, 0]

    at = jnp.asarray(1.0), jnp.asarray(0.02)
    back = jax.jit(jax.grad(tip, (0, 1)))(*at)
    ahead = jax.jit(jax.jacfwd(tip, (0, 1)))(*at)
    np.testing.assert_allclose(back, ahead, rtol=1e-9)
    value = jax.jit(tip)
    steps = 1e-4, 1e-5
    for i, step in enumerate(steps):
        up, down = (value(*(x + s * step * (i == j) for j, x in enumerate(at))) for s in (1, -1))
        np.testing.assert_allclose((up - down) / (2 * step), back[i], rtol=1e-5)


# A law of one's own


class Softening(rx.AbstractMaterial):
    """Moments that grow less than in proportion beyond a curvature."""

    limit: jax.Array

    def moment(self, at):
        return at.stiffness * self.limit * jnp.tanh(at.bent / self.limit)

    def energy(self, at):
        return at.stiffness * self.limit**2 * jnp.log(jnp.cosh(at.bent / self.limit))


@pytest.fixture(scope="module")
def soft():
    """A cantilever of that law with a moment that comes on at its end."""
    section = small_section(material=Softening(2.0), rotary_inertia=(1e-3, 1e-3, 2e-3))
    moment = rx.Smooth([0.0, 0.5, 1.0], [[0.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 1.0, 0.0]])
    pull = rx.PointLoad(-1, moment=moment, follower=True)
    return rx.Scene(rx.straight_rod(1.0, N, section), rx.Clamped(), loads=(pull,))


@pytest.mark.slow
def test_a_law_of_the_users_own_bends_as_it_says(soft):
    state, _ = rx.equilibrium(soft, rx.placing(soft), time=0.5, load_steps=2)
    expected = 2.0 * np.arctanh(1.0 / 2.0)
    np.testing.assert_allclose(curvature(soft.rod, state.quaternion)[:, 1], expected, rtol=1e-9)


def test_a_law_of_the_users_own_moves_and_is_booked(soft):
    run = rx.adaptive_rollout(soft, rx.start(soft), 0.5)
    booked = ledger(soft, run)
    assert booked.balance_error < 1e-2
    assert booked.material_loss is not None
    assert abs(booked.material_loss[-1]) < 1e-12


# What is refused


def test_what_is_no_material_is_refused_with_the_mend():
    make = lambda **changes: rx.straight_rod(1.0, N, small_section(**changes))
    with pytest.raises(ValueError, match="stiffness: must be positive definite"):
        make(coupling=(0.0, 0.0, 0.9))
    with pytest.raises(ValueError, match="coupling: the matrix of the stiffness holds it"):
        make(stiffness=np.eye(3), coupling=(0.0, 0.0, 0.1))
    with pytest.raises(ValueError, match="material: a rod with mass=None cannot be of KelvinVoigt"):
        make(material=rx.KelvinVoigt(0.1), mass=None, rotary_inertia=None)
    with pytest.raises(ValueError, match="stretch: a rod without compliance does not stretch"):
        make(material=rx.KelvinVoigt(0.1, stretch=0.1))
    with pytest.raises(ValueError, match="bending: must be finite and not negative"):
        rx.KelvinVoigt(-0.1)
    with pytest.raises(ValueError, match="actuation: the schedule must give three components"):
        rx.straight_rod(1.0, N, small_section(), actuation=FIXED(1.0))


class Averaging(rx.AbstractMaterial):
    """A law that looks at other elements."""

    def moment(self, at):
        return at.stiffness * jnp.mean(at.bent, 0, keepdims=True)


class Scalar(rx.AbstractMaterial):
    """A law that gives one number an element."""

    def moment(self, at):
        return jnp.sum(at.bent, 1)


@pytest.mark.usefixtures("unchecked")
def test_a_law_that_is_none_is_refused_with_the_mend():
    scene = lambda law: rx.Scene(rx.straight_rod(1.0, N, small_section(material=law)), rx.Clamped())
    with pytest.raises(ValueError, match=r"material \(Averaging\): its slopes are not"):
        scene(Averaging())
    with pytest.raises(ValueError, match=r"material \(Scalar\): moment\(at\) must give \(4, 3\)"):
        scene(Scalar())
