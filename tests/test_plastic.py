"""Elastic-plastic bending: return mapping, a kink that stays, its loss and its derivatives."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rodjax as rx
from rodjax.measuring.energy import ledger
from rodjax.rods.constitution import seen_by_material
from rodjax.rods.state import at_rest
from rodjax.rods.strains import curvature

N = 3
LIMIT, HARD = 0.5, 0.4
BEND = 1.0


def plastic_rod(material, stiffness=(BEND, BEND, 0.8)):
    section = rx.Section(stiffness, mass=1.0, rotary_inertia=(1e-2, 1e-2, 2e-2), material=material)
    return rx.straight_rod(1.0, N, section)


def test_a_section_flows_until_its_moment_is_at_the_limit():
    material = rx.ElasticPlastic(LIMIT, HARD)
    rod = plastic_rod(material, (BEND, 3.0, 0.8))
    at = seen_by_material(rod, at_rest(jnp.zeros(()), rod.position, rod.quaternion))
    before = jnp.asarray([[0.1, -0.2], [0.0, 0.0], [0.3, 0.1]])
    bent = jnp.asarray([[2.0, -1.0, 0.3], [0.3, 0.05, 0.1], [-4.0, 5.0, 0.0]])
    at = at._replace(curvature=bent, memory=before)
    flown, moment = material.next_memory(at), material.moment(at)
    driving = moment[:, :2] - HARD * flown
    size = np.linalg.norm(driving, axis=1)
    np.testing.assert_allclose(size[[0, 2]], LIMIT, rtol=1e-12)
    assert size[1] < LIMIT and np.all(flown[1] == before[1])
    grown = flown - before
    across = grown[:, 0] * driving[:, 1] - grown[:, 1] * driving[:, 0]
    np.testing.assert_allclose(across, 0.0, atol=1e-12)  # along the driving moment
    assert np.all(np.sum(grown[jnp.asarray([0, 2])] * driving[jnp.asarray([0, 2])], 1) > 0)
    elastic = bent.at[:, :2].add(-flown)
    np.testing.assert_allclose(moment, rod.stiffness * elastic, rtol=1e-12)
    # with what it remembers then, the same
    later = at._replace(memory=flown)
    np.testing.assert_allclose(material.moment(later), moment, rtol=1e-12)
    np.testing.assert_allclose(material.energy(later), material.energy(at), rtol=1e-12)
    lost = jnp.sqrt(jnp.sum(grown**2, 1)) * LIMIT
    np.testing.assert_allclose(
        material.lost(at._replace(curvature=jnp.pad(before, ((0, 0), (0, 1)))), later), lost
    )


@pytest.mark.slow
def test_a_kink_stays_when_the_moment_is_taken_off():
    moment = rx.PiecewiseLinear([0.0, 1.0, 2.0], [[0.0, 0.0, 0.0], [0.0, 0.8, 0.0], [0, 0, 0]])
    pull = rx.PointLoad(-1, moment=moment, follower=True)
    scene = rx.Scene(plastic_rod(rx.ElasticPlastic(LIMIT, HARD)), rx.Clamped(), loads=(pull,))
    bent, _ = rx.equilibrium(scene, rx.placing(scene), time=1.0, load_steps=2)
    kink = (0.8 - LIMIT) / HARD
    expected = [0.0, 0.8 / BEND + kink, 0.0]
    found = curvature(scene.rod, bent.quaternion)
    np.testing.assert_allclose(found, np.broadcast_to(expected, (N, 3)), atol=1e-9)
    left, _ = rx.equilibrium(scene, bent, time=2.0, load_steps=2)
    found = curvature(scene.rod, left.quaternion)
    np.testing.assert_allclose(found, np.broadcast_to([0.0, kink, 0.0], (N, 3)), atol=1e-9)
    assert left.memory is not None
    np.testing.assert_allclose(left.memory.material[:, 1], kink, atol=1e-9)


@pytest.fixture(scope="module")
def struck():
    """A cantilever that is given a velocity."""
    scene = rx.Scene(plastic_rod(rx.ElasticPlastic(LIMIT, HARD)), rx.Clamped())
    shape = np.linspace(0.0, 1.0, N + 1)[:, None] ** 2 * np.array([[1.0, 0.2, 0.0]])
    return scene, rx.start(scene, velocity=2.0 * shape)


@pytest.mark.slow
def test_what_a_kink_costs_is_booked(struck):
    scene, state = struck
    booked = ledger(scene, rx.rollout(scene, state, np.linspace(0.005, 1.0, 200)))
    assert booked.material_loss is not None
    assert float(booked.material_loss[-1]) > 0.2 * booked.kinetic[0]
    assert np.all(np.diff(booked.material_loss) >= 0)
    assert np.max(np.abs(booked.residual)) < 1e-2 * booked.kinetic[0]


@pytest.mark.slow
def test_derivatives_pass_through_what_is_remembered(struck):
    scene, _ = struck
    times = np.linspace(0.05, 0.4, 8)
    shape = np.linspace(0.0, 1.0, N + 1)[:, None] ** 2 * np.array([[1.0, 0.2, 0.0]])

    def tip(limit, speed):
        rod = dataclasses.replace(scene.rod, material=rx.ElasticPlastic(limit, HARD))
        moved = dataclasses.replace(scene, rod=rod)
        state = rx.start(moved, velocity=speed * shape)
        method = rx.GeneralizedAlpha(0.9, tolerance=1e-13)
        return rx.rollout(moved, state, times, method, throw=False).final.position[-1, 0]

    at = jnp.asarray(LIMIT), jnp.asarray(2.0)
    back = jax.jit(jax.grad(tip, (0, 1)))(*at)
    np.testing.assert_allclose(back, jax.jit(jax.jacfwd(tip, (0, 1)))(*at), rtol=1e-9)
    value, step = jax.jit(tip), 1e-5
    for i in range(2):
        up, down = (value(*(x + s * step * (i == j) for j, x in enumerate(at))) for s in (1, -1))
        np.testing.assert_allclose((up - down) / (2 * step), back[i], rtol=1e-5)
