"""Loads that remember: what a step accepts is kept in the state, through runs, files, gradients."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float

import rodjax as rx
from rodjax import storage
from rodjax.scenes.memory import remembering

ELEMENTS, MASS, STIFFNESS, SPEED = 4, 0.5, 30.0, 2.0
STEPS = np.linspace(0.0, 0.4, 401)[1:]


class Ratchet(rx.AbstractLoad):
    """A spring along x that does not come back: it pulls as at the farthest that a node came."""

    stiffness: Float[Array, ""]
    memory: Float[Array, " nodes"] | None = None

    @property
    def remembers(self):
        return True

    def first_memory(self, rod, motion):
        return motion.position[:, 0]

    def next_memory(self, rod, motion):
        return self._farthest(motion)

    def _farthest(self, motion):
        x = motion.position[:, 0]
        return x if self.memory is None else jnp.maximum(self.memory, x)

    def wrench(self, rod, motion):
        pull = -self.stiffness * rod.node_length * self._farthest(motion)
        return jnp.zeros((len(pull), 6), pull.dtype).at[:, 0].set(pull)


def thrown(stiffness=STIFFNESS):
    """A free rod along z, thrown along x, and its start."""
    rod = rx.straight_rod(1.0, ELEMENTS, rx.circular_section(0.02, 1e9, 0.4e9, density=1500.0))
    rod = dataclasses.replace(rod, mass=jnp.full(ELEMENTS, MASS))
    scene = rx.Scene(rod, loads=(rx.Gravity((0, 0, 0)), Ratchet(jnp.asarray(stiffness))))
    velocity = jnp.zeros((ELEMENTS + 1, 3)).at[:, 0].set(SPEED)
    return scene, rx.start(scene, velocity=velocity)


def exact(time, stiffness=STIFFNESS):
    """x of a mass that swings out by a spring and falls back under its largest force."""
    omega = np.sqrt(stiffness / MASS)
    top, turn = SPEED / omega, 0.5 * np.pi / omega
    falling = top * (1 - 0.5 * omega**2 * (time - turn) ** 2)
    return np.where(time < turn, top * np.sin(omega * time), falling)


@pytest.fixture(scope="module")
def run():
    scene, state = thrown()
    return scene, rx.rollout(scene, state, STEPS)


def test_a_load_pulls_by_what_it_remembers(run):
    _, run = run
    place = np.asarray(run.states.position[:, 2, 0])
    np.testing.assert_allclose(place, exact(np.asarray(run.times)), atol=2e-5)
    assert place[-1] < 0.9 * np.max(place)
    farthest = np.maximum.accumulate(np.asarray(run.states.position[:, :, 0]))
    nothing, kept = run.states.memory.loads
    assert nothing is None
    np.testing.assert_allclose(kept, farthest, rtol=1e-15)


@pytest.mark.slow  # as users' programs are compiled: bits may differ else
def test_a_file_keeps_what_is_remembered(run, tmp_path):
    scene, run = run
    half = rx.rollout(scene, run.state(0), STEPS[:250])
    storage.save(tmp_path / "half.h5", scene, half, schedule=jnp.asarray(STEPS))
    rest = storage.load(tmp_path / "half.h5", classes=[Ratchet]).resume()
    for one, other in zip(jax.tree.leaves(rest.final), jax.tree.leaves(run.final), strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.slow
def test_steps_that_are_rejected_leave_no_memory():
    scene, state = thrown()
    control = rx.StepControl(1e-5, 1e-7, first_step=0.3)
    run = rx.adaptive_rollout(scene, state, 0.4, control=control)
    assert int(run.rejected) > 0
    farthest = np.maximum.accumulate(np.asarray(run.states.position[:, :, 0]))
    np.testing.assert_allclose(run.states.memory.loads[1], farthest, rtol=1e-15)


@pytest.mark.slow
def test_derivatives_pass_through_memory():
    def end(stiffness):
        scene, state = thrown(stiffness)
        return rx.rollout(scene, state, STEPS[3::4], throw=False).final.position[2, 0]

    at = jnp.asarray(STIFFNESS)
    value, pull = jax.vjp(end, at)
    pushed = jax.jvp(end, (at,), (jnp.ones_like(at),))[1]
    np.testing.assert_allclose(pull(jnp.ones_like(value))[0], pushed, rtol=1e-10)
    small = 1e-3
    slope = (exact(STEPS[-1], STIFFNESS + small) - exact(STEPS[-1], STIFFNESS - small)) / 2 / small
    small_steps = [end(at + sign * 1e-3) for sign in (1, -1)]
    differences = (small_steps[0] - small_steps[1]) / 2e-3
    np.testing.assert_allclose(pushed, differences, rtol=1e-6)
    np.testing.assert_allclose(pushed, slope, rtol=5e-3)


def test_memory_of_another_scene_is_refused(run):
    scene, run = run
    other = rx.Scene(scene.rod, loads=(Ratchet(jnp.asarray(1.0)),))
    with pytest.raises(ValueError, match="another scene"):
        rx.rollout(other, run.final, [0.5])
    forgetful = rx.Scene(scene.rod)
    assert remembering(forgetful, run.final).memory is None
