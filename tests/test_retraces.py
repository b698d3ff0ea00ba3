"""Numbers are traced: another one, or another node, compiles nothing anew."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rodjax.constraints.ends import Clamped, Pinned, Slider, Switched, Turn
from rodjax.dynamics import stepping
from rodjax.dynamics.consistency import start
from rodjax.dynamics.fixed_rollout import rollout
from rodjax.equations.generalized_alpha import GeneralizedAlpha
from rodjax.fitting.fit import least_squares
from rodjax.fitting.observations import Observations
from rodjax.fitting.priors import NormalPrior
from rodjax.fitting.robust import Huber
from rodjax.inputs.schedules import Constant, Function, PiecewiseLinear, PiecewiseLinearRate, Smooth
from rodjax.interactions.contact import Contact
from rodjax.interactions.contact_laws import Penalty
from rodjax.interactions.load import AbstractLoad
from rodjax.interactions.loads import (
    DistributedLoad,
    Gravity,
    LinearDrag,
    MorisonDrag,
    PointLoad,
)
from rodjax.rods.builders import straight_rod
from rodjax.rods.section import circular_section
from rodjax.scenes.scene import Scene


def spread(parameters, s, motion):
    """A user's load, of floats and whole numbers."""
    power = parameters["power"].astype(s.dtype)
    force = parameters["k"] * s[:, None] ** power - parameters["c"] * motion.velocity
    return jnp.concatenate([force, jnp.zeros_like(force)], 1)


def swing(time):
    return 0.01 * jnp.sin(time)


class Spring(AbstractLoad):
    """A user's class, of Python's floats."""

    stiffness: float

    def wrench(self, rod, motion):
        return jnp.concatenate([-self.stiffness * motion.position, 0 * motion.velocity], 1)


def scene_of(x, number=int):
    """Every kind of load, end, schedule and law, with numbers that depend on x."""
    rod = straight_rod(
        1.0 + x,
        6,
        circular_section(0.02 * (1 + x), 1e6 * (1 + x), 4e5, 1500.0),
        natural_curvature=(0.1 * x, 0.0, 0.0),
    )
    schedule = Smooth([0.0, 1.0 + x], [[0.0, 0.0, 0.0], [1e-3 * x, 0.0, 1e-3]])
    push = PiecewiseLinear([0.0, 1.0, 2.0], [[0.0] * 3, [x] * 3, [1.0] * 3])
    more = PiecewiseLinearRate([0.0, 1.0 + x], [[0.0] * 3, [x] * 3])
    loads = (
        Gravity((0.0, 0.0, -9.81 * (1 + x)), fluid_density=x),
        MorisonDrag(1000.0 * x, 1.0, 0.01, current=(x, 0.0, 0.0), added_mass_coefficient=x),
        LinearDrag(x, 0.1, 0.01 * x),
        DistributedLoad(spread, {"k": float(x), "c": 0.1, "power": number(1 + 10 * x)}),
        PointLoad(number(10 * x), push, more),
        PointLoad(-number(10 * x), Constant([x, 0.0, 0.0]), follower=True),
        Spring(float(x)),
    )
    turn = Turn((0.0, x, 1.0), Function(swing, last=100.0 + x))
    end = Switched(Slider((0.0, x, 1.0)), Pinned(), 5.0 + x)
    contact = Contact(Penalty(1e4 * (1 + x), relaxation=1e-3 * x), 6, 0.1 * (1 + x))
    return Scene(rod, Clamped(schedule, turn), end, loads, contact)


def signature(tree):
    """What a compilation depends on: the structure with what is static, shapes and types."""
    arrays, static = eqx.partition(tree, eqx.is_array)
    kinds = [(x.shape, x.dtype, x.weak_type) for x in jax.tree.leaves(arrays)]
    return jax.tree.structure(tree), kinds, jax.tree.leaves(static)


SETTINGS = [
    scene_of,
    lambda x: GeneralizedAlpha(0.5 * x, 1e-8 * (1 + x), int(10 * x)),
    lambda x: Smooth([0.0, 1.0], [0.0, x]).padded(6),
    lambda x: PiecewiseLinear(np.arange(2 + int(10 * x)), np.arange(2.0 + int(10 * x))).padded(9),
    lambda x: Observations([0.0, 1.0], [x, np.nan if x > 0.2 else 1.0], x),
    lambda x: NormalPrior(x, 1),
    Huber,
]


@pytest.mark.parametrize("make", SETTINGS)
def test_numbers_are_no_part_of_a_program(make):
    """Of Python or numpy, whole or not; nor are their types weak."""
    first = signature(make(0.1))
    for x in (0.2, np.float64(0.3), float(np.float32(0.4))):
        assert signature(make(x)) == first
    assert not any(weak for *_, weak in first[1])


@pytest.fixture(scope="module")
def count():
    """How often a step has been traced."""
    calls, original = [], stepping.advance_to

    def counted(*arguments):
        calls.append(1)
        return original(*arguments)

    patch = pytest.MonkeyPatch()
    patch.setattr(stepping, "advance_to", counted)
    yield calls
    patch.undo()


TIMES = np.array([1e-3, 2e-3, 3e-3])


@pytest.mark.slow
def test_rollout_traces_once(count):
    """With all numbers changed, of the scene, the state, the times and the method."""
    for i, x in enumerate((0.1, 0.2)):
        scene = scene_of(x)
        scene = dataclasses.replace(scene, contact=None)
        state = start(scene, time=x, angular_velocity=x * jnp.ones((7, 3)))
        method = GeneralizedAlpha(x, 1e-8 * (1 + x), 20)
        times = jnp.asarray(x + TIMES * (1 + x))
        run = rollout(scene, state, times, method, throw=False)
        assert np.all(np.isfinite(run.final.position))
        seen = len(count) if i == 0 else seen
    assert len(count) == seen


def test_a_fit_traces_once_with_all_numbers_changed():
    """Data, gaps, deviations, guesses, priors and the loss's scale."""
    traces = []

    def predict(p):
        traces.append(1)
        return p["a"] * jnp.exp(-p["k"] * jnp.linspace(0.0, 1.0, 8))

    for x in (1.0, 2.0):
        values = x * np.exp(-np.linspace(0.0, 1.0, 8))
        values[int(x)] = np.nan
        data = Observations(np.linspace(0.0, 1.0 * x, 8), values, 0.01 * x)
        priors = {"a": NormalPrior(x, 1.0), "k": None}
        guess = {"a": 0.5 * x, "k": int(x)}
        least_squares(predict, guess, data, priors=priors, robust=Huber(1.0 + x))
    assert len(traces) <= 2
