"""Small scenes and comparisons shared by the tests of the core modules."""

import dataclasses
import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from rodjax import rotations
from rodjax.constraints.ends import Clamped, Slider, Switched, Turn
from rodjax.dynamics.run import Run
from rodjax.dynamics.stepping import no_info, prepare, step
from rodjax.equations.generalized_alpha import GeneralizedAlpha
from rodjax.inputs.schedules import Smooth
from rodjax.interactions import contact_laws as laws
from rodjax.interactions.contact import Contact
from rodjax.interactions.contact_law import PairProperties
from rodjax.interactions.loads import MorisonDrag
from rodjax.rods.builders import curved_rod, straight_rod
from rodjax.rods.rod import Rod
from rodjax.rods.section import Section, circular_section
from rodjax.rods.state import State
from rodjax.rods.strains import strains
from rodjax.scenes.placing import placing
from rodjax.scenes.scene import Scene

UNIT_SECTION = Section(
    stiffness=(1.0, 1.3, 0.8), mass=1.0, rotary_inertia=(2e-3, 2e-3, 4e-3), diameter=0.1, area=8e-3
)
"""A section in units of the rod's length, bending stiffness and mass."""

PRECISE = GeneralizedAlpha(0.8, tolerance=1e-12)
UP = (0.0, 0.0, 1.0)
ARC = lambda s: np.array([1 - np.cos(s), 0.0, np.sin(s)])


def slow(value):
    """One of a test's parameters, for the slow run."""
    return pytest.param(value, marks=pytest.mark.slow)


def primitives(jaxpr):
    """Every equation of a traced program, those of loops and branches among them."""
    for equation in jaxpr.eqns:
        yield equation
        inner = lambda leaf: hasattr(leaf, "jaxpr") or hasattr(leaf, "eqns")
        for leaf in jax.tree.leaves(list(equation.params.values()), is_leaf=inner):
            if inner(leaf):
                yield from primitives(getattr(leaf, "jaxpr", leaf))


def time(value) -> jax.Array:
    """A time as an array, which no second value makes a jitted function be traced again for."""
    return jnp.asarray(value, float)


def random_arrays(seed: int, *shapes: tuple[int, ...]) -> list[jax.Array]:
    """Standard normal arrays."""
    generator = np.random.default_rng(seed)
    return [jnp.asarray(generator.normal(size=shape)) for shape in shapes]


def random_configuration(rod: Rod, seed: int, size: float = 0.3):
    """Positions, frames and internal forces at a distance `size` from the rod's placing."""
    n = rod.elements
    shift, turn, force = random_arrays(seed, (n + 1, 3), (n + 1, 3), (n, 3))
    frames = rotations.multiply(rod.quaternion, rotations.exponential(size * turn))
    return rod.position + size * jnp.mean(rod.length) * shift, frames, force


def relative_difference(value, expected) -> float:
    """Largest difference of two arrays over the largest entry expected."""
    value, expected = np.asarray(value), np.asarray(expected)
    return float(np.max(np.abs(value - expected)) / np.max(np.abs(expected)))


def stretch_error(scene: Scene, state: State) -> float:
    """Largest distance of the strains gamma from e3, which an inextensible rod keeps."""
    stretch = strains(scene.rod, state.position, state.quaternion).stretch
    return float(jnp.max(jnp.abs(stretch - jnp.asarray([[0.0, 0.0, 1.0]]))))


def order_of(steps, errors) -> float:
    """Observed order of convergence: the slope of log error over log step by least squares."""
    return float(np.polyfit(np.log(np.asarray(steps)), np.log(np.asarray(errors)), 1)[0])


def driven_scene(elements: int = 12, section: Section = UNIT_SECTION, loads=None) -> Scene:
    """A rod between a clamp that is shifted and twisted by smooth schedules, and a slider.

    (Clamped at both ends, a straight inextensible rod would be over-constrained.)
    """
    if loads is None:
        loads = (MorisonDrag(1.0, 2.0, 0.5),)
    ramp = [0.0, 1.0, 10.0]
    push = Smooth(ramp, [[0.0, 0.0, 0.0], [0.1, -0.05, 0.2], [0.1, -0.05, 0.2]])
    first = Clamped(push, Turn((0.0, 0.0, 1.0), Smooth(ramp, [0.0, 2.0, 2.0])))
    rod = straight_rod(1.0, elements, section, natural_curvature=(0.3, 0.1, 0.0))
    return Scene(rod, first, Slider((0.0, 0.0, 1.0)), loads)


@eqx.filter_jit
def advance_to(scene, state, end, count, method):
    """State after `count` equal steps to the time `end`, and the worst result of the steps.

    All of them are traced: one compilation serves every step size.
    """
    begin = state.time

    def one(i, carry):
        now, worst = carry
        now, info = step(scene, now, begin + (end - begin) * ((i + 1) / count), method)
        return now, jnp.maximum(worst, info.result)

    carry = (state, jnp.asarray(0, jnp.int32))
    return lax.fori_loop(0, jnp.asarray(count), one, carry)


def final_state(scene, state, end, count, method):
    """State after `count` equal steps that must all succeed."""
    final, worst = advance_to(scene, state, jnp.asarray(end), jnp.asarray(count), method)
    assert int(worst) == 0
    return final


DIAMETER = 0.02
LAWS = {
    "damped": laws.DampedInversePower(k1=1e-4, k3=1e-1, reference_spacing=1e-3),
    "inverse_power": laws.InversePower(strength=1e-2, exponent=3.0),
    "lennard_jones": laws.LennardJones(energy=1.0, range=0.03),
    "debye_hueckel": laws.DebyeHueckel(strength=0.1, screening=0.02),
    "barrier": laws.Barrier(stiffness=1e6),
    "penalty": laws.Penalty(stiffness=1e6),
    "damped_penalty": laws.Penalty(stiffness=1e6, relaxation=2e-3),
}
"""Laws for strands of this diameter."""
PAIR = PairProperties(jnp.asarray(DIAMETER), jnp.asarray(0.5))


def hairpin(elements=24, half_gap=0.04, tilt=0.003):
    """A rod bent into two parallel strands 2 * half_gap apart."""
    leg = (1 - np.pi * half_gap) / 2

    def curve(s):
        s = np.asarray(s)
        if s < leg:
            return np.array([0.0, s, 0.0])
        angle = (s - leg) / half_gap
        if angle < np.pi:
            bend = np.array([1 - np.cos(angle), np.sin(angle), 0.0])
            return half_gap * bend + np.array([0.0, leg, 0.0])
        return np.array([2 * half_gap, leg - (s - leg - np.pi * half_gap), tilt])

    section = circular_section(DIAMETER, 1e6, 5e5, 1500.0)
    return curved_rod(curve, 1.0, elements, section)


@functools.cache
def moving_hairpin(elements: int):
    """Hairpin scene, a moving state of it, and the points near each other."""
    contact = Contact(LAWS["damped"], segments=20, cutoff=0.1, points_per_segment=2)
    scene = Scene(hairpin(elements), Clamped(), Clamped(), (), contact)
    state = prepare(scene, placing(scene))
    velocity = 0.1 * np.random.default_rng(0).normal(size=state.position.shape)
    state = dataclasses.replace(state, rate=state.rate.at[:, :3].set(velocity))
    return scene, state, scene.find_contact(state.position, 1e-3 * state.velocity)


def standing_run(scene: Scene, steps: int, first: float = 0.0, step_size: float = 0.1) -> Run:
    """A run in which nothing moves, made without computing it: for tests of files.

    Args:
        first: time of its start [s].
    """
    state = prepare(scene, placing(scene))
    copies = lambda count: lambda leaf: jnp.stack([leaf] * count)
    states = jax.tree.map(copies(steps + 1), state)
    states = eqx.tree_at(lambda s: s.time, states, first + step_size * jnp.arange(steps + 1.0))
    infos = jax.tree.map(
        lambda leaf: jnp.zeros((steps, *leaf.shape), leaf.dtype), no_info(state.time.dtype)
    )
    zero = jnp.asarray(0, jnp.int32)
    return Run(states, infos, zero, zero, zero)


def assert_identical(a, b):
    """Equal trees: structure, classes, dtypes and every bit."""
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        assert type(x) is type(y)
        if isinstance(x, jax.Array | np.ndarray):
            assert (x.dtype, x.shape) == (y.dtype, y.shape)
            assert np.asarray(x).tobytes() == np.asarray(y).tobytes()
        else:
            assert x == y


def switched_scene() -> Scene:
    """Driven, sliding until it is held in the middle of the run."""
    driven = driven_scene(elements=8)
    held = Switched(Slider(UP), Clamped(), 0.4)
    return Scene(driven.rod, driven.first_end, held, driven.loads)
