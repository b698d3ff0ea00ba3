"""Magnetised rods in a field, against the elastica and the potential."""

import jax.numpy as jnp
import numpy as np
import pytest

import rodjax as rx
from rodjax.rods.state import at_rest

SECTION = rx.Section((1.0, 1.0, 0.8), mass=1.0, rotary_inertia=(1e-3, 1e-3, 2e-3))
ALONG = (0.0, 0.0, 1.0)


@pytest.mark.slow
def test_a_cantilever_across_a_field_is_the_elastica_of_an_end_load():
    """EI theta'' + m B cos(theta) = 0, as under an end load P = m B: Mattiasson (1981), P L^2 = 5.

    So tip and angle are those of his table, without any load.
    """
    rod = rx.straight_rod(1.0, 24, SECTION)
    magnet = rx.HardMagnetic((0.0, 0.0, 2.5), field=(2.0, 0.0, 0.0))
    scene = rx.Scene(rod, rx.Clamped(), loads=(magnet,))
    state, _ = rx.equilibrium(scene, rx.placing(scene), load_steps=4, relax=False)
    tip = state.position[-1]
    np.testing.assert_allclose(tip[0], 0.71379, atol=1e-3)
    np.testing.assert_allclose(1 - tip[2], 0.38763, atol=1e-3)


def dipole(parameters, position):
    """Field of a magnet below the origin."""
    arm = position - parameters["place"]
    distance = jnp.sqrt(jnp.sum(arm**2))
    strength = parameters["strength"]
    return (3 * arm * jnp.dot(arm, strength) / distance**5) - strength / distance**3


def test_a_field_that_varies_pulls_towards_where_it_is_stronger():
    given = {"place": jnp.asarray([0.0, 0.0, -1.0]), "strength": jnp.asarray([0.0, 0.0, 0.5])}
    rod = rx.straight_rod(0.1, 4, SECTION)
    magnet = rx.HardMagnetic((0.0, 0.0, 3.0), function=dipole, parameters=given)
    rx.Scene(rod, rx.Clamped(), loads=(magnet,))  # its energy has been compared with its wrench
    wrench = magnet.wrench(rod, at_rest(jnp.zeros(()), rod.position, rod.quaternion))
    # on the axis B = 2 p / z^3
    distance = 1.0 + rod.position[:, 2]
    moment = 3.0 * rod.node_length
    np.testing.assert_allclose(wrench[:, 2], -moment * 6 * 0.5 / distance**4, rtol=1e-12)
    np.testing.assert_allclose(wrench[:, jnp.asarray([0, 1, 3, 4, 5])], 0.0, atol=1e-15)


@pytest.mark.slow
def test_a_field_that_is_switched_on_does_work():
    rising = rx.Smooth([0.0, 0.2], [0.0, 1.0])
    magnet = rx.HardMagnetic(np.tile([[0.0, 0.0, 2.0]], (4, 1)), (1.0, 0, 0), amplitude=rising)
    scene = rx.Scene(rx.straight_rod(1.0, 4, SECTION), rx.Clamped(), loads=(magnet,))
    run = rx.rollout(scene, rx.start(scene), np.linspace(0.004, 0.2, 50))
    booked = rx.energy.ledger(scene, run)
    assert booked.work[-1] > 1e-3
    assert booked.balance_error < 1e-2
    with pytest.raises(ValueError, match=r"loads\[0\].amplitude: its schedule ends"):
        rx.adaptive_rollout(scene, run.final, 1.0)


def test_what_is_no_magnet_is_refused():
    with pytest.raises(ValueError, match="field: give the field"):
        rx.HardMagnetic(ALONG)
    with pytest.raises(ValueError, match="moment: give three components"):
        rx.HardMagnetic((0.0, 1.0), (1.0, 0.0, 0.0))
    with pytest.raises(ValueError, match=r"moment: expected \(4, 3\)"):
        load = rx.HardMagnetic(np.zeros((5, 3)), (1.0, 0.0, 0.0))
        rx.Scene(rx.straight_rod(1.0, 4, SECTION), rx.Clamped(), loads=(load,))
