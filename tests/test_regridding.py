"""States on other grids of their rod."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import order_of

from rodjax import rotations
from rodjax.constraints.ends import Clamped
from rodjax.dynamics.consistency import start
from rodjax.interactions.loads import Gravity
from rodjax.rods.builders import curved_rod, straight_rod
from rodjax.rods.regridding import regrid
from rodjax.rods.section import Section
from rodjax.rods.state import State
from rodjax.rods.strains import curvature, relative_rotation, strains
from rodjax.scenes.scene import Scene

SECTION = Section((1.0, 1.3, 0.8), mass=1.0, rotary_inertia=(2e-3, 2e-3, 4e-3))
SOFT = dataclasses.replace(SECTION, compliance=(1e-3, 1e-3, 1e-2))


def helix(s):
    """Of unit speed, one turn in the length 1."""
    pitch, radius = 0.6, 0.8 / (2 * np.pi)
    return np.array([radius * np.cos(2 * np.pi * s), radius * np.sin(2 * np.pi * s), pitch * s])


def rod_of(elements, section=SECTION, jumps=()):
    return curved_rod(helix, 1.0, elements, section, jumps=jumps)


def state_of(rod):
    """Its placing, in a motion that is smooth along the rod."""
    s, part = rod.arc_length[:, None], jnp.arange(3.0)[None]
    rate = jnp.concatenate([jnp.sin(3 * s + part), jnp.cos(2 * s + part)], 1)
    force = jnp.sin(2 * rod.midpoints[:, None] + part)
    return State(jnp.asarray(0.3), rod.position, rod.quaternion, rate, 2 * rate, 3 * rate, force)


def stretch_error(rod, state):
    stretch = strains(rod, state.position, state.quaternion).stretch
    return float(jnp.max(jnp.abs(stretch - jnp.asarray([[0.0, 0.0, 1.0]]))))


@pytest.mark.parametrize(("elements", "others"), [(20, 33), (20, 9), (20, 20)])
def test_constraint_and_ends_hold_exactly(elements, others):
    old, rod = rod_of(elements), rod_of(others, jumps=(0.37,))
    state = state_of(old)
    new = regrid(state, rod)
    assert new.position.shape == (others + 1, 3)
    assert stretch_error(rod, new) < 1e-13
    np.testing.assert_allclose(new.position[0], state.position[0], atol=1e-15)
    np.testing.assert_allclose(new.position[-1], state.position[-1], atol=1e-12)
    for end in (0, -1):
        np.testing.assert_allclose(new.quaternion[end], state.quaternion[end], atol=1e-14)
    assert new.time == 0.3 and new.force.shape == (others, 3)


def test_the_same_grid_changes_nothing_but_rounding():
    rod = rod_of(20)
    state = state_of(rod)
    new = regrid(state, rod, old=rod)
    for name in ("position", "quaternion", "rate", "acceleration", "auxiliary", "force"):
        np.testing.assert_allclose(getattr(new, name), getattr(state, name), atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("finer", [False, True])
def test_errors_are_of_second_order(finer):
    """Against the rod built on the new grid itself: places, frames, strains and rates."""
    sizes, errors = [10, 20, 40], []
    for n in sizes:
        old, rod = rod_of(n), rod_of(int(1.7 * n) if finer else int(0.6 * n))
        state, exact = state_of(old), state_of(rod)
        new = regrid(state, rod)
        bent = curvature(rod, new.quaternion) - curvature(rod, exact.quaternion)
        errors.append(
            [
                float(jnp.max(jnp.abs(new.position - exact.position))),
                float(jnp.max(jnp.abs(new.quaternion - exact.quaternion))),
                float(jnp.max(jnp.abs(bent))),
                float(jnp.max(jnp.abs(new.rate - exact.rate))),
                float(jnp.max(jnp.abs(new.force - exact.force))),
            ]
        )
    for kind in np.array(errors).T:
        assert order_of(1 / np.array(sizes), kind) > 1.8
    assert np.all(np.array(errors[-1]) < 5e-2)


@pytest.mark.slow
def test_whole_turns_are_kept():
    """A rod twisted by 12.3 turns, on finer and coarser grids."""
    rod = straight_rod(2.0, 40, SECTION)
    twisted = lambda rod: dataclasses.replace(
        state_of(rod),
        quaternion=rotations.multiply(
            rod.quaternion,
            rotations.exponential(
                jnp.asarray([[0.0, 0.0, 1.0]]) * jnp.pi * 12.3 * rod.arc_length[:, None]
            ),
        ),
    )
    state = twisted(rod)
    total = lambda state: float(
        jnp.sum(rotations.logarithm(relative_rotation(state.quaternion))[:, 2]) / (2 * jnp.pi)
    )
    assert total(state) == pytest.approx(12.3, rel=1e-12)
    for others in (97, 23, 14):
        assert total(regrid(state, straight_rod(2.0, others, SECTION))) == pytest.approx(12.3)
    with pytest.raises(ValueError, match="rod: an element of the new grid would turn by 1.2"):
        regrid(state, straight_rod(2.0, 10, SECTION))


@pytest.mark.slow
def test_a_compliant_rod_keeps_its_stretch():
    """Stretched by 3 % here and sheared there, to second order."""
    sizes, errors = [10, 20, 40], []
    for n in sizes:
        pulled = []
        for elements in (n, int(1.5 * n)):
            rod = rod_of(elements, SOFT)
            frames = strains(rod, rod.position, rod.quaternion).frame
            gamma = jnp.stack(
                [0.01 * jnp.sin(3 * rod.midpoints), 0 * rod.midpoints, 1 + 0.03 * rod.midpoints], 1
            )
            edges = rod.length[:, None] * jnp.einsum("nij,nj->ni", frames, gamma)
            line = jnp.concatenate([jnp.zeros((1, 3)), jnp.cumsum(edges, 0)])
            pulled.append((rod, dataclasses.replace(state_of(rod), position=line)))
        (old, state), (rod, exact) = pulled
        new = regrid(state, rod, old=old)
        found = strains(rod, new.position, new.quaternion).stretch
        expected = strains(rod, exact.position, exact.quaternion).stretch
        errors.append(float(jnp.max(jnp.abs(found - expected))))
    assert errors[-1] < 1e-4 and order_of(1 / np.array(sizes), errors) > 1.8


@pytest.mark.slow
def test_a_start_from_it_in_another_scene():
    """Accepted as unstretched, at its time; the velocities hardly change."""
    state, rod = state_of(rod_of(16)), rod_of(24)
    scene = Scene(rod, Clamped(), loads=(Gravity((0.0, 0.0, -1.0)),))
    free = Scene(rod)
    new = regrid(state, rod)
    given = {"position": new.position, "quaternion": new.quaternion, "time": new.time}
    still = start(scene, **given)
    assert still.time == 0.3 and np.all(np.isfinite(still.force))
    moving = start(free, **given, velocity=new.velocity, angular_velocity=new.angular_velocity)
    np.testing.assert_array_equal(moving.position, new.position)


@pytest.mark.slow
@pytest.mark.parametrize("straight", [False, True])
def test_derivative_against_differences(straight):
    """In traced code; along the straight rod too, whose ends no small rotation brings apart."""
    rod = straight_rod(1.0, 8, SECTION) if straight else rod_of(8)
    fine, state = straight_rod(1.0, 11, SECTION), state_of(rod)
    rng = np.random.default_rng(0)
    weights, turn = rng.normal(size=(12, 3)), rng.normal(size=(9, 4))

    @jax.jit
    def size(h):
        quaternion = rotations.normalize(state.quaternion + h * turn)
        new = regrid(dataclasses.replace(state, quaternion=quaternion), fine, old=rod)
        return jnp.sum(new.position * weights) + jnp.sum(new.rate**2)

    h = 1e-5
    difference = (float(size(h)) - float(size(-h))) / (2 * h)
    assert float(jax.grad(size)(0.0)) == pytest.approx(difference, rel=1e-6)


def bare(function):
    """The function as users have it, without the checks of types that the tests add."""
    return getattr(function, "__wrapped__", function)


def test_what_cannot_be_regridded_is_refused():
    rod = rod_of(20)
    state = state_of(rod)
    for given, message in (
        ((rod, rod), "state: give a state"),
        ((state, state), "rod: give the rod"),
        ((state, 20), "rod: give the rod"),
        ((state, straight_rod(2.0, 20, SECTION)), "rod: has length 2, but the state's is 1"),
        ((jax.tree.map(lambda x: jnp.stack([x, x]), state), rod), "state: give one state"),
    ):
        with pytest.raises(ValueError, match=message):
            bare(regrid)(*given)
    with pytest.raises(ValueError, match="old: has 9 elements, but the state 20"):
        regrid(state, rod, old=rod_of(9))
    with pytest.raises(ValueError, match="too coarse for the shape"):
        regrid(state, rod_of(2))
