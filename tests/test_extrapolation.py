"""Orders that Richardson's extrapolation reaches on the grid and in time."""

import jax.numpy as jnp
import numpy as np
import pytest
from helpers import driven_scene, final_state, order_of

from rodjax.constraints.ends import Clamped, Turn
from rodjax.dynamics.consistency import start
from rodjax.equations.generalized_alpha import GeneralizedAlpha
from rodjax.equilibria.load_path import equilibrium
from rodjax.inputs.schedules import Constant, Function
from rodjax.interactions.loads import PointLoad
from rodjax.measuring.extrapolation import extrapolate
from rodjax.rods.builders import straight_rod
from rodjax.rods.section import Section
from rodjax.scenes.placing import placing
from rodjax.scenes.scene import Scene


def gaps(values):
    """Largest difference of every two successive results."""
    return [float(jnp.max(jnp.abs(a - b))) for a, b in zip(values, values[1:], strict=False)]


def test_polynomials_lose_their_leading_error():
    error = {"a": np.array([1.0, -2.0]), "b": (3.0,)}
    at = lambda h: {"a": 5 + error["a"] * h**3, "b": (7 + 3.0 * h**3,)}
    found = extrapolate(at(0.3), at(0.1), order=3, ratio=3)
    np.testing.assert_allclose(found["a"], [5, 5], rtol=1e-14)
    assert found["b"][0] == pytest.approx(7, rel=1e-14)


@pytest.mark.slow
def test_statics_become_fourth_order_in_space():
    """The elastica of Mattiasson (1981) at P L^2/A = 5: deflection .713792, shortening .387628."""
    sizes, tips = [8, 16, 32, 64], []
    for n in sizes:
        rod = straight_rod(1.0, n, Section((1.0, 1.0, 1.0), mass=1.0), direction=(1.0, 0.0, 0.0))
        scene = Scene(rod, Clamped(), loads=(PointLoad(-1, Constant([0.0, 0.0, 5.0])),))
        tips.append(equilibrium(scene, placing(scene), tolerance=1e-13)[0].position[-1])
    better = [extrapolate(a, b) for a, b in zip(tips, tips[1:], strict=False)]
    np.testing.assert_allclose(better[-1], [1 - 0.387628, 0.0, 0.713792], atol=1e-6)
    differences = [float(jnp.max(jnp.abs(a - b))) for a, b in zip(better, better[1:], strict=False)]
    assert order_of(1 / np.array(sizes[: len(differences)]), differences) == pytest.approx(
        4, abs=0.2
    )
    # the better of two results at a third of the price of one that is as exact
    assert abs(better[0][2] - 0.713792) < 0.2 * abs(tips[2][2] - 0.713792)


@pytest.mark.slow
def test_steps_become_third_order_in_time():
    scene = driven_scene(6)
    turn = Turn((0.0, 0.0, 1.0), Function(lambda t: 2 * jnp.sin(1.5 * t) ** 8))
    shift = Function(lambda t: jnp.sin(1.5 * t) ** 8 * jnp.asarray([0.2, -0.1, 0.2]))
    scene = Scene(scene.rod, Clamped(shift, turn), scene.last_end, scene.loads)
    method, state = GeneralizedAlpha(0.5, tolerance=1e-13), start(scene)
    counts = 100 * 2 ** np.arange(5)
    ends = [final_state(scene, state, 0.6, count, method).position for count in counts]
    better = [extrapolate(a, b) for a, b in zip(ends, ends[1:], strict=False)]
    plain, found = gaps(ends), gaps(better)
    assert order_of(1 / counts[:4], plain) == pytest.approx(2, abs=0.1)
    assert order_of(1 / counts[:3], found) == pytest.approx(3, abs=0.3)


def test_what_does_not_match_is_refused():
    with pytest.raises(ValueError, match=r"^coarse, fine: shapes \(3,\) and \(5,\)"):
        extrapolate(jnp.zeros(3), jnp.zeros(5))
    with pytest.raises(ValueError, match="^ratio, order"):
        extrapolate(jnp.zeros(3), jnp.zeros(3), ratio=1.0)
    bare = getattr(extrapolate, "__wrapped__", extrapolate)  # without the tests' checks of types
    for settings in ({"order": "2"}, {"ratio": None}, {"order": jnp.ones(2)}, {"ratio": 2j}):
        with pytest.raises(ValueError, match="^(order|ratio): must be one real number"):
            bare(jnp.zeros(3), jnp.zeros(3), **settings)
    for settings in ({"order": np.nan}, {"order": -1.0}, {"ratio": 0.5}):
        with pytest.raises(ValueError, match="^ratio, order: must be above"):
            bare(jnp.zeros(3), jnp.zeros(3), **settings)
    with pytest.raises(ValueError, match="^coarse, fine: give the same quantities"):
        extrapolate({"a": 1.0}, {"b": 1.0})
    with pytest.raises(ValueError, match="^coarse, fine: must be a real number"):
        extrapolate({"a": "x"}, {"a": "y"})
