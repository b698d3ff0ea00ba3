"""Obstacles that move themselves: none sweeps over a rod unseen, by steps of any length."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

import rodjax as rx
from rodjax.equilibria.passages_at_rest import passages
from rodjax.interactions.interaction import as_seen

SECTION = rx.circular_section(0.02, 1e6, 0.4e6, density=1500.0)
WAY = rx.PiecewiseLinear([0.0, 0.01, 0.02], [(0, 0, 0), (-1, 0, 0), (-1, 0, 0)])


def flung(shape, **given):
    """A hanging rod and what comes from the side at 100 m/s, and is a metre further in 10 ms."""
    rod = rx.straight_rod(1.0, 10, SECTION, direction=(0, 0, -1), origin=(0, 0, 1.03))
    obstacle = rx.Obstacle(shape, 1e4, displacement=WAY, **given)
    return rx.Scene(rod, rx.Clamped(), loads=(obstacle,))


BALL = rx.Sphere((0.5, 0, 0.5), 0.1)
PEG = rx.Cylinder((0.5, 0, 0.48), (0, 1, 0), 0.015)  # between two nodes
WALL = rx.Plane((0.5, 0, 0), (1, 0, 0))
WALL_BEYOND = rx.Plane((0.5, 0, 0), (-1, 0, 0))


@pytest.mark.parametrize("shape", [BALL, PEG, WALL_BEYOND], ids=["ball", "peg", "wall"])
def test_what_is_flung_through_a_rod_is_told(shape):
    scene = flung(shape)
    for steps in (1, 3, 8):
        times = np.linspace(0, 0.01, steps + 1)[1:]
        run = rx.rollout(scene, rx.start(scene), times, throw=False)
        assert int(run.result) == rx.Result.OBSTACLE_PASSED
        assert np.all(np.isnan(run.states.position[-1]))


def test_a_wall_that_leaves_is_no_passage():
    scene = flung(dataclasses.replace(WALL, point=jnp.asarray([-0.5, 0.0, 0.0])))
    run = rx.rollout(scene, rx.start(scene), np.asarray([0.005, 0.01]))
    np.testing.assert_allclose(run.states.position[-1], run.states.position[0], atol=1e-12)


def test_shorter_steps_meet_it():
    """A stiff ball at 1 m/s pushes the rod before it, and adaptive steps that begin too long are
    taken again."""
    way = rx.PiecewiseLinear([0.0, 1.0], [(0, 0, 0), (-1, 0, 0)])
    scene = flung(rx.Sphere((0.2, 0, 0.08), 0.1), softness=0.1)
    obstacle = dataclasses.replace(scene.loads[0], displacement=way, stiffness=jnp.asarray(1e5))
    scene = dataclasses.replace(scene, loads=(obstacle,))
    control = rx.StepControl(first_step=0.15, max_step=0.2)
    run = rx.adaptive_rollout(scene, rx.start(scene), 0.2, control=control)
    assert int(run.rejected) > 0
    # its front is at x = 0.1 - t
    assert float(run.states.position[-1][-1, 0]) < -0.1


def test_at_rest_it_pushes_the_rod_however_few_the_load_steps():
    scene = flung(BALL)
    for steps in (1, 4, 30):
        state, _ = rx.equilibrium(
            scene, rx.placing(scene), time=0.01, load_steps=steps, relax=False
        )
        # it is pushed on to where the ball stops, at x = -0.5
        assert np.min(state.position[:, 0]) < -0.6
        gap = jnp.linalg.norm(state.position - jnp.asarray([[-0.5, 0, 0.5]]), axis=1) - 0.11
        assert -0.01 < float(jnp.min(gap)) < 0


def test_along_a_path_of_equilibria():
    rod = flung(BALL).rod

    def scene_of(shift):
        way = rx.Constant(jnp.stack([-shift, 0 * shift, 0 * shift]))
        obstacle = rx.Obstacle(BALL, 1e4, displacement=way)
        return rx.Scene(rod, rx.Clamped(), loads=(obstacle,))

    at = lambda shift: (scene_of(jnp.asarray(shift)), jnp.zeros(()))
    (code,) = passages(at(0.0), at(1.0), rod.position, rod.position)
    assert int(code) == rx.Result.OBSTACLE_PASSED
    (code,) = passages(at(0.0), at(0.5), rod.position, rod.position)  # half through
    assert int(code) == rx.Result.OBSTACLE_PASSED
    (code,) = passages(at(0.0), at(0.4), rod.position, rod.position)
    assert int(code) == rx.Result.SUCCESS


def test_what_rests_sees_the_rod_where_it_was():
    rows = jnp.ones((3, 3))
    still = rx.Obstacle(BALL, 1e4)
    moved = rx.Obstacle(BALL, 1e4, displacement=WAY)
    time, since = jnp.asarray(0.01), jnp.asarray(0.005)
    assert as_seen(still, time, rows, since) is rows
    np.testing.assert_allclose(as_seen(moved, time, rows, since), rows - jnp.asarray([[0.5, 0, 0]]))
    there = as_seen(moved, time, rows, since, still)
    np.testing.assert_allclose(there, rows - jnp.asarray([[1.0, 0, 0]]))
