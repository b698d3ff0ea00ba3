"""Cables hung from a pin or between two: loads hold what the ends leave free; the spin is kept."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq

from rodjax.constraints.ends import Free, Pinned
from rodjax.equilibria.load_path import equilibrium
from rodjax.inputs.schedules import Constant
from rodjax.interactions.loads import Gravity, MorisonDrag, PointLoad
from rodjax.measuring.energy import reactions
from rodjax.numerics.results import ModelWarning, Result
from rodjax.rods.builders import curved_rod, straight_rod
from rodjax.rods.section import Section, circular_section
from rodjax.scenes.placing import placing
from rodjax.scenes.scene import Scene

WEIGHT = 9.81
ELEMENTS = 20


def hung(direction=(0, 0, -1), stiffness=(1e-5, 1e-5, 1e-5), pull=(1.0, 0.0, 0.0), torque=0.0):
    """A cable of unit length and mass on a pin; force and axial torque on its free end."""
    rod = straight_rod(1.0, ELEMENTS, Section(stiffness, mass=1.0), direction=direction)
    loads = (
        Gravity((0.0, 0.0, -WEIGHT)),
        PointLoad(-1, Constant(pull)),
        PointLoad(-1, None, Constant((0.0, 0.0, torque)), follower=True),
    )
    return Scene(rod, Pinned(), Free(), loads)


def catenary(pull):
    """Tip of a chain hung from one end and pulled sideways at the other."""
    vertical = np.hypot(pull, WEIGHT) - pull
    return np.array([pull / WEIGHT * np.arcsinh(WEIGHT / pull), 0.0, -vertical / WEIGHT])


@pytest.mark.slow
def test_a_chain_pulled_sideways():
    scene = hung()
    state, info = equilibrium(scene, placing(scene))
    assert int(info.unstable) == 0
    np.testing.assert_allclose(state.position[-1], catenary(1.0), atol=2e-3)
    held = reactions(scene, state)
    np.testing.assert_allclose(held.force[0], [-1.0, 0.0, WEIGHT], atol=1e-8)
    np.testing.assert_allclose(held.torque[0], 0.0, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("direction", [(1, 0, 0), (1, 1, 1)])
def test_it_swings_to_where_it_hangs(direction):
    scene = hung(direction)
    state, info = equilibrium(scene, placing(scene))
    assert int(info.unstable) == 0
    np.testing.assert_allclose(state.position[-1], catenary(1.0), atol=2e-3)


@pytest.mark.slow
def test_upside_down_it_is_unstable():
    scene = hung((0, 0, 1), stiffness=(1.0, 1.0, 1.0), pull=(0.0, 0.0, 0.0))
    with pytest.warns(ModelWarning, match=r"2 unstable mode\(s\)"):
        equilibrium(scene, placing(scene))
    state, info = equilibrium(scene, placing(scene), relax=True)
    assert int(info.unstable) == 0
    np.testing.assert_allclose(state.position[-1], [0.0, 0.0, -1.0], atol=1e-8)


@pytest.mark.slow
def test_an_uneven_rod_turns_to_its_soft_side():
    """A spin that costs energy is not held: no torque is left at the pin."""
    scene = hung(stiffness=(0.05, 0.2, 0.1), pull=(1.0, 2.0, 0.0))
    state, info = equilibrium(scene, placing(scene))
    assert int(info.unstable) == 0
    np.testing.assert_allclose(reactions(scene, state).torque[0], 0.0, atol=1e-7)
    # the plane of bending is that of the force; the rod bends about its first director
    across = np.cross([0, 0, 1], [1.0, 2.0, 0.0]) / np.sqrt(5.0)
    np.testing.assert_allclose(state.position @ across, 0.0, atol=1e-6)


@pytest.mark.slow
def test_derivative_by_the_pull():
    def tip(pull):
        scene = hung()
        pulled = eqx.tree_at(lambda s: s.loads[1].force.value, scene, jnp.stack([pull, 0.0, 0.0]))
        return equilibrium(pulled, placing(scene), throw=False)[0].position[-1]

    pull, h = jnp.asarray(1.0), 1e-5
    slope = (tip(pull + h) - tip(pull - h)) / (2 * h)
    np.testing.assert_allclose(jax.jvp(tip, (pull,), (jnp.ones(()),))[1], slope, atol=1e-7)


@pytest.mark.slow
def test_a_torque_that_nothing_balances_fails():
    scene = hung(torque=1e-4)
    _, info = equilibrium(scene, placing(scene), throw=False)
    assert info.result != Result.SUCCESS


@pytest.mark.slow
def test_a_cable_in_a_current_streams_at_its_critical_angle():
    """Straight, at a from the vertical: w sin(a) = rho C_n D U^2 cos(a)^2 / 2 across it."""
    diameter, speed, water, steel, across = 0.02, 1.2, 1000.0, 2500.0, 1.1
    section = circular_section(diameter, 2e6, 2e6 / 3, steel)
    rod = straight_rod(20.0, ELEMENTS, section, direction=(0, 0, -1))
    drag = MorisonDrag(water, across, 0.02, current=(-speed, 0, 0), added_mass_coefficient=1.0)
    scene = Scene(rod, Pinned(), Free(), (Gravity((0, 0, -WEIGHT), fluid_density=water), drag))
    state, info = equilibrium(scene, placing(scene))
    weight = (steel - water) * np.pi * diameter**2 / 4 * WEIGHT
    flow = 0.5 * water * across * diameter * speed**2
    angle = brentq(lambda a: weight * np.sin(a) - flow * np.cos(a) ** 2, 0, 1.57)
    tip = 20.0 * np.array([-np.sin(angle), 0.0, -np.cos(angle)])
    np.testing.assert_allclose(state.position[-1], tip, atol=1e-6)
    assert int(info.unstable) == 0


@pytest.mark.slow
def test_a_catenary_between_two_pins():
    """Span d of a chain of length L: d = 2 H/w asinh(w L / 2 H)."""
    bend = 1.2
    arc = lambda s: np.array([np.sin(bend * (s - 0.5)), 0.0, -np.cos(bend * (s - 0.5))]) / bend
    rod = curved_rod(arc, 1.0, ELEMENTS, Section((1e-5, 1e-5, 1e-5), mass=1.0))
    scene = Scene(rod, Pinned(), Pinned(), (Gravity((0.0, 0.0, -WEIGHT)),))
    state, info = equilibrium(scene, placing(scene))
    span = float(jnp.linalg.norm(rod.position[-1] - rod.position[0]))
    pull = brentq(lambda h: 2 * h / WEIGHT * np.arcsinh(WEIGHT / 2 / h) - span, 1e-2, 1e2)
    held = reactions(scene, state).force
    np.testing.assert_allclose(held[:, 0], [-pull, pull], rtol=5e-3)
    np.testing.assert_allclose(held[:, 2], WEIGHT / 2, rtol=1e-8)
    assert int(info.unstable) == 0
