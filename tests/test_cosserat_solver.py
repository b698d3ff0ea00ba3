"""Scenarios of cosseratbench as scenes, and a run of it from end to end."""

import dataclasses
import importlib.metadata
import logging

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rodjax as rx
from rodjax.harness import translation
from rodjax.harness.frames_at_rest import frames_at_rest
from rodjax.harness.material_lines import material_lines
from rodjax.harness.refinement import refined
from rodjax.rods.balance import internal
from rodjax.rods.state import at_rest
from rodjax.rods.strains import curvature, strains

pytest.importorskip("cosseratbench")

from cosseratbench.experiment import Experiment
from cosseratbench.experiment import run as run_experiment
from cosseratbench.scenario import (
    Cylinder,
    End,
    EndCondition,
    Material,
    Motion,
    Plane,
    PointLoad,
    Rod,
    Scenario,
)

from rodjax.harness.cosserat_solver import CosseratSolver

RUBBER = Material(1e6, 1e6 / 3, 1000.0)
BEAM = Rod(
    ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0)),
    0.02,
    RUBBER,
    start=EndCondition.CLAMPED,
    loads=(PointLoad((0.0, 0.0, -7.5e-3)),),
)
BENDING = Scenario((BEAM,), duration=10.0, quasi_static=True, self_contact=False)


def translated(scenario, elements=6):
    return translation.scene_of(scenario, elements, translation.settings_of(scenario))


def test_a_loaded_clamped_rod():
    scene = translated(BENDING)
    assert isinstance(scene.first_end, rx.Clamped) and isinstance(scene.last_end, rx.Free)
    load, damping = scene.loads
    assert int(load.node) == 6
    assert np.allclose(load.force(0.0), (0, 0, -7.5e-3))
    # a quarter of the inertia, all that moves twice as fast
    area, inertia = np.pi * 0.02**2, 250 * np.pi * 0.02**4 / 4
    rate = 4 * BENDING.slowest_frequency()
    expected = rate * np.array([250 * area] * 3 + [inertia, inertia, 2 * inertia])
    assert np.allclose(scene.rod.mass, 250 * area, rtol=1e-12)
    assert np.allclose(damping.parameters, expected[None], rtol=1e-12)
    # Timoshenko's factor is 27/28 where E = 3 G
    shear = 27 / 28 * RUBBER.shear_modulus * area
    compliance = [1 / shear, 1 / shear, 1 / (1e6 * area)]
    assert np.allclose(scene.rod.compliance, [compliance] * 6, rtol=1e-12)
    assert scene.contact is None


def test_motion_that_counts_is_not_damped():
    moving = dataclasses.replace(BENDING, quasi_static=False)
    assert np.allclose(translated(moving).rod.mass, 1000 * np.pi * 0.02**2, rtol=1e-12)
    assert not [x for x in translated(moving).loads if isinstance(x, rx.DistributedLoad)]


def test_weight_is_whole_where_inertia_is_not():
    hung = dataclasses.replace(BENDING, gravity=(0.0, 0.0, -9.81))
    for scenario in (hung, dataclasses.replace(hung, self_contact=True)):
        scene = translated(scenario)
        (gravity,) = (load for load in scene.loads if isinstance(load, rx.Gravity))
        weight = np.asarray(scene.rod.mass)[:, None] * np.asarray(gravity.acceleration)
        assert np.allclose(weight, [[0, 0, -9.81e3 * np.pi * 0.02**2]] * len(weight), rtol=1e-12)


def test_a_rod_that_starts_stretched():
    hung = dataclasses.replace(BEAM, rest_arc_length=(0.0, 0.8))
    scene = translated(dataclasses.replace(BENDING, rods=(hung,)))
    assert np.allclose(scene.rod.length, 0.8 / 6)
    assert np.allclose(scene.rod.position[-1], (1, 0, 0))
    found = strains(scene.rod, scene.rod.position, scene.rod.quaternion)
    assert np.allclose(found.stretch, [[0, 0, 1.25]] * 6, atol=1e-12)


def test_a_driven_sliding_end_rests_after_its_motion():
    motion = Motion(
        (0.0, 1.0),
        ((0.0, 0.0, 0.0), (0.0, 0.1, 0.0)),
        ((0.0, 0.0, 0.0), (-3.0, 0.0, 0.0)),
        slides_along=(1.0, 0.0, 0.0),
    )
    rod = dataclasses.replace(BEAM, end=EndCondition.CLAMPED, end_motion=motion)
    for duration in (0.01, 10.0):  # a warm-up's and a run's are one program
        scenario = dataclasses.replace(BENDING, rods=(rod,), duration=duration)
        end = translated(scenario).last_end
        assert isinstance(end, rx.Slider) and end.displacement.times.shape == (3,)
        assert np.allclose(end.displacement(0.5), (0, 0.05, 0))
        assert np.allclose(end.displacement(1.0 + duration), (0, 0.1, 0))
        assert np.allclose(end.rotation(0.5), (-1.5, 0, 0))
        assert end.displacement.until >= duration


def test_a_clamp_that_turns_about_two_axes_is_refused():
    turning = Motion((0.0, 1.0, 2.0), ((0.0,) * 3,) * 3, ((0, 0, 0), (1, 0, 0), (1, 1, 0)))
    rod = dataclasses.replace(BEAM, start_motion=turning)
    with pytest.raises(NotImplementedError, match="more than one axis"):
        translated(dataclasses.replace(BENDING, rods=(rod,)))


def test_obstacles():
    floor = Plane((0.0, 0.0, -0.1), (0.0, 0.0, 2.0), friction=0.3)
    drum = Cylinder((0.5, 0.0, -0.5), (0.0, 1.0, 0.0), 0.1, 0.4, friction=0.3)
    rod = dataclasses.replace(BEAM, friction=0.5)
    flat, round_ = translated(
        dataclasses.replace(BENDING, rods=(rod,), obstacles=(floor, drum))
    ).loads[2:]
    assert float(flat.friction.coefficient) == float(round_.friction.coefficient) == 0.5
    assert float(flat.shape.distance(jnp.array([3.0, 2.0, 0.3]))) == pytest.approx(0.4)
    for place, distance in [
        ((0.5, 0.0, 0.0), 0.4),  # above the axis
        ((0.5, 0.3, -0.5), 0.1),  # beyond an end, on the axis
        ((0.9, 0.5, -0.5), np.hypot(0.3, 0.3)),  # off an edge
        ((0.5, 0.1, -0.47), -0.07),  # inside
    ]:
        found, normal = round_.shape.distance_and_normal(jnp.array(place))
        assert float(found) == pytest.approx(distance)
        assert np.linalg.norm(normal) == pytest.approx(1)


def test_several_rods_touch():
    other = dataclasses.replace(
        BEAM,
        centerline=((0.0, 0.3, 0.0), (1.0, 0.3, 0.0)),
        friction=0.2,
        loads=(PointLoad((1.0, 0.0, 0.0), End.START),),
    )
    rods = (dataclasses.replace(BEAM, friction=0.2), other)
    scene = translated(dataclasses.replace(BENDING, rods=rods))
    assert scene.contact.friction.coefficient == 0.2
    assert scene.contact.shared[0] == scene.contact.shared[1] > 1
    assert [int(load.node) for load in scene.loads[:2]] == [6, 7]
    with pytest.raises(NotImplementedError, match="rub differently"):
        translated(dataclasses.replace(BENDING, rods=(BEAM, other)))


def test_frames_at_rest_balance_their_moments():
    angles = np.linspace(0, 1.5, 31)
    arc = np.stack([np.sin(angles), np.zeros(31), 1 - np.cos(angles)], 1)
    section = rx.circular_section(0.02, 1e6, 4e5, density=1000.0, extensible=True)
    rod = rx.straight_rod(1.5, 30, section)
    frames = frames_at_rest(rod, arc, np.array([0.0, 1.0, 0.0]))
    motion = at_rest(jnp.zeros(()), jnp.asarray(arc), jnp.asarray(frames))
    gap = strains(rod, *motion[1:3]).stretch - jnp.array([[0.0, 0.0, 1.0]])
    moment = internal(rod, motion, gap / rod.compliance).moment
    bending = float(rod.stiffness[0, 0])  # over the radius, 1 m
    assert np.max(np.abs(moment)) < 2e-3 * bending
    # the free ends unbend, for which they shear a little
    shear = np.abs(gap[:, :2]).max(1)
    assert shear[0] > 1e-3 and np.all(shear[10:20] < 1e-5)
    assert np.allclose(np.abs(curvature(rod, jnp.asarray(frames))[10:20, 0]), 1, rtol=1e-3)


def test_material_lines_turn_with_the_rod():
    half = np.array([0.0, 0.5, 1.0])  # half of the angles that the sections are turned by
    along = np.stack([[0.0, 0, 0], [0, 0, 1.0], [0, 0, 2.0]])
    frames = np.stack([np.cos(half), 0 * half, 0 * half, np.sin(half)], 1)
    still = np.array([[1.0, 0, 0, 0]] * 3)
    first = np.array([[0.6, 0.8, 0.0]] * 2)
    found = material_lines(np.stack([along] * 2), np.stack([still, frames]), first)
    assert np.allclose(found[0], first)
    for i, angle in enumerate((0.5, 1.5)):
        turned = np.array(
            [
                0.6 * np.cos(angle) - 0.8 * np.sin(angle),
                0.6 * np.sin(angle) + 0.8 * np.cos(angle),
                0.0,
            ]
        )
        assert np.allclose(found[1, i], turned)


def test_refined_positions_are_of_higher_order():
    exact = lambda s: np.stack([np.sin(s), np.cos(2 * s), s], -1)[None]
    error = lambda s: np.stack([s**2, np.sin(s), 0 * s], -1)[None]
    fine, coarse = np.linspace(0, 1, 21), np.linspace(0, 1, 17)
    found = refined(exact(coarse) + 1.25**2 * error(coarse), exact(fine) + error(fine))
    assert np.allclose(found, exact(fine), atol=1e-5)


def test_grids_and_steps_are_refined_together():
    moving = dataclasses.replace(BENDING, quasi_static=False)
    settings = CosseratSolver().settings(moving, n_elements=20, n_frames=101)
    assert settings["extrapolated_from_elements"] == [16, 20]
    # 1600 steps a period, a multiple of five a frame
    longest = 2 * np.pi / BENDING.slowest_frequency() / 1600
    assert longest / 2 < settings["time_step"] <= longest
    assert round(0.1 / settings["time_step"]) % 5 == 0


def test_it_is_found_by_its_entry_point():
    points = importlib.metadata.entry_points(group="cosseratbench.solvers", name="rodjax")
    for point in points:  # none in a source tree
        assert point.load() is CosseratSolver


class Watched(CosseratSolver):
    """Notes the programs that each of its runs compiles."""

    def __init__(self):
        super().__init__()
        self.compiled = []

    def run(self, scenario, **given):
        heard, logger = [], logging.getLogger("jax")
        handler = logging.Handler()
        handler.emit = lambda record: heard.append(record.getMessage())
        logger.addHandler(handler)
        try:
            with jax.log_compiles():
                return super().run(scenario, **given)
        finally:
            logger.removeHandler(handler)
            self.compiled.append([one for one in heard if "Finished XLA compilation" in one])


@pytest.fixture(scope="module")
def watched():
    return Watched()


@pytest.fixture(scope="module")
def result(watched):
    """A cantilever through the benchmark itself, in a process of single precision."""
    tip = lambda scenario, run: float(run.positions[0][-1, -1, 2])
    experiment = Experiment("bending", "", lambda: BENDING, {"tip": tip}, n_elements=8, n_frames=51)
    with jax.enable_x64(False):
        return run_experiment(experiment, watched)


def test_the_benchmark_runs_it(result):
    assert result.outcome == "completed"
    bending = 1e6 * np.pi * 0.02**4 / 4
    assert result.metrics["tip"] == pytest.approx(-7.5e-3 / (3 * bending), rel=5e-3)
    assert result.trajectory.directors[0].shape == (51, 8, 3)
    assert np.allclose(result.trajectory.directors[0][0], BEAM.directors(8))
    assert result.settings["time_step"] == pytest.approx(0.1)


def test_what_is_timed_is_compiled_by_the_warm_up(watched, result):
    warm_up, timed = watched.compiled
    assert len(warm_up) > 0
    assert timed == []
