"""Of the pairs near each other those that act: sizes of the systems, and rods side by side."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rodjax as rx
from rodjax.equations import dense_elimination
from rodjax.equations.equations import step_equations

LENGTH, DIAMETER = 0.3, 0.01
SECTION = rx.circular_section(DIAMETER, 1e6, 1e6 / 3, density=1100.0)


def weave(elements, friction=None, gap=0.9):
    """Two rods on two others, crosswise, their axes so many diameters apart."""
    rods = []
    for upper in (0, 1):
        along, across, up = np.eye(3)[[upper, 1 - upper, 2]]
        for side in (-1, 1):
            begin = -0.5 * LENGTH * along + 0.07 * side * across + gap * upper * DIAMETER * up
            given = {"direction": tuple(along), "origin": tuple(begin)}
            rods.append(rx.straight_rod(LENGTH, elements, SECTION, **given))
    friction = None if friction is None else rx.SlidingFriction(friction, 1e-3)
    contact = rx.Contact.solid(rods[0], 5.0, friction=friction, capacities=(24, 144))
    return rx.Scene(rods=tuple(rods), contact=contact)


def system_of(scene):
    """Newton's system of a step from wild velocities."""
    state = rx.start(dataclasses.replace(scene, contact=None))
    wild = 0.1 * np.random.default_rng(1).normal(size=state.rate.shape)
    state = dataclasses.replace(state, rate=jnp.asarray(wild))
    numbers = jnp.asarray(1e-4), jnp.asarray(0.8)

    @jax.jit
    def system(scene, state):
        found = scene.find(state.position, numbers[0] * state.velocity)
        equations = step_equations(scene, state, *numbers, found)
        return equations.linearize(equations.guess(state.force))

    return system(scene, state)


def by_size(system, capacity):
    """The same system, eliminated by this size."""
    acting = system.coupling.acting._replace(capacity=jnp.asarray(capacity, jnp.int32))
    return dataclasses.replace(system, coupling=dataclasses.replace(system.coupling, acting=acting))


@pytest.mark.parametrize(
    ("elements", "friction"),
    [(40, 0.4), pytest.param(8, None, marks=pytest.mark.slow)],
)
def test_rods_share_right_sides(elements, friction):
    """On grids finer and coarser than the segments: what is solved is the matrix as it stands."""
    system = system_of(weave(elements, friction))
    coupling = system.coupling
    assert coupling.capacities[-1].nodes == (None if elements == 40 else 36)
    assert dense_elimination._seats(coupling, coupling.capacities[-1]) is not None
    shape = system.blocks.diagonal.shape[:2]
    b = jnp.asarray(np.random.default_rng(3).normal(size=shape))
    eye = np.eye(b.size).reshape(-1, *shape)
    matrix = np.asarray(jax.jit(jax.vmap(system.multiply))(eye)).reshape(b.size, -1).T

    @jax.jit
    def solutions(system):
        eliminated = system.eliminate()
        solved = system.solve(b), eliminated.solve(b), system.solve_transpose(b)
        return solved, eliminated.sign()

    for size in {int(coupling.acting.capacity), len(coupling.capacities)}:
        (one, other, turned), sign = solutions(by_size(system, size))
        for found, of in ((one, matrix), (other, matrix), (turned, matrix.T)):
            expected = np.linalg.solve(of, np.reshape(b, -1)).reshape(shape)
            np.testing.assert_allclose(found, expected, rtol=1e-8, atol=1e-9)
        assert float(sign) == np.linalg.slogdet(matrix)[0]


def test_what_acts_chooses_the_size():
    """And not what is near, which is more: apart, the rods are solved as if alone."""
    system = system_of(weave(40))
    coupling = system.coupling
    assert int(coupling.acting.involved.count) <= 24 < 4 * int(coupling.pairs.count)
    assert int(coupling.pairs.capacity) == 2 and int(coupling.acting.capacity) == 1
    apart = system_of(weave(40, gap=1.05))
    assert int(apart.coupling.pairs.count) > 0
    assert not apart.coupling.acts
    b = jnp.ones(apart.blocks.diagonal.shape[:2])
    solved = jax.jit(lambda one: one.solve(b))(apart)
    np.testing.assert_allclose(solved, apart.blocks.solve(b), rtol=1e-10, atol=1e-11)
