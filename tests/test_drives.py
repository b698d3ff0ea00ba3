"""Whole turns are never lost: a drive is followed, or a code says that the steps are too large."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import UNIT_SECTION, slow

import rodjax as rx
from rodjax import energy, measures
from rodjax.constraints.ends import Clamped, Free, Slider, Switched, Turn
from rodjax.dynamics.adaptive import adaptive_rollout
from rodjax.dynamics.consistency import start
from rodjax.dynamics.fixed_rollout import rollout
from rodjax.dynamics.step_control import StepControl
from rodjax.equations.generalized_alpha import GeneralizedAlpha
from rodjax.inputs.schedules import Function, PiecewiseLinear
from rodjax.interactions.contact import Contact
from rodjax.interactions.contact_laws import Barrier
from rodjax.interactions.loads import LinearDrag
from rodjax.numerics.results import Result, SimulationError
from rodjax.rods.builders import straight_rod
from rodjax.scenes.scene import Scene

# many turns in a straight rod are what these tests are about
pytestmark = pytest.mark.filterwarnings("ignore:the rod ends straight")

UP = (0.0, 0.0, 1.0)
DRAG = (LinearDrag(1.0, 1.0, 1e-2),)
ROD = straight_rod(1.0, 12, UNIT_SECTION)


def turned(turns, axis=UP):
    """So many turns in a unit of time, at constant speed."""
    return Turn(axis, PiecewiseLinear([0.0, 1.0], [0.0, 2 * np.pi * turns]))


def shaft(turns, **changes):
    """A straight rod whose last end is turned about its tangent."""
    scene = Scene(ROD, Clamped(), Slider(UP, rotation=turned(turns)), loads=DRAG)
    return dataclasses.replace(scene, **changes)


def run(scene, steps, until=1.0, **options):
    """The motion in equal steps."""
    times = jnp.linspace(0.0, until, steps + 1)[1:]
    return rollout(scene, start(scene), times, throw=False, **options)


@pytest.mark.slow
@pytest.mark.parametrize("turns", [2.0, -2.0, 4.0, 1.9, 2.3, 1.0, 0.5, -0.5, 20.0])
def test_turns_of_a_step_are_not_counted_modulo_two(turns):
    """So many turns a step, at an end that is about to have turned four steps."""
    found = run(shaft(4 * turns), 4)
    assert int(found.result) == Result.DRIVE_TOO_FAST
    assert int(found.infos.iterations[0]) == 0  # compared before solving


FAST = {
    "first end": shaft(0.0, first_end=Clamped(rotation=turned(8.0))),
    "both ends": shaft(8.0, first_end=Clamped(rotation=turned(-8.0))),
    "the whole rod": shaft(0.0, first_end=Clamped(rotation=turned(8.0)), last_end=Free()),
    "across": shaft(0.0, first_end=Clamped(rotation=turned(8.0, (1.0, 0, 0))), last_end=Free()),
    "after a switch": shaft(0.0, last_end=Switched(Free(), Slider(UP), 0.5, rotation=turned(8.0))),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["after a switch", *map(slow, list(FAST)[:-1])])
def test_no_drive_is_exempt(name):
    found = run(FAST[name], 4)
    assert int(found.result) == Result.DRIVE_TOO_FAST
    # until the drive engages the motion is there
    ended = np.asarray(found.infos.result)
    assert np.all(ended[: 2 if name == "after a switch" else 0] == Result.SUCCESS)


def test_the_code_comes_out_of_traced_code():
    times = jnp.linspace(0.0, 1.0, 5)[1:]

    @jax.jit
    def code(turns):
        scene = shaft(turns)
        return rollout(scene, start(scene), times, throw=False).result

    assert int(code(1.0)) == Result.SUCCESS
    assert int(code(8.0)) == Result.DRIVE_TOO_FAST
    with pytest.raises(SimulationError, match="half a turn or more in one step"):
        rollout(shaft(8.0), start(shaft(8.0)), times)


@pytest.mark.slow
def test_adaptive_steps_are_cut_to_what_the_drive_allows():
    scene = shaft(8.0)
    long = StepControl(first_step=0.5, max_step=0.5, relative=10.0, twisting=100.0)
    found = adaptive_rollout(scene, start(scene), 1.0, control=long)
    assert float(np.max(np.diff(found.times))) < 1 / 16
    assert int(found.rejected) > 0
    assert float(measures.twist(found.final)) == pytest.approx(8.0, abs=1e-9)


@pytest.mark.slow
def test_twist_of_elements_beyond_half_a_turn():
    """12 elements hold 8 turns, 2/3 of one each, with the right twist and torque."""
    scene = shaft(8.0)
    found = run(scene, 40)
    assert int(found.result) == Result.SUCCESS
    final = found.final
    assert float(measures.twist(final)) == pytest.approx(8.0, abs=1e-9)
    assert float(measures.twist_eq15(ROD, final)) == pytest.approx(8.0, abs=1e-9)
    # the last turns have not spread along the rod, whose fastest torsion wave takes 0.07
    torque = energy.reactions(scene, final).torque[1, 2]
    assert float(torque) == pytest.approx(0.8 * 2 * np.pi * 8.0, rel=0.1)
    linking = measures.linking(scene, found)
    np.testing.assert_allclose(linking.turns, 8.0 * found.times, atol=1e-12)
    np.testing.assert_allclose(linking.error, 0.0, atol=1e-9)


@pytest.mark.slow
def test_the_alarm_for_passages_lets_a_straight_rod_be():
    scene = shaft(8.0, contact=Contact(Barrier(1e9), segments=12, cutoff=0.15))
    found = run(scene, 40)
    assert int(found.result) == Result.SUCCESS
    assert float(measures.twist(found.final)) == pytest.approx(8.0, abs=1e-9)


def _hinged(angle):
    """Two rods in line, the second turned about the first's tangent by a motor between them."""
    other = straight_rod(1.0, 4, UNIT_SECTION, origin=(0.0, 0.0, 1.0))
    rods = straight_rod(1.0, 4, UNIT_SECTION), other
    motor = rx.Hinge(rx.Point(-1), rx.Point(0, rod=1), axis=UP, angle=angle)
    return Scene(rods=rods, first_end=(Clamped(), Free()), joints=(motor,), loads=DRAG)


@pytest.mark.slow
def test_an_end_that_is_not_where_its_schedule_puts_it():
    """A function that reads what changes: the compiled steps know its first value only."""
    speed = [1.0]
    angle = lambda t: speed[0] * t
    push = Function(lambda t: 0.1 * speed[0] * t * jnp.asarray([0.0, 0.0, 1.0]))
    drives = {
        "rotation": shaft(0.0, last_end=Slider(UP, rotation=Turn(UP, Function(angle)))),
        "displacement": shaft(0.0, first_end=Clamped(push)),
        "joint": _hinged(Function(angle)),
    }
    for scene in drives.values():
        assert int(run(scene, 4).result) == Result.SUCCESS
    speed[0] = 2.0
    for scene in drives.values():
        assert int(run(scene, 4).result) == Result.DRIVE_MISSED
    with pytest.raises(SimulationError, match="not where its schedule puts it"):
        run_times = jnp.linspace(0.0, 1.0, 5)[1:]
        rollout(drives["rotation"], start(drives["rotation"]), run_times, GeneralizedAlpha())


@pytest.mark.slow
def test_ends_are_followed_across_switches_and_saves():
    """Driven while held, then let go: what it does afterwards does not count as astray."""
    last = Switched(Slider(UP), Free(), 0.25, rotation=turned(0.5))
    found = run(shaft(0.0, last_end=last), 16, save_every=4)
    assert int(found.result) == Result.SUCCESS
