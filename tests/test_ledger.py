"""The ledger of a run against its own convergence and what drives and loads did."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import UNIT_SECTION, order_of
from made_runs import AXIS, ELEMENTS, hanging, run_over, start, state_of

import rodjax as rx
from rodjax import energy
from rodjax.constraints.ends import Clamped, Free, Slider, Switched, Turn
from rodjax.inputs.schedules import Function, Smooth
from rodjax.interactions.loads import DistributedLoad, Gravity, LinearDrag, MorisonDrag, PointLoad
from rodjax.rods import builders
from rodjax.scenes.scene import Scene


def smooth_twist(turns, until=1.0):
    return Turn(AXIS, Smooth([0.0, until, 1e3], [0.0, -2 * np.pi * turns, -2 * np.pi * turns]))


def everything():
    """A driven rod with every kind of load, all frequencies of its grid low enough to resolve."""
    inertia = (0.05, 0.05, 0.1)
    section = eqx.tree_at(lambda s: s.rotary_inertia, UNIT_SECTION, inertia)
    push = lambda time: jnp.array([0.5, 0.2, -0.3]) * jnp.sin(2 * time) ** 2
    spread = lambda strength, s, motion: (
        strength
        * jnp.concatenate([jnp.sin(motion.time) * jnp.cos(motion.position), motion.position], 1)
    )
    loads = (
        Gravity((1.0, 0.0, -2.0), fluid_density=20.0),
        MorisonDrag(5.0, 2.0, 0.5, added_mass_coefficient=10.0),
        LinearDrag(0.5, 0.2, 0.1),
        PointLoad(-1, force=Function(push), moment=Function(push), follower=True),
        DistributedLoad(spread, jnp.asarray(0.5)),
    )
    shift = Smooth([0.0, 1.0, 9.0], [[0.0] * 3, [0.1, 0.0, 0.1], [0.1, 0.0, 0.1]])
    a_rod = builders.straight_rod(1.0, 3, section)
    return Scene(a_rod, Clamped(shift, smooth_twist(0.3)), Free(), loads)


@pytest.fixture(scope="module")
def refined():
    """Ledgers of the driven, loaded and damped rod with halved steps."""
    scene = everything()
    state = start(scene)
    steps = (40, 80, 160, 320)
    return [(n, energy.ledger(scene, run_over(scene, state, 0.8, n, steps[-1]))) for n in steps]


def test_ledger_balances_at_second_order(refined):
    """Every column is in use; the balance error falls as the square of the step."""
    last = refined[-1][1]
    for name in ("drive_work", "load_work", "bending", "torsion", "kinetic", "gravity"):
        assert np.max(np.abs(np.asarray(getattr(last, name)))) > 1e-3 * abs(last.work[-1]), name
    for name in ("drag_loss", "damping_loss"):
        assert np.all(np.diff(getattr(last, name)) > -1e-6) and getattr(last, name)[-1] > 1e-2
    for name in ("axial", "contact_work", "projection_loss"):
        np.testing.assert_array_equal(getattr(last, name), 0)
    errors = [float(book.balance_error) for _, book in refined]
    assert errors[-1] < 1e-5
    assert order_of([1 / n for n, _ in refined], errors) == pytest.approx(2.0, abs=0.1)


@pytest.mark.parametrize("name", ["drive_work", "load_work", "drag_loss", "damping_loss"])
def test_ledger_columns_converge_at_second_order(refined, name):
    """Differences of successive refinements at the end fall by four."""
    ends = np.array([float(getattr(book, name)[-1]) for _, book in refined])
    differences = np.abs(np.diff(ends))
    steps = [1 / n for n, _ in refined[:-1]]
    assert order_of(steps, differences) == pytest.approx(2.0, abs=0.1)


@pytest.fixture(scope="module")
def slow_twist():
    """A damped rod twisted smoothly and left alone until it rests: scene, run."""
    a_rod = builders.straight_rod(1.0, ELEMENTS, UNIT_SECTION)
    drive = Clamped(rotation=smooth_twist(0.4, 2.0))
    scene = Scene(a_rod, drive, Slider((0, 0, 1)), (LinearDrag(0.1, 0.1, 0.05),))
    return scene, run_over(scene, state_of(a_rod), 4.0, 200)


@pytest.mark.slow
def test_work_of_a_slow_twist_is_the_torsional_energy(slow_twist):
    """W = C (2 pi turns)^2 / 2 L + losses, kinetic energy gone; the torque is C 2 pi turns / L."""
    scene, run = slow_twist
    book = energy.ledger(scene, run)
    stored = 0.8 * (2 * np.pi * 0.4) ** 2 / 2
    assert book.torsion[-1] == pytest.approx(stored, rel=1e-3)
    assert book.drive_work[-1] == pytest.approx(stored + float(book.damping_loss[-1]), rel=1e-3)
    assert 0.01 * stored < book.damping_loss[-1] < stored
    assert book.balance_error < 1e-3
    torque = jax.lax.map(lambda s: energy.reactions(scene, s).torque[0] @ AXIS, run.states)
    assert torque[-1] == pytest.approx(-0.8 * 2 * np.pi * 0.4, rel=1e-2)


def test_ledger_is_differentiable(slow_twist):
    """Derivative of a loss and of the work by parameters against central differences."""
    scene, run = slow_twist

    def columns(factor):
        scaled = eqx.tree_at(lambda s: s.loads[0].rotational, scene, 0.05 * factor)
        scaled = eqx.tree_at(lambda s: s.rod.stiffness, scaled, scene.rod.stiffness * factor)
        book = energy.ledger(scaled, run)
        return jnp.stack([book.drive_work[-1], book.damping_loss[-1], book.torsion[-1]])

    found = jax.jvp(columns, (jnp.asarray(1.0),), (jnp.asarray(1.0),))[1]
    high, low = columns(jnp.asarray(1.001)), columns(jnp.asarray(0.999))
    assert np.min(np.abs(found)) > 1e-3
    np.testing.assert_allclose(found, (high - low) / 2e-3, rtol=1e-6)


@pytest.mark.slow
def test_gravity_pendulum_with_a_point_load():
    """A pinned rod falls, pulled at its end: no drive works, the load by force times way."""
    scene = hanging((1.0, 0.0, 0.0), [0.5, 0.0, 1.0])
    state = start(scene)
    errors = []
    for steps in (50, 100):
        run = run_over(scene, state, 0.3, steps, 100)
        book = energy.ledger(scene, run)
        np.testing.assert_allclose(book.drive_work, 0, atol=1e-12)
        way = run.states.position[-1, -1] - run.states.position[0, -1]
        work = way @ jnp.array([0.5, 0.0, 1.0])
        assert book.load_work[-1] == pytest.approx(float(work), rel=1e-12)
        assert book.kinetic[-1] > 1.0
        errors.append(float(jnp.max(jnp.abs(book.residual)) / book.kinetic[-1]))
    assert errors[1] < 1e-3
    assert 3.2 < errors[0] / errors[1] < 4.8


@pytest.mark.slow
def test_projection_loss_is_booked_once():
    """A flying rod whose end is caught loses energy there; the ledger says how much.

    States saved every fourth step give the same losses as all of them.
    """
    a_rod = builders.straight_rod(1.0, 4, UNIT_SECTION)
    catch = Switched(Slider((1.0, 0.0, 0.0)), Clamped(), 0.1)
    scene = Scene(a_rod, Free(), catch, (LinearDrag(0.1, 0.1, 0.1),))
    state = start(scene, velocity=jnp.zeros((5, 3)).at[:, 0].set(0.2))
    book = energy.ledger(scene, run_over(scene, state, 0.2, 40))
    with pytest.warns(rx.ModelWarning, match="up to 4 steps between two saved states"):
        # of the drag on what rings after the blow
        thinned = energy.ledger(scene, run_over(scene, state, 0.2, 40, every=4))
    loss = np.asarray(book.projection_loss)
    assert loss[20] == 0 and loss[21] > 1e-3 and loss[-1] == loss[21]
    np.testing.assert_allclose(thinned.projection_loss, loss[::4], atol=1e-15)
    # until the blow nothing but drag acts; after it the scheme damps the fastest ringing
    assert np.max(np.abs(book.residual[:21])) < 1e-6 * book.kinetic[0]
    assert np.max(np.abs(book.residual)) < 0.1 * loss[-1]


@pytest.mark.slow
def test_a_thinned_run_that_does_not_close_is_told():
    """A rod let go in a viscous fluid, at its start and its end alone and at every step."""
    section = rx.circular_section(0.02, 1e8, 0.4e8, density=1500.0)
    rod = rx.straight_rod(0.5, 4, section, direction=(1, 0, 0))
    drag = rx.LinearDrag(0.3, 0.3, 1e-5)
    scene = rx.Scene(rod, rx.Clamped(), loads=(rx.Gravity((0, 0, -9.81)), drag))
    times, state = np.arange(1, 161) * 0.005, rx.start(scene)
    whole = rx.energy.ledger(scene, rx.rollout(scene, state, times))
    assert np.max(np.abs(whole.residual)) < 0.01 * np.ptp(whole.gravity)
    thinned = rx.rollout(scene, state, times, save_every=160)
    with pytest.warns(rx.ModelWarning, match="up to 160 steps between two saved states"):
        rx.energy.ledger(scene, thinned)
