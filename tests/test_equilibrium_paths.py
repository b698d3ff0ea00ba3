"""Paths of equilibria against closed forms, their critical points and their derivatives."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import ellipe, ellipk

import rodjax as rx
from rodjax.continuation.path_arguments import check_settings

TWIST = 8.986819  # M L/A of clamped ends without tension
RATIO = 0.8  # torsional over bending stiffness
AXIS = (0.0, 0.0, 1.0)
TURN = rx.Turn(AXIS, rx.PiecewiseLinear([-20.0, 20.0], [-40 * np.pi, 40 * np.pi]))
TURNS = TWIST / (2 * np.pi * RATIO)


def rod_of(elements):
    section = rx.Section((1.0, 1.0, RATIO), diameter=0.02, mass=1.0)
    return rx.straight_rod(1.0, elements, section)


def turned(rod, loads=()):
    return rx.Scene(rod, rx.Clamped(), rx.Slider(AXIS, rotation=TURN), loads=loads)


def _pressed(rod, thrust):
    force = rx.Constant(jnp.stack([0.0 * thrust, 0.0 * thrust, -thrust]))
    load = rx.PointLoad(-1, force=force)
    return rx.Scene(rod, rx.Clamped(), rx.Slider(AXIS), loads=(load,))


def pressed(rod):
    return jax.tree_util.Partial(_pressed, rod)


def shortening(scene, state):
    return 1.0 - state.position[-1, 2]


@pytest.fixture(scope="module")
def twisted():
    """A clamped rod of 16 elements whose other end is turned by up to three turns."""
    scene = turned(rod_of(16))
    return scene, rx.path(scene, rx.placing(scene), 0.0, 2.5, measures={"short": shortening})


@pytest.mark.slow
def test_a_rod_under_torsion_stays_straight_and_loses_stability_twice(twisted):
    _, path = twisted
    assert path.end is rx.PathEnd.STOP and path.result == 0
    assert path.parameters[0] == 0 and path.parameters[-1] == pytest.approx(2.5, abs=1e-12)
    assert np.max(np.abs(path.measures["short"])) < 1e-12
    (point,) = path.critical
    assert point.kind == "branch" and point.modes.shape == (2, 17, 6)
    # second order: 0.77/n^2 above the continuous rod's
    assert float(point.parameter) / TURNS - 1 == pytest.approx(0.77 / 16**2, rel=0.03)
    beyond = path.parameters > float(point.parameter)
    assert np.all(path.unstable == np.where(beyond, 2, 0))
    torque = path.reactions.torque[:, 1, 2]
    np.testing.assert_allclose(torque, 2 * np.pi * RATIO * path.parameters, atol=1e-9)
    np.testing.assert_allclose(path.energy, 0.5 * torque**2 / RATIO, atol=1e-9)


@pytest.mark.slow
def test_eigenvalues_are_those_of_stability(twisted):
    scene, path = twisted
    i = int(np.argmin(np.abs(path.parameters - 1.6)))
    lowest = np.asarray(rx.stability(scene, path.state(i), count=3).eigenvalues)
    # another norm, which does not count displacements: zero at the same load, and of the same sign
    near = path.eigenvalues[i, :2]
    assert np.all(near > 0) and np.all(lowest > 0)
    np.testing.assert_allclose(near / lowest[:2], near[0] / lowest[0], rtol=1e-6)
    assert path.eigenvalues.shape == (len(path), 4)
    # bending has no part in the torsional modes that are nearest to zero before
    assert np.all(
        np.sum(path.eigenvalues < 0, 1)[path.parameters < 2.1]
        == path.unstable[path.parameters < 2.1]
    )


@pytest.mark.slow
def test_what_is_printed_says_where_it_branches(twisted):
    said = str(twisted[1])
    assert "the parameter reached the value asked" in said
    assert "unstable modes: 0, 2" in said and "branch at 1.79" in said


@pytest.mark.slow
def test_the_buckled_rod_is_unstable_and_unwinds_into_a_plane_loop(twisted):
    """The pitchfork is subcritical; half of it mirrors the other (Coyne; van der Heijden 2003)."""
    scene, path = twisted
    (point,) = path.critical
    both = [
        rx.branch(scene, point, (1.0, 2.5), way=way, measures={"short": shortening})
        for way in (1, -1)
    ]
    for found in both:
        assert found.end is rx.PathEnd.STOP and found.parameters[-1] == pytest.approx(1.0)
        assert np.all(np.diff(found.parameters) < 0) and np.all(found.unstable[1:] == 1)
        assert np.all(np.diff(np.asarray(found.measures["short"])) > 0)
    x = [np.asarray(found.states.position)[-1, 8, :2] for found in both]
    np.testing.assert_allclose(x[0], -x[1], atol=1e-6)
    other = rx.branch(scene, point, (1.0, 2.5), mode=(0.6, 0.8), measures={"short": shortening})
    short = [np.asarray(one.measures["short"])[-1] for one in (*both, other)]
    np.testing.assert_allclose(short, short[0], rtol=1e-8)


@pytest.mark.slow
def test_thresholds_converge_in_second_order():
    found = {}
    for elements in (24, 48, 96):
        rod = rod_of(elements)
        state = rx.placing(turned(rod))
        column = rx.path(pressed(rod), state, 30.0, 45.0, longest_step=0.5).critical[0]
        twist = rx.path(turned(rod), state, 0.0, 2.2, longest_step=0.4).critical[0]
        found[elements] = float(column.parameter), float(twist.parameter)
    for i, exact in enumerate((4 * np.pi**2, TURNS)):
        errors = np.array([found[n][i] / exact - 1 for n in (24, 48, 96)])
        order = np.log2(errors[:-1] / errors[1:])
        np.testing.assert_allclose(order, 2.0, atol=0.05)
        finest = (4 * found[96][i] - found[48][i]) / 3
        assert finest == pytest.approx(exact, rel=1e-5)


@pytest.mark.slow
def test_a_buckled_column_is_the_elastica():
    rod = rod_of(100)
    scene_of = pressed(rod)
    point = rx.path(scene_of, rx.placing(turned(rod)), 30.0, 45.0, longest_step=0.5).critical[0]
    found = rx.branch(scene_of, point, (30.0, 54.0), measures={"short": shortening})
    m = np.array([_modulus(load) for load in found.parameters[1:]])
    exact = 2 - 2 * ellipe(m) / ellipk(m)
    assert found.parameters[-1] == pytest.approx(54.0) and exact[-1] > 0.4
    np.testing.assert_allclose(np.asarray(found.measures["short"])[1:], exact, atol=2e-3)


def _modulus(load):
    """m of 16 K(m)^2 = load."""
    low, high = 0.0, 1 - 1e-12
    for _ in range(200):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if 16 * ellipk(middle) ** 2 < load else (low, middle)
    return low


@pytest.mark.slow
def test_a_branch_that_comes_back_to_its_path_has_a_branch_point_there():
    """Seen from the branch: the parameter turns, and as many modes are unstable as before."""
    rod = rod_of(24)
    scene_of = pressed(rod)
    straight = rx.path(scene_of, rx.placing(turned(rod)), 30.0, 45.0, longest_step=0.5)
    point = straight.critical[0]
    out = rx.branch(scene_of, point, (30.0, 46.0))
    back = rx.path(scene_of, out.state(-1), 46.0, 30.0)
    assert back.end is rx.PathEnd.START and np.all(back.unstable == 0)
    x = [np.asarray(back.states.position)[i, 12, :2] for i in (0, -1)]
    np.testing.assert_allclose(x[0], -x[1], atol=1e-6)
    (found,) = back.critical
    assert found.kind == "branch"
    assert float(found.parameter) == pytest.approx(float(point.parameter), rel=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("longest_step", (0.2, 0.5))
def test_a_branch_of_shapes_that_can_be_turned_comes_back_at_its_lowest(longest_step):
    """Steps along the bowl pass beside its lowest point; two turns less are the same rod."""

    def section(s):
        fourth = np.where(abs(s - 0.5) < 0.125, 0.9, 1.0) ** 4
        return rx.Section((fourth, fourth, RATIO * fourth), diameter=0.02, mass=1.0)

    scene = turned(rx.straight_rod(1.0, 24, section))
    straight = rx.path(scene, rx.placing(scene), 0.0, 2.2, longest_step=0.5)
    first = straight.critical[0]
    path = rx.branch(scene, first, (0.0, 2.5), points=130, longest_step=longest_step)
    folds = [float(one.parameter) for one in path.critical if one.kind == "fold"]
    assert folds[0] + folds[1] == pytest.approx(2.0, abs=1e-9)
    found = next(one for one in path.critical if one.kind == "branch")
    assert float(found.parameter) == pytest.approx(2.0 - float(first.parameter), abs=1e-8)


@pytest.mark.slow
def test_branch_points_of_a_bent_rod_do_not_depend_on_the_steps(twisted):
    """Its axis of symmetry turns along the path, and Newton's method may come to the branch."""
    scene, straight = twisted

    def found(scene, straight, longest_step):
        bounds = (-1.4, 2.5)
        path = rx.branch(scene, straight.critical[0], bounds, longest_step=longest_step)
        (point,) = path.critical
        return point

    points = [found(scene, straight, step) for step in (0.2, 0.3, 0.5)]
    turns = [float(one.parameter) for one in points]
    np.testing.assert_allclose(turns, turns[0], rtol=1e-9)
    # and are found in a scene that differs, whose axis stands otherwise
    rod = scene.rod
    stiffer = dataclasses.replace(rod, stiffness=rod.stiffness * np.array([[1.0, 1.0, 1.05]]))
    other = turned(stiffer)
    walked = found(other, rx.path(other, rx.placing(other), 0.0, 2.5), 0.3)
    again = rx.critical(other, points[0])
    assert abs(float(walked.parameter) - turns[0]) > 0.05
    assert float(again.parameter) == pytest.approx(float(walked.parameter), rel=1e-9)


@pytest.mark.slow
def test_seeded_steps_give_one_diagram(twisted):
    scene, path = twisted
    random = np.random.default_rng(7)
    for _ in range(20):
        steps = {"first_step": random.uniform(0.005, 0.3), "longest_step": random.uniform(0.1, 0.5)}
        again = rx.path(scene, path.state(0), 0.0, 2.5, measures={"short": shortening}, **steps)
        assert [one.kind for one in again.critical] == ["branch"]
        found, known = again.critical[0].parameter, path.critical[0].parameter
        assert float(found) == pytest.approx(float(known), rel=1e-8)


def _necked(rod, amplitudes, turns):
    s = jnp.asarray((np.arange(rod.elements) + 0.5) / rod.elements)
    fourth = (1.0 + amplitudes[0] * jnp.cos(2 * jnp.pi * s) + amplitudes[1] * s) ** 4
    stiffness = jnp.stack([fourth, fourth, RATIO * fourth], 1)
    return turned(dataclasses.replace(rod, stiffness=stiffness)), turns


@pytest.mark.slow
def test_critical_turns_have_derivatives_in_both_modes(twisted):
    scene, path = twisted
    (point,) = path.critical

    def critical(amplitudes):
        scenes = jax.tree_util.Partial(_necked, scene.rod, amplitudes)
        return rx.critical(scenes, point).parameter

    at = jnp.array([-0.1, 0.05])
    reverse = jax.jit(jax.grad(critical))(at)
    forward = jax.jit(jax.jacfwd(critical))(at)
    # the point has a pair of modes: along the second rounding is divided by little
    np.testing.assert_allclose(reverse, forward, rtol=1e-6)
    for i in range(2):
        # Richardson's rule of central differences
        slopes = [
            (critical(at.at[i].add(h)) - critical(at.at[i].add(-h))) / (2 * h) for h in (4e-3, 2e-3)
        ]
        assert float(reverse[i]) == pytest.approx(float(4 * slopes[1] - slopes[0]) / 3, rel=1e-6)


def _leaning(rod, lean, turns):
    """Turned with a small force across, so that it bends from the first."""
    push = rx.PointLoad(rod.elements // 2, force=rx.Constant(jnp.stack([lean, 0 * lean, 0 * lean])))
    return turned(rod, (push,)), turns


@pytest.mark.slow
@pytest.mark.parametrize("split", [1e-6, 1e-3, 0.05])
def test_a_pair_of_modes_that_is_split_has_two_loads(twisted, split):
    """The other mode of the pair is not held where it costs something.

    Both are found where they lie in one step of the path.
    """
    scene, path = twisted
    rod = scene.rod
    stiffness = rod.stiffness * jnp.asarray([[1 + split, 1.0, 1.0]])
    other = dataclasses.replace(scene, rod=dataclasses.replace(rod, stiffness=stiffness))
    found = float(rx.critical(other, path.critical[0]).parameter)
    walked = rx.path(other, rx.placing(other), 0.0, 2.2, longest_step=0.05)
    apart = [abs(found / float(one.parameter) - 1) for one in walked.critical]
    assert min(apart) < 1e-8
    first, second = walked.critical
    assert len(first.modes) == len(second.modes) == 1
    # by one half of the split more than the pair in the mean, to first order
    pair = float(path.critical[0].parameter)
    mean = 0.5 * (float(first.parameter) + float(second.parameter))
    assert mean / pair - 1 == pytest.approx(0.5 * split, rel=0.02 + 1.5 * split)
    # and apart in proportion to it
    apart = float(second.parameter) - float(first.parameter)
    assert apart / pair == pytest.approx(0.39 * split, rel=0.02 + 6 * split)


@pytest.mark.slow
def test_functions_that_make_schedules_have_critical_points(twisted):
    """Constants of a function that is compiled within another are literals there."""
    scene, path = twisted

    def scene_of(turns):
        turn = rx.Turn(AXIS, rx.PiecewiseLinear([-20.0, 20.0], [-40 * np.pi, 40 * np.pi]))
        return rx.Scene(scene.rod, rx.Clamped(), rx.Slider(AXIS, rotation=turn)), turns

    point = path.critical[0]
    found = jax.jit(lambda point: rx.critical(scene_of, point, throw=False))(point)
    assert int(found.result) == 0
    assert float(found.parameter) == pytest.approx(float(point.parameter), rel=1e-9)


@pytest.mark.slow
def test_an_imperfection_makes_a_fold_whose_load_has_derivatives(twisted):
    scene, path = twisted
    lean = jnp.asarray(0.05)
    scenes = jax.tree_util.Partial(_leaning, scene.rod, lean)
    state, _ = rx.equilibrium(scenes(0.0)[0], rx.placing(scene))
    found = rx.path(scenes, state, 0.0, 2.5, points=300)
    folds = [one for one in found.critical if one.kind == "fold"]
    assert folds and found.end is rx.PathEnd.START  # over the top, and back to no turns
    top = folds[0]
    assert float(top.parameter) < float(path.critical[0].parameter)
    assert float(top.parameter) == pytest.approx(np.max(found.parameters), abs=1e-4)

    load = lambda lean: rx.critical(jax.tree_util.Partial(_leaning, scene.rod, lean), top).parameter
    slope = jax.jit(jax.grad(load))(lean)
    assert float(slope) == pytest.approx(float(jax.jit(jax.jacfwd(load))(lean)), rel=1e-7)
    h = 1e-3
    differences = [(load(lean + k * h) - load(lean - k * h)) / (2 * k * h) for k in (2, 1)]
    assert float(slope) == pytest.approx(float(4 * differences[1] - differences[0]) / 3, rel=1e-6)


@pytest.mark.slow
def test_a_target_ends_a_path_where_a_measure_has_it(twisted):
    scene, path = twisted
    short = lambda scene, state: rx.energy.reactions(scene, state).torque[1, 2]
    options = {"measures": {"torque": short}, "targets": {"torque": 5.0}}
    found = rx.path(scene, path.state(0), 0.0, 2.5, **options)
    assert found.end is rx.PathEnd.TARGET
    assert found.measures["torque"][-1] == pytest.approx(5.0, abs=1e-9)
    assert found.parameters[-1] == pytest.approx(5.0 / (2 * np.pi * RATIO), abs=1e-9)


def test_wrong_arguments_are_told():
    scene = turned(rod_of(4))
    start = rx.placing(scene)
    modes, one = jnp.ones((2, 5, 6)), jnp.ones(())
    point = rx.CriticalPoint("branch", 1.79 * one, start, modes, modes, one, start, jnp.asarray(0))
    fold = dataclasses.replace(point, kind="fold")
    cases = [
        (lambda: rx.path(scene, start, 1.0, 1.0), "stop: must differ from start"),
        (lambda: rx.path(lambda p: 3.0, start, 0.0, 1.0), "scene_of: must return a Scene"),
        (lambda: rx.path(scene, start, 0.0, 1.0, points=1), "points"),
        (lambda: rx.path(scene, start, 0.0, 1.0, modes=1), "modes"),
        (lambda: check_settings(2, 0.1, 0.1, 4, {"a": 1}, None), "must be a function"),
        (lambda: rx.path(scene, start, 0.0, 1.0, targets={"a": 1.0}), "is none of the measures"),
        (lambda: rx.branch(scene, fold, (0.0, 2.0)), "point: is a fold"),
        (lambda: rx.branch(scene, point, (0.0, 1.0)), "do not hold the branch point"),
        (lambda: rx.branch(scene, point, (0.0, 2.0), way=2), "way: must be 1 or -1"),
        (lambda: rx.branch(scene, point, (0.0, 2.0), mode=5), "mode: the point has 2"),
    ]
    for call, message in cases:
        with pytest.raises(ValueError, match=message):
            call()


def test_what_remembers_has_no_paths():
    scene = turned(rod_of(4))
    plastic = rx.ElasticPlastic(yield_moment=1.0, hardening=0.1)
    rod = dataclasses.replace(scene.rod, material=plastic)
    with pytest.raises(ValueError, match="depend on how it was reached"):
        rx.path(dataclasses.replace(scene, rod=rod), rx.placing(scene), 0.0, 1.0)


@pytest.mark.slow
def test_a_start_that_is_no_equilibrium_is_told(twisted):
    scene, path = twisted
    with pytest.raises(ValueError, match="state: is no equilibrium"):
        rx.path(scene, path.state(5), 0.0, 2.0)


@pytest.mark.slow
def test_a_parameter_without_influence_is_told(twisted):
    scene, path = twisted
    still = dataclasses.replace(scene, last_end=rx.Slider(AXIS))
    with pytest.raises(ValueError, match="nothing in the scene changes with the parameter"):
        rx.path(still, path.state(0), 0.0, 1.0)
