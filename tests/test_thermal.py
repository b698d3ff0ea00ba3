"""Rods in a heat bath: their averages, their reproducibility, and what is refused."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import thermal_oracles

import rodjax as rx
from rodjax.numerics.averages import Averages
from rodjax.rods.strains import strains

KT = 4.114  # [pN nm]
STIFFNESS = (50 * KT, 50 * KT, 100 * KT)  # [pN nm^2]
SPACING, ELEMENTS, TRAP = 5.0, 4, 5.0  # [nm], [pN/nm]
WATER = rx.LinearDrag(3e-3, 2e-3, 0.025)  # [pN us/nm^2, pN us]
SECTION = rx.Section(stiffness=STIFFNESS, diameter=2.0)
STRAIGHT = rx.straight_rod(SPACING * ELEMENTS, ELEMENTS, SECTION)
ROD = rx.yielding(STRAIGHT, 10.0)
BATH = rx.Bath(KT)


class Trap(rx.AbstractLoad):
    """A spring that draws the last node to the origin."""

    stiffness: jax.Array

    def wrench(self, rod, motion):
        pull = jnp.zeros_like(motion.position).at[-1].set(-self.stiffness * motion.position[-1])
        return jnp.concatenate([pull, jnp.zeros_like(pull)], 1)


SCENE = rx.Scene(ROD, loads=(WATER, Trap(jnp.asarray(TRAP))))


TRACED = []
"""One entry for every time that `seen` is traced."""


def seen(state):
    """Squares of the elements' rotations and strains, of the ends' distance, of the trap's node."""
    TRACED.append(state)
    found = strains(ROD, state.position, state.quaternion)
    strain = found.stretch - jnp.asarray([[0.0, 0.0, 1.0]])
    return {
        "turns": jnp.mean(found.rotation**2, 0),
        "strains": jnp.mean(strain**2, 0),
        "ends": jnp.sum((state.position[-1] - state.position[0]) ** 2),
        "trap": jnp.mean(state.position[-1] ** 2),
    }


def expected():
    compliance = float(ROD.compliance[0, 0])
    return {
        "turns": thermal_oracles.mean_squares(STIFFNESS, SPACING, KT),
        "strains": np.full(3, KT * compliance / SPACING),
        "ends": thermal_oracles.end_to_end(ELEMENTS, STIFFNESS, compliance, SPACING, KT),
        "trap": KT / TRAP,
    }


REPLICAS, STRIDE = 64, 40


@eqx.filter_jit
def _stride(starts, bath, dt, averages):
    """Some steps of replicas, looked at by every fourth."""
    roll = lambda one, before: rx.thermal_rollout(
        SCENE, one, bath, dt, STRIDE, measure=seen, measure_every=4, averages=before, throw=False
    )
    return jax.vmap(roll)(starts, averages)


def _replicas(starts, bath, dt, steps):
    """Any number of strides of replicas, by one program."""
    dt, number = jnp.asarray(dt), len(starts.key)
    shapes = jax.eval_shape(seen, jax.tree.map(lambda leaf: leaf[0], starts.state))
    averages = jax.tree.map(lambda leaf: jnp.stack([leaf] * number), Averages.of(shapes))
    assert steps % STRIDE == 0
    for _ in range(steps // STRIDE):
        run = _stride(starts, bath, dt, averages)
        starts, averages = run.final, run.averages
    return run


def _starts(count, seed=0):
    keys = jax.random.split(jax.random.key(seed), count)
    return jax.vmap(lambda key: rx.thermal_start(SCENE, key))(keys)


def _averages(bath, dt, replicas, steps):
    """Mean and error of what is seen, once the rods are in equilibrium."""
    begun = _replicas(_starts(replicas), bath, dt, steps)
    run = _replicas(begun.final, bath, dt, steps)
    assert int(jnp.max(run.result)) == 0
    return run.averages.pooled()


def test_curvature_and_twist_have_their_variance():
    """kT ds/B of the rotation of an element, but for the curvature of the space of frames."""
    found = expected()["turns"] / (KT * SPACING / np.asarray(STIFFNESS))
    np.testing.assert_allclose(found, 1 - np.array([0.1, 0.1, 0.05]) / 6, atol=2e-3)


def _agree(found, names, errors=2, within=0.01):
    """Within so many standard errors, of which none is more than so much of the average."""
    (mean, error), right = found, expected()
    for name in names:
        one, off = np.asarray(error[name]), np.abs(np.asarray(mean[name]) - right[name])
        assert np.all(one < within * right[name]), (name, one / right[name])
        assert np.all(off < errors * one), (name, off / one)


def test_averages_of_equilibrium():
    """Of few steps; the slow test below has narrower bounds."""
    found = _averages(BATH, 8e-5, REPLICAS, 1200)
    _agree(found, ("turns", "strains", "ends"), errors=3, within=0.025)


@pytest.mark.slow
def test_averages_of_equilibrium_by_two_steps():
    """Equipartition in curvature, twist, stretch, shear, a trap; ends of a wormlike chain.

    By steps of 0.13 and 0.53 of the shortest relaxation time, 0.15 ns, which agree with each other.
    """
    by_steps = [_averages(BATH, dt, 128, round(0.8 / dt)) for dt in (2e-5, 8e-5)]
    for one in by_steps:
        _agree(one, expected())
    (mean, error), (other, its) = by_steps
    for name in mean:
        off = np.abs(np.asarray(mean[name]) - np.asarray(other[name]))
        assert np.all(off < 2 * np.hypot(error[name], its[name])), name


@pytest.mark.slow
def test_the_midpoint_rule_agrees():
    bath = rx.Bath(KT, implicit=True)
    (mean, error), right = _averages(bath, 1e-4, 64, 2000), expected()
    for name in ("turns", "strains"):
        off = np.abs(np.asarray(mean[name]) - right[name])
        assert np.all(off < 3 * np.asarray(error[name]) + 0.015 * right[name]), (name, mean, error)


def test_a_run_goes_on_bit_for_bit():
    start = rx.thermal_start(SCENE, jax.random.key(5))
    roll = lambda one, steps: rx.thermal_rollout(
        SCENE, one, BATH, 5e-5, steps, save_every=10, measure=seen
    )
    whole = roll(start, 20)
    parts = roll(roll(start, 10).final, 10)
    for one, other in zip(
        jax.tree.leaves(whole.final.state), jax.tree.leaves(parts.final.state), strict=True
    ):
        np.testing.assert_array_equal(one, other)
    np.testing.assert_array_equal(
        jax.random.key_data(whole.final.key), jax.random.key_data(parts.final.key)
    )
    assert whole.run.states.position.shape == (3, ELEMENTS + 1, 3)
    np.testing.assert_allclose(whole.run.times, [0.0, 5e-4, 1e-3], rtol=1e-12)


def test_replicas_are_single_runs():
    starts = _starts(REPLICAS, seed=7)
    many = _replicas(starts, BATH, 5e-5, STRIDE)
    pick = lambda tree, i: jax.tree.map(lambda leaf: leaf[i], tree)
    one = rx.thermal_rollout(
        SCENE, pick(starts, 1), BATH, 5e-5, STRIDE, measure=seen, measure_every=4
    )
    np.testing.assert_allclose(
        many.final.state.position[1], one.final.state.position, rtol=0, atol=1e-9
    )
    np.testing.assert_allclose(many.averages.mean["ends"][1], one.averages.mean["ends"], rtol=1e-9)
    # each has its own noise
    assert np.max(np.abs(many.final.state.position[1] - many.final.state.position[0])) > 0.1


def test_averages_go_on():
    start = rx.thermal_start(SCENE, jax.random.key(1))
    roll = lambda one, steps, before=None: rx.thermal_rollout(
        SCENE, one, BATH, 5e-5, steps, measure=seen, averages=before
    )
    half = roll(start, 20)
    both = roll(half.final, 20, half.averages)
    assert int(both.averages.count) == 40
    # no program is compiled anew for another bath, step or number of steps
    before = len(TRACED)
    rx.thermal_rollout(SCENE, half.final, rx.Bath(2 * KT), 4e-5, 30, measure=seen)
    assert len(TRACED) - before <= 1  # looked at for its shape, not compiled


@pytest.mark.slow
@pytest.mark.parametrize("implicit", [False, True])
def test_a_ring_keeps_its_linking_number(implicit):
    rod = rx.yielding(rx.ring(114.0, 24, SECTION, turns=1.5), 10.0)
    weld = (rx.Weld(rx.Point(0), rx.Point(-1)),)
    scene = rx.Scene(rod, loads=(WATER,), joints=weld)
    start = rx.thermal_start(scene, jax.random.key(3))
    run = rx.thermal_rollout(scene, start, rx.Bath(KT, implicit=implicit), 3e-5, 400, save_every=50)
    states = run.run.states
    np.testing.assert_allclose(states.position[:, 0], states.position[:, -1], atol=1e-11)
    linking = rx.measures.linking(scene, run.run)
    np.testing.assert_allclose(linking.twist + linking.writhe, 1.5, atol=1e-6)
    assert np.max(np.abs(np.diff(linking.writhe))) > 1e-3


@pytest.mark.parametrize("implicit", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_pathwise_derivatives(implicit):
    """Of a run with its noise held, by the stiffness of the trap, against differences."""
    bath = rx.Bath(KT, implicit=implicit, tolerance=1e-11)
    start = rx.thermal_start(SCENE, jax.random.key(2))

    def end(stiffness):
        scene = eqx.tree_at(lambda s: s.loads[1].stiffness, SCENE, stiffness)
        run = rx.thermal_rollout(scene, start, bath, 5e-5, 12, throw=False)
        return jnp.sum(run.final.state.position[-1])

    at, h = jnp.asarray(TRAP), 1e-4
    ahead = jax.jit(lambda at: jax.jvp(end, (at,), (jnp.ones(()),)))
    difference = (ahead(at + h)[0] - ahead(at - h)[0]) / (2 * h)
    np.testing.assert_allclose(jax.jit(jax.grad(end))(at), difference, rtol=1e-6)
    np.testing.assert_allclose(ahead(at)[1], difference, rtol=1e-6)


def test_held_ends_stay_where_they_are_told():
    turn = rx.Turn((0, 0, 1), rx.PiecewiseLinear([0.0, 1.0], [0.0, 40.0]))
    scene = rx.Scene(ROD, rx.Clamped(), rx.Slider((0, 0, 1), rotation=turn), loads=(WATER,))
    run = rx.thermal_rollout(scene, rx.thermal_start(scene, jax.random.key(0)), BATH, 5e-5, 100)
    state = run.final.state
    np.testing.assert_allclose(state.position[0], ROD.position[0], atol=1e-14)
    np.testing.assert_allclose(state.position[-1, :2], 0.0, atol=1e-12)
    assert abs(float(state.position[-1, 2]) - 20.0) > 1e-3
    half = 0.5 * 40.0 * 5e-3
    np.testing.assert_allclose(
        np.abs(state.quaternion[-1]), [np.cos(half), 0, 0, np.sin(half)], atol=1e-9
    )


def test_relaxation_times_are_those_of_a_trap():
    """A stiff rod in a weak trap at its end moves as a whole, in its whole drag."""
    weak = 0.05
    times = rx.relaxation_times(dataclasses.replace(SCENE, loads=(WATER, Trap(jnp.asarray(weak)))))
    assert np.all(np.diff(times[np.isfinite(times)]) <= 1e-12)
    # along the rod: the tangential drag of 20 nm over the stiffness, twist and turns apart
    along = 2e-3 * SPACING * ELEMENTS / weak
    assert np.min(np.abs(times / along - 1)) < 1e-2
    assert 1e-4 < times[-1] < 2e-4


def test_a_bead_is_a_drag_on_its_node_or_a_body_welded_to_it():
    """Both relax alike, and the body stays on the node in a bath that shakes it."""
    trap, drags = Trap(jnp.asarray(0.05)), {"linear": 0.1, "rotational": 2.0}
    own = _massive(WATER, trap, rx.PointDrag(-1, **drags))
    body = rx.Body(1.0, inertia=(1.0, 1.0, 1.0), position=(0.0, 0.0, SPACING * ELEMENTS))
    weld = rx.Weld(rx.Point(-1), rx.Point(body=0))
    loads = (WATER, trap, rx.PointDrag(body=0, **drags))
    welded = rx.Scene(own.rod, bodies=(body,), joints=(weld,), loads=loads)
    times = [one[np.isfinite(one)] for one in map(rx.relaxation_times, (own, welded))]
    # but for c ds^2/4 of the turning of the node itself, which has no drag where the body has it
    np.testing.assert_allclose(*times, rtol=0.02)
    # in the weak trap both move as a whole, in the drag of rod and bead
    along = (2e-3 * SPACING * ELEMENTS + drags["linear"]) / 0.05
    assert np.min(np.abs(times[0] / along - 1)) < 1e-2
    run = rx.thermal_rollout(welded, rx.thermal_start(welded, jax.random.key(0)), BATH, 5e-5, 50)
    position = run.final.state.position
    np.testing.assert_allclose(position[-1], position[-2], rtol=0, atol=1e-12)
    assert np.max(np.abs(position[-1] - body.position)) > 1e-3


PLANE = {"shape": rx.Plane(point=(0.0, 0.0, -2.0)), "stiffness": 5.0}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda s: _massive(), "loads: .*needs drag.*LinearDrag"),
        (lambda s: _with(rx.PointDrag(-1, 0.1, 0.0, 0.1, offset=(0, 0, 3.0))), "without an offset"),
        (lambda s: _with(rx.Obstacle(**PLANE, relaxation=1e-3)), "loads: .*relaxation=0"),
        (
            lambda s: _with(rx.Obstacle(**PLANE, friction=rx.SlidingFriction(0.3, slip_speed=1.0))),
            "loads: .*friction that slides",
        ),
        (lambda s: rx.Scene(STRAIGHT, loads=s.loads), "compliance: .*yielding"),
        (lambda s: _massive(rx.Gravity((0, 0, -1.0))), "loads: .*drag in all directions.*Linear"),
        (lambda s: _massive(WATER, rx.MorisonDrag(1.0, 1.0, 0.1)), "loads: .*linear"),
        (lambda s: _massive(WATER, material=rx.KelvinVoigt(1e-3)), "material: .*elastic"),
    ],
    ids=[
        "no load",
        "drag off the node",
        "damped obstacle",
        "sliding friction",
        "rigid",
        "no drag",
        "quadratic drag",
        "viscous",
    ],
)
def test_scenes_without_equilibrium_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        rx.thermal_start(change(SCENE), jax.random.key(0))


def _with(load):
    return rx.Scene(ROD, loads=(WATER, load))


def _massive(*loads, material=None):
    section = dataclasses.replace(SECTION, mass=1.0, material=material)
    rod = rx.yielding(rx.straight_rod(20.0, ELEMENTS, section))
    return rx.Scene(rod, loads=loads)


def test_bad_numbers_are_refused(unchecked):
    start = rx.thermal_start(SCENE, jax.random.key(0))
    roll = lambda **named: rx.thermal_rollout(
        SCENE, start, BATH, **({"dt": 1e-5, "steps": 10} | named)
    )
    for named in ({"dt": -1.0}, {"dt": np.nan}, {"steps": 0}, {"save_every": 3}):
        with pytest.raises(ValueError, match=f"{next(iter(named))}: "):
            roll(**named)
    with pytest.raises(ValueError, match="measure_every: 4"):
        roll(measure=seen, measure_every=4)
    with pytest.raises(ValueError, match="thermal_energy: "):
        rx.Bath(-1.0)
    with pytest.raises(ValueError, match="start: "):
        rx.thermal_rollout(SCENE, start.state, BATH, 1e-5, 10)


def test_a_step_too_long_for_contact_is_told():
    law = rx.DebyeHueckel(strength=70.0, screening=1.0, floor=0.1)
    contact = rx.Contact(law, segments=ELEMENTS, cutoff=0.4, exclusion=10.0)
    scene = dataclasses.replace(SCENE, contact=contact)
    start = rx.thermal_start(scene, jax.random.key(0))
    run = rx.thermal_rollout(scene, start, BATH, 1.2e-4, 30, measure=seen, throw=False)
    assert rx.Result(int(run.result)) is rx.Result.DIFFUSED_TOO_FAR
    assert np.all(np.isnan(run.final.state.position))
    assert np.isnan(run.averages.mean["ends"])
    with pytest.raises(rx.SimulationError, match="smaller dt"):
        rx.thermal_rollout(scene, start, BATH, 1.2e-4, 30, measure=seen)


def test_small_roots():
    from rodjax.numerics import small_roots

    matrices = np.random.default_rng(0).normal(size=(5, 6, 6))
    matrices = matrices @ np.swapaxes(matrices, 1, 2) + np.eye(6)
    lower = small_roots.root(jnp.asarray(matrices))
    np.testing.assert_allclose(lower, np.linalg.cholesky(matrices), atol=1e-12)
    b = jnp.asarray(np.random.default_rng(1).normal(size=(5, 6)))
    back = small_roots.solve_transpose(lower, small_roots.solve(lower, b))
    np.testing.assert_allclose(back, np.linalg.solve(matrices, b[..., None])[..., 0], atol=1e-10)
