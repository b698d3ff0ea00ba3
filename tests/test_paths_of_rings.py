"""Paths of a ring, which everts at no cost wherever it is, against Michell's threshold."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rodjax as rx

RATIO = 2.0  # torsional over bending stiffness


def naturally_twisted(rod, turns):
    """The ring of a rod whose natural twist is so many turns less than none."""
    natural = rod.natural_curvature.at[:, 2].set(-2 * jnp.pi * turns)
    weld = rx.Weld(rx.Point(0), rx.Point(-1))
    twisted = dataclasses.replace(rod, natural_curvature=natural)
    return rx.Scene(twisted, rx.Clamped(), joints=(weld,))


@pytest.mark.slow
def test_a_ring_stays_plane_while_its_natural_twist_grows_to_michells():
    elements = 24
    rod = rx.ring(1.0, elements, rx.Section((1.0, 1.0, RATIO), mass=1.0))
    scene_of = jax.tree_util.Partial(naturally_twisted, rod)
    state = rx.placing(scene_of(0.0))
    threshold = np.sqrt(3) / RATIO
    # nothing of this path moves the ring: its tangent is rounding, and that is no motion to follow
    path = rx.path(scene_of, state, 0.0, 1.2 * threshold, longest_step=0.5, modes=3)
    assert path.end is rx.PathEnd.STOP
    assert np.max(np.abs(path.states.position - np.asarray(state.position))) < 1e-9
    assert np.max(np.abs(path.eigenvalues[:, 0])) < 1e-9
    (point,) = path.critical
    assert point.kind == "branch" and len(point.modes) == 2
    # second order: 13.2/n^2 above the continuous ring's
    off = float(point.parameter) / threshold - 1
    assert off == pytest.approx(13.2 / elements**2, rel=0.05)
