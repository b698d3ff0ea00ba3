"""The Newton system coupled by contact: its derivative, its solvers, and steps by them."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import LAWS, slow

from rodjax.dynamics.stepping import step
from rodjax.equations import coupling, dense_elimination
from rodjax.equations.equations import step_equations
from rodjax.interactions import contact_capacities, screening
from rodjax.interactions.contact import Contact
from rodjax.numerics import newton
from rodjax.numerics.front_order import FrontSize
from rodjax.numerics.results import Result
from rodjax.scenes.scene import Found

# grids finer and coarser than the contact's 20 segments
finer_and_coarser = pytest.mark.parametrize("bent", [slow(24), 14], indirect=True)


@pytest.mark.slow
@finer_and_coarser
def test_newton_system_is_the_exact_derivative(bent):
    scene, state, near = bent
    equations = step_equations(scene, state, jnp.asarray(1e-3), jnp.asarray(0.8), Found((), near))
    x = equations.guess(state.force)
    system = equations.linearize(x)
    matrix = jax.jacfwd(equations.residual)(x).reshape(x.size, x.size)
    b = jnp.asarray(np.random.default_rng(1).normal(size=x.shape))
    dx = system.solve(b)
    np.testing.assert_allclose(
        matrix @ equations.lift(x, dx).reshape(-1), b.reshape(-1), atol=1e-11
    )
    np.testing.assert_allclose(system.multiply(dx), b, atol=1e-11)
    y = system.solve_transpose(b)
    np.testing.assert_allclose(jnp.vdot(y, system.multiply(b)), jnp.vdot(b, b), rtol=1e-11)
    np.testing.assert_allclose(
        equations.newton_increment(x), system.solve(-equations.residual(x)), atol=1e-13
    )


@pytest.mark.parametrize("bent", [slow(24), slow(14), slow(40)], indirect=True)
def test_a_strip_is_solved_as_a_dense_system(bent, monkeypatch):
    """Systems and transposed ones, held and not, on grids finer and coarser than the segments."""
    scene, state, _ = bent
    b = jnp.asarray(np.random.default_rng(1).normal(size=(state.position.shape[0], 9)))

    def solutions():
        near = scene.find_contact(state.position)
        equations = step_equations(
            scene, state, jnp.asarray(1e-3), jnp.asarray(0.8), Found((), near)
        )
        system = equations.linearize(equations.guess(state.force))
        front = system.coupling.capacities[int(near.pairs.capacity) - 1].front
        found = system.solve(b), system.solve_transpose(b), system.eliminate().solve(b)
        return front, found, system.multiply(found[0])

    front, expected, _ = solutions()
    assert front is None
    # however few joints are in contact, by a front, or as a dense system if it is too narrow
    whole = contact_capacities.capacities(scene.contact, len(b) - 1)[-1]
    size = FrontSize(24, 8)
    for kept in (True, False):  # its factors, or eliminated for each right side
        strip = whole._replace(front=size, kept=kept)
        for module in (screening, coupling):
            monkeypatch.setattr(module, "capacities", lambda *given, strip=strip: (strip, whole))
        front, found, product = solutions()
        assert front == size
        np.testing.assert_allclose(product, b, atol=1e-11)
        for one, other in zip(found, expected, strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-11)


@pytest.mark.parametrize("bent", [14], indirect=True)
@pytest.mark.parametrize("last", ["dense", "front"])
def test_with_nothing_near_the_chain_alone_is_eliminated(bent, last, monkeypatch):
    """Whatever the largest size of contact is solved by: equilibria do not ask what is near."""
    scene, state, _ = bent
    whole = contact_capacities.capacities(scene.contact, 14)[-1]
    sizes = whole, whole if last == "dense" else whole._replace(front=FrontSize(24, 8))
    for module in (screening, coupling):
        monkeypatch.setattr(module, "capacities", lambda *given: sizes)
    near = scene.find_contact(100 * state.position)
    assert int(near.pairs.capacity) == 0
    equations = step_equations(scene, state, jnp.asarray(1e-3), jnp.asarray(0.8), Found((), near))
    system = equations.linearize(equations.guess(state.force))
    b = jnp.asarray(np.random.default_rng(1).normal(size=(15, 9)))
    expected = system.blocks.solve(b)
    for found in (system.solve(b), system.eliminate().solve(b)):
        np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-12)
    assert float(system.eliminate().sign()) == float(
        dataclasses.replace(system, coupling=None).eliminate().sign()
    )


@pytest.mark.parametrize("bent", [14], indirect=True)
@pytest.mark.parametrize("width", [3, 6])
def test_pairs_are_summed_at_nodes_as_by_way_of_vertices(bent, width, monkeypatch):
    """Of a grid coarser than the segments, for any number of pairs in use and any capacity."""
    scene, state, _ = bent
    # pairs that may come near in a wild motion: more than are summed at once
    wild = 0.2 * np.random.default_rng(2).normal(size=state.position.shape)
    sites, pairs = scene.find_contact(state.position, jnp.asarray(wild))
    values = np.random.default_rng(3).normal(size=(len(pairs.first), 4, 4, width, width))
    assert int(pairs.count) > dense_elimination._TOGETHER
    nothing = jnp.zeros((15, 9, width))
    (whole,) = contact_capacities.capacities(scene.contact, 14)
    for count in (int(pairs.count), 1, 0):
        derivative = jnp.asarray(np.where(np.arange(len(values)) < count, values.T, 0.0).T)
        few = pairs._replace(count=jnp.asarray(count, jnp.int32))
        acts = jnp.any(derivative != 0, (1, 2, 3, 4))
        acting = coupling.Acting.of(acts, few, sites, 15, (whole,))
        one = jnp.ones(width)
        given = sites, few, acting, derivative, (one, one), nothing, nothing, (whole,)
        pushed = coupling.Coupling(*given)
        found = []
        for most in (0, 10_000):
            monkeypatch.setattr(dense_elimination, "_FEW", most)
            found.append(jax.jit(lambda one: dense_elimination._derivative(one, whole))(pushed))
        np.testing.assert_allclose(found[0], found[1], atol=1e-12)
        assert bool(jnp.any(found[0] != 0)) == (count > 0)


@pytest.mark.slow
@finer_and_coarser
def test_batches_of_right_sides_and_of_systems(bent):
    """Lanes in contact and out of it, by the solver of their own."""
    scene, state, _ = bent
    along = jnp.concatenate([jnp.zeros(1), jnp.cumsum(scene.rod.length)])
    straight = jnp.zeros_like(state.quaternion).at[:, 0].set(1.0)
    line = along[:, None] * jnp.asarray([[0.0, 0.0, 1.0]])
    apart = dataclasses.replace(state, position=line, quaternion=straight)
    both = jax.tree.map(lambda *leaves: jnp.stack(leaves), state, apart)
    right = jnp.asarray(np.random.default_rng(1).normal(size=(2, state.position.shape[0], 9)))

    @jax.jit
    def equations(state):
        found_contact = scene.find_contact(state.position)
        return step_equations(
            scene, state, jnp.asarray(1e-3), jnp.asarray(0.5), Found((), found_contact)
        )

    system = lambda state: equations(state).linearize(equations(state).guess(state.force))

    def root(state):
        tried = equations(state)
        return tried.iterate(tried.guess(state.force), jnp.asarray(1e-11), jnp.asarray(2))

    def close(found, expected):
        # the rod apart is drawn straight, and springs back: its nodes move by many elements
        largest = max(1.0, float(jnp.max(jnp.abs(expected))))
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12 * largest)

    one = system(state)
    assert int(one.coupling.pairs.capacity) > 0 and int(system(apart).coupling.pairs.capacity) == 0
    alone = [one.solve(b) for b in right]
    close(jax.vmap(one.solve)(right), jnp.stack(alone))
    # several right sides of several systems
    grid = jax.jit(jax.vmap(lambda s: jax.vmap(system(s).solve)(right)))(both)
    close(grid[0], jnp.stack(alone))
    close(grid[1], jnp.stack([system(apart).solve(b) for b in right]))
    # two of Newton's iterations, of each lane for itself or, if none is in contact, together
    expected = [jax.jit(root)(s) for s in (state, apart)]
    found, infos = jax.jit(jax.vmap(root))(both)
    for lane, (x, info) in enumerate(expected):
        close(found[lane], x)
        assert int(infos.iterations[lane]) == int(info.iterations)
    easy = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), apart)
    close(jax.jit(jax.vmap(root))(easy)[0], jnp.stack([expected[1][0]] * 2))


@pytest.mark.slow
@finer_and_coarser
def test_a_held_derivative_leads_to_the_same_motion(bent):
    scene, state, _ = bent
    found_contact = scene.find_contact(state.position)
    equations = step_equations(
        scene, state, jnp.asarray(1e-3), jnp.asarray(0.5), Found((), found_contact)
    )
    assert int(found_contact.pairs.count) > 0
    rest = (equations.guess(state.force), jnp.asarray(1e-11), jnp.asarray(20))
    whole, each = jax.jit(lambda: newton.iterate(equations, *rest))()
    held, once = jax.jit(lambda: newton.iterate_held(equations, *rest))()
    assert int(each.result) == int(once.result) == 0
    np.testing.assert_allclose(held, whole, rtol=1e-8, atol=1e-10)
    assert int(each.iterations) <= int(once.iterations) <= 2 * int(each.iterations)


@pytest.mark.slow
@finer_and_coarser
def test_every_size_of_solver_gives_the_same_increment(bent):
    scene, state, near = bent
    found = []
    apart = dataclasses.replace(scene.contact, exclusion=jnp.asarray(0.4))
    # far enough that some pairs are listed, and few
    wild = jnp.zeros_like(state.position).at[:3].set(0.03)
    for sizes in ((21,), (4, 18, 21)):
        contact = dataclasses.replace(apart, capacities=sizes)
        same = eqx.tree_at(lambda s: s.contact, scene, contact)
        near = same.find_contact(state.position, wild)
        assert int(near.pairs.capacity) == len(sizes) - (len(sizes) > 1)
        equations = step_equations(
            same, state, jnp.asarray(1e-3), jnp.asarray(0.8), Found((), near)
        )
        found.append(equations.newton_increment(equations.guess(state.force)))
    np.testing.assert_allclose(found[1], found[0], atol=1e-12)


@pytest.mark.slow
def test_capacity_overflow_is_reported(bent):
    scene, state, _ = bent
    small = eqx.tree_at(
        lambda s: s.contact, scene, Contact(LAWS["damped"], 20, 0.1, capacities=(4,))
    )
    _, info = step(small, state, jnp.asarray(1e-3))
    assert int(info.result) == Result.CAPACITY_OVERFLOW


@pytest.mark.slow
def test_gradient_through_a_step_in_contact(bent):
    scene, state, _ = bent

    def end(k1):
        law = eqx.tree_at(lambda c: c.law.k1, scene.contact, k1)
        touching = eqx.tree_at(lambda s: s.contact, scene, law)
        return jnp.sum(step(touching, state, jnp.asarray(1e-3))[0].velocity[:8, 0])

    k1 = jnp.asarray(1e-4)
    reverse, forward = jax.grad(end)(k1), jax.jvp(end, (k1,), (jnp.ones(()),))[1]
    h = 1e-6
    difference = (end(k1 + h) - end(k1 - h)) / (2 * h)
    assert abs(difference) > 0
    np.testing.assert_allclose(reverse, forward, rtol=1e-9)
    np.testing.assert_allclose(reverse, difference, rtol=1e-5)
