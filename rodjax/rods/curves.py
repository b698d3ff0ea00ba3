"""Space curves for placing a rod: functions of arc length, and smooth curves through points."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rodjax.inputs.argument_types import AnyArray
from rodjax.inputs.user_functions import called, returned
from rodjax.inputs.validation import all_known, array_of, check_finite, check_numbers, known, shown
from rodjax.rods.framing import module_of, vector

MOST_POINTS = 2000
_GAUSS = np.polynomial.legendre.leggauss(8)
_NEWTON = 5  # iterations for the parameter at an arc length, from a guess that is nearly right


def along(curve: Callable, s: AnyArray) -> tuple[AnyArray, AnyArray]:
    """Position (3,) of a curve at the first of the arc lengths (k,), and its slopes at all (k, 3).

    Traced where the curve or they are. The slopes of a curve written with jax.numpy are exact in
    any precision; those of one that cannot be differentiated are differences.
    """
    if not all_known(s):
        return _differentiated(curve, s)
    first = called("curve", curve, s[0])
    if not all_known(array_of(first)):
        return _differentiated(curve, s)
    begin = vector(first, "curve")
    if any(isinstance(part, jax.Array) for part in jax.tree.leaves(first)):
        slopes = _exact(curve, s)
        if slopes is not None and np.all(np.isfinite(slopes)):
            return begin, slopes
    return begin, _differences(curve, s, np.asarray(first).dtype)


def _exact(curve, s) -> np.ndarray | None:
    try:
        return np.asarray(_differentiated(curve, s)[1], float)
    except Exception:  # numpy or `if` after all, or what jax has no derivative of
        return None


def _differentiated(curve, s):
    s = jnp.asarray(s)
    shape = returned("curve", curve, jax.ShapeDtypeStruct((), s.dtype)).shape
    if shape != (3,):
        raise ValueError(f"curve: must give three components, got shape {shape}")
    at = lambda place: jnp.asarray(curve(place))
    slope = lambda place: jax.jvp(at, (place,), (jnp.ones_like(place),))[1]
    return at(s[0]), jax.vmap(slope)(s)


def _differences(curve, s, dtype):
    """Central ones, of places so far apart that they are told apart in the curve's precision."""
    part = 1e-4 if np.finfo(dtype if dtype.kind == "f" else float).eps < 1e-12 else 0.3
    step = part * s[-1] / (len(s) - 1)
    # one by one, for the curve may be written with numpy and `if`
    at = lambda place: vector(called("curve", curve, place), "curve")
    return np.stack([at(place + step) - at(place - step) for place in s]) / (2 * step)


def through(points: Any, length: Any = None) -> tuple[Callable, np.floating | AnyArray]:
    """The cubic spline through points (k, 3), and its length.

    The spline is a function of arc lengths (m,), to positions (m, 3) and slopes (m, 3). `length` is
    that of the rod to be: where it is traced the arc lengths will be.

    Its parameter is the length along the chords; at the ends the third derivative has no jump
    beside the first and last points (two points make a line, three a parabola).
    """
    check_numbers(curve=points)
    x = array_of(points)
    if x.ndim != 2 or x.shape[1] != 3 or not 2 <= x.shape[0] <= MOST_POINTS:
        raise ValueError(
            "curve: give a function of arc length, or points (k, 3), from 2 to"
            f" {MOST_POINTS}; got {shown(points)}"
        )
    check_finite(curve=points)
    xp = module_of(x, length)
    x = xp.asarray(x)
    chord = xp.sqrt(xp.sum((x[1:] - x[:-1]) ** 2, 1))
    if known(chord) and not np.all(chord > 1e-9 * np.sum(chord)):
        raise ValueError("curve: no point may lie on the one before it")
    bend = _second_derivatives(xp, x, chord)

    def slope(i, t):
        """dx/dt on interval i, 0 <= t <= 1."""
        h = chord[i][..., None]
        t = t[..., None]
        curved = (3 * t**2 - 1) * bend[i + 1] - (3 * (1 - t) ** 2 - 1) * bend[i]
        return x[i + 1] - x[i] + h**2 / 6 * curved

    def speed(i, t):
        return xp.sqrt(xp.sum(slope(i, t) ** 2, -1))

    def passed(i, t):
        """Arc length on interval i from its start to t."""
        nodes = 0.5 * t[:, None] * (1 + _GAUSS[0])[None]
        index = xp.broadcast_to(i[:, None], nodes.shape)
        return 0.5 * t * xp.sum(_GAUSS[1][None] * speed(index, nodes), -1)

    intervals = np.arange(x.shape[0] - 1)
    each = passed(intervals, xp.ones(len(intervals)))
    begin = xp.concatenate([xp.zeros(1), xp.cumsum(each)])

    def at(s):
        i = xp.clip(xp.searchsorted(begin, s, side="right") - 1, 0, len(intervals) - 1)
        wanted = s - begin[i]
        t = wanted / each[i]
        for _ in range(_NEWTON):
            t = t - (passed(i, t) - wanted) / speed(i, t)
        slopes = slope(i, t) / speed(i, t)[:, None]
        h, t = chord[i][:, None], t[:, None]
        straight = (1 - t) * x[i] + t * x[i + 1]
        curved = (t**3 - t) * bend[i + 1] + ((1 - t) ** 3 - (1 - t)) * bend[i]
        return straight + h**2 / 6 * curved, slopes

    return at, begin[-1]


def _second_derivatives(xp, x, h):
    """Of the spline at its points (k, 3): continuous slopes, and the condition at the ends."""
    k = x.shape[0]
    if k == 2:
        return xp.zeros((2, 3))
    rows = xp.zeros((k, k))
    chord = (x[1:] - x[:-1]) / h[:, None]
    right = xp.concatenate([xp.zeros((1, 3)), 6 * (chord[1:] - chord[:-1]), xp.zeros((1, 3))])
    i = np.arange(1, k - 1)
    put = _put if xp is np else lambda a, where, value: a.at[where].set(value)
    rows = put(rows, (i, i - 1), h[:-1])
    rows = put(rows, (i, i), 2 * (h[:-1] + h[1:]))
    rows = put(rows, (i, i + 1), h[1:])
    if k == 3:  # a parabola
        rows = put(rows, (0, np.arange(3)), np.array([1.0, -1.0, 0.0]))
        rows = put(rows, (2, np.arange(3)), np.array([0.0, -1.0, 1.0]))
    else:
        first = xp.stack([h[1], -(h[0] + h[1]), h[0]])
        last = xp.stack([h[-1], -(h[-1] + h[-2]), h[-2]])
        rows = put(rows, (0, np.arange(3)), first)
        rows = put(rows, (k - 1, np.arange(k - 3, k)), last)
    return xp.linalg.solve(rows, right)


def _put(array, where, value):
    array[where] = value
    return array
