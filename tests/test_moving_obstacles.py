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
    for first in (0.01, 0.003, 0.00125):  # at once, or by steps
        times = np.linspace(first, 0.02, 5)
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
    passed, well = rx.Result.OBSTACLE_PASSED, rx.Result.SUCCESS
    for shift, expected in ((1.0, passed), (0.5, passed), (0.4, well)):  # 0.5: half through
        (code,) = passages(lambda: at(0.0), at(shift), rod.position, rod.position)
        assert int(code) == expected


def test_a_path_of_equilibria_meets_it():
    """By a parameter that moves it across a rod that hangs, in steps that begin longer than it."""
    rod = flung(BALL).rod

    def scene_of(shift):
        way = rx.Constant(jnp.stack([-shift, 0 * shift, 0 * shift]))
        aside = rx.PointLoad(-1, rx.Constant(jnp.stack([0 * shift, 1e-3 * shift, 0 * shift])))
        loads = (rx.Gravity((0, 0, -9.81)), rx.Obstacle(BALL, 1e4, displacement=way), aside)
        return rx.Scene(rod, rx.Clamped(), loads=loads)

    origin, _ = rx.equilibrium(scene_of(jnp.zeros(())), rx.placing(scene_of(jnp.zeros(()))))
    path = rx.path(scene_of, origin, 0.0, 0.6, first_step=0.5, longest_step=0.5, throw=False)
    reached = np.asarray(path.parameters)
    ball = np.stack([0.5 - reached, 0 * reached, 0.5 + 0 * reached], 1)
    position = np.asarray(path.states.position)
    assert np.min(np.linalg.norm(position - ball[:, None], axis=2)) > 0.09
    # pushed by its radius and the rod's before it slips round
    np.testing.assert_allclose(np.min(position[..., 0]), -0.11, atol=2e-3)


def test_what_rests_sees_the_rod_where_it_was():
    rows = jnp.ones((3, 3))
    still = rx.Obstacle(BALL, 1e4)
    moved = rx.Obstacle(BALL, 1e4, displacement=WAY)
    time, since = jnp.asarray(0.01), jnp.asarray(0.005)
    assert as_seen(still, time, rows, since) is rows
    np.testing.assert_allclose(as_seen(moved, time, rows, since), rows - jnp.asarray([[0.5, 0, 0]]))
    there = as_seen(moved, time, rows, since, still)
    np.testing.assert_allclose(there, rows - jnp.asarray([[1.0, 0, 0]]))
