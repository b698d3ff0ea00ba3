"""Measures in blocks of states: any number of them by one program, derivatives pass."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import UNIT_SECTION
from made_runs import run_of

import rodjax as rx
from rodjax import energy, measures
from rodjax.constraints.ends import Clamped, Free
from rodjax.dynamics.adaptive import placeholder
from rodjax.dynamics.run import of_no_steps
from rodjax.interactions.loads import Gravity, LinearDrag
from rodjax.measuring import blocks
from rodjax.measuring.beforehand import compile_measures
from rodjax.scenes.scene import Scene

SIZES = (1, blocks.BLOCK - 1, blocks.BLOCK, 2 * blocks.BLOCK + 1)


def states(size):
    numbers = np.random.default_rng(size).normal(size=(size, 3))
    return {"x": jnp.asarray(numbers), "n": jnp.arange(size, dtype=jnp.int32)}


def test_one_program_for_any_number_of_states():
    traces = []

    @blocks.over_states
    def measured(state, factor):
        """Its own docstring."""
        traces.append(None)
        return factor * jnp.sum(state["x"] ** 2), state["n"]

    assert measured.__doc__ == "Its own docstring."
    for size in SIZES:
        given = states(size)
        found, count = measured(given, jnp.asarray(0.5))
        np.testing.assert_allclose(found, 0.5 * np.sum(np.asarray(given["x"]) ** 2, 1), rtol=1e-14)
        np.testing.assert_array_equal(count, np.arange(size))
        assert found.dtype == given["x"].dtype and count.dtype == jnp.int32
    assert len(traces) == 1


@pytest.mark.parametrize("size", SIZES)
def test_what_is_carried_goes_on_from_block_to_block(size):
    last, sums = scanned(jnp.zeros(3), states(size))
    expected = np.cumsum(np.asarray(states(size)["x"]), 0)
    np.testing.assert_allclose(sums, expected, rtol=1e-12, atol=1e-13)
    np.testing.assert_allclose(last, expected[-1], rtol=1e-12, atol=1e-13)


@blocks.scan_states
def scanned(carry, state):
    carry = carry + state["x"]
    return carry, carry


def test_derivatives_pass():
    given = states(5)
    loss = lambda x: jnp.sum(scanned(jnp.zeros(3), {**given, "x": x})[1])
    # x_i is in the sums from the i-th on
    expected = np.repeat(np.arange(5, 0, -1.0)[:, None], 3, 1)
    np.testing.assert_allclose(jax.grad(loss)(given["x"]), expected, rtol=1e-14)


def heavy():
    rod = rx.straight_rod(1.0, 4, UNIT_SECTION)
    return Scene(rod, Clamped(), Free(), (Gravity((0.0, 0.0, -9.0)), LinearDrag(0.2, 0.1)))


def sinking(scene, size):
    """States that sink by 1/8 each."""
    down = jnp.asarray([[0.0, 0.0, -0.125]])
    first = placeholder(scene)
    at = lambda k: dataclasses.replace(first, position=first.position + k * down)
    return run_of([at(k) for k in range(size)])


def test_ledger_and_linking_do_not_hang_on_the_number_of_states(monkeypatch):
    """Compiled beforehand, they are not traced again; what they say is known."""
    scene = heavy()
    compile_measures(scene)
    monkeypatch.delattr(energy, "node_motion")  # tracing would miss them
    monkeypatch.delattr(measures, "twist")
    for size in (3, blocks.BLOCK + 2):
        run = sinking(scene, size)
        # of a weight of 9 (mass 1), 1/8 deeper from each state to the next
        height = np.asarray(run.states.position[:, 0, 2])
        expected = np.asarray(energy.ledger(scene, run).gravity)
        np.testing.assert_allclose(expected - expected[0], 9 * height, rtol=1e-12)
        np.testing.assert_allclose(measures.linking(scene, run).error, 0, atol=1e-13)


def test_ledger_of_many_states_is_that_of_traced_code():
    scene = heavy()
    run = sinking(scene, blocks.BLOCK + 3)
    traced = jax.jit(lambda run: energy.ledger(scene, run))(run)
    for name, one, other in zip(traced._fields, traced, energy.ledger(scene, run), strict=True):
        assert (one is None) == (other is None), name
        if one is not None:
            np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-12, err_msg=name)


def test_the_run_of_no_steps_has_the_kind_of_state_that_runs_have():
    scene = heavy()
    run = of_no_steps(placeholder(scene))
    kind = lambda tree: jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype), tree)
    assert kind(run.final) == kind(eqx.filter_eval_shape(rx.start, scene))
    assert len(run.times) == 1 and len(run.infos.result) == 0
