"""A step along a curve of folds in two parameters, and through its cusps.

Unknowns are those of the extended equations of `singular_points`, (x, beta), and both parameters
q = (p_1, p_2), with

    <t, (x, q) - (x, q)_0> = s,

t the tangent. At a cusp both parameters turn back and x goes on, so that nothing there is singular.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from rodjax.continuation.arc_step import Tangent, driven_far
from rodjax.continuation.critical import borders
from rodjax.continuation.family import (
    Family,
    Place,
    elastic_of,
    held,
    motion_weight,
)
from rodjax.continuation.near_modes import Motions, near_modes
from rodjax.continuation.singular_points import SingularPoint
from rodjax.equilibria.motion_norms import moving_weight
from rodjax.equilibria.passages_at_rest import passages
from rodjax.equilibria.path_following import overflow
from rodjax.numerics import results
from rodjax.numerics.compilation import compiled
from rodjax.numerics.results import Result
from rodjax.rods.strains import wound

# Increments at most, and what the last may change, in rotations and parameters over their units.
_MOST, _CHANGE = 16, 1e-9

# Below what part of mean bending stiffness over the length squared a motion costs nothing, and how
# much of it must lie beside the mode to be held.
_NOTHING, _BESIDE = 1e-5, 1e-3


class CurvePoint(eqx.Module):
    """A fold of two parameters, and the curve's direction there."""

    parameters: Float[Array, "2"]
    place: Place
    mode: Float[Array, "nodes 6"]
    free: Motions  # what costs nothing besides
    tangent: Tangent  # of x and of the parameters over their units


class CurveStep(NamedTuple):
    """Where a step came to.

    Attributes:
        corrected: how far the correction went.
        along: cosine of the angle between the tangents before and after.
    """

    point: CurvePoint
    result: Int[Array, ""]
    corrected: Float[Array, ""]
    along: Float[Array, ""]
    iterations: Int[Array, ""]


class _Loop(NamedTuple):
    parameters: Float[Array, "2"]
    place: Place
    mode: Float[Array, "nodes 6"]
    tangent: Tangent
    gone: Float[Array, ""]  # along the row
    corrected: Float[Array, ""]
    change: Float[Array, ""]
    iterations: Int[Array, ""]
    done: Bool[Array, ""]


@compiled
def curve_step(
    family: Family,
    start: CurvePoint,
    row: Tangent,
    length: Float[Array, ""],
    units: Float[Array, "2"],
) -> CurveStep:
    """The fold at this distance along the row, predicted along the tangent.

    Args:
        family: its parameter is a pair of them.
        row: at right angles to which the correction is made.
        units: of both parameters.
    """
    place, q = start.place, start.parameters
    weight = motion_weight(family.equations(q, place), row.x)
    measured = weight * row.x
    inner = lambda x, n: jnp.sum(measured * x) + jnp.sum(row.parameter * n)
    ahead = length / jnp.maximum(inner(*start.tangent), 1e-3)
    first = family.guess(q, place) + ahead * start.tangent.x
    begun = family.place(q, place, first)

    def advance(loop: _Loop) -> _Loop:
        q, place = loop.parameters, loop.place
        x, here = family.guess(q, place), family.equations(q, place)
        column, border = borders(here, start.mode, x)
        free, pairs = held(here, start.free, x), family.pairs(q, place, x)
        none, no = jnp.zeros_like(length), jnp.asarray(False)
        extended = SingularPoint(family, place, column, border, free, none + 1.0, no, pairs)
        along, beta, of_g = extended.responses(q, jnp.diag(units))
        # how far along both parameters and c: g and beta are zero, and the length is that asked
        rows = jnp.stack([of_g[1:], beta[1:], jax.vmap(inner)(along[1:], jnp.eye(3, 2))])
        short = length - loop.gone - jnp.sum(measured * along[0])
        known = jnp.stack([-beta[-1] - of_g[0], -beta[0], short])
        last = jnp.stack([none, none, none + 1.0])
        numbers = jnp.linalg.solve(rows, jnp.stack([known, last], 1)).T
        dx = along[0] + jnp.einsum("i,inr->nr", numbers[0], along[1:])
        size, further = here.size(dx), jnp.max(jnp.abs(numbers[0, :2]))
        change = jnp.maximum(size, further)
        scale = jnp.minimum(1.0, 0.3 / jnp.maximum(change, 1e-12))
        square = jnp.sum(motion_weight(here, dx) * dx**2) + jnp.sum(numbers[0, :2] ** 2)
        return _Loop(
            q + scale * units * numbers[0, :2],
            family.place(q, place, x + scale * dx),
            here.change(along[-1]),
            Tangent(jnp.einsum("i,inr->nr", numbers[1], along[1:]), numbers[1, :2]),
            loop.gone + scale * inner(dx, numbers[0, :2]),
            loop.corrected + scale * jnp.sqrt(square),
            change,
            loop.iterations + 1,
            change <= _CHANGE,
        )

    def going(loop: _Loop):
        return ~loop.done & jnp.isfinite(loop.change) & (loop.iterations < _MOST)

    zero, count = jnp.zeros_like(length), jnp.zeros((), jnp.int32)
    q = q + ahead * units * start.tangent.parameter
    loop = _Loop(q, begun, start.mode, row, length, zero, zero, count, jnp.asarray(False))
    end = lax.while_loop(going, advance, loop)
    result = jnp.where(end.done, Result.SUCCESS, Result.NEWTON_FAILED)
    result = jnp.where(jnp.isfinite(end.change), result, Result.NON_FINITE).astype(jnp.int32)
    tangent = end.tangent
    size = jnp.sqrt(jnp.sum(weight * tangent.x**2) + jnp.sum(tangent.parameter**2))
    tangent = jax.tree.map(lambda part: part / size, tangent)
    x = family.guess(end.parameters, end.place)
    scene, time = family.at(end.parameters)
    mode = end.mode / jnp.sqrt(jnp.sum(moving_weight(scene) * end.mode**2))
    point = CurvePoint(end.parameters, end.place, mode, start.free, tangent)
    astray = jnp.where(wound(scene.rod, end.place.quaternion), Result.ROTATION_TOO_LARGE, 0)
    driven = driven_far(family, place, start.parameters, end.parameters)
    driven = jnp.where(driven, Result.DRIVE_TOO_FAST, 0)
    crowded = overflow(family.pairs(end.parameters, end.place, x))
    then = lambda: family.at(start.parameters)
    passed = passages(then, (scene, time), place.position, end.place.position)
    result = results.join(result, astray, driven, crowded, *passed)
    return CurveStep(point, result, end.corrected, inner(*tangent), end.iterations)


@compiled
def with_free(family: Family, point: CurvePoint, first: Motions) -> tuple[CurvePoint, Motions]:
    """The point with what costs nothing beside its mode, looked for from the second."""
    near = near_modes(family, point.parameters, point.place, first)
    scene = family.at(point.parameters)[0]
    weight = moving_weight(scene)
    share = jnp.einsum("kni,ni,ni->k", near.modes, weight, point.mode)
    beside = near.modes - share[:, None, None] * point.mode[None]
    rest = jnp.einsum("kni,ni,kni->k", beside, weight, beside)
    still = (jnp.abs(near.values) <= _NOTHING * elastic_of(scene)) & (rest > _BESIDE)
    free = jnp.where(still[:, None, None], beside, 0.0)
    return eqx.tree_at(lambda one: one.free, point, free), near.modes
