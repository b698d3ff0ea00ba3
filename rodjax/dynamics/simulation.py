"""From a scene to its motion in one call."""

import itertools
import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from rodjax.dynamics.adaptive import adaptive_rollout
from rodjax.dynamics.consistency import start
from rodjax.dynamics.fixed_rollout import rollout
from rodjax.dynamics.given_steps import until_failure
from rodjax.dynamics.progress import Progress, check_progress, showing
from rodjax.dynamics.run import Run, continued, thinned
from rodjax.dynamics.step_control import Control, StepControl
from rodjax.equations.generalized_alpha import GeneralizedAlpha
from rodjax.inputs.argument_types import AnyArray
from rodjax.inputs.validation import (
    all_known,
    as_integer,
    check_finite,
    check_integer,
    check_numbers,
    check_positive,
    check_scalar,
    given,
    shown,
)
from rodjax.numerics.results import Interrupted, ModelWarning, Result
from rodjax.rods.state import State
from rodjax.scenes.arguments import check_scene
from rodjax.scenes.scene import Scene

# Accepted steps between which the states that are not asked for are let go of.
_WINDOW = 2000

# Part of the time to run within which times are one and the same.
_SAME = 1e-9


def simulate(
    scene: Scene,
    until: float,
    begin: Run | State | None = None,
    *,
    dt: float | None = None,
    every: float | None = None,
    times: Float[AnyArray, " t"] | Sequence[float] | None = None,
    method: GeneralizedAlpha | None = None,
    control: StepControl | None = None,
    max_steps: int = 100_000,
    progress: Progress = None,
) -> Run:
    """The motion of a scene until a time, from its start or on from where a run has ended.

    Steps are chosen by the local error (`adaptive_rollout`), or of a given size (`rollout`). Ctrl-C
    stops the run, which is returned as far as it came, its `result` INTERRUPTED; so is a run that
    fails, with its code. A `ModelWarning` says so in both cases.

    Args:
        scene: what moves.
        until: where the run ends [s].
        begin: a run to go on with, or a state to begin from; default `start(scene)`.
        dt: largest step [s]; between two times at which steps must end they are equal. Default:
            chosen by the error.
        every: time between saved states [s]. Default: every step is saved, which the energy
            ledger needs where something snaps or slips.
        times: at which states are saved, instead of `every` [s]; steps end on them exactly. The
            state at the begin is saved too, and the last.
        method: the time integration; default `GeneralizedAlpha()`.
        control: tolerances and bounds of chosen steps; default `StepControl()`.
        max_steps: chosen steps after which the run fails by MAX_STEPS.
        progress: a line with the time reached, on stderr. None shows it in terminals and notebooks,
            True and False do and do not, a function is called with the time and the steps so far.

    Returns:
        The whole run, what it goes on from included. Not differentiable: replay it by `rollout`.

    Raises:
        ValueError: an argument or a schedule of the scene does not fit.

    Example:
        >>> run = rx.simulate(scene, 0.2, dt=0.02)
        >>> run = rx.simulate(scene, 0.4, run, dt=0.02)  # goes on, as if it had never stopped
        >>> len(run.times)
        21
    """
    check_scene(scene)
    check_progress(progress)
    check_scalar(until=until, **given(dt=dt, every=every))
    if not all_known(scene, until, begin, dt, every, times, method, control):
        raise ValueError("scene: simulate cannot be traced; use rollout in jit, grad and vmap")
    check_finite(until=until)
    check_positive(**given(dt=dt, every=every))
    max_steps = as_integer(max_steps)
    check_integer(1, 2**31 - 1, max_steps=max_steps)
    if every is not None and times is not None:
        raise ValueError("every: give it or times, not both")
    if dt is not None and control is not None:
        raise ValueError("control: is of chosen steps; leave it or dt out")
    state, before = _beginning(scene, begin, dt is None)
    end, now = float(until), float(state.time)
    reached = now if before is None else float(before.times[-1])
    if not end > reached:
        raise ValueError(f"until: must lie after t = {reached:g}, where it begins, got {end:g}")
    wanted = _wanted(scene, now, end, float(before.times[0]) if before else now, every, times)
    with showing(progress, now, end) as show:
        if dt is not None:
            rest = _given(scene, state, end, float(dt), wanted, method, show)
        else:
            resume = None if before is None else before.control
            rest = _chosen(scene, state, end, resume, wanted, method, control, max_steps, show)
    whole = rest if before is None else continued(before, rest)
    _say(whole, end)
    return whole


def _beginning(scene: Scene, begin: Any, chosen: bool) -> tuple[State, Run | None]:
    """Where to begin, and the run that it is the end of."""
    if begin is None:
        return start(scene), None
    if hasattr(begin, "states") and hasattr(begin, "infos"):
        return begin.resume_state if chosen else begin.final, begin
    if not hasattr(begin, "position"):
        raise ValueError(f"begin: give a run, a state or None, got {shown(begin)}")
    return begin, None


def _marks(scene: Scene, now: float, end: float) -> np.ndarray:
    """Times at which steps must end whoever chooses them, `end` the last."""
    found = np.asarray([*map(float, scene.switch_times), *np.asarray(scene.corners), end])
    return np.unique(found[(found > now) & (found <= end)])


def _wanted(
    scene: Scene, now: float, end: float, first: float, every: float | None, times: Any
) -> np.ndarray | None:
    """Times after now at which states are saved; None: at all steps."""
    if every is not None:
        size = float(every)
        low, high = np.floor((now - first) / size), np.ceil((end - first) / size)
        asked = first + size * np.arange(low, high + 1)
        asked = asked[asked <= end]
    elif times is not None:
        check_numbers(times=times)
        asked = np.asarray(times, float)
        if asked.ndim != 1 or not np.all(np.isfinite(asked)) or np.any(np.diff(asked) <= 0):
            raise ValueError(f"times: give increasing times, got {shown(times)}")
        if asked.size and asked[-1] > end * (1 + _SAME):
            raise ValueError(f"times: end at {asked[-1]:g}, after the run's end at {end:g}")
    else:
        return None
    marks, same = _marks(scene, now, end), _SAME * (end - now)
    # steps of rounding's size between a time and a mark that mean the same would not do
    nearest = marks[np.argmin(np.abs(asked[:, None] - marks[None]), 1)]
    asked = np.where(np.abs(asked - nearest) <= same, nearest, asked)
    return np.unique(asked[asked > now + same])


def _chosen(
    scene: Scene,
    state: State,
    end: float,
    resume: Control | None,
    wanted: np.ndarray | None,
    method: GeneralizedAlpha | None,
    control: StepControl | None,
    max_steps: int,
    show,
) -> Run:
    """Steps chosen by the error; of a run of which not every state is kept in windows."""
    made, whole, code = 0, None, Result.MAX_STEPS
    while code is Result.MAX_STEPS and made < max_steps:
        most = max_steps - made
        most = most if wanted is None else min(most, _WINDOW)
        try:
            part = adaptive_rollout(
                scene,
                state,
                end,
                method,
                control,
                resume=resume,
                max_steps=most,
                stops=wanted,
                progress=lambda time, steps, made=made: show(time, made + steps),
                throw=False,
            )
        except Interrupted as stop:
            part = _part_of(stop)
        code = Result(int(part.result))
        made += part.infos.result.shape[0]
        state, resume = part.final, part.control
        if wanted is not None:
            part = thinned(part, wanted)
        if whole is not None:
            # where a window ended nothing may have been asked for
            part = continued(whole, part)
            part = part if wanted is None else thinned(part, wanted)
        whole = part
    assert whole is not None
    return whole


def _given(
    scene: Scene,
    state: State,
    end: float,
    dt: float,
    wanted: np.ndarray | None,
    method: GeneralizedAlpha | None,
    show,
) -> Run:
    """Steps of at most dt, equal between the times on which some must end."""
    now = float(state.time)
    marks = _marks(scene, now, end)
    marks = marks if wanted is None else np.union1d(marks, wanted)
    pairs = list(itertools.pairwise([now, *marks.tolist()]))
    counts = [max(1, int(np.ceil((b - a) / dt * (1 - _SAME)))) for a, b in pairs]
    steps = [np.linspace(*pair, n + 1)[1:] for pair, n in zip(pairs, counts, strict=True)]
    # every so many are saved while the run goes on, if that is what was asked for
    even = wanted is not None and len(set(counts)) == 1 and np.array_equal(marks, wanted)
    try:
        run = rollout(
            scene,
            state,
            np.concatenate(steps),
            method,
            save_every=counts[0] if even else 1,
            progress=show,
            throw=False,
        )
    except Interrupted as stop:
        run = _part_of(stop)
    run = until_failure(run)
    return run if wanted is None or even else thinned(run, wanted)


def _part_of(stop: Interrupted) -> Run:
    """What a run had computed when it was stopped."""
    assert stop.partial is not None  # both rollouts give it
    return stop.partial


def _say(run: Run, end: float) -> None:
    """ModelWarning where a run did not do what was asked for."""
    code, reached = Result(int(run.result)), f"t = {float(run.times[-1]):g} of {end:g}"
    if code is Result.INTERRUPTED:
        words = f"stopped at {reached}; simulate(scene, {end:g}, run) goes on with the run returned"
    elif code is not Result.SUCCESS:
        words = f"the run returned ends at {reached} by {code}"
    else:
        return
    warnings.warn(words, ModelWarning, stacklevel=3)
