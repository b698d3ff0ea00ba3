"""Where a loop in contact collapses, and what the contact law has to do with that."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rodjax as rx

AXIS = (0.0, 0.0, 1.0)
TURN = rx.Turn(AXIS, rx.PiecewiseLinear([-9.0, 9.0], [-18 * np.pi, 18 * np.pi]))


@pytest.mark.slow
def test_the_load_at_which_a_loop_collapses_has_derivatives_by_the_contact_law():
    section = rx.Section((1.0, 1.0, 0.8), diameter=0.02, mass=1.0)
    rod = rx.straight_rod(1.0, 40, section)
    law = rx.Penalty(stiffness=1e4)
    contact = rx.Contact(law, cutoff=0.03, segments=80)
    scene = rx.Scene(rod, rx.Clamped(), rx.Slider(AXIS, rotation=TURN), contact=contact)
    straight = rx.path(scene, rx.placing(scene), 0.0, 2.2, longest_step=0.5)
    buckled = rx.branch(scene, straight.critical[0], (0.0, 3.0), points=200, throw=False)
    folds = [one for one in buckled.critical if one.kind == "fold"]
    collapse = folds[1]
    assert float(collapse.parameter) > float(folds[0].parameter)

    def turns(stiffness):
        own = dataclasses.replace(law, stiffness=stiffness)
        softer = dataclasses.replace(scene, contact=dataclasses.replace(contact, law=own))
        return rx.critical(softer, collapse).parameter

    turns, at = rx.jit(turns), jnp.asarray(1e4)
    assert float(turns(at)) == pytest.approx(float(collapse.parameter), rel=1e-9)
    forward = float(rx.jit(jax.jacfwd(turns))(at))
    assert float(rx.jit(jax.grad(turns))(at)) == pytest.approx(forward, rel=1e-8)
    h = 0.02 * at
    differences = [(turns(at + k * h) - turns(at - k * h)) / (2 * k * h) for k in (2, 1)]
    assert forward != 0
    assert forward == pytest.approx(float(4 * differences[1] - differences[0]) / 3, rel=1e-5)
