"""Contact in all space: forces with a potential, their exact values, round tips, rings."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import DIAMETER, LAWS, hairpin
from scipy.integrate import quad
from scipy.special import k1

import rodjax as rx
from rodjax import energy
from rodjax.dynamics.stepping import no_info
from rodjax.equations.overlap import least_held
from rodjax.interactions.contact_energy import contact_energy, has_potential, pair_energy
from rodjax.interactions.contact_law import PairProperties, continued
from rodjax.interactions.contact_report import report
from rodjax.interactions.pair_points import window
from rodjax.interactions.screening import search
from rodjax.interactions.sites import sites_of

report = eqx.filter_jit(report)
contact_energy = eqx.filter_jit(contact_energy)


class Wall(rx.AbstractLaw):
    """A user's law with today's abstract methods alone."""

    strength: float = 2.0

    def repulsion(self, distance, approach, pair):
        return self.strength * jnp.exp(-distance / pair.diameter) + 0.0 * approach

    def smallest(self, pair):
        return 0.2 * pair.diameter


def wound():
    """Two strands wound about each other, not side by side exactly, and a rod of their length."""
    s = np.linspace(0, 0.4, 12)
    turn = 12 * s
    radius = 0.6 * DIAMETER
    one = np.stack([radius * np.cos(turn), radius * np.sin(turn), s], 1)
    two = np.stack([-radius * np.cos(turn), -radius * np.sin(turn), s + 0.01], 1)[::-1]
    cap = [[0.004, 0.03, 0.45]]
    position = jnp.asarray(np.concatenate([one, cap, two]))
    section = rx.circular_section(DIAMETER, 1e6, 5e5, 1500.0)
    return rx.straight_rod(0.96, 24, section), position


class Pole(rx.AbstractLaw):
    """A user's law that diverges outside the strands, at 1.2 diameters."""

    def repulsion(self, distance, approach, pair):
        return 2.0 / (distance - 1.2 * pair.diameter) ** 3

    def smallest(self, pair):
        return 1.21 * pair.diameter


def contact_of(law, **options):
    options = {"segments": 24, "cutoff": 0.06, "points_per_segment": 3} | options
    return rx.Contact(law, **options)


USERS = {"user": Wall(), "pole": Pole()}


@pytest.mark.parametrize("name", [*LAWS, *USERS])
def test_slope_of_a_pairs_energy_is_its_force(name):
    """At all distances, also where the law is continued or fades; a user's law is integrated."""
    contact = contact_of((LAWS | USERS)[name], aperture=np.pi)
    d = jnp.linspace(0.05, 3.1, 150) * DIAMETER
    pair = PairProperties(jnp.full_like(d, DIAMETER), jnp.full_like(d, 0.5))

    @jax.jit
    def both(d):
        psi = continued(contact.law, d, jnp.zeros_like(d), pair)
        slope = jax.grad(lambda d: jnp.sum(pair_energy(contact, d, pair)))(d)
        return psi * window(contact, d, pair, (jnp.zeros_like(d), jnp.zeros_like(d))), -slope

    force, slope = both(d)
    assert np.max(np.abs(force)) > 0
    np.testing.assert_allclose(slope, force, rtol=1e-9, atol=1e-9 * np.median(np.abs(force)))
    assert float(pair_energy(contact, d, pair)[-1]) == 0


def test_a_pole_outside_the_strands_is_not_integrated_across():
    """The integral of 2/(x - 1.2 D)^3 is 1/(d - 1.2 D)^2."""
    d = jnp.linspace(1.21, 3.0, 20) * DIAMETER
    pair = PairProperties(jnp.full_like(d, DIAMETER), None)
    phi = jax.jit(lambda d: Pole().potential(d, pair))(d)
    exact = (d - 1.2 * DIAMETER) ** -2
    np.testing.assert_allclose(phi - phi[-1], exact - exact[-1], rtol=1e-9)
    one = jax.tree.map(lambda v: v[:1], pair)
    held = float(least_held(contact_of(Pole()), one)[0])
    # below its smallest distance s it goes on by a steep tangent: phi is about (s - d)^2 there
    assert held == pytest.approx(1.21 * DIAMETER / 3, rel=0.01)


def test_energy_of_a_law_that_fades():
    """The integral of psi times the window, by an independent quadrature."""
    law, cutoff, edge = LAWS["debye_hueckel"], 0.06, 0.25
    pair = PairProperties(jnp.asarray(DIAMETER), None)

    def psi(x):
        u = np.clip((1 - x / cutoff) / edge, 0, 1)
        decay = 0.1 * np.exp(-x / 0.02) * (1 / x + 1 / 0.02) / x
        return decay * u**3 * (10 - 15 * u + 6 * u**2)

    energy_at = jax.jit(lambda d: pair_energy(contact_of(law), d, pair))
    for d in (0.005, 0.02, 0.05, 0.0599, 0.06, 0.07):
        expected = quad(psi, d, cutoff, points=[0.045], epsrel=1e-10)[0] if d < cutoff else 0.0
        assert float(energy_at(d)) == pytest.approx(expected, rel=1e-8, abs=1e-16)


def test_force_is_the_slope_of_the_energy():
    """Of nodes, by the exact derivative and by differences along one direction."""
    rod, position = wound()
    contact = contact_of(LAWS["debye_hueckel"]).fitted(rod)
    found = report(contact, rod, position, jnp.zeros_like(position))
    assert not found.overflow
    slope = eqx.filter_jit(jax.grad(lambda x: contact_energy(contact, rod, x)))(position)
    scale = float(jnp.max(jnp.abs(found.force)))
    np.testing.assert_allclose(-slope, found.force, atol=1e-10 * scale)
    way = jnp.asarray(np.random.default_rng(0).normal(size=position.shape))
    h = 1e-7
    up, down = (contact_energy(contact, rod, position + s * h * way) for s in (1, -1))
    expected = -float(jnp.sum(found.force * way))
    assert float(up - down) / (2 * h) == pytest.approx(expected, rel=1e-6)


def test_default_aperture_is_the_laws():
    """All space but for Eq. (13), whose force has no potential, as its energy says."""
    assert contact_of(LAWS["damped"]).acting_aperture == pytest.approx(np.pi / 2)
    assert not has_potential(contact_of(LAWS["damped"]))
    assert has_potential(contact_of(LAWS["damped"], aperture=np.pi))
    assert not has_potential(contact_of(LAWS["penalty"], aperture=3.1))
    for law in (*(LAWS[name] for name in set(LAWS) - {"damped"}), Wall()):
        assert has_potential(contact_of(law)) is True


def asymmetry(contact, rod, position):
    force = lambda x: report(contact, rod, x, jnp.zeros_like(x)).force
    size = position.size
    slope = np.asarray(eqx.filter_jit(jax.jacfwd(force))(position)).reshape(size, size)
    return np.linalg.norm(slope - slope.T) / np.linalg.norm(slope + slope.T)


def test_derivative_is_symmetric():
    rod, position = wound()
    law = LAWS["debye_hueckel"]
    assert asymmetry(contact_of(law).fitted(rod), rod, position) < 1e-12
    # what an aperture does to it
    assert asymmetry(contact_of(law, aperture=np.pi / 2), rod, position) > 0.05


def meeting(end, angle=np.pi / 2, beside=0.0):
    """A straight strand along z through 0, and one in the plane y = beside that ends at `end`.

    The second comes from +x at the angle to the first; between both is a wide detour.
    """
    first = [[0.0, 0.0, 0.05 * (i - 10)] for i in range(21)]
    way = np.array([np.sin(angle), 0.0, np.cos(angle)])
    last = [np.array([0.0, beside, 0.0]) + (0.05 * i + end) * way for i in range(20, -1, -1)]
    start, stop = np.array(first[-1]), np.array(last[0])
    a = np.linspace(0, 1, 21)[1:-1, None]
    detour = start + a * (stop - start) + np.array([0.0, -2.0, 0.0]) * np.sin(np.pi * a)
    position = jnp.asarray(np.concatenate([first, detour, last]))
    section = rx.Section((1.0, 1.0, 0.8), mass=1.0, diameter=0.1)
    return rx.straight_rod(3.0, 60, section), position


def push(law, **shape):
    """Force on the last 21 nodes, those of the second strand."""
    rod, position = meeting(**shape)
    contact = rx.Contact(law, 60, cutoff=0.12, points_per_segment=8)
    found = report(contact.fitted(rod), rod, position, jnp.zeros_like(position))
    assert not found.overflow
    return np.asarray(found.force)[-21:].sum(0)


@pytest.mark.parametrize("angle", [90, 60, 30])
@pytest.mark.parametrize("distance", [0.9, 0.6, 0.2])
def test_crossing_strands(angle, distance):
    """2 pi d phi(d) / sin(angle), away from each other."""
    law, pair = rx.Penalty(1e3), PairProperties(jnp.asarray(0.1), None)
    d = 0.1 * distance
    force = push(law, end=-0.5, angle=np.radians(angle), beside=d)
    expected = (
        2 * np.pi * d * float(law.potential(jnp.asarray(d), pair)) / np.sin(np.radians(angle))
    )
    assert force[1] == pytest.approx(expected, rel=0.02)
    np.testing.assert_allclose(force[[0, 2]], 0.0, atol=0.02 * expected)


def test_parallel_charged_strands():
    """Force per length 2 S K1(d/l)/l, the exact integral, also where points are not abreast."""
    strength, length, d = 0.1, 0.02, 0.06
    rod, position = meeting(end=0.0, angle=0.0)
    position = position.at[-21:].add(jnp.asarray([d, 0.0, 0.005 - 0.5]))
    contact = rx.Contact(rx.DebyeHueckel(strength, length), 60, 12 * length, points_per_segment=4)
    found = report(contact.fitted(rod), rod, position, jnp.zeros_like(position))
    assert not found.overflow
    force = -np.asarray(found.force)[9:12, 0].sum() / 0.15
    assert force == pytest.approx(2 * strength * k1(d / length) / length, rel=5e-4)


@pytest.mark.parametrize("gap", [0.07, 0.05, 0.0])
def test_a_tip_pushed_into_a_strand_is_pushed_back(gap):
    """Its cap is round: the force is that of the end point, the integral of phi over the strand."""
    law, pair = rx.Penalty(1e3), PairProperties(jnp.asarray(0.1), None)
    s = np.linspace(-0.1, 0.1, 4001)
    phi = law.potential(jnp.hypot(gap, jnp.asarray(s)), pair)
    expected = float(jnp.sum(phi) * (s[1] - s[0]))
    assert push(law, end=gap)[0] == pytest.approx(expected, rel=0.05)


def ring(radius=0.1, last_end=None):
    """A rod clamped into a ring, with contact."""
    around = lambda s: s / radius
    circle = lambda s: jnp.stack(
        [radius * jnp.sin(around(s)), 0 * s, radius - radius * jnp.cos(around(s))]
    )
    section = rx.Section((1.0, 1.0, 0.8), mass=1.0, diameter=0.01)
    rod = rx.curved_rod(circle, 2 * np.pi * radius, 16, section)
    contact = rx.Contact(rx.DebyeHueckel(1.0, 0.005), 32, 0.04, 2, pairs_per_segment=8)
    return rx.Scene(rod, rx.Clamped(), rx.Clamped() if last_end is None else last_end,
                    contact=contact)  # fmt: skip


def squeezed(scene, flatness):
    """What the contact of a ring does that is pressed flat, on its nodes and in all."""
    flat = scene.rod.position * jnp.stack([1.0, 1.0, flatness]).reshape(1, 3)
    found = report(scene.contact, scene.rod, flat, jnp.zeros_like(flat), scene.closed)
    return found.force, found.total, found.overflow


def test_ends_of_a_ring_are_neighbours():
    """Clamped to one point, they do not repel each other; the sides of an oval still do."""
    scene = ring()
    assert scene.closed
    assert float(squeezed(scene, 1.0)[1]) == 0
    force, total, _ = squeezed(scene, 0.12)
    assert float(total) > 0
    # apart only where the strands are, a quarter along
    assert float(jnp.max(jnp.abs(force[:2]))) < 0.2 * float(jnp.max(jnp.abs(force)))
    assert ring(last_end=rx.Pinned()).closed
    away = rx.Clamped(displacement=rx.Constant(jnp.zeros(3)))
    for end in (rx.Free(), rx.Slider((0.0, 0.0, 1.0)), away):
        assert ring(last_end=end).closed is False
    assert not ring(last_end=rx.Switched(rx.Free(), rx.Clamped(), 1.0)).closed
    assert ring(last_end=rx.Switched(rx.Pinned(), rx.Clamped(), 1.0)).closed
    # it belongs to the scene as it is, not to the contact it was made with
    opened = eqx.tree_at(lambda s: s.rod.position, scene, scene.rod.position.at[-1, 0].add(0.02))
    assert not opened.closed


def test_a_ring_of_traced_code_is_a_ring():
    """Its forces are those of the ring made outside, under jit, vmap and grad."""

    def made(flatness, radius):
        force, total, overflow = squeezed(ring(radius), flatness)
        return total, (force, overflow)

    h = 1e-6
    slopes = jax.vmap(jax.value_and_grad(made, has_aux=True))
    flatness = jnp.asarray([1.0, 0.12, 0.12 + h, 0.12 - h])
    (total, (force, overflow)), slope = jax.jit(slopes)(flatness, jnp.full(4, 0.1))
    assert float(total[0]) == 0 and float(slope[0]) == 0
    expected = squeezed(ring(), 0.12)
    assert float(total[1]) == pytest.approx(float(expected[1]), rel=1e-9)
    np.testing.assert_allclose(force[1], expected[0], atol=1e-9 * float(expected[1]))
    assert not np.any(overflow)
    assert float(slope[1]) == pytest.approx(float(total[2] - total[3]) / (2 * h), rel=1e-5)


def test_lists_hold_two_strands_by_default():
    """Nobody has to choose pairs_per_segment, and what is given is kept."""
    rod = hairpin(24, half_gap=0.015)
    contact = rx.Contact(rx.DebyeHueckel(1.0, 0.02), 100, 0.2)
    scene = rx.Scene(rod, rx.Clamped(), contact=contact)
    searched = lambda scene, x: search(scene.contact, sites_of(scene.contact, scene.rod), x)
    found = eqx.filter_jit(searched)(scene, rod.position)
    assert int(found.count) > 4 * 101 and not found.overflow
    assert scene.contact.pairs_per_segment is None
    wider = dataclasses.replace(scene.contact, cutoff=jnp.asarray(0.25))
    assert dataclasses.replace(scene, contact=wider).contact.room > scene.contact.room
    few = dataclasses.replace(contact, pairs_per_segment=1)
    with pytest.raises(ValueError, match="^pairs_per_segment"):
        rx.Scene(rod, rx.Clamped(), contact=few)


def pressed(law, aperture=np.pi):
    """Ledger of strands that are pressed together and let go again."""
    rod = hairpin(12, half_gap=0.02)
    contact = rx.Contact(law, 24, 0.03, points_per_segment=4, aperture=aperture)
    scene = rx.Scene(rod, rx.Clamped(), rx.Clamped(), contact=contact)
    parts = np.concatenate([np.linspace(0, 1, 121), np.linspace(1, 0, 121)[1:]])
    times = np.linspace(0, 0.4, 241)

    def at(part, rate, time):
        place = rod.position.at[:, 0].multiply(1 - 0.62 * part)
        zero = jnp.zeros((13, 6))
        moving = zero.at[:, 0].set(-0.62 * rate * rod.position[:, 0])
        force = jnp.zeros((12, 3))
        return rx.State(jnp.asarray(time), place, rod.quaternion, moving, zero, zero, force)

    rows = zip(parts, np.gradient(parts, times), times, strict=True)
    states = jax.tree.map(lambda *leaves: jnp.stack(leaves), *[at(*row) for row in rows])
    infos = jax.tree.map(lambda leaf: jnp.stack([leaf] * 240), no_info(jnp.float64))
    zero = jnp.asarray(0, jnp.int32)
    return energy.ledger(scene, rx.Run(states, infos, zero, zero, zero))


@pytest.mark.slow
def test_ledger_tells_what_contact_stored_from_what_it_lost():
    """A spring gives back, a dashpot does not; with an aperture there is nothing to store."""
    spring = pressed(rx.Penalty(1e6))
    stored = np.asarray(spring.contact_energy)
    assert stored[120] > 0
    np.testing.assert_allclose(stored, stored[::-1], atol=1e-12 * stored[120])
    np.testing.assert_array_equal(spring.contact_loss, 0)
    np.testing.assert_allclose(spring.contact_work, stored - stored[0], atol=5e-3 * stored[120])
    dashpot = pressed(rx.Penalty(1e6, relaxation=1e-2))
    np.testing.assert_allclose(dashpot.contact_energy, stored, rtol=1e-12)
    loss = np.asarray(dashpot.contact_loss)
    assert loss[-1] > 0.05 * stored[120] and np.all(np.diff(loss) > -1e-12)
    work = stored - stored[0] + loss
    np.testing.assert_allclose(dashpot.contact_work, work, atol=5e-3 * stored[120])
    screened = pressed(rx.Penalty(1e6), aperture=np.pi / 2)
    np.testing.assert_array_equal(screened.contact_energy, 0)
    np.testing.assert_array_equal(screened.contact_loss, screened.contact_work)
    assert screened.contact_work[120] > 0
