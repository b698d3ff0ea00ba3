"""Load paths stay on the branch that they lead along, and unstable ends of paths are said."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from rodjax.constraints.ends import Clamped, Free, Slider, Turn
from rodjax.equilibria.load_path import equilibrium
from rodjax.inputs.schedules import PiecewiseLinear
from rodjax.interactions.loads import PointLoad
from rodjax.measuring.energy import reactions
from rodjax.numerics.results import ModelWarning, Result
from rodjax.rods.builders import straight_rod
from rodjax.rods.section import Section
from rodjax.scenes.placing import placing
from rodjax.scenes.scene import Scene

EULER = np.pi**2 / 4
ELEMENTS = 20


def pushed(force):
    """A dead force at the tip, brought on from -1 s to 0 s."""
    return PointLoad(-1, PiecewiseLinear([-1.0, 0.0, 1.0], [(0.0, 0.0, 0.0), force, force]))


def column(thrust, crooked=0.0, side=0.0):
    """A clamped column of unit length and stiffness under a dead thrust at its tip."""
    rod = straight_rod(
        1.0, ELEMENTS, Section((1.0, 1.0, 0.8), mass=1.0), natural_curvature=(crooked, 0.0, 0.0)
    )
    return Scene(rod, Clamped(), Free(), (pushed((side, 0.0, -thrust)),))


def elastica(thrust, crooked=0.0):
    """Height of the tip of a column bent by a thrust: its ODE integrated, shot at the free end."""

    def ended(moment):
        slope = lambda _, y: [y[1], -thrust * np.sin(y[0]), np.cos(y[0])]
        return solve_ivp(slope, (0, 1), [0, moment, 0], rtol=1e-10, atol=1e-12).y[:, -1]

    # the largest root of the end's moment: the column bent by a quarter of a wave
    moments = np.linspace(7.0, 0.3, 68)
    moment = [ended(moment)[1] - crooked for moment in moments]
    k = np.flatnonzero(np.diff(np.sign(moment)))[0]
    return ended(brentq(lambda m: ended(m)[1] - crooked, moments[k + 1], moments[k]))[2]


@pytest.mark.slow
@pytest.mark.parametrize("thrust", [1.5, 3.0])
@pytest.mark.parametrize("crooked", [1e-1, 1e-3])
@pytest.mark.parametrize("load_steps", [1, 10])
def test_a_crooked_column_ends_bent(thrust, crooked, load_steps):
    scene = column(thrust * EULER, crooked)
    state, info = equilibrium(scene, placing(scene), load_steps=load_steps)
    assert info.result == Result.SUCCESS and int(info.unstable) == 0
    height = elastica(thrust * EULER, crooked)
    assert float(state.position[-1, 2]) == pytest.approx(height, abs=5e-3)
    assert float(jnp.max(jnp.abs(state.position[:, :2]))) > 0.3


@pytest.mark.slow
def test_a_perfect_column_stays_straight_and_says_so():
    scene = column(1.5 * EULER)
    with pytest.warns(ModelWarning, match=r"2 unstable mode\(s\) that nothing in the scene"):
        state, info = equilibrium(scene, placing(scene))
    assert int(info.unstable) == 2
    np.testing.assert_allclose(state.position, scene.rod.position, atol=1e-12)
    # knowingly: no warning
    knowing, info = equilibrium(scene, placing(scene), relax=False)
    assert int(info.unstable) == 2 and info.result == Result.SUCCESS
    # and with less than Euler's load nothing is unstable
    _, info = equilibrium(column(0.99 * EULER), placing(scene))
    assert int(info.unstable) == 0


@pytest.mark.parametrize("thrust", [1.05, 1.5, 2.5, 4.0])
def test_a_perfect_column_relaxes_to_the_elastica(thrust):
    scene = column(thrust * EULER)
    state, info = equilibrium(scene, placing(scene), relax=True)
    assert int(info.unstable) == 0 and 0 < int(info.descent) < 100
    height = elastica(thrust * EULER)
    assert float(state.position[-1, 2]) == pytest.approx(height, abs=5e-3)


def test_unloaded_it_is_straight_again():
    """Back along the load, past Euler's, from the bent branch; the state is the start's."""
    scene = column(2 * EULER, 1e-2)
    unloaded, _ = equilibrium(scene, placing(scene, -1.0))
    bent, _ = equilibrium(scene, placing(scene, -1.0), time=0.0)
    assert float(bent.position[-1, 2]) < 0.5
    back, info = equilibrium(scene, bent, time=-1.0)
    np.testing.assert_allclose(back.position, unloaded.position, atol=1e-8)
    assert float(back.time) == -1.0 and int(info.unstable) == 0


@pytest.mark.slow
@pytest.mark.parametrize("imperfection", [1e-1, 1e-2])
def test_a_twisted_rod_does_not_stay_on_its_axis_beyond_the_critical_turns(imperfection):
    """Between a clamp and a slider: 1.788 turns without tension, fewer with an imperfection.

    It jumps into a loop, which takes one of the turns: the torque is that of the rest.
    """
    stiffness, turns = 0.8, 1.9
    section = Section((1.0, 1.0, stiffness), mass=1.0)
    rod = straight_rod(1.0, ELEMENTS, section, natural_curvature=(imperfection, 0.0, 0.0))
    turn = Turn((0, 0, 1), PiecewiseLinear([0.0, 1.0], [0.0, 2 * np.pi * turns]))
    scene = Scene(rod, Clamped(), Slider((0, 0, 1), rotation=turn))
    ended, info = equilibrium(scene, placing(scene), time=1.0, throw=False)
    assert info.result == Result.NEWTON_FAILED and np.all(np.isnan(ended.position))
    assert 1.65 < turns * float(info.reached) < 1.788
    looped, info = equilibrium(scene, placing(scene), time=1.0, relax=True)
    assert int(info.unstable) == 0
    held = reactions(scene, looped)
    np.testing.assert_allclose(held.force[1, 2], 0.0, atol=1e-8)
    torque = 2 * np.pi * stiffness * (turns - 1)
    assert float(held.torque[1, 2]) == pytest.approx(torque, rel=0.06)
    assert abs(float(looped.position[-1, 2])) < 0.02


@pytest.mark.parametrize("side", [1e-2, 1e-3])
def test_a_strip_under_a_tip_force_buckles_sideways(side):
    """Prandtl's strip: 4.0126 sqrt(A C)/L^2 at the tip."""
    critical = 4.0126 * np.sqrt(0.7)
    section = Section((1.0, 100.0, 0.7), mass=1.0)
    rod = straight_rod(1.0, ELEMENTS, section, direction=(1, 0, 0), first_director=(0, 0, 1))
    load = lambda factor, side: pushed((0.0, side, -factor * critical))
    scene = Scene(rod, Clamped(), Free(), (load(1.1, side),))
    state, info = equilibrium(scene, placing(scene))
    assert int(info.unstable) == 0
    assert float(state.position[-1, 1]) > 0.2
    upright = eqx.tree_at(lambda s: s.loads, scene, (load(1.1, 0.0),))
    with pytest.warns(ModelWarning, match=r"1 unstable mode\(s\)"):
        equilibrium(upright, placing(scene))
