"""A step along a path of equilibria: predicted along its tangent, corrected at the length asked.

Unknowns are those z = (x, p) of the equations at rest and of the parameter, for the equations

    R(x, p) = 0,     <t, z - z_0> = s,

t the row of what is asked: the tangent at z_0 (Keller's pseudo-arc length), or the parameter alone.
Lengths are measured by <z, z> = mean of |displacement|^2/L^2 + |spin|^2 over the rod + (p/unit)^2.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from rodjax.constraints import ends
from rodjax.continuation.bordered_solve import Bordered, Free
from rodjax.continuation.family import (
    Derivative,
    Family,
    Parameter,
    Place,
    Rows,
    held,
    motion_weight,
    of_motion,
)
from rodjax.continuation.near_modes import Motions
from rodjax.equilibria.motion_norms import moving_weight
from rodjax.equilibria.passages_at_rest import passages
from rodjax.equilibria.path_following import overflow
from rodjax.numerics import results
from rodjax.numerics.compilation import compiled
from rodjax.numerics.results import Result
from rodjax.rods.strains import wound
from rodjax.scenes import drives
from rodjax.scenes.holds import rows_at

# Increments that are made at most, and how many may fail to shrink.
_MOST, _PATIENCE = 14, 3

# Of a path's length, what of it moves the rod for a motion along it to be its own.
_MOVES = 1e-3

# What an end may turn in a step [rad].
_TURN = 0.5 * jnp.pi


class Tangent(NamedTuple):
    """A direction in unknowns and parameter, of length one."""

    x: Rows
    parameter: Float[Array, ""]  # over its unit


class Aim(NamedTuple):
    """How far a step goes."""

    length: Float[Array, ""]
    unit: Float[Array, ""]  # of the parameter
    row: Tangent  # along what that is measured
    predicted: Tangent  # where it starts from: `length` times this
    free: Motions  # that cost nothing where it starts, zeros where there are fewer


class ArcStep(NamedTuple):
    """Where a step came to.

    Attributes:
        corrected: how far the correction went.
        along: cosine of the angle between the tangents before and after.
        iterations: Newton increments.
        pull: largest entry of what the parameter changes in the equations, scaled.
    """

    parameter: Parameter
    place: Place
    tangent: Tangent
    result: Int[Array, ""]
    corrected: Float[Array, ""]
    along: Float[Array, ""]
    iterations: Int[Array, ""]
    pull: Float[Array, ""]


class _Loop(NamedTuple):
    x: Rows
    p: Parameter
    size: Float[Array, ""]
    iterations: Int[Array, ""]
    slow: Int[Array, ""]
    arrived: Bool[Array, ""]
    tangent: Tangent  # found by the increment after the last
    pull: Float[Array, ""]
    done: Bool[Array, ""]


@compiled
def arc_step(
    family: Family, parameter: Parameter, place: Place, aim: Aim, tolerance: Float[Array, ""]
) -> ArcStep:
    """The equilibrium at this distance, and the path's tangent there on the side of `aim.row`."""
    start, unit = family.guess(parameter, place), aim.unit
    weight = motion_weight(family.equations(parameter, place), start)
    row = weight * aim.row.x
    first = start + aim.length * aim.predicted.x
    p_first = parameter + aim.length * unit * aim.predicted.parameter

    def unfinished(loop: _Loop):
        going = ~loop.done & jnp.isfinite(loop.size) & (loop.slow < _PATIENCE)
        return going & (loop.iterations < _MOST)

    def correct(loop: _Loop) -> _Loop:
        x, p, arrived = loop.x, loop.p, loop.arrived
        pairs = family.pairs(p, place, x)
        equations = family.equations(p, place)
        lacking, slope = family.residual(p, place, x, pairs)
        short = aim.length - jnp.sum(row * (x - start))
        short = short - aim.row.parameter * (p - parameter) / unit
        bordered = _bordered(family.derivative(p, place, x, pairs), x, row, unit * slope, aim)
        # once arrived the same system gives the tangent
        right = jnp.where(arrived, 0.0, -lacking), jnp.where(arrived, 1.0, short)
        dx, dp = bordered.solve(*right)
        scale = jnp.where(arrived, 0.0, equations.limit(x, dx))
        size = jnp.maximum(equations.size(dx), jnp.abs(dp))
        contraction = jnp.where(loop.iterations > 0, size / loop.size, 1.0)
        left = size * jnp.minimum(contraction / jnp.maximum(1 - contraction, 0.5), 1.0)
        slow = (contraction > 0.7) & (loop.iterations > 0)
        return _Loop(
            equations.retract(x, scale * dx),
            p + scale * unit * dp,
            jnp.where(arrived, loop.size, size),
            loop.iterations + (~arrived).astype(jnp.int32),
            loop.slow + (slow & ~arrived).astype(jnp.int32),
            arrived | ((left <= tolerance) & (scale >= 1.0)),
            # solved increments are those of the unknowns counted from where they have come to
            Tangent(dx, dp),
            jnp.max(jnp.abs(slope)),
            arrived,
        )

    none, no = jnp.zeros((), jnp.int32), jnp.asarray(False)
    begun = _Loop(first, p_first, jnp.ones_like(unit), none, none, no, aim.row, 0.0 * unit, no)
    end = lax.while_loop(unfinished, correct, begun)
    x, p = end.x, end.p
    result = jnp.where(end.done, Result.SUCCESS, Result.NEWTON_FAILED)
    result = jnp.where(jnp.isfinite(end.size), result, Result.NON_FINITE).astype(jnp.int32)
    new = family.place(p, place, x)
    equations = family.equations(p, place)
    astray = wound(equations.scene.rod, new.quaternion)
    turned = jnp.where(astray, Result.ROTATION_TOO_LARGE, Result.SUCCESS)
    driven = jnp.where(
        driven_far(family, place, parameter, p), Result.DRIVE_TOO_FAST, Result.SUCCESS
    )
    passed = passages(
        lambda: family.at(parameter),
        (equations.scene, equations.time),
        place.position,
        new.position,
    )
    far = jnp.sum(weight * (x - first) ** 2) + ((p - p_first) / unit) ** 2
    tangent = end.tangent
    length = jnp.sqrt(jnp.sum(weight * tangent.x**2) + tangent.parameter**2)
    tangent = jax.tree.map(lambda part: part / length, tangent)
    return ArcStep(
        p,
        new,
        tangent,
        results.join(result, turned, driven, overflow(family.pairs(p, place, x)), *passed),
        jnp.sqrt(far),
        jnp.sum(row * tangent.x) + aim.row.parameter * tangent.parameter,
        end.iterations,
        end.pull,
    )


@compiled
def along(family: Family, parameter: Parameter, place: Place, x: Rows) -> Float[Array, "nodes 6"]:
    """The motion of a tangent, which is the mode of a fold, of unit norm."""
    equations = family.equations(parameter, place)
    motion = equations.change(x)
    return motion / jnp.sqrt(jnp.sum(moving_weight(equations.scene) * motion**2))


@compiled
def unknowns(family: Family, parameter: Parameter, place: Place, motion) -> Rows:
    """The unknowns that move so, forces as they are."""
    x = family.guess(parameter, place)
    return of_motion(motion / family.equations(parameter, place).scales.motion[None], x)


@compiled
def ahead(family: Family, parameter: Parameter, place: Place, change: Rows) -> Place:
    """The place to which unknowns change, not corrected."""
    return family.place(parameter, place, family.guess(parameter, place) + change)


@compiled
def cosine(family: Family, parameter: Parameter, place: Place, one: Tangent, other: Tangent):
    """Of the angle between two directions at a place."""
    weight = motion_weight(family.equations(parameter, place), one.x)
    return jnp.sum(weight * one.x * other.x) + one.parameter * other.parameter


def driven_far(family: Family, place: Place, before: Array, after: Array) -> Bool[Array, ""]:
    """Whether an end or a joint is turned further than can be told from fewer turns."""

    def turns(p):
        scene, time = family.at(p)
        frames = rows_at(place.quaternion, scene.held_nodes)
        begun = family.origin.time
        both = zip(scene.holds, frames, strict=True)
        found = [ends.increments(one.end, begun, time, frame)[3:] for one, frame in both]
        return jnp.stack([*found, *drives.turns_of_joints(scene, time, place.quaternion.dtype)])

    change = turns(after) - turns(before)
    return jnp.max(jnp.sum(change**2, 1)) > _TURN**2


def _bordered(derivative: Derivative, x, row, column, aim: Aim) -> Bordered:
    """The derivative of the equations by solved increments, and by the parameter over its unit."""
    lift = lambda dx: derivative.equations.lift(x, dx)
    of_increments = lambda row: jax.linear_transpose(lift, x)(row)[0]
    corner = jnp.asarray(aim.row.parameter, x.dtype)
    free = _free(derivative, aim, x)
    free = free._replace(rows=jax.vmap(of_increments)(free.rows))
    return Bordered(derivative, column, of_increments(row), corner, free)


def _free(derivative: Derivative, aim: Aim, x) -> Free:
    """What resists motions that cost nothing, but for what of them is the path's own."""
    equations = derivative.equations
    scene = equations.scene
    weight = moving_weight(scene)
    along = equations.change(aim.predicted.x)
    square = jnp.sum(weight * along**2)
    # of a path that hardly moves the rod (a ring whose natural twist grows) that is rounding
    moves = square > _MOVES**2 * jnp.sum(scene.rod.length)
    share = jnp.einsum("kni,ni,ni->k", aim.free, weight, along)
    share = jnp.where(moves, share / jnp.where(moves, square, 1.0), 0.0)
    free = aim.free - share[:, None, None] * along[None]
    sizes = jnp.einsum("kni,ni,kni->k", free, weight, free)
    free = jnp.where((sizes > 0.5)[:, None, None], free, 0.0)
    return held(equations, free, x)
