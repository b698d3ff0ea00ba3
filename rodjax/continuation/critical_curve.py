"""Curves of critical points in two parameters, through their cusps."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from rodjax.continuation.curve_diagram import CriticalCurve
from rodjax.continuation.curve_walk import Folds, branch_points
from rodjax.continuation.diagram import CriticalPoint
from rodjax.continuation.path_arguments import check_bounds, check_settings, checked_family
from rodjax.inputs.user_functions import check_function
from rodjax.inputs.validation import check_instance
from rodjax.numerics import results


def critical_curve(
    scene_of: Callable[[Any, Any], Any],
    point: CriticalPoint,
    start: float,
    stop: float,
    *,
    points: int = 100,
    first_step: float = 0.02,
    longest_step: float = 0.2,
    throw: bool = True,
) -> CriticalCurve:
    """Follow a fold or branch point along a second parameter.

    Folds by arc length in shapes and both parameters: the curve may turn in either of them, and
    passes cusps, where two folds meet and end. (What lies between the two folds of a cusp has three
    equilibria, what lies outside has one.) Branch points by steps of the second parameter, each
    found as by `critical`.

    Args:
        scene_of: gives for both parameters, arrays without dimensions, a scene, or a scene and the
            time at which its schedules are evaluated. The first is the parameter of `point`.
        point: where to begin, of `EquilibriumPath.critical` or of `critical`: a critical point at
            `start` of the second parameter.
        start, stop: values of the second parameter, which bound the curve.
        points: at most so many.
        first_step, longest_step: lengths along the curve, in radians that sections turn by (root
            mean square), and of the parameters over their units: `point.unit` and |stop - start|.
            Of branch points, of the second parameter alone.
        throw: raise where no next point was found; the error's `partial` holds the curve so far.
            Otherwise its `end` and `result` tell.

    Returns:
        The curve, see `CriticalCurve`.

    Raises:
        ValueError: arguments do not fit.
        SimulationError: the point is not critical at `start`, or the curve could not be followed:
            STEP_TOO_SMALL, or what made steps fail (NO_BRANCH_POINT: the second parameter breaks
            the symmetry to which the branch point owes itself).

    Example:
        >>> turn = rx.Turn((1, 0, 0), rx.PiecewiseLinear([0.0, 3.0], [0.0, 6 * np.pi]))
        >>> middle = np.exp(-(((np.arange(20) - 9.5) / 4.0) ** 2))[:, None]
        >>> def turned(turns, softer):  # the middle of the rod has another stiffness
        ...     own = dataclasses.replace(rod, stiffness=rod.stiffness * (1.0 - softer * middle))
        ...     return rx.Scene(own, rx.Clamped(), rx.Slider((1, 0, 0), rotation=turn)), turns
        >>> uniform = jax.tree_util.Partial(lambda turns: turned(turns, jnp.zeros(())))
        >>> path = rx.path(uniform, rx.placing(turned(0.0, jnp.zeros(()))[0]), 0.0, 3.0)
        >>> curve = rx.critical_curve(turned, path.critical[0], 0.0, 0.3)
        >>> bool(curve.parameters[-1] < curve.parameters[0]), round(float(curve.others[-1]), 9)
        (True, 0.3)
    """
    check_instance(CriticalPoint, "give one of those that `path(...).critical` holds", point=point)
    check_function(scene_of=scene_of)
    bounds = check_bounds(start, stop, None)
    settings = check_settings(points, first_step, longest_step, 4, None, None)
    scene_of = _bound(scene_of)
    of_pair = jax.tree_util.Partial(_of_pair, scene_of)
    at = jnp.stack([point.parameter, jnp.asarray(bounds.start, point.parameter.dtype)])
    family = checked_family(of_pair, point.origin, at)
    lengths = settings.points, settings.first_step, settings.longest_step
    if point.kind == "branch":
        found = branch_points(scene_of, point, (bounds.start, bounds.stop), *lengths)
    else:
        units = jnp.stack([point.unit, jnp.asarray(bounds.unit, point.unit.dtype)])
        found = Folds(family, point, units, (bounds.start, bounds.stop)).onward(*lengths)
    if throw:
        where = f"critical_curve, at {found.others[-1]:g} after {len(found)} points"
        results.raise_if_failed(found.result, where, found)
    return found


def _bound(scene_of) -> Any:
    return scene_of if isinstance(scene_of, jax.tree_util.Partial) else eqx.Partial(scene_of)


def _of_pair(scene_of, parameters):
    return scene_of(parameters[0], parameters[1])
