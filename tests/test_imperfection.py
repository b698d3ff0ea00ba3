"""The imperfection that works for any ends: columns and shafts leave their straight branch."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.special import ellipe, ellipk

from rodjax import energy
from rodjax.constraints.ends import AbstractEnd, Turn
from rodjax.equilibria.load_path import equilibrium
from rodjax.inputs.schedules import PiecewiseLinear
from rodjax.interactions.loads import PointLoad
from rodjax.numerics.results import ModelWarning
from rodjax.rods.builders import straight_rod
from rodjax.rods.imperfection import imperfect
from rodjax.rods.section import Section
from rodjax.scenes.placing import placing
from rodjax.scenes.scene import Scene

N = 20
STEPS = 100  # fine enough to follow the bent branch past the critical load
GIVE = 2e-4


class Held(AbstractEnd):
    """An end that holds any of the six directions, pushed and turned; one structure for all."""

    held: jax.Array
    displacement: PiecewiseLinear | None
    rotation: Turn | None

    def projector(self, time):
        return jnp.diag(self.held)


def end(directions, push=0.0, turns=0.0):
    """x y z and rotations about a_1 a_2 a_3; a push along -z and turns about z until 1 s.

    The push grows as the square of time, since the deflection grows as the push's root.
    """
    times = np.linspace(0.0, 1.0, STEPS + 1)
    return Held(
        jnp.asarray([float(d in directions) for d in "xyz123"]),
        PiecewiseLinear(times, np.stack([0 * times, 0 * times, -push * times**2], 1)),
        Turn((0.0, 0.0, 1.0), PiecewiseLinear([0.0, 1.0], [0.0, 2 * np.pi * turns])),
    )


CLAMP, PIN, FREE = "xyz123", "xyz3", ""


def column(rod, first, last, push=0.0, turns=0.0, thrust=0.0):
    """A column whose end is pushed, turned or loaded until 1 s."""
    force = PiecewiseLinear([0.0, 1.0], [[0.0, 0.0, 0.0], [0.0, 0.0, -thrust]])
    return Scene(rod, end(first), end(last, push, turns), (PointLoad(-1, force),))


def straight(n=N):
    """A column of unit A and L that can be shortened a little."""
    return straight_rod(1.0, n, Section((1.0, 1.0, 0.8), mass=1.0, compliance=(0.0, 0.0, GIVE)))


def pressed(scene):
    """Its equilibrium at 1 s."""
    return equilibrium(scene, placing(scene), time=1.0, load_steps=STEPS)[0]


def sideways(state):
    """Largest deflection."""
    return float(jnp.max(jnp.linalg.norm(state.position[:, :2], axis=1)))


@pytest.mark.slow
def test_uniform_curvature_is_no_imperfection_between_clamps():
    rod = straight_rod(
        1.0,
        N,
        Section((1.0, 1.0, 0.8), mass=1.0, compliance=(0.0, 0.0, GIVE)),
        natural_curvature=(1e-2, 0.0, 0.0),
    )
    with pytest.warns(ModelWarning, match="nothing in the scene excites"):
        state = pressed(column(rod, CLAMP, CLAMP, push=0.05))
    assert sideways(state) < 1e-6


@pytest.mark.slow
@pytest.mark.parametrize(
    ("first", "last", "critical", "crooked"),
    [
        (CLAMP, CLAMP, 4 * np.pi**2, 1e-2),
        (PIN, PIN, np.pi**2, 3e-3),
        (CLAMP, PIN, 20.1907, 3e-3),
    ],
)
def test_a_column_shortened_by_a_twentieth_buckles(first, last, critical, crooked):
    # elastica between pins, or a quarter of that between clamps: shortening 2 (1 - E/K)
    load = lambda m: critical * (2 * ellipk(m) / np.pi) ** 2
    shortened = lambda m: 2 * (1 - ellipe(m) / ellipk(m)) + GIVE * load(m)
    expected = load(brentq(lambda m: shortened(m) - 0.05, 1e-3, 0.5))
    scene = column(imperfect(straight(), crooked), first, last, push=0.05)
    state = pressed(scene)
    thrust = -float(energy.reactions(scene, state).force[1, 2])
    np.testing.assert_allclose(thrust, expected, rtol=0.03)
    assert sideways(state) > 0.1


@pytest.mark.slow
def test_a_cantilever_under_a_dead_thrust_bends_as_the_elastica():
    thrust = 1.2 * np.pi**2 / 4
    state = pressed(column(imperfect(straight(), 1e-2), CLAMP, FREE, thrust=thrust))
    # K(sin^2(alpha/2)) = sqrt(P) for the tip's angle alpha, tip at 2 sin(alpha/2) / sqrt(P) aside
    m = brentq(lambda m: ellipk(m) - np.sqrt(thrust), 1e-6, 0.9)
    np.testing.assert_allclose(sideways(state), 2 * np.sqrt(m / thrust), rtol=5e-2)


@pytest.mark.slow
def test_a_twisted_shaft_leaves_its_axis():
    # clamped ends, free to slide: critical at 1.7879 turns (M L / A = 8.986819)
    bent = [
        sideways(pressed(column(imperfect(straight()), CLAMP, "xy123", turns=turns)))
        for turns in (0.0, 1.75)
    ]
    assert bent[0] < 2e-3
    assert bent[1] > 5 * bent[0]


@pytest.mark.slow
def test_amplitude_is_the_deviation_of_the_shape_at_rest():
    rod = imperfect(straight(), amplitude=0.01)
    scene = column(rod, CLAMP, FREE)
    shape = np.asarray(pressed(scene).position)
    chord = (shape[-1] - shape[0]) / np.linalg.norm(shape[-1] - shape[0])
    away = shape - (shape @ chord)[:, None] * chord
    np.testing.assert_allclose(np.linalg.norm(away, axis=1).max(), 0.01, rtol=2e-2)
    same = imperfect(straight(), 0.01)
    np.testing.assert_allclose(same.natural_curvature, rod.natural_curvature)
    slope = jax.grad(lambda a: jnp.sum(imperfect(rod, amplitude=a).natural_curvature ** 2))(0.01)
    assert np.isfinite(slope)


# curvature of the lowest modes: between clamps (both), pins (both), a pin and a clamp, free
MODES = {
    "clamps": lambda s: np.cos(2 * np.pi * s),
    "clamps, second": lambda s: np.sin(8.98682 * (s - 0.5)),
    "pins": lambda s: np.sin(np.pi * s),
    "pins, second": lambda s: np.sin(2 * np.pi * s),
    "clamp and pin": lambda s: np.sin(4.49341 * s),
    "clamp and free": lambda s: np.cos(np.pi * s / 2),
}


@pytest.mark.parametrize("seed", range(5))
def test_every_low_mode_is_excited_in_both_planes(seed):
    rod = imperfect(straight(200), seed=seed)
    s = np.asarray(rod.midpoints)
    kappa = np.asarray(rod.natural_curvature)[:, :2]
    size = np.sqrt(np.mean(kappa**2))
    assert np.linalg.matrix_rank(kappa, tol=0.1 * size) == 2
    for name, mode in MODES.items():
        part = np.linalg.norm(np.mean(kappa * mode(s)[:, None], 0))
        assert part > 0.1 * size * np.sqrt(np.mean(mode(s) ** 2)), name
    # the same shape on every grid
    coarse = np.asarray(imperfect(straight(50), seed=seed).natural_curvature)
    np.testing.assert_allclose(coarse[20], kappa_at(rod, 20.5 / 50), rtol=2e-2, atol=0.02 * size)


def kappa_at(rod, s):
    """Natural curvature at an arc length."""
    midpoints, values = np.asarray(rod.midpoints), np.asarray(rod.natural_curvature)
    return [np.interp(s, midpoints, column) for column in values.T]


def test_bad_sizes_are_refused():
    for given in ({"fraction": -1.0}, {"amplitude": -1e-3}, {"modes": 0}, {"modes": N}):
        with pytest.raises(ValueError, match=next(iter(given))):
            imperfect(straight(), **given)
