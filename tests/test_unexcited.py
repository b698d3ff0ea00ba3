"""Runs that end straight under a load that no rod would bear so say it."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import slow

import rodjax as rx
from rodjax.numerics.results import ModelWarning

# along others rounding alone would excite a rod that is twisted
UP, ALONG = (0.0, 0.0, 1.0), (1.0, 0.0, 0.0)
GIVE = 2e-4
END = 4.0
STRAIN = GIVE * 4 * np.pi**2  # of a column between clamps at its critical thrust
CLAMPED_TURNS = 8.98682 / (2 * np.pi * 0.8)  # M L/A = 8.987 between clamps, C = 0.8 A


def rod(direction=UP, rotary_inertia=None, natural_curvature=(0.0, 0.0, 0.0)):
    """Of unit length, bending stiffness and mass, and a little extensible."""
    section = rx.Section(
        (1.0, 1.0, 0.8), mass=1.0, rotary_inertia=rotary_inertia, compliance=(0.0, 0.0, GIVE)
    )
    return rx.straight_rod(
        1.0, 16, section, direction=direction, natural_curvature=natural_curvature
    )


def driven(body, push=0.0, turns=0.0):
    """The rod pressed and twisted slowly between ends that are held."""
    along = body.position[-1] - body.position[0]
    shift = rx.Smooth([0.0, END], -push * np.stack([np.zeros(3), along]))
    turn = rx.Turn(along, rx.Smooth([0.0, END], [0.0, 2 * np.pi * turns]))
    return rx.Scene(
        body, rx.Clamped(), rx.Clamped(shift, turn), loads=(rx.LinearDrag(20.0, 20.0, 1.0),)
    )


TIMES = np.linspace(0.0, END, 401)[1:]

TOO_MUCH = {
    "pressed": (driven(rod(ALONG), push=2 * STRAIN), 2),
    "twisted": (driven(rod(), turns=1.3 * CLAMPED_TURNS), 2),
    "curved alike everywhere": (
        driven(
            rod(natural_curvature=(1e-2, 0.0, 0.0)),
            push=2 * STRAIN,
        ),
        2,
    ),
}
BORNE = {
    "pressed": driven(rod(), push=0.8 * STRAIN),
    "pulled": driven(rod(), push=-2 * STRAIN),
    "twisted": driven(rod(), turns=0.8 * CLAMPED_TURNS),
    "crooked": driven(rx.imperfect(rod(), 1e-2), push=1.5 * STRAIN),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", TOO_MUCH)
def test_a_run_says_that_nothing_excites_its_modes(name):
    scene, modes = TOO_MUCH[name]
    with pytest.warns(ModelWarning, match=rf"ends straight.* with {modes} unstable mode\(s\)"):
        rx.rollout(scene, rx.start(scene), TIMES)


@pytest.mark.slow
def test_an_adaptive_run_says_so_too():
    scene, _ = TOO_MUCH["pressed"]
    with pytest.warns(ModelWarning, match=r"Give it an imperfection, rodjax.imperfect\(rod\)"):
        rx.adaptive_rollout(scene, rx.start(scene), END)


@pytest.mark.parametrize("name", [slow("pressed"), slow("pulled"), "twisted", "crooked"])
def test_what_a_rod_bears_is_no_finding(name):
    scene = BORNE[name]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        rx.rollout(scene, rx.placing(scene), TIMES)


@pytest.mark.slow
def test_an_end_released_at_the_end_is_not_looked_at():
    held = BORNE["pressed"]
    last = rx.Switched(rx.Clamped(), rx.Free(), END, displacement=held.last_end.displacement)
    scene = rx.Scene(held.rod, held.first_end, last, held.loads)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        rx.rollout(scene, rx.start(scene), TIMES)


@pytest.mark.slow
def test_a_rod_pushed_through_space_is_at_rest_nowhere():
    push = rx.PointLoad(0, rx.Constant((0.0, 0.0, 50.0)))
    scene = rx.Scene(rod(rotary_inertia=(1e-4, 1e-4, 2e-4)), loads=(push,))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        run = rx.rollout(scene, rx.start(scene), np.linspace(0.0, 0.1, 41)[1:])
    assert float(jnp.max(-run.final.force[:, 2])) > 10.0


@pytest.mark.slow
def test_traced_runs_are_not_looked_at():
    scene, _ = TOO_MUCH["pressed"]
    state = rx.start(scene)
    found = jax.jit(lambda s: rx.rollout(s, state, jnp.asarray(TIMES), throw=False).result)(scene)
    assert int(found) == rx.Result.SUCCESS
