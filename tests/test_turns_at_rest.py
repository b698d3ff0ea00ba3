"""What ends turn by along a load path: no turn is lost, and what cannot be held is refused."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import slow

from rodjax import measures
from rodjax.constraints.ends import Clamped, Free, Slider, Turn
from rodjax.equilibria.load_path import equilibrium as stable_equilibrium
from rodjax.inputs.schedules import Constant, PiecewiseLinear
from rodjax.interactions.loads import PointLoad
from rodjax.measuring.energy import reactions
from rodjax.numerics.results import ModelWarning, Result
from rodjax.rods.builders import straight_rod
from rodjax.rods.section import Section
from rodjax.scenes.placing import placing
from rodjax.scenes.scene import Scene

C = 0.7
ELEMENTS = 40
SECTION = Section((1.0, 1.0, C), mass=1.0)
# straight rods that a real one would leave, beyond 1.8 turns
equilibrium = functools.partial(stable_equilibrium, relax=False)


def turned(first, last, knots=(0.0, 0.4, 0.6, 1.0), part=(0.0, 0.4, 0.6, 1.0), elements=ELEMENTS):
    """A straight rod whose ends turn about its axis by so many turns; the last may slide."""
    turn = lambda turns: Turn((0, 0, 1), PiecewiseLinear(knots, 2 * np.pi * turns * np.array(part)))
    rod = straight_rod(1.0, elements, SECTION)
    return Scene(rod, Clamped(rotation=turn(first)), Slider((0, 0, 1), rotation=turn(last)))


@jax.jit
def torque(scene, state):
    """Torque on the last end, its twist by Eq. (15) and as measured [turns]."""
    found = reactions(scene, state).torque[1, 2]
    return found, measures.twist_eq15(scene.rod, state), measures.twist(state)


@pytest.mark.parametrize("load_steps", [slow(1), slow(3), 10, slow(13)])
@pytest.mark.parametrize(
    "first, last",
    [(0, 20), (-20, 0), (0, -18), (-10, 10), (10, 10), (0, 0.5), (0, 1), (2, 1.5), (0, 15.25)],
)
def test_no_turn_is_lost(first, last, load_steps):
    scene = turned(first, last)
    state, info = equilibrium(scene, placing(scene), time=1.0, load_steps=load_steps)
    applied = last - first
    found, *twists = torque(scene, state)
    np.testing.assert_allclose(found, C * 2 * np.pi * applied, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(twists[0], applied, rtol=1e-9, atol=1e-9)
    if abs(applied) < 0.5 * ELEMENTS:
        np.testing.assert_allclose(twists[1], applied, rtol=1e-9, atol=1e-9)
    # each end by a quarter of a turn a step at most
    assert int(info.load_steps) >= 4 * max(abs(first), abs(last))


@pytest.mark.parametrize("turns", [3, -10])
def test_a_straight_rod_that_nothing_excites_keeps_its_axis_and_says_so(turns):
    """Far beyond its critical turns, 1.8: unstable modes are counted, not fallen for."""
    scene = turned(0, turns)
    with pytest.warns(ModelWarning, match="unstable mode"):
        state, info = stable_equilibrium(scene, placing(scene), time=1.0)
    found, *twists = torque(scene, state)
    np.testing.assert_allclose(found, C * 2 * np.pi * turns, rtol=1e-9)
    np.testing.assert_allclose(twists, turns, rtol=1e-9)
    # two become unstable at each root of tan(x) = x, where x is half the torque (A = L = 1)
    roots = np.pi * (np.arange(1, 20) + 0.5)
    roots = roots - 1 / roots  # to 3e-3
    assert int(info.unstable) == 2 * np.sum(roots < 0.5 * C * 2 * np.pi * abs(turns))


def test_turns_are_taken_back():
    scene = turned(0, 20)
    state, _ = equilibrium(scene, placing(scene), time=1.0)
    again, _ = equilibrium(scene, state, time=0.1, load_steps=1)
    np.testing.assert_allclose(torque(scene, again)[0], C * 2 * np.pi * 2, rtol=1e-9)
    assert float(again.time) == pytest.approx(0.1)
    # to and fro within one path: what counts is where the schedule ends
    scene = turned(0, 20, part=(0.0, 1.0, 0.5, 0.25))
    state, _ = equilibrium(scene, placing(scene), time=1.0)
    np.testing.assert_allclose(torque(scene, state)[0], C * 2 * np.pi * 5, rtol=1e-9)


def test_more_turns_than_elements_hold_are_refused():
    scene = turned(0, 40)
    state, info = equilibrium(scene, placing(scene), time=1.0, throw=False)
    assert info.result == Result.ROTATION_TOO_LARGE
    # 0.9 of a turn an element
    assert float(info.reached) == pytest.approx(0.9, abs=2e-3)
    assert np.all(np.isnan(state.position))


def test_a_turn_at_once_is_refused():
    scene = turned(0, 3, knots=(0.0, 0.5, 0.5 + 1e-9, 1.0), part=(0.0, 0.0, 1.0, 1.0))
    _, info = equilibrium(scene, placing(scene), time=1.0, throw=False)
    assert info.result == Result.DRIVE_TOO_FAST
    assert float(info.reached) <= 0.5
    # a jump that can be told from fewer turns is followed
    scene = turned(0, 0.2, knots=(0.0, 0.5, 0.5 + 1e-9, 1.0), part=(0.0, 0.0, 1.0, 1.0))
    state, _ = equilibrium(scene, placing(scene), time=1.0)
    np.testing.assert_allclose(torque(scene, state)[0], C * 2 * np.pi * 0.2, rtol=1e-9)


@pytest.mark.slow
def test_a_cantilever_turned_over_comes_back():
    """Seven turns of the clamp about an axis across the rod, with a force that does not turn."""
    rod = straight_rod(1.0, 8, SECTION)
    turn = Turn((1, 0, 0), PiecewiseLinear([0.0, 1.0], [0.0, 14 * np.pi]))
    load = PointLoad(-1, Constant((0.0, 0.0, 0.5)))
    scene = Scene(rod, Clamped(rotation=turn), Free(), loads=(load,))
    state, info = equilibrium(scene, placing(scene), time=1.0)
    np.testing.assert_allclose(state.position, rod.position, atol=1e-9)
    # 14 sign changes of the quaternions: turned seven times
    np.testing.assert_allclose(state.quaternion, -rod.quaternion, atol=1e-9)
    assert int(info.load_steps) >= 28


@pytest.mark.slow
def test_derivative_by_the_turns():
    """Torque by turns: C 2 pi / L, mapped and differentiated in a caller's program too."""

    def found(turns):
        base = turned(0, 1)
        schedule = PiecewiseLinear([0.0, 0.4, 0.6, 1.0], 2 * jnp.pi * turns * base_part)
        scene = Scene(
            base.rod, base.first_end, Slider((0, 0, 1), rotation=Turn((0, 0, 1), schedule))
        )
        state, info = equilibrium(scene, placing(scene), time=1.0, throw=False)
        return C * measures.twist_eq15(scene.rod, state) * 2 * jnp.pi, info.result

    base_part = jnp.asarray([0.0, 0.4, 0.6, 1.0])
    slopes, codes = jax.jit(jax.vmap(jax.grad(found, has_aux=True)))(jnp.asarray([3.0, 20.0, 40.0]))
    np.testing.assert_allclose(slopes[:2], 2 * np.pi * C, rtol=1e-9)
    np.testing.assert_array_equal(codes, [0, 0, Result.ROTATION_TOO_LARGE])
    assert np.isnan(slopes[2])
