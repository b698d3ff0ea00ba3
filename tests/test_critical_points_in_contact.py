"""Where the example's loop collapses, and what its contact law has to do with that."""

import dataclasses

import example
import example_path
import jax
import jax.numpy as jnp
import pytest

import rodjax as rx


@pytest.mark.slow
def test_the_load_at_which_a_loop_collapses_has_derivatives_by_the_contact_law():
    scene = example_path.at_rest(example.PRESETS["timeline"], 60, crooked=False)
    straight = rx.path(scene, rx.placing(scene), 0.0, 2.2, longest_step=0.5)
    (point,) = straight.critical
    buckled = rx.branch(scene, point, (0.0, 2.5))
    folds = [one for one in buckled.critical if one.kind == "fold"]
    assert [round(float(one.parameter), 3) for one in folds] == [0.435, 2.224, 2.091]
    contact, collapse = scene.contact, folds[1]

    def turns(factor):
        law = dataclasses.replace(contact.law, k1=factor * contact.law.k1)
        harder = dataclasses.replace(scene, contact=dataclasses.replace(contact, law=law))
        return rx.critical(harder, collapse).parameter

    load, at = rx.jit(turns), jnp.asarray(1.0)
    assert float(load(at)) == pytest.approx(float(collapse.parameter), rel=1e-10)
    forward = float(rx.jit(jax.jacfwd(turns))(at))
    assert forward > 1e-4  # a harder law keeps the loop open for longer
    assert float(rx.jit(jax.grad(turns))(at)) == pytest.approx(forward, rel=1e-8)
    h = 1e-3
    differences = [(load(at + k * h) - load(at - k * h)) / (2 * k * h) for k in (2, 1)]
    assert forward == pytest.approx(float(4 * differences[1] - differences[0]) / 3, rel=1e-6)
