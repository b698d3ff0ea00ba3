"""Loads of a user's own, stepped through runs, and their work booked as they say."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float
from scipy.integrate import solve_ivp

import rodjax as rx
from rodjax.measuring import energy
from rodjax.rods.state import at_rest, moved

ELEMENTS = 8
MASS, STIFFNESS = 0.5, 30.0  # of the rod [kg], of the bed under it [N/m^2]


class Bed(rx.AbstractLoad):
    """Springs and dashpots along a rod, against displacements from where it is placed."""

    stiffness: Float[Array, ""]  # [N/m^2]
    damping: Float[Array, ""]  # [N s/m^2]

    def _moved(self, rod, motion):
        return motion.position - rod.position

    @property
    def role(self):
        return rx.Role.STORED

    def energy(self, rod, motion):
        moved = self._moved(rod, motion)
        return 0.5 * self.stiffness * jnp.sum(rod.node_length[:, None] * moved**2)

    def wrench(self, rod, motion):
        force = self.stiffness * self._moved(rod, motion) + self.damping * motion.velocity
        force = -rod.node_length[:, None] * force
        return jnp.concatenate([force, jnp.zeros_like(force)], 1)


class CubicDrag(rx.AbstractLoad):
    """-c |v|^2 v per length, lost as its role says."""

    coefficient: Float[Array, ""]
    lost: rx.Role = dataclasses.field(default=rx.Role.DRAG, metadata={"static": True})

    @property
    def role(self):
        return self.lost

    def wrench(self, rod, motion):
        squared = jnp.sum(motion.velocity**2, 1, keepdims=True)
        force = -self.coefficient * rod.node_length[:, None] * squared * motion.velocity
        return jnp.concatenate([force, jnp.zeros_like(force)], 1)


def thrown(*loads):
    """A free rod of unit length that moves as a rigid body at 2 m/s, and its start."""
    rod = rx.straight_rod(1.0, ELEMENTS, rx.circular_section(0.02, 1e9, 0.4e9, density=1500.0))
    rod = dataclasses.replace(rod, mass=jnp.full(ELEMENTS, MASS))
    scene = rx.Scene(rod, loads=loads)
    velocity = jnp.zeros((ELEMENTS + 1, 3)).at[:, 0].set(2.0)
    return scene, rx.start(scene, velocity=velocity)


def booked(scene, state, until, steps):
    run = rx.rollout(scene, state, jnp.linspace(0.0, until, steps + 1)[1:])
    return run, energy.ledger(scene, run)


@pytest.mark.slow
def test_a_bed_that_stores_and_damps():
    """m x'' + c x' + k x = 0, v(0) = 2: the oscillator's own energies."""
    c = 1.0
    scene, state = thrown(Bed(jnp.asarray(STIFFNESS), jnp.asarray(c)))
    run, ledger = booked(scene, state, 0.5, 1000)
    decay, natural = c / (2 * MASS), STIFFNESS / MASS
    omega = np.sqrt(natural - decay**2)
    t = np.asarray(run.times)
    x = 2 / omega * np.exp(-decay * t) * np.sin(omega * t)
    v = 2 * np.exp(-decay * t) * (np.cos(omega * t) - decay / omega * np.sin(omega * t))
    np.testing.assert_allclose(ledger.gravity, 0.5 * STIFFNESS * x**2, atol=1e-5)
    np.testing.assert_allclose(ledger.kinetic, 0.5 * MASS * v**2, atol=1e-5)
    lost = 1.0 - 0.5 * STIFFNESS * x**2 - 0.5 * MASS * v**2
    np.testing.assert_allclose(ledger.damping_loss, lost, atol=1e-5)
    assert lost[-1] > 0.3
    np.testing.assert_array_equal(ledger.load_work, 0.0)
    np.testing.assert_array_equal(ledger.drag_loss, 0.0)
    assert np.max(np.abs(ledger.residual)) < 1e-5


@pytest.mark.parametrize(
    "role, column, sign",
    [
        pytest.param(rx.Role.DRAG, "drag_loss", 1, marks=pytest.mark.slow),
        pytest.param(rx.Role.DAMPING, "damping_loss", 1, marks=pytest.mark.slow),
        pytest.param(rx.Role.DRIVEN, "load_work", -1, marks=pytest.mark.slow),
    ],
)
def test_a_drag_is_lost_as_it_says(role, column, sign):
    """m v' = -c v^3: v = v0/sqrt(1 + 2 c v0^2 t/m)."""
    c, until = 0.4, 0.5
    scene, state = thrown(CubicDrag(jnp.asarray(c), role))
    run, ledger = booked(scene, state, until, 200)
    v = 2 / np.sqrt(1 + 2 * c * 4 * np.asarray(run.times) / MASS)
    lost = 0.5 * MASS * (4 - v**2)
    assert lost[-1] > 0.5
    for name in ("drag_loss", "damping_loss", "load_work"):
        expected = sign * lost if name == column else 0 * lost
        np.testing.assert_allclose(getattr(ledger, name), expected, atol=1e-4)


def test_the_energy_has_derivatives():
    def stored(stiffness):
        scene, state = thrown(Bed(stiffness, jnp.asarray(0.0)))
        raised = dataclasses.replace(state, position=state.position + 0.1)
        return energy.gravity_energy(scene, raised)

    value, slope = jax.jit(jax.value_and_grad(stored))(jnp.asarray(STIFFNESS))
    np.testing.assert_allclose([value, slope], [0.015 * STIFFNESS, 0.015], rtol=1e-12)


class Wall(rx.AbstractLoad):
    """A wall at x = 0 that no force presses a rod into: k/x per length, and dashpots c/x."""

    stiffness: Float[Array, ""]  # [N]
    damping: Float[Array, ""]  # [N s/m]
    careful: bool = dataclasses.field(default=True, metadata={"static": True})

    @property
    def role(self):
        return rx.Role.CONTACT

    def energy(self, rod, motion):
        return -self.stiffness * jnp.sum(rod.node_length * jnp.log(motion.position[:, 0]))

    def wrench(self, rod, motion):
        x, speed = motion.position[:, 0], motion.velocity[:, 0]
        push = rod.node_length * (self.stiffness - self.damping * speed) / x
        return jnp.zeros((len(x), 6), x.dtype).at[:, 0].set(push)

    def safe_fraction(self, rod, position, change, found):
        if not self.careful:
            return None
        x, closing = position[:, 0], -change[:, 0]
        nearing = closing > 0
        return jnp.min(
            jnp.where(nearing, 0.7 * x / jnp.where(nearing, closing, 1.0), 1.0), initial=1
        )


def before_the_wall(k, c, careful=True):
    """A rod at x = 0.1 m, parallel to the wall and on its way to it, and its start."""
    rod = rx.straight_rod(1.0, ELEMENTS, rx.circular_section(0.02, 1e9, 0.4e9, density=1500.0))
    place = rod.position.at[:, 0].set(0.1)
    rod = dataclasses.replace(rod, mass=jnp.full(ELEMENTS, MASS), position=place)
    scene = rx.Scene(rod, loads=(Wall(jnp.asarray(k), jnp.asarray(c), careful),))
    velocity = jnp.zeros((ELEMENTS + 1, 3)).at[:, 0].set(-2.0)
    return scene, rx.start(scene, velocity=velocity)


def test_a_wall_of_its_user_throws_a_rod_back():
    """m x'' = (k - c x')/x; what is stored and lost in contact against an integration of that."""
    k, c, until = 0.4, 0.02, 0.15
    scene, state = before_the_wall(k, c)
    run = rx.adaptive_rollout(scene, state, until, control=rx.StepControl(1e-3, 1e-5))
    ledger = energy.ledger(scene, run)

    def rates(_, y):
        x, v = y[:2]
        return [v, (k - c * v) / x / MASS, c * v**2 / x]

    exact = solve_ivp(rates, (0, until), [0.1, -2, 0], rtol=1e-10, atol=1e-12, t_eval=run.times)
    x, v, lost = exact.y
    assert np.min(x) < 0.02 and v[-1] > 1
    np.testing.assert_allclose(run.states.position[:, 3, 0], x, atol=2e-4)
    np.testing.assert_allclose(ledger.contact_energy, -k * np.log(x), atol=2e-3)
    np.testing.assert_allclose(ledger.contact_loss, lost, atol=2e-3)
    assert lost[-1] > 0.1
    np.testing.assert_allclose(
        ledger.contact_work,
        ledger.contact_energy - ledger.contact_energy[0] + ledger.contact_loss,
        atol=2e-3,
    )
    for name in ("load_work", "gravity", "damping_loss", "drag_loss"):
        np.testing.assert_array_equal(getattr(ledger, name), 0.0)
    assert np.max(np.abs(ledger.residual)) < 2e-3


@pytest.mark.parametrize("careful", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_no_increment_passes_a_wall(careful):
    """A step whose prediction lies behind it ends before it, if the wall says what is safe."""
    scene, state = before_the_wall(0.4, 0.0, careful)
    new, info = rx.step(scene, state, state.time + 0.08)
    before = int(info.result) == rx.Result.SUCCESS and float(new.position[0, 0]) > 0
    assert before == careful


class Wrong(Bed):
    def energy(self, rod, motion):
        return 2 * super().energy(rod, motion)


class InTime(Bed):
    def energy(self, rod, motion):
        return super().energy(rod, motion) + jnp.sin(motion.time)


class Periodic(Bed):
    """Of period one second, at which the energy is the same again."""

    def energy(self, rod, motion):
        return super().energy(rod, motion) + jnp.sin(2 * jnp.pi * motion.time)


class Begins(Bed):
    def energy(self, rod, motion):
        begun = jnp.clip(motion.time - 50.0, 0.0, 100.0)
        return super().energy(rod, motion) + begun


class Rows(Bed):
    def energy(self, rod, motion):
        return jnp.sum(self._moved(rod, motion) ** 2, 1)


class NoEnergy(CubicDrag):
    @property
    def role(self):
        return rx.Role.STORED


class NoRole(CubicDrag):
    @property
    def role(self):
        return "lost"


BED = jnp.asarray(STIFFNESS), jnp.asarray(0.0)
REFUSED = {
    "twice": (Wrong(*BED), "its energy grows by"),
    "in time": (InTime(*BED), "changes in time"),
    "periodic": (Periodic(*BED), "changes in time"),
    "begins": (Begins(*BED), "changes in time"),
    "rows": (Rows(*BED), "must be one number"),
    "none": (NoEnergy(jnp.asarray(1.0)), r"needs energy\(rod, motion\)"),
    "no role": (NoRole(jnp.asarray(1.0)), "must be a rodjax.Role, got 'lost'"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_loads_that_book_themselves_wrongly_are_refused(case):
    load, message = REFUSED[case]
    rod = rx.straight_rod(1.0, ELEMENTS, rx.circular_section(0.02, 1e9, 0.4e9, density=1500.0))
    with pytest.raises(ValueError, match=message):
        rx.Scene(rod, rx.Clamped(), loads=(load,))


class Foundation(Bed):
    """Rotational springs about the tangent beside those of the bed: moments in body axes."""

    def energy(self, rod, motion):
        turn = motion.quaternion[:, 3] / motion.quaternion[:, 0]
        return super().energy(rod, motion) + 2 * jnp.sum(jnp.arctan(turn) ** 2)

    def wrench(self, rod, motion):
        turn = motion.quaternion[:, 3] / motion.quaternion[:, 0]

        def energy(z):
            return self.energy(rod, moved(motion, z))

        slope = jax.grad(energy)(jnp.zeros((*turn.shape, 6)))
        resting = super().wrench(rod, at_rest(motion.time, motion.position, motion.quaternion))
        damped = super().wrench(rod, motion) - resting
        return damped - slope


def test_a_wrench_by_differentiation_of_the_energy_passes():
    rod = rx.straight_rod(1.0, ELEMENTS, rx.circular_section(0.02, 1e9, 0.4e9, density=1500.0))
    rx.Scene(rod, rx.Clamped(), loads=(Foundation(*BED),))


def test_a_rod_without_inertia_rests_on_a_drag_of_its_user():
    class Own(rx.AbstractLoad):
        honey: rx.LinearDrag

        def wrench(self, rod, motion):
            return self.honey.wrench(rod, motion)

        @property
        def resistance(self):
            return self.honey.resistance

    section = rx.Section((1.0, 1.0, 0.8), diameter=0.02)
    rod = rx.straight_rod(1.0, ELEMENTS, section)
    rx.Scene(rod, rx.Clamped(), loads=(Own(rx.LinearDrag(1.0, 0.5, 0.1)),))
    with pytest.raises(ValueError, match="rotational"):
        rx.Scene(rod, rx.Clamped(), loads=(Own(rx.LinearDrag(1.0, 0.5, 0.0)),))
