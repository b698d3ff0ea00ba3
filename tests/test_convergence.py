"""Observed orders of convergence in time and in space, by regression over refinements.

Errors are differences of successive refinements, so that no reference solution enters. The drives
are smooth to high order at the start: a quintic step starts with a jump of the jerk, which excites
waves that are shorter than a coarse step.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import driven_scene, final_state, order_of, slow

from rodjax.constraints.ends import Clamped, Free, Slider, Turn
from rodjax.dynamics.consistency import start
from rodjax.dynamics.stepping import step
from rodjax.equations.generalized_alpha import GeneralizedAlpha
from rodjax.inputs.schedules import Function
from rodjax.interactions.loads import Gravity, LinearDrag, MorisonDrag
from rodjax.rods.builders import straight_rod
from rodjax.rods.section import Section
from rodjax.scenes.scene import Scene

FIELDS = ("position", "quaternion", "rate", "force")
DRAG = (MorisonDrag(1.0, 2.0, 0.5),)
STIFFNESS, ROTARY = (1.0, 1.3, 0.8), (0.02, 0.02, 0.04)
SECTIONS = {
    "paper": (Section(STIFFNESS, mass=1.0, rotary_inertia=ROTARY, diameter=0.1), DRAG),
    "extensible": (
        Section(
            STIFFNESS,
            mass=1.0,
            rotary_inertia=ROTARY,
            compliance=(0.01, 0.01, 0.005),
            diameter=0.1,
        ),
        DRAG,
    ),
    "no rotary inertia": (Section(STIFFNESS, mass=1.0, diameter=0.1), DRAG),
    "no inertia": (Section(STIFFNESS), (LinearDrag(1.0, 0.5, 0.05),)),
}


def shift(time):
    return jnp.sin(1.5 * time) ** 6 * jnp.asarray([0.4, -0.2, 0.8])


def turn(time):
    return 4 * jnp.sin(1.5 * time) ** 6


def driven(elements, kind):
    """A clamp that moves and turns, a slider, drag; the rod is bent and twisted in space."""
    section, loads = SECTIONS[kind]
    rod = straight_rod(1.0, elements, section, natural_curvature=(0.3, 0.1, 0.0))
    first = Clamped(Function(shift), Turn((0.0, 0.0, 1.0), Function(turn)))
    return Scene(rod, first, Slider((0.0, 0.0, 1.0)), loads)


def orders(states, sizes):
    """Order of every field from states at successively halved sizes."""
    found = {}
    for name in FIELDS:
        values = [np.asarray(getattr(state, name)) for state in states]
        differences = [np.max(np.abs(a - b)) for a, b in zip(values, values[1:], strict=False)]
        found[name] = order_of(sizes[:-1], differences)
    return found


def assert_second_order(found):
    assert found == {name: pytest.approx(2.0, abs=0.1) for name in found}, found


# Time

COUNTS = 50 * 2 ** np.arange(5)
# At rho = 0 the next order of the error, that of the damping, is as large as the second with few
# steps (the force's order rises as 1.1, 1.6, 1.8, 1.92, 1.98). With rho near 1 many steps end in
# round-off instead, which forces feel as 1/dt^2 (1e-7 of theirs with 1600 steps at 0.95).
MANY = 5 * COUNTS


@pytest.mark.slow
@pytest.mark.parametrize(
    "kind",
    [
        "paper",
        *map(slow, ("no inertia", "extensible", "no rotary inertia")),
    ],
)
def test_order_in_time(kind):
    scene = driven(6, kind)
    state = start(scene)
    for rho in (0.0, 0.5, 0.8, 0.95):
        method = GeneralizedAlpha(rho, tolerance=1e-13)
        counts = MANY if rho == 0 else COUNTS
        states = [final_state(scene, state, 0.4, count, method) for count in counts]
        assert_second_order(orders(states, 1 / counts))


def released():
    """Out of equilibrium at t = 0: without consistent accelerations this is first order."""
    section = Section(STIFFNESS, mass=1.0, rotary_inertia=ROTARY)
    rod = straight_rod(1.0, 6, section, natural_curvature=(0.3, 0.1, 0.0))
    return Scene(rod, Clamped(), Free(), (Gravity((0.0, -3.0, 2.0)),))


def pulled_away():
    """The same, from a clamp whose rate and acceleration change from the start on."""
    section = Section(STIFFNESS, mass=1.0, rotary_inertia=ROTARY, diameter=0.1)
    rod = straight_rod(1.0, 6, section, natural_curvature=(0.3, 0.1, 0.0))
    shift = Function(lambda t: jnp.sin(2 * t + 0.5) * jnp.asarray([0.1, 0.05, 0.02]))
    first = Clamped(shift, Turn((0.0, 0.0, 1.0), Function(lambda t: jnp.sin(3 * t + 0.3))))
    return Scene(rod, first, Free(), (Gravity((0.0, -3.0, 2.0)), *DRAG))


def driven_off():
    """From rest by quintic steps, whose third derivative jumps at t = 0."""
    return driven_scene(6, Section(STIFFNESS, mass=1.0, rotary_inertia=ROTARY, diameter=0.1))


@pytest.mark.slow
@pytest.mark.parametrize("make", [released, *map(slow, (pulled_away, driven_off))])
def test_every_step_from_the_first_on_is_second_order(make):
    """The largest error of all steps: a force that starts at first order shows in the first."""
    scene = make()
    first, one, counts = start(scene), eqx.filter_jit(step), 25 * 2 ** np.arange(5)
    for rho in (0.0, 0.5, 0.8):
        method, runs = GeneralizedAlpha(rho, tolerance=1e-13), []
        for count in counts:
            states = [first]
            for i in range(count):
                after, info = one(scene, states[-1], jnp.asarray(0.05 * (i + 1) / count), method)
                assert int(info.result) == 0
                states.append(after)
            runs.append({name: np.stack([getattr(s, name) for s in states]) for name in FIELDS})
        found = {}
        for name in FIELDS:
            pairs = zip(runs, runs[1:], strict=False)
            errors = [np.max(np.abs(a[name] - b[name][::2])) for a, b in pairs]
            found[name] = order_of(1 / counts[:-1], errors)
        assert_second_order(found)


# Space


@pytest.mark.slow
@pytest.mark.parametrize("kind", SECTIONS)
def test_order_in_space(kind):
    sizes = 1 / np.array([8, 16, 32, 64, 128])
    method, states = GeneralizedAlpha(0.8, tolerance=1e-12), []
    for h in sizes:
        scene = driven(round(1 / h), kind)
        fine = final_state(scene, start(scene), 0.8, 400, method)
        skip = round(sizes[0] / h)
        states.append(
            {
                "position": fine.position[::skip],
                "rate": fine.rate[::skip],
                # of an element: its mean over the two at a node, second order at that node
                "force": 0.5 * (fine.force[:-1] + fine.force[1:])[skip - 1 :: skip],
            }
        )
    found = {}
    for name in states[0]:
        pairs = zip(states, states[1:], strict=False)
        differences = [float(jnp.max(jnp.abs(a[name] - b[name]))) for a, b in pairs]
        found[name] = order_of(sizes[:-1], differences)
    assert_second_order(found)
