"""A motion cut into windows and rolled again."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import driven_scene, standing_run

from rodjax.dynamics.consistency import start
from rodjax.dynamics.fixed_rollout import rollout
from rodjax.dynamics.windows import cut, defects, roll


@pytest.fixture(scope="module")
def whole():
    scene = driven_scene(6)
    return scene, rollout(scene, start(scene), jnp.linspace(0.0, 0.6, 13)[1:])


@pytest.mark.slow
def test_windows_of_a_motion_are_the_motion(whole):
    scene, run = whole
    windows = cut(run, 3)
    assert windows.times.shape == (3, 4)

    @jax.jit
    def missed(drag):
        load = dataclasses.replace(scene.loads[0], normal_coefficient=drag)
        new = dataclasses.replace(scene, loads=(load,))
        again = roll(new, windows)
        return jnp.sum(defects(windows, again) ** 2), again

    loss, again = missed(scene.loads[0].normal_coefficient)
    joined = jnp.concatenate([run.states.position[:1], *again.states.position[:, 1:]])
    np.testing.assert_allclose(joined, run.states.position, atol=1e-10)
    assert float(loss) < 1e-16
    assert np.all(np.asarray(again.result) == 0)
    # another drag misses, and the slope leads back
    slope = jax.jit(jax.grad(lambda drag: missed(drag)[0]))
    more = 1.5 * scene.loads[0].normal_coefficient
    assert float(missed(more)[0]) > 1e-10 and float(slope(more)) > 0


@pytest.mark.slow
def test_starts_have_derivatives(whole):
    scene, run = whole
    windows = cut(run, 2)

    @jax.jit
    @jax.grad
    def slope(shift):
        moved = eqx.tree_at(lambda w: w.starts.rate, windows, windows.starts.rate + shift)
        return jnp.sum(roll(scene, moved).states.position[:, -1])

    found = slope(jnp.zeros_like(windows.starts.rate))
    assert np.all(np.isfinite(found)) and float(jnp.max(jnp.abs(found))) > 1e-3


@pytest.fixture(scope="module")
def standing():
    """A run as long that nobody computed."""
    scene = driven_scene(6)
    return scene, standing_run(scene, 12, step_size=0.05)


def test_windows_take_their_states_times_and_drives_from_the_run(standing):
    _, run = standing
    windows = cut(run, 3)
    np.testing.assert_array_equal(windows.times, np.reshape(run.times[1:], (3, 4)))
    np.testing.assert_array_equal(windows.starts.time, run.times[:-1:4])
    np.testing.assert_array_equal(windows.starts.position, run.states.position[:-1:4])


def test_windows_must_share_the_steps(standing):
    with pytest.raises(ValueError, match="count: the 12 steps of the run do not make 5"):
        cut(standing[1], 5)


def test_what_makes_no_windows_is_refused(standing):
    scene, run = standing
    for count in (0, -3, 2.5, True, "3", None, jnp.ones(2)):
        with pytest.raises(ValueError, match="count: must be a whole number"):
            bare(cut)(run, count)
    with pytest.raises(ValueError, match="run: give a run"):
        bare(cut)(run.states, 3)
    with pytest.raises(ValueError, match="run: every step must be saved"):
        sparse = jax.tree.map(lambda leaf: leaf[::2], run.states)
        cut(dataclasses.replace(run, states=sparse), 3)
    with pytest.raises(ValueError, match="run: its states repeat after a failure"):
        cut(dataclasses.replace(run, states=held(run.states)), 3)
    windows = cut(run, 3)
    with pytest.raises(ValueError, match="windows: give windows"):
        bare(roll)(scene, run)
    with pytest.raises(ValueError, match="scene: give a scene"):
        bare(roll)(windows, windows)


def held(states):
    """The last states repeat one, as after a failure."""
    return jax.tree.map(lambda leaf: leaf.at[-3:].set(leaf[-3]), states)


def bare(function):
    """The function as users have it, without the checks of types that the tests add."""
    return getattr(function, "__wrapped__", function)
