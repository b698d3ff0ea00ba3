"""Curves of critical points in two parameters: cusps, and thresholds that depend on a load."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rodjax as rx

AXIS = (0.0, 0.0, 1.0)


def rod_of(stiffness):
    return rx.straight_rod(1.0, 16, rx.Section(stiffness, diameter=0.02, mass=1.0))


STRIP = rod_of((1.0, 3.0, 0.8))
ROUND = rod_of((1.0, 1.0, 0.8))


def pushed(side, thrust):
    """A clamped strip under a force at its middle and a thrust."""
    none = 0.0 * thrust
    ahead = rx.PointLoad(-1, force=rx.Constant(jnp.stack([none, none, -thrust])))
    across = rx.PointLoad(8, force=rx.Constant(jnp.stack([none, side, none])))
    return rx.Scene(STRIP, rx.Clamped(), rx.Slider(AXIS), loads=(ahead, across))


def turned(turns, pull):
    """A clamped round rod whose end is turned, and pulled."""
    turn = rx.Turn(AXIS, rx.PiecewiseLinear([-9.0, 9.0], [-18 * np.pi, 18 * np.pi]))
    ahead = rx.PointLoad(-1, force=rx.Constant(pull * jnp.asarray(AXIS)))
    return rx.Scene(ROUND, rx.Clamped(), rx.Slider(AXIS, rotation=turn), loads=(ahead,)), turns


def at(scene_of, other):
    """The scenes of the first parameter alone."""
    return lambda one: scene_of(one, jnp.asarray(other))


@pytest.mark.slow
def test_folds_of_a_pushed_strip_meet_in_a_cusp_where_the_perfect_one_buckles():
    """Both turn back there; beyond the cusp the other fold is the mirror image."""
    perfect = lambda thrust: pushed(0.0 * thrust, thrust)
    still = rx.placing(pushed(jnp.zeros(()), jnp.zeros(())))
    straight = rx.path(perfect, still, 30.0, 45.0, longest_step=0.5)
    buckled = rx.branch(perfect, straight.critical[0], (30.0, 44.0)).state(-1)
    far = -8.0 * float(np.sign(buckled.position[8, 1]))
    (fold,) = rx.path(at(pushed, 44.0), buckled, 0.0, far, modes=3).critical
    curve = rx.critical_curve(pushed, fold, 44.0, 30.0)
    assert curve.end is rx.PathEnd.START and curve.result == 0
    load = float(straight.critical[0].parameter)
    np.testing.assert_allclose(curve.cusps, [[0.0, load]], atol=1e-8)
    assert "cusp at (" in str(curve)
    assert curve.parameters[-1] == pytest.approx(-curve.parameters[0], rel=1e-8)
    # near the cusp a force goes as the power 3/2 of the thrust beyond
    beyond = curve.others - load
    near = (beyond < 0.7) & (beyond > 0.05)
    force = np.abs(curve.parameters[near]) / beyond[near] ** 1.5
    assert np.ptp(force) < 0.05 * np.mean(force)
    # points in between are folds of their own
    for i in (3, len(curve) - 4):
        again = rx.critical(at(pushed, curve.others[i]), curve.points[i])
        assert float(again.parameter) == pytest.approx(curve.parameters[i], rel=1e-8)


@pytest.mark.slow
def test_turns_at_which_a_pulled_rod_buckles():
    """From neighbour to neighbour the curve is that of `critical`, as long as both can follow."""
    straight = rx.path(at(turned, 0.0), rx.placing(turned(0.0, jnp.zeros(()))[0]), 0.0, 2.2)
    first = straight.critical[0]
    curve = rx.critical_curve(turned, first, 0.0, 30.0)
    assert curve.end is rx.PathEnd.STOP and curve.others[-1] == pytest.approx(30.0)
    assert len(curve.cusps) == 0 and np.all(np.diff(curve.parameters) > 0)
    for i in (len(curve) // 2, -1):
        found = curve.points[i]
        again = rx.critical(at(turned, curve.others[i]), found)
        assert float(again.parameter) == pytest.approx(curve.parameters[i], rel=1e-8)
        # the grid buckles a little late, in second order
        torque, pull = 2 * np.pi * 0.8 * curve.parameters[i], curve.others[i]
        assert _lacks(0.97 * torque, pull) * _lacks(torque, pull) < 0
    # a derivative of the curve is that of a critical load
    last = curve.points[-1]
    slope = jax.grad(lambda pull: rx.critical(at(turned, pull), last).parameter)(30.0)
    before = curve.parameters[-2] - curve.parameters[-1]
    chord = before / (curve.others[-2] - curve.others[-1])
    assert float(slope) == pytest.approx(chord, rel=0.05)


@pytest.mark.slow
def test_branch_points_of_bent_rods_along_their_torsional_stiffness():
    """The axis of symmetry of such a rod turns with both parameters."""

    def twisted(turns, ratio):
        own = ROUND.stiffness * jnp.stack([jnp.ones_like(ratio), jnp.ones_like(ratio), ratio])[None]
        turn = rx.Turn(AXIS, rx.PiecewiseLinear([-9.0, 9.0], [-18 * np.pi, 18 * np.pi]))
        rod = dataclasses.replace(ROUND, stiffness=own)
        return rx.Scene(rod, rx.Clamped(), rx.Slider(AXIS, rotation=turn)), turns

    def found(ratio):
        scenes = at(twisted, ratio)
        straight = rx.path(scenes, rx.placing(scenes(jnp.zeros(()))[0]), 0.0, 2.5)
        (point,) = rx.branch(scenes, straight.critical[0], (-1.4, 2.5)).critical
        return point

    first, last = found(1.0), found(1.125)
    curve = rx.critical_curve(twisted, first, 1.0, 1.125)
    assert curve.others[-1] == pytest.approx(1.125, rel=1e-12)
    assert curve.parameters[0] == pytest.approx(float(first.parameter), rel=1e-9)
    assert curve.parameters[-1] == pytest.approx(float(last.parameter), rel=1e-8)


@pytest.mark.slow
def test_a_branch_point_has_no_curve_along_an_imperfection():
    pressed = lambda thrust, side: pushed(side, thrust)
    straight = rx.path(
        at(pressed, 0.0), rx.placing(pressed(jnp.zeros(()), jnp.zeros(()))), 30.0, 45.0
    )
    with pytest.raises(rx.SimulationError) as told:
        rx.critical_curve(pressed, straight.critical[0], 0.0, 1.0)
    assert told.value.result is rx.Result.NO_BRANCH_POINT
    assert len(told.value.partial) == 1 and np.all(np.isfinite(told.value.partial.parameters))


def _lacks(torque, pull) -> float:
    """What changes sign where a straight clamped rod of unit stiffness and length buckles.

    Solutions of w'''' - i M w''' - T w'' = 0 that both ends allow.
    """
    b = np.emath.sqrt(torque**2 / 4 - pull)
    value = 2 * b * (np.cos(b) - np.cos(torque / 2)) - pull * np.sin(b)
    return float(np.real(value / (b * pull**2)))


def test_wrong_arguments_are_told():
    one = jnp.zeros(())
    start = rx.placing(turned(0.0, one)[0])
    modes = jnp.zeros((1, 17, 6))
    point = rx.CriticalPoint(
        "branch", 1.79 + one, start, modes, modes, 1 + one, start, jnp.asarray(0)
    )
    with pytest.raises((TypeError, ValueError), match="scene_of"):
        rx.critical_curve(turned(0.0, one)[0], point, 0.0, 1.0)
    with pytest.raises(ValueError, match="stop: must differ"):
        rx.critical_curve(turned, point, 1.0, 1.0)
    with pytest.raises(ValueError, match="scene_of: must return a Scene"):
        rx.critical_curve(lambda p, q: p, point, 0.0, 1.0)
    memory = dataclasses.replace(point, kind="fold")
    with pytest.raises(ValueError, match="points: "):
        rx.critical_curve(turned, memory, 0.0, 1.0, points=1)
