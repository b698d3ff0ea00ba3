"""Derivatives of eigenvalues by what changes the directions that the ends hold."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rodjax.constraints.ends import Clamped, Slider
from rodjax.equilibria.linear_stability import stability
from rodjax.equilibria.load_path import equilibrium
from rodjax.equilibria.small_vibration import vibration
from rodjax.inputs.schedules import Constant
from rodjax.interactions.loads import PointLoad
from rodjax.numerics.compilation import jit
from rodjax.numerics.eigenvalues import lowest
from rodjax.rods.builders import curved_rod, straight_rod
from rodjax.rods.section import Section
from rodjax.scenes.placing import placing
from rodjax.scenes.scene import Scene

STEP = 1e-4


@pytest.mark.parametrize("odd", [0.0, 0.4], ids=["symmetric", "general"])
def test_the_held_directions_turn(odd):
    draw = lambda *shape: jnp.asarray(random.normal(size=shape))
    random = np.random.default_rng(3)
    half, skew, weight = draw(7, 7), draw(7, 7), draw(7, 7)
    stiffness = half @ half.T + odd * (skew - skew.T)
    held, turn = draw(2, 7), draw(2, 7)

    @jax.jit
    def values(p):
        rows = held + p * turn
        # dependent rows hold no more than one of them does
        rows = jnp.concatenate([rows, rows[:1]])
        return lowest(stiffness, weight @ weight.T, rows, jnp.ones(()), 2).values.real

    slopes = (values(STEP) - values(-STEP)) / (2 * STEP)
    assert np.max(np.abs(slopes)) > 0.1
    np.testing.assert_allclose(jax.jacfwd(values)(0.0), slopes, rtol=1e-5)
    np.testing.assert_allclose(jax.jacrev(values)(0.0), slopes, rtol=1e-5)


SECTION = Section((1.0, 1.3, 0.8), mass=1.0)


def stretched(rod, size):
    return eqx.tree_at(lambda r: r.length, rod, size * rod.length)


STRAIGHT = straight_rod(1.0, 6, SECTION, first_director=(1, 0, 0))


def of_bent_rod(parameters):
    """The two lowest eigenvalues, in sum, of a straight rod that is bent to a circle.

    It is clamped at one end, and on a rail across it at the other, so that it is held twice where
    it is straight. Parameters: the angle it is bent by, its length, and the tilt of the rail.
    """
    angle, size, tilt = parameters
    rail = Slider(jnp.stack([jnp.ones(()), tilt, tilt]))
    scene = Scene(stretched(STRAIGHT, size), Clamped(), rail)
    turn = angle * jnp.linspace(0.0, 1.0, 7)
    none = jnp.zeros_like(turn)
    middle = 0.5 * (turn[1:] + turn[:-1])
    edges = scene.rod.length[:, None] * jnp.stack(
        [jnp.sin(middle), none[1:], jnp.cos(middle)], axis=1
    )
    position = jnp.concatenate([jnp.zeros((1, 3)), jnp.cumsum(edges, 0)])
    quaternion = jnp.stack([jnp.cos(0.5 * turn), none, jnp.sin(0.5 * turn), none], axis=1)
    place = lambda s: (s.position, s.quaternion)
    state = eqx.tree_at(place, placing(Scene(STRAIGHT)), (position, quaternion))
    return jnp.sum(stability(scene, state, 2).eigenvalues)


value_and_slopes = jit(jax.value_and_grad(of_bent_rod))


@pytest.mark.slow
def test_a_rod_bent_to_a_circle():
    at = jnp.asarray([1.0, 1.0, 0.3])
    value = lambda at: value_and_slopes(at)[0]
    differences = [
        (value(at + STEP * one) - value(at - STEP * one)) / (2 * STEP) for one in jnp.eye(3)
    ]
    assert np.min(np.abs(differences)) > 1e-3
    np.testing.assert_allclose(value_and_slopes(at)[1], differences, rtol=1e-5)


@pytest.mark.slow
def test_a_straight_rod_held_twice():
    """The rows of its ends depend on each other, and do so no longer when it is bent."""
    at = jnp.asarray([0.0, 1.0, 0.0])
    value, slopes = value_and_slopes(at)
    # twist between the clamps, and bending about the second director with one end on the rail
    np.testing.assert_allclose(value, (0.8 + 1.3) * np.pi**2, rtol=3e-2)
    np.testing.assert_allclose(slopes[1], -2 * value, rtol=1e-6)  # both as 1 / L^2
    assert np.all(np.isfinite(slopes))


@pytest.mark.slow
def test_an_arch_under_a_load():
    """Also by the load, with the equilibrium that it makes."""
    angle = 2 * np.pi / 3
    curve = lambda s: np.array([(1 - np.cos(angle * s)) / angle, np.sin(angle * s) / angle, 0.0])
    arch = curved_rod(curve, 1.0, 6, SECTION, first_director=(0, 0, 1))

    def values(push):
        load = PointLoad(3, Constant(push * jnp.asarray([-1.0, 0.5, 0.2])))
        scene = Scene(arch, Clamped(), Clamped(), (load,))
        state, _ = equilibrium(scene, placing(scene), load_steps=2, relax=False, throw=False)
        value, mode = stability(scene, state), vibration(scene, state)
        return jnp.stack([value.eigenvalues[0], mode.frequency[0]])

    forward = jit(lambda push: jax.jvp(values, (push,), (jnp.ones(()),)))
    pushes = jnp.asarray([2.0, 2.0 + STEP, 2.0 - STEP])
    (_, slopes), (above, _), (below, _) = (forward(push) for push in pushes)
    differences = (above - below) / (2 * STEP)
    assert np.min(np.abs(differences)) > 1e-2
    np.testing.assert_allclose(slopes, differences, rtol=1e-5)
    np.testing.assert_allclose(jit(jax.jacrev(values))(pushes[0]), differences, rtol=1e-5)
