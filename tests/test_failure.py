"""What comes after a failure is not a number, nor is its derivative; what was before is kept."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import UNIT_SECTION, hairpin

from rodjax import energy, measures, topology
from rodjax.constraints.ends import Clamped
from rodjax.dynamics.consistency import start
from rodjax.dynamics.fixed_rollout import rollout
from rodjax.dynamics.run import Run
from rodjax.dynamics.stepping import no_info
from rodjax.dynamics.windows import Windows, defects, roll
from rodjax.fitting.observations import positions_at
from rodjax.interactions.contact import Contact
from rodjax.interactions.contact_laws import Barrier
from rodjax.interactions.load import AbstractLoad
from rodjax.interactions.loads import LinearDrag
from rodjax.numerics.failure import not_a_number
from rodjax.numerics.results import Result, SimulationError
from rodjax.rods.builders import straight_rod
from rodjax.scenes.scene import Scene

TIMES = jnp.linspace(0.0, 0.1, 11)[1:]


class Breaking(AbstractLoad):
    """A force on the last node that is not a number from a time on."""

    force: jax.Array
    until: jax.Array

    def wrench(self, rod, motion):
        force = jnp.where(motion.time > self.until, jnp.nan, self.force)
        return jnp.zeros((rod.elements + 1, 6)).at[-1, 0].set(force)


def breaking(steps, force=1.0):
    """A cantilever of which so many steps of `TIMES` succeed."""
    load = Breaking(jnp.asarray(force), 0.01 * jnp.asarray(steps) + 5e-3)
    rod = straight_rod(1.0, 6, UNIT_SECTION)
    return Scene(rod, Clamped(), loads=(LinearDrag(1.0, 1.0, 0.1), load))


@jax.jit
def traced(steps, force, index):
    """The motion in traced code, the path of its tip, and the derivative of one saved tip."""

    def tip(force):
        scene = breaking(steps, force)
        run = rollout(scene, start(scene), TIMES, throw=False)
        return run.states.position[index, -1, 0], run

    slope, run = jax.grad(tip, has_aux=True)(force)
    return run, run.states.position[:, -1, 0], slope


@pytest.fixture(scope="module")
def runs():
    """All steps succeed; the first five do; none does."""
    return {steps: at(steps, 3) for steps in (10, 5, 0)}


def at(steps, index):
    return traced(jnp.asarray(float(steps)), jnp.asarray(1.0), jnp.asarray(index))


@pytest.mark.parametrize("steps", [5, 0])
def test_values_and_derivatives_in_traced_code(runs, steps):
    """NaN from the failure on; before it what they are without the failure."""
    whole, path, slope = runs[10]
    run, found, found_slope = runs[steps]
    assert int(whole.result) == Result.SUCCESS and int(run.result) == Result.NON_FINITE
    good = slice(0, steps + 1)
    np.testing.assert_allclose(found[good], path[good], rtol=1e-12, atol=1e-15)
    assert np.all(np.isnan(found[steps + 1 :]))
    np.testing.assert_allclose(run.times, whole.times, atol=1e-15)  # these are given
    for name in ("position", "quaternion", "rate", "acceleration", "force"):
        assert np.all(np.isnan(getattr(run.states, name)[steps + 1 :])), name
        assert np.all(np.isfinite(getattr(run.states, name)[good])), name
    assert np.all(np.asarray(run.infos.result) == np.where(np.arange(10) < steps, 0, 8))
    # the motion is linear in the force
    assert float(slope) == pytest.approx(float(path[3]), rel=1e-2)
    # where the equations of the failed step are not finite, nor is any derivative behind it
    assert np.isnan(found_slope) or (steps and found_slope == pytest.approx(float(slope)))
    assert np.isnan(at(steps, 8)[2])


@pytest.mark.parametrize("every", [1, 2, 5])
def test_outside_traced_code_it_is_the_same(runs, every):
    run, path, *_ = runs[5]
    scene = breaking(5)
    found = rollout(scene, start(scene), TIMES, throw=False, save_every=every)
    np.testing.assert_allclose(found.states.position[:, -1, 0], path[::every], atol=1e-14)
    np.testing.assert_allclose(found.times, run.times[::every], atol=1e-15)
    np.testing.assert_array_equal(found.infos.result, run.infos.result)
    with pytest.raises(SimulationError, match="after t = 0.05") as error:
        rollout(scene, start(scene), TIMES, save_every=every)
    partial = error.value.partial
    kept = 5 // every
    np.testing.assert_allclose(partial.times, run.times[: kept * every + 1 : every], atol=1e-15)
    assert partial.infos.iterations.shape == (kept * every,)
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(partial.states))
    assert np.isfinite(energy.ledger(scene, partial).residual).all()


@pytest.mark.slow
def test_measures_of_a_failed_run(runs):
    """None of them has a plausible number where the run has none."""
    run = runs[5][0]
    scene = breaking(5)
    final = run.final
    axis = jnp.asarray([0.0, 0.0, 1.0])
    assert np.isnan(run.nearest(0.09).position).all()
    assert np.isfinite(run.nearest(0.02).position).all()
    values = {
        "twist": measures.twist(final),
        "eq15": measures.twist_eq15(scene.rod, final),
        "writhe": measures.writhe(final),
        "finite writhe": measures.writhe(final, 10.0),
        "closed writhe": topology.writhe(final.position, closed=True),
        "bending": energy.bending_energy(scene, final),
        "kinetic": energy.kinetic_energy(scene, final),
        "reaction": energy.reactions(scene, final).force[0, 0],
        "stretch": measures.stretch_error(scene.rod, final),
        "apex": measures.apex(final, axis).index,
        "apex angle": measures.apex_angle(final, axis),
        "buckling": measures.buckling_time(scene, run),
        "orthogonal apex": measures.apex_orthogonal_time(run, axis),
        "position": positions_at(run, jnp.asarray([0.07]))[0, 0, 0],
        "balance": energy.ledger(scene, run).balance_error,
    }
    assert all(np.isnan(value) for value in values.values()), values
    linking = measures.linking(scene, run)
    assert np.isnan(linking.writhe[6:]).all() and np.isfinite(linking.writhe[:6]).all()
    np.testing.assert_allclose(positions_at(run, run.times[:6]), run.states.position[:6])


def test_an_event_before_the_failure_is_kept():
    times = jnp.arange(4.0)
    values = jnp.asarray([0.0, 1.0, 3.0, jnp.nan])
    assert float(measures.first_crossing(times, values, 2.0)) == 1.5
    assert np.isnan(measures.first_crossing(times, values, 4.0))
    assert np.isinf(measures.first_crossing(times[:3], values[:3], 4.0))
    assert np.isnan(measures.time_of_maximum(times, values))
    assert np.isnan(jax.grad(lambda a: measures.time_of_maximum(times, a * values))(1.0))
    assert np.isnan(jax.grad(lambda a: measures.first_crossing(times, a * values, 4.0))(1.0))


@pytest.mark.slow
def test_contact_forces_of_what_is_not_a_number():
    rod = hairpin()
    scene = Scene(rod, Clamped(), contact=Contact(Barrier(1e6), 24, 0.1, pairs_per_segment=8))
    state = start(scene)
    lost = not_a_number(state, jnp.asarray(True))
    pair = jax.tree.map(lambda *leaves: jnp.stack(leaves), state, lost)
    run = runless(pair)
    found = measures.contacts(scene, run)
    assert np.isfinite(found.total[0]) and np.isnan(found.total[1])
    assert np.isnan(found.smallest[1]) and np.isnan(found.force[1]).all()


def runless(states):
    """Saved states as a run."""

    infos = jax.tree.map(lambda leaf: leaf[None], no_info(jnp.float64))
    zero = jnp.asarray(0, jnp.int32)
    return Run(states, infos, zero, zero, zero)


@pytest.mark.slow
def test_windows_that_fail_are_not_numbers_and_the_others_go_on():
    scene = breaking(5)
    whole = rollout(scene, start(scene), TIMES[:4], throw=False)
    begin = jax.tree.map(lambda leaf: jnp.stack([leaf[0], leaf[4]]), whole.states)
    windows = Windows(begin, jnp.stack([TIMES[:4], TIMES[4:8]]))
    found = jax.jit(roll)(scene, windows)
    assert np.asarray(found.result).tolist() == [Result.SUCCESS, Result.NON_FINITE]
    np.testing.assert_allclose(found.states.position[0], whole.states.position, atol=1e-13)
    assert np.isfinite(found.states.position[1, :2]).all()
    assert np.isnan(found.states.position[1, 2:]).all()
    assert np.isfinite(defects(windows, found)).all()  # of the first, which is whole


def test_a_start_that_raises_elsewhere_is_not_a_number_in_traced_code():
    scene = breaking(5)
    stretched = lambda by: start(scene, position=by * scene.rod.position)
    with pytest.raises(ValueError, match="stretched"):
        stretched(1.01)
    assert np.isnan(jax.jit(stretched)(1.01).position).all()
    right = jax.jit(stretched)(1.0)
    assert np.isfinite(right.acceleration).all()
    np.testing.assert_array_equal(right.position, scene.rod.position)


def test_marking_is_exact_in_both_modes_and_nested():
    failed = jnp.asarray([False, True])
    mark = lambda x: not_a_number(x, failed)
    square = lambda x, weight: jnp.sum(weight * mark(x**2))
    x, first, both = jnp.asarray([3.0, 4.0]), jnp.asarray([1.0, 0.0]), jnp.ones(2)
    np.testing.assert_array_equal(jax.grad(square)(x, both), [6.0, np.nan])
    np.testing.assert_array_equal(jax.vjp(mark, x)[1](first)[0], [1.0, 0.0])
    np.testing.assert_array_equal(jax.jvp(mark, (x,), (first,))[1], [1.0, np.nan])
    np.testing.assert_array_equal(jax.vmap(mark)(jnp.stack([x, x])), [[3.0, np.nan]] * 2)
    twice = jax.jacfwd(jax.grad(lambda x: mark(x**2)[0] ** 2))(x)
    assert twice[0, 0] == 12 * 9.0
    tree = mark({"count": jnp.asarray([1, 2]), "value": x, "none": None})
    assert tree["count"].tolist() == [1, 2] and np.isnan(tree["value"][1])
