"""One call from scene to motion: whole, thinned, of given steps, stopped, failed, gone on with."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import UNIT_SECTION

import rodjax as rx
from rodjax.dynamics.progress import showing
from rodjax.numerics.pace import Pace

SCENE = rx.Scene(
    rx.straight_rod(1.0, 4, UNIT_SECTION, direction=(1, 0, 0)),
    rx.Clamped(),
    loads=(rx.LinearDrag(1.0, 1.0, 0.1), rx.Gravity((0.0, 0.0, -1.0))),
)
UNTIL = 0.8


@pytest.fixture(scope="module")
def whole():
    """All states, of steps chosen by the error."""
    return rx.simulate(SCENE, UNTIL, progress=False)


def assert_same(one, other):
    """Equal to the last bit."""
    jax.tree.map(np.testing.assert_array_equal, one, other)


def assert_close(one, other):
    """Equal but for rounding, which programs of the tests' compiler differ by.

    Accelerations carry that of positions over the square of a step: those across the plane of the
    motion, which are zero, are found to be 1e-9.
    """

    def close(path, a, b):
        place = jax.tree_util.keystr(path)
        of_rates = place.endswith(("acceleration", "auxiliary"))
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-8 if of_rates else 1e-9, err_msg=place)

    jax.tree_util.tree_map_with_path(close, one, other)


def test_it_is_a_start_and_a_rollout(whole):
    assert_same(whole, rx.adaptive_rollout(SCENE, rx.start(SCENE), UNTIL))
    given = rx.simulate(SCENE, UNTIL, dt=0.1, progress=False)
    np.testing.assert_allclose(given.times, np.linspace(0, UNTIL, 9), atol=1e-15)
    assert_same(given, rx.rollout(SCENE, rx.start(SCENE), given.times[1:]))


def test_going_on_is_as_if_it_had_never_stopped(whole):
    half = rx.simulate(SCENE, 0.4, control=rx.StepControl(max_step=UNTIL / 100), progress=False)
    assert float(half.times[-1]) == 0.4
    assert_close(rx.simulate(SCENE, UNTIL, half, progress=False), whole)
    part = rx.simulate(SCENE, 0.4, dt=0.1, progress=False)
    both = rx.simulate(SCENE, UNTIL, part, dt=0.1, progress=False)
    direct = rx.simulate(SCENE, UNTIL, dt=0.1, progress=False)
    np.testing.assert_allclose(both.final.position, direct.final.position, atol=1e-12)
    assert len(both.times) == len(direct.times) and both.steps_before is None


def test_states_are_saved_at_the_times_asked_for(whole):
    times = np.array([0.05, 0.3, 0.31, 0.77])
    run = rx.simulate(SCENE, UNTIL, times=times, progress=False)
    np.testing.assert_array_equal(run.times, [0.0, *times, UNTIL])
    assert np.all(np.diff(run.step_counts) > 0)
    assert run.step_counts[-1] == len(run.infos.result)
    found = rx.positions_at(whole, jnp.asarray(times))
    np.testing.assert_allclose(run.states.position[1:-1], found, atol=2e-4)
    run = rx.simulate(SCENE, UNTIL, every=0.25, progress=False)
    np.testing.assert_array_equal(run.times, [0.0, 0.25, 0.5, 0.75, UNTIL])
    half = rx.simulate(SCENE, 0.4, every=0.25, progress=False)
    on = rx.simulate(SCENE, UNTIL, half, every=0.25, progress=False)
    np.testing.assert_array_equal(on.times, [0.0, 0.25, 0.4, 0.5, 0.75, UNTIL])


@pytest.mark.parametrize("times", [[0.2, 0.4, 0.6, UNTIL], [0.11, 0.7]])
def test_given_steps_end_on_the_times_asked_for(times):
    run = rx.simulate(SCENE, UNTIL, dt=0.05, times=times, progress=False)
    np.testing.assert_array_equal(run.times, np.union1d(times, [0.0, UNTIL]))
    every = rx.simulate(SCENE, UNTIL, dt=0.05, progress=False)
    np.testing.assert_allclose(run.final.position, every.final.position, atol=1e-3)
    assert len(run.infos.result) >= 16


def test_many_steps_are_thinned_in_windows(monkeypatch):
    monkeypatch.setattr("rodjax.dynamics.simulation._WINDOW", 50)
    run = rx.simulate(SCENE, UNTIL, every=0.25, progress=False)
    monkeypatch.undo()
    one = rx.simulate(SCENE, UNTIL, every=0.25, progress=False)
    assert_close(run, one)
    with pytest.warns(rx.ModelWarning, match=r"ends at t = .* of 0.8 by MAX_STEPS \(2\)"):
        short = rx.simulate(SCENE, UNTIL, every=0.25, max_steps=50, progress=False)
    assert len(short.infos.result) == 50 and int(short.result) == rx.Result.MAX_STEPS


def test_a_thinned_run_is_measured_and_kept(tmp_path):
    run = rx.simulate(SCENE, UNTIL, every=0.2, progress=False)
    with pytest.warns(rx.ModelWarning, match="steps between two saved states"):
        ledger = rx.energy.ledger(SCENE, run)
    assert ledger.time.shape == (5,) and np.all(np.isfinite(ledger.residual))
    rx.storage.save(tmp_path / "run.h5", SCENE, run)
    assert_same(rx.storage.load(tmp_path / "run.h5").run, run)
    with pytest.raises(rx.storage.StorageError, match="was thinned"):
        rx.storage.Recorder.append(tmp_path / "run.h5")


@pytest.mark.parametrize("settings", [{}, {"every": 0.1}, {"dt": 0.01}])
def test_ctrl_c_returns_what_there_is(settings, monkeypatch):
    calls, call = [], Pace.call

    def interrupted(pace, loop):
        calls.append(pace)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return call(pace, loop)

    monkeypatch.setattr(Pace, "call", interrupted)
    with pytest.warns(
        rx.ModelWarning, match=r"stopped at t = .* of 0.8; simulate\(scene, 0.8, run"
    ):
        run = rx.simulate(SCENE, UNTIL, progress=False, **settings)
    monkeypatch.undo()
    assert int(run.result) == rx.Result.INTERRUPTED and 0 < float(run.final.time) < UNTIL
    on = rx.simulate(SCENE, UNTIL, run, progress=False, **settings)
    assert int(on.result) == 0 and float(on.times[-1]) == UNTIL
    direct = rx.simulate(SCENE, UNTIL, progress=False, **settings)
    np.testing.assert_allclose(on.final.position, direct.final.position, atol=1e-6)


def test_a_failed_run_comes_back_with_its_code():
    def snap(time):
        return jnp.where(time < 0.3, 0.0, jnp.nan) * jnp.ones(3)

    scene = rx.Scene(SCENE.rod, rx.Clamped(), loads=(rx.PointLoad(-1, rx.Function(snap)),))
    with pytest.warns(rx.ModelWarning, match=r"the run returned ends at t = .* of 0.8 by [A-Z]"):
        run = rx.simulate(scene, UNTIL, dt=0.05, progress=False)
    assert int(run.result) != 0 and 0.2 < float(run.times[-1]) <= 0.3
    assert np.all(np.isfinite(run.states.position))


@pytest.mark.parametrize(
    ("arguments", "settings", "message"),
    [
        ((0.0,), {}, "until: must lie after t = 0"),
        ((np.inf,), {}, "until"),
        ((1.0,), {"dt": 0.0}, "dt: must be positive"),
        ((1.0,), {"every": 0.1, "times": [0.5]}, "every: give it or times, not both"),
        ((1.0,), {"times": [0.5, 0.5]}, "times: give increasing times"),
        ((1.0,), {"times": [0.5, 1.5]}, "times: end at 1.5, after the run's end at 1"),
        ((1.0,), {"dt": 0.1, "control": rx.StepControl()}, "control: is of chosen steps"),
    ],
)
def test_what_does_not_fit_is_told(arguments, settings, message, unchecked):
    with pytest.raises(ValueError, match=message):
        rx.simulate(SCENE, *arguments, **settings)


def test_other_kinds_are_told(whole, unchecked):
    with pytest.raises(ValueError, match="begin: give a run, a state or None"):
        rx.simulate(SCENE, 1.0, 0.0)
    with pytest.raises(ValueError, match="progress: give True, False or a function"):
        rx.simulate(SCENE, 1.0, progress="yes")
    with pytest.raises(ValueError, match="until: must lie after t = 0.8"):
        rx.simulate(SCENE, 0.5, whole)
    with pytest.raises(ValueError, match="simulate cannot be traced"):
        jax.jit(lambda until: rx.simulate(SCENE, until).times)(1.0)


def test_progress_tells_time_and_steps(capsys):
    seen = []
    run = rx.simulate(SCENE, UNTIL, progress=lambda time, steps: seen.append((time, steps)))
    assert seen[-1] == (UNTIL, len(run.infos.result)) and len(seen) > 1
    assert capsys.readouterr().err == ""
    rx.simulate(SCENE, UNTIL, dt=0.1)  # stderr is no terminal here
    assert capsys.readouterr().err == ""
    with showing(True, 1.0, 3.0) as show:
        show(2.0, 17)
    told = capsys.readouterr().err
    assert "0%|" in told and "t = 1 of 3, compiling" in told
    assert " 50%|" in told and "t = 2 of 3, 17 steps" in told
    with showing(True, 0.0, 0.3) as show:
        show(float(np.float32(0.3)), 18)  # as single precision has the end, a little later
    assert "100%|" in capsys.readouterr().err
