"""Critical loads, as differentiable functions of the scene."""

import dataclasses
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from rodjax.continuation.diagram import CriticalPoint
from rodjax.continuation.family import (
    Family,
    Parameter,
    Place,
    balanced,
    function_of,
    held,
    motion_weight,
    of_motion,
)
from rodjax.continuation.singular_points import SingularPoint
from rodjax.continuation.symmetry import SETTLED, SYMMETRIC, Symmetry, bent_by
from rodjax.equilibria.motion_norms import moving_weight
from rodjax.inputs.validation import all_known, check_instance
from rodjax.numerics import newton, results
from rodjax.numerics.compilation import compiled
from rodjax.numerics.failure import not_a_number
from rodjax.numerics.results import Result
from rodjax.rods.state import State

# Newton increments at most; what the last may change of the parameter over its unit, and of x.
_MOST, _PARAMETER, _MOTION = 24, 1e-9, 1e-3

# How much of a mode may lie along what is held: the critical load is wrong by about that.
_HELD_SHARE = 1e-8


class _Loop(NamedTuple):
    parameter: Parameter
    place: Place
    null: Float[Array, "nodes 6"]
    bent: Float[Array, ""]
    symmetry: Symmetry
    change: Float[Array, ""]
    iterations: Int[Array, ""]
    holds: Array  # whether motions are held
    done: Array


def critical(
    scene_of, point: CriticalPoint, *, origin: State | None = None, throw: bool = True
) -> CriticalPoint:
    """The fold or branch point near `point`, a differentiable function of the scenes.

    Solves the extended equations of `singular_points` by Newton's method, from a point that
    `path` found, perhaps of scenes that differ a little. Its parameter (the buckling load, the
    turns at which a loop pops) and its state can be differentiated by every array that
    `scene_of` closes over, in forward and reverse mode, by the implicit function theorem.

    A branch point owes itself to a symmetry. What breaks that symmetry (an imperfection where the
    scene had none) turns it into a fold, and moves the critical load by the power 2/3 of its size:
    no derivative tells of it, and the code is NO_BRANCH_POINT where the scene has it already. The
    fold of a scene with an imperfection has derivatives by it. The derivative of the state of a
    branch point leaves out motion along its mode.

    Args:
        scene_of: as of `path`. In a loop of your own give one function with its arrays bound,
            `jax.tree_util.Partial(scene_of, radii)`, of which p is the last argument: functions
            made anew are compiled anew.
        point: where to begin, of `EquilibriumPath.critical` or of this function.
        origin: the state from which the schedules of the scenes count, `point.origin` by default.
            Give it where the scenes place their rods otherwise.
        throw: raise where no point was found. Otherwise, and in traced code, `result` tells, and
            numbers are NaN.

    Raises:
        SimulationError: Newton's method found no singular point near by (NEWTON_FAILED), or one
            that only a disturbance makes an equilibrium (NO_BRANCH_POINT).

    Example:
        >>> turn = rx.Turn((1, 0, 0), rx.PiecewiseLinear([0.0, 3.0], [0.0, 6 * np.pi]))
        >>> scene = rx.Scene(rod, rx.Clamped(), rx.Slider((1, 0, 0), rotation=turn))
        >>> path = rx.path(scene, rx.placing(scene), 0.0, 3.0)
        >>> point = path.critical[0]
        >>> def turns(stiffness):
        ...     softer = dataclasses.replace(rod, stiffness=stiffness * rod.stiffness)
        ...     return rx.critical(dataclasses.replace(scene, rod=softer), point).parameter
        >>> bool(abs(turns(1.1) - point.parameter) < 1e-9)  # the ratio of stiffnesses alone counts
        True
        >>> slope = jax.grad(turns)(1.0)  # doctest: +SKIP
    """
    check_instance(CriticalPoint, "give one of those that `path(...).critical` holds", point=point)
    family = Family(function_of(scene_of), point.origin if origin is None else origin)
    converted = explicit(family, point.parameter)
    # a function that closes over traced values is made explicit before it is compiled; others are
    # not, for a converted function is a new one
    if not all_known(converted):
        family = converted
    # folds and branch points share a program
    branches = jnp.asarray(point.kind == "branch")
    # other modes of the point are held, as what costs nothing wherever the path goes
    free = jnp.concatenate([point.modes[1:], point.free])[: len(point.free)]
    first = dataclasses.replace(point, kind="fold", modes=point.modes[:1], free=free)
    found = _critical(family, first, branches)
    others = not_a_number(lax.stop_gradient(point.modes[1:]), found.result != 0)
    modes = jnp.concatenate([found.modes, others])
    found = dataclasses.replace(found, kind=point.kind, modes=modes, free=point.free)
    if throw and all_known(found.result):
        where = f"critical, near the {point.kind} point at {float(point.parameter):g}"
        results.raise_if_failed(found.result, where, found)
    return found


def explicit(family: Family, parameter: Parameter) -> Family:
    """The family whose scenes have as leaves the arrays that their function closes over."""
    scene_of: Any = eqx.filter_closure_convert(family.scene_of, parameter)
    scene_of = jax.tree_util.Partial(_of_arrays, scene_of)
    return eqx.tree_at(lambda one: one.scene_of, family, scene_of)


def _of_arrays(scene_of, parameter: Parameter):
    """What a converted function gives, in which constants may be literals of a program."""
    literal = lambda leaf: hasattr(leaf, "__array__") and not isinstance(leaf, jax.Array)
    convert = lambda leaf: jnp.asarray(leaf) if literal(leaf) else leaf
    return jax.tree.map(convert, scene_of(parameter))


@compiled
def _critical(family: Family, point: CriticalPoint, branches: Bool[Array, ""]) -> CriticalPoint:
    family = explicit(family, point.parameter)
    fixed, start = newton.constant((family, point))
    unit = start.unit

    def equations(family, p, place, holds):
        x = family.guess(p, place)
        rest = family.equations(p, place)
        mode = start.modes[0]
        column, row = borders(rest, mode, x)
        free = held(rest, jnp.where(holds, start.free, 0.0), x)
        pairs = fixed.pairs(p, place, x)
        return SingularPoint(family, place, column, row, free, unit, branches, pairs)

    def advance(loop: _Loop) -> _Loop:
        p, place = loop.parameter, loop.place
        extended = equations(fixed, p, place, loop.holds)
        found, here = extended.increment(p), fixed.equations(p, place)
        # how far a motion of c.x = 1 goes [rad]
        radian = jnp.sqrt(jnp.sum(motion_weight(here, found.null) * found.null**2))
        size, change = here.size(found.newton.x), jnp.abs(found.newton.parameter)
        bent = bent_by(here, start.modes[0], extended.column, found.newton.beta)
        settled = (change <= SETTLED) & (size <= _MOTION)
        move, symmetry, asymmetric = loop.symmetry.search(
            found.skew / radian, bent, settled, branches
        )
        step = jax.tree.map(lambda n, s: n + move / radian * s, found.newton, found.sideways)
        # not further than the chart and the linearisation hold
        scale = jnp.minimum(1.0, 0.3 / jnp.maximum(here.size(step.x), 1e-12))
        x = fixed.guess(p, place) + scale * step.x
        p = p + scale * unit * step.parameter
        done = (change <= _PARAMETER) & (size <= _MOTION) & ~asymmetric
        place = fixed.place(p, place, x)
        null = here.change(found.null)
        # what costs nothing beside the mode may cost something in this scene (a pair that is
        # split): held, it would move the point
        weight = moving_weight(fixed.at(p)[0])
        share = jnp.max(jnp.abs(jnp.einsum("kni,ni,ni->k", start.free, weight, null)))
        share = share / jnp.sqrt(jnp.sum(weight * null**2))
        unlike = done & loop.holds & (share > _HELD_SHARE)
        count, holds = jnp.where(unlike, 0, loop.iterations + 1), loop.holds & ~unlike
        return _Loop(p, place, null, bent, symmetry, change, count, holds, done & ~unlike)

    def going(loop: _Loop):
        return ~loop.done & jnp.isfinite(loop.change) & (loop.iterations < _MOST)

    zero, none = jnp.zeros_like(unit), jnp.zeros((), jnp.int32)
    place, no = Place.of(start.state), jnp.asarray(False)
    symmetry = Symmetry.unknown(unit)
    begun = _Loop(start.parameter, place, start.modes[0], zero, symmetry, zero, none, ~no, no)
    end = lax.while_loop(going, advance, begun)
    result = jnp.where(end.done, Result.SUCCESS, Result.NEWTON_FAILED)
    result = jnp.where(jnp.isfinite(end.change), result, Result.NON_FINITE)
    asymmetric = (end.bent > SYMMETRIC) & branches
    result = jnp.where(end.done & asymmetric, Result.NO_BRANCH_POINT, result).astype(jnp.int32)

    extended = equations(family, end.parameter, end.place, end.holds)
    z = extended.packed(fixed.guess(end.parameter, end.place), end.parameter, zero)
    # borders and chart have no influence on the point
    where = lambda one: (one.place, one.column, one.row, one.free, one.unit)
    extended = eqx.tree_at(where, extended, newton.constant(where(extended)))
    z = newton.root(extended, z)
    p = extended.parameter(z)
    place = family.place(p, end.place, z[:-1])
    weight = moving_weight(fixed.at(end.parameter)[0])
    mode = end.null / jnp.sqrt(jnp.sum(weight * end.null**2))
    known = p, family.state(p, place), mode[None]
    parameter, state, modes = not_a_number(known, result != 0)
    return dataclasses.replace(
        point, parameter=parameter, state=state, modes=modes, origin=family.origin, result=result
    )


def borders(equations, mode: Float[Array, "nodes 6"], x) -> tuple:
    """Column and row that make a system regular which is singular by this mode."""
    weight = motion_weight(equations, x)
    rows = of_motion(mode / equations.scales.motion[None], x)
    row = weight * rows
    column = balanced(equations, moving_weight(equations.scene) * mode, x)
    return column / jnp.linalg.norm(column), row / jnp.sqrt(jnp.sum(row * rows))
