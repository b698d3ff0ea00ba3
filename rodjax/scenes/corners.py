"""Corners of schedules that fall inside given steps, where adaptive steps would end."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from rodjax.numerics.results import ModelWarning
from rodjax.scenes.scene import Scene

# Part of the largest value (of a load) or rate (of a drive) by which a jump counts.
_JUMP = 0.05

# Part of a step within which a change counts as a jump.
_SUDDEN = 1e-2

# Part of a step off whose ends a corner is inside, beyond the rounding of times. A load's jump from
# one knot to the next, however near, must have both at ends of steps: else half of it acts for a
# whole step more.
_OFF = {"load": 1e-12, "drive": 1e-6}

# Rounding of a time: its last digits, where a step's end was computed in another way.
_ROUNDING = 4


def _kind(name: str) -> str:
    """What jumps: a load's or an actuation's value, or a drive's rate."""
    return "load" if name.startswith(("loads", "rod.actuation")) else "drive"


def corners_inside(scene: Scene, start: float, times: Float[np.ndarray, " k"]) -> dict[str, float]:
    """First time inside a step at which a load's value or a drive's rate jumps, by schedule.

    Over such a step the load acts in part, or the drive's velocity is a mean of two: the motion is
    of first order there. (Not in traced code.)
    """
    ends = np.append(start, np.asarray(times, float))
    eps = lambda v: np.finfo(v.dtype).eps if np.issubdtype(v.dtype, np.floating) else 0.0
    found = {}
    for name, schedule in scene.schedules:
        kind = _kind(name)
        given = np.asarray(schedule.corners)
        corners = np.sort(given.astype(float))
        step = np.clip(np.searchsorted(ends, corners) - 1, 0, len(ends) - 2)
        size = ends[step + 1] - ends[step]
        apart = np.minimum(corners - ends[step], ends[step + 1] - corners)
        rounding = _ROUNDING * max(eps(given), eps(np.asarray(times))) * np.abs(corners)
        off = np.maximum(_OFF[kind] * size, rounding)
        inside = (corners > start) & (corners < ends[-1]) & (apart > off)
        if np.any(inside):
            chosen = corners[inside]
            jumps = _jumps(kind, schedule, chosen, _SUDDEN * size[inside], ends[[0, -1]])
            if np.any(jumps):
                found[name] = float(chosen[np.argmax(jumps)])
    return found


def _jumps(kind, schedule, corners, widths, span) -> Bool[np.ndarray, " c"]:
    """Whether a load, or the rate of a drive, jumps at each of the corners."""
    times = np.concatenate([corners - widths, corners, corners + widths, span])
    values = np.asarray(jax.vmap(schedule)(jnp.asarray(times)), float)
    values = values.reshape(len(times), -1)
    before, middle, after = values[:-2].reshape(3, len(corners), -1)
    if kind == "load":
        change, largest = after - before, np.max(np.abs(values))
    else:
        left, right = (middle - before) / widths[:, None], (after - middle) / widths[:, None]
        # between the corners it may be faster than at any of them
        order = np.argsort(np.append(corners, span))
        at = np.append(corners, span)[order]
        secants = np.diff(np.concatenate([middle, values[-2:]])[order], axis=0)
        rates = secants / np.maximum(np.diff(at), np.finfo(float).tiny)[:, None]
        change, largest = right - left, np.max(np.abs(np.concatenate([left, right, rates])))
    return np.max(np.abs(change), 1) > _JUMP * largest


def warn_of_corners(scene: Scene, start: float, times: Float[np.ndarray, " k"]) -> None:
    """ModelWarning where corners of schedules fall inside steps."""
    for name, corner in corners_inside(scene, start, times).items():
        load = _kind(name) == "load"
        what = "load" if load else "drive's velocity"
        # after a jump of a load the scheme's accelerations need some steps to be right again
        mend = (
            "end a step there and take short ones after it, or use the times of an adaptive run,"
            " adaptive_rollout(scene, state, end).times[1:]"
            if load
            else "end steps at the schedule's corners, as the adaptive rollout does:"
            " np.union1d(times, scene.corners)"
        )
        warnings.warn(
            f"{name}: the {what} jumps at t = {corner:.10g}, inside a step, which makes the motion"
            f" first order; {mend}",
            ModelWarning,
            stacklevel=3,
        )
