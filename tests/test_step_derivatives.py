"""Derivatives through a short rollout, in both modes, against central differences."""

import dataclasses
import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import slow

from rodjax.constraints.ends import Clamped, Slider, Turn
from rodjax.dynamics.consistency import start
from rodjax.dynamics.fixed_rollout import rollout
from rodjax.dynamics.stepping import prepare
from rodjax.equations.generalized_alpha import GeneralizedAlpha
from rodjax.inputs.schedules import Smooth
from rodjax.interactions.loads import LinearDrag, MorisonDrag
from rodjax.rods.builders import straight_rod
from rodjax.rods.section import Section
from rodjax.scenes.placing import placing
from rodjax.scenes.scene import Scene

ELEMENTS, STEPS = 12, 10
KNOTS = (0.0, 0.25, 9.0)


class Inputs(eqx.Module):
    """What is differentiated."""

    stiffness: jax.Array
    natural_curvature: jax.Array
    mass: jax.Array
    morison: jax.Array
    linear: jax.Array
    shift: jax.Array
    turn: jax.Array
    velocity: jax.Array
    spectral_radius: jax.Array


MOVING = Inputs(
    stiffness=jnp.asarray([1.0, 1.3, 0.8]),
    natural_curvature=jnp.asarray([0.5, -0.3, 0.2]),
    mass=jnp.asarray(1.1),
    morison=jnp.asarray([2.0, 0.5]),
    linear=jnp.asarray([0.3, 0.2]),
    shift=jnp.asarray([0.1, -0.05, -0.1]),
    turn=jnp.asarray(1.5),
    velocity=jnp.asarray([0.4, -0.3]),
    spectral_radius=jnp.asarray(0.7),
)
RESTING = eqx.tree_at(
    lambda i: (i.natural_curvature, i.shift, i.turn, i.velocity),
    MOVING,
    (jnp.zeros(3), jnp.zeros(3), jnp.asarray(0.0), jnp.zeros(2)),
)


def moving(scene, velocity):
    """The rod as placed, without the accelerations and forces that `start` finds.

    Their program is as large as that of the steps.
    """
    rate = jnp.concatenate([velocity, jnp.zeros_like(velocity)], 1)
    return prepare(scene, dataclasses.replace(placing(scene), rate=rate))


def loss(inputs, begin=start):
    """A smooth functional of every part of the last state; all else follows from the inputs."""
    section = Section(
        stiffness=tuple(inputs.stiffness),
        mass=inputs.mass,
        rotary_inertia=(2e-3, 2e-3, 4e-3),
        diameter=0.1,
    )
    rod = straight_rod(1.0, ELEMENTS, section, natural_curvature=tuple(inputs.natural_curvature))
    rest = jnp.zeros(3)
    first = Clamped(
        Smooth(KNOTS, jnp.stack([rest, inputs.shift, inputs.shift])),
        Turn((0.0, 0.0, 1.0), Smooth(KNOTS, jnp.stack([0 * inputs.turn, *[inputs.turn] * 2]))),
    )
    loads = (MorisonDrag(1.0, *inputs.morison), LinearDrag(*inputs.linear))
    scene = Scene(rod, first, Slider((0.0, 0.0, 1.0)), loads)
    s = rod.arc_length
    bump = (jnp.sin(jnp.pi * s) ** 2)[:, None] * jnp.concatenate([inputs.velocity, rest[:1]])[None]
    state = begin(scene, velocity=bump)
    method = GeneralizedAlpha(inputs.spectral_radius, tolerance=1e-13)
    times = 0.02 * jnp.arange(1.0, STEPS + 1)
    run = rollout(scene, state, times, method, save_every=5, throw=False)
    last = run.final
    weight = jnp.cos(3 * s)[:, None]
    return (
        jnp.sum(weight * last.position**2)
        + jnp.sum(weight * jnp.sin(last.quaternion + 0.3))
        + 0.1 * jnp.sum(weight * last.rate * jnp.asarray([[1.0, 2, 3, 0.1, 0.2, 0.3]]))
        + 1e-2 * jnp.sum(weight[1:] * last.force * jnp.asarray([[1.0, -2.0, 0.5]]))
    )


@functools.cache
def gradient_and_slope(begin=start):
    """In reverse mode, and value and slope in forward mode: two programs."""
    of = functools.partial(loss, begin=begin)
    ahead = jax.jit(lambda inputs, step: jax.jvp(of, (inputs,), (step,)))
    return jax.jit(jax.grad(of)), ahead


def one_at_a_time(inputs, name, seed=0):
    """A direction in one field only."""
    zero = jax.tree.map(jnp.zeros_like, inputs)
    field = getattr(inputs, name)
    step = jnp.asarray(np.random.default_rng(seed).uniform(0.3, 1.0, size=field.shape))
    return eqx.tree_at(lambda i: getattr(i, name), zero, step)


def along(inputs, step, width):
    return jax.tree.map(lambda x, d: x + width * d, inputs, step)


def inner(a, b):
    products = jax.tree.map(jnp.vdot, a, b)
    return float(sum(jax.tree.leaves(products)))


def central_difference(function, inputs, step, width):
    """Fourth order in the width."""
    at = lambda k: function(along(inputs, step, k * width))
    return (8 * (at(1) - at(-1)) - (at(2) - at(-2))) / (12 * width)


@pytest.mark.parametrize("name", list(map(slow, sorted(Inputs.__dataclass_fields__))))
def test_reverse_and_forward_against_differences(name):
    step = one_at_a_time(MOVING, name)
    gradient, ahead = gradient_and_slope()
    expected = float(central_difference(lambda x: ahead(x, step)[0], MOVING, step, 2e-3))
    assert abs(expected) > 1e-5
    assert inner(gradient(MOVING), step) == pytest.approx(expected, rel=1e-6)
    assert float(ahead(MOVING, step)[1]) == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("begin", [moving, slow(start)])
def test_derivatives_at_the_straight_motionless_rod(begin):
    gradient, ahead = gradient_and_slope(begin)
    found = gradient(RESTING)
    for leaf in jax.tree.leaves(found):
        assert np.all(np.isfinite(leaf))
    for name in ("natural_curvature", "shift", "turn", "velocity"):
        step = one_at_a_time(RESTING, name)
        value = lambda inputs, step=step: ahead(inputs, step)[0]
        expected = float(central_difference(value, RESTING, step, 3e-4))
        assert inner(found, step) == pytest.approx(expected, rel=1e-5, abs=1e-8)
        slope = float(ahead(RESTING, step)[1])
        assert slope == pytest.approx(inner(found, step), rel=1e-8, abs=1e-9)


@pytest.mark.slow
def test_gradient_and_vmap_in_both_orders():
    gradient, _ = gradient_and_slope()
    several = jax.tree.map(lambda a, b: jnp.stack([a, 0.5 * (a + b), b]), MOVING, RESTING)
    mapped = jax.jit(jax.vmap(jax.grad(loss)))(several)
    total = jax.jit(jax.grad(lambda many: jnp.sum(jax.vmap(loss)(many))))(several)
    for k in range(3):
        pick = lambda tree, k=k: jax.tree.map(lambda leaf: leaf[k], tree)
        expected = gradient(pick(several))
        for found in (pick(mapped), pick(total)):
            for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
                np.testing.assert_allclose(a, b, rtol=1e-7, atol=1e-9)


@pytest.mark.slow
def test_hessian_vector_product():
    gradient, _ = gradient_and_slope()
    step = jax.tree.map(
        lambda a, b: a + b, one_at_a_time(MOVING, "stiffness"), one_at_a_time(MOVING, "shift")
    )
    product = jax.jit(lambda inputs: jax.jvp(jax.grad(loss), (inputs,), (step,))[1])(MOVING)
    expected = jax.tree.map(
        lambda a, b: (a - b) / 2e-5,
        gradient(along(MOVING, step, 1e-5)),
        gradient(along(MOVING, step, -1e-5)),
    )
    for name in Inputs.__dataclass_fields__:
        found, other = getattr(product, name), getattr(expected, name)
        np.testing.assert_allclose(found, other, rtol=1e-5, atol=1e-6, err_msg=name)
