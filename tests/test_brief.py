"""Texts of results, rods, scenes and runs: short, with their numbers, also where traced."""

import json

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rodjax as rx
from rodjax.dynamics.stepping import no_info
from rodjax.inputs.brief import brief
from rodjax.numerics.results import MESSAGES, SimulationError

SECTION = rx.Section(
    stiffness=(2.0, 3.0, 1.5), mass=0.25, rotary_inertia=(1e-3, 1e-3, 2e-3), diameter=0.02
)


def _scene():
    rod = rx.straight_rod(2.0, 8, SECTION, natural_curvature=(0.3, 0.0, 0.0))
    turn = rx.Turn((0, 0, 1), rx.PiecewiseLinear([0.0, 1.0], [0.0, 2.5]))
    law = rx.Penalty(stiffness=1e6)
    contact = rx.Contact(law, segments=8, cutoff=0.1, pairs_per_segment=8)
    return rx.Scene(
        rod, rx.Clamped(rotation=turn), contact=contact, loads=(rx.Gravity((0, 0, -9.81)),)
    )


def _run(steps=3, result=0):
    state = rx.placing(_scene())
    stack = lambda tree, count: jax.tree.map(lambda x: jnp.stack([x] * count), tree)
    states = eqx.tree_at(
        lambda s: s.time, stack(state, steps + 1), jnp.linspace(0.0, 1.5, steps + 1)
    )
    number = lambda x: jnp.asarray(x, jnp.int32)
    infos = stack(no_info(state.position.dtype), steps)
    return rx.Run(states, infos, number(result), number(7), number(0))


@pytest.mark.parametrize("result", list(rx.Result))
def test_result_tells_its_name_number_and_meaning(result):
    text = str(result)
    assert text == f"{result}" == f"{result.name} ({result.value}): {MESSAGES[result]}"
    assert result == result.value and f"{result:d}" == str(result.value)
    assert json.dumps({"result": result}) == f'{{"result": {result.value}}}'
    assert np.asarray(result).dtype == np.asarray(0).dtype
    assert MESSAGES[result] in str(SimulationError(result))


def test_rod_shows_its_numbers():
    assert repr(_scene().rod) == (
        "Rod(elements=8, length=2, stiffness=(2, 3, 1.5), natural_curvature=(0.3, 0, 0), mass=0.25,"
        " rotary_inertia=(0.001, 0.001, 0.002), diameter=0.02)"
    )


def test_rod_of_changing_section_shows_shapes():
    section = lambda s: rx.Section(stiffness=(1.0 + s, 1.0 + s, 1.0), mass=1.0)
    text = repr(rx.straight_rod(1.0, 4, section))
    assert "stiffness=float64[4,3]" in text
    assert "mass=1" in text and "diameter" not in text


def test_scene_is_a_few_lines():
    lines = repr(_scene()).splitlines()
    assert lines[0] == "Scene(" and lines[-1] == ")" and len(lines) == 7
    assert lines[1].startswith("    rod=Rod(elements=8, length=2,")
    assert lines[2].startswith(
        "    first_end=Clamped(rotation=Turn(axis=(0, 0, 1), angle=Piecewise"
    )
    assert "values=(0, 2.5)" in lines[2]
    assert lines[3].startswith("    last_end=Free(")
    assert lines[4] == "    loads=(Gravity(acceleration=(0, 0, -9.81)),),"
    assert lines[5].startswith("    contact=Contact(law=Penalty(stiffness=1e+06")
    assert "cutoff=0.1" in lines[5]


def test_run_tells_steps_times_and_result():
    assert repr(_run()) == ("Run(steps=3, states=4, times=0 to 1.5, rejected=7, result=SUCCESS)")
    assert repr(_run(result=4)).endswith("result=STRAND_PASSAGE)")
    empty = eqx.tree_at(lambda r: r.states.time, _run(), jnp.zeros((0,)))
    assert "states=0, times=none" in repr(empty)


def test_texts_do_not_fail_where_values_are_traced():
    seen = []

    @jax.jit
    def trace(scene, run):
        seen.extend([repr(scene), repr(scene.rod), repr(run)])
        return run.result

    trace(_scene(), _run())
    assert "stiffness=float64[8,3]" in seen[0] and "cutoff=float64[]" in seen[0]
    assert seen[2] == "Run(states=float64[4], result=int32[])"
    for tree in (_scene(), _scene().rod, _run()):
        batch = jax.tree.map(lambda x: jnp.stack([x, x]), tree)
        shapes = eqx.filter_eval_shape(lambda x: x, tree)
        without = eqx.filter(tree, eqx.is_array, inverse=True)
        assert repr(batch) and repr(shapes) and repr(without)


def test_brief_texts_of_values():
    assert brief(jnp.asarray(2.5)) == "2.5"
    assert brief(np.arange(3)) == "(0, 1, 2)"
    assert brief(np.zeros((5, 3))) == "(0, 0, 0)"
    assert brief(np.arange(5.0)) == "float64[5]"
    assert brief((1.0, "text", None)) == "(1, 'text', None)"
    assert brief(np.sin) == "sin"
