"""Closed rings: rods placed on a circle, cut, twisted and ready to be rejoined."""

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from rodjax.inputs.argument_types import AnyArray, Number, Vector
from rodjax.inputs.validation import (
    as_float,
    check_flag,
    check_integer,
    check_positive,
    check_scalar,
)
from rodjax.numerics import rotations
from rodjax.rods.builders import build_rod
from rodjax.rods.framing import direction_of, first_frame, vector
from rodjax.rods.rod import Rod
from rodjax.rods.section import Section, Three
from rodjax.rods.strains import halfway


def ring(
    length: Number | AnyArray,
    elements: int,
    section: Section | Callable[[np.ndarray], Section],
    *,
    turns: Number | Array = 0.0,
    normal: Vector = (0.0, 0.0, 1.0),
    center: Vector = (0.0, 0.0, 0.0),
    natural_curvature: Three = (0.0, 0.0, 0.0),
    stress_free: bool = False,
) -> Rod:
    """A rod placed as a circle, a regular polygon of its elements, whose ends meet.

    A weld of its ends rejoins it: `Scene(rod, joints=(Weld(Point(0), Point(-1)),))`.

    Args:
        length: L at rest, of the polygon's sides together [m].
        elements: n, at least 3.
        section: a `Section`, or a function of arc lengths such as `circular_section` returns.
        turns: by how many the cut rod is twisted, all along alike, before it is rejoined: the
            linking number Lk of the ring (Tw = Lk and Wr = 0 in this placing), right-handed
            positive. Whole numbers where the section tells its directions apart.
        normal: of its plane, inertial axes; it runs about that by the right-hand rule.
        center: of the circle [m].
        natural_curvature: kappa0 in the body frame [1/m]; zero for a rod that is naturally
            straight, whose circle has the energy 2 pi^2 A/L and, by Michell and by Zajac,
            leaves its plane beyond sqrt(3) A/C turns.
        stress_free: whether it is at rest as it is placed (then kappa0 is its curvature here).

    Example:
        >>> loop = rx.ring(1.0, 40, section, turns=2)
        >>> closed = rx.Scene(loop, joints=(rx.Weld(rx.Point(0), rx.Point(-1)),))
    """
    check_flag(stress_free=stress_free)
    check_integer(3, 100_000, elements=elements)
    check_scalar(length=length, turns=turns)
    check_positive(length=as_float(length))
    n, total = elements, jnp.asarray(as_float(length), jnp.result_type(float))
    ds, bend = total / n, 2 * jnp.pi / n
    twist = bend * jnp.asarray(as_float(turns), total.dtype)
    axis = jnp.asarray(direction_of(normal, "normal"), total.dtype)
    about = lambda unit, angle: rotations.exponential(unit * angle)
    along = jnp.asarray([0.0, 0.0, 1.0], total.dtype)
    # its first element goes across `radial`, with a_1 along the plane's normal
    across = jnp.asarray([1.0, 0.0, 0.0], total.dtype)
    outward = jnp.asarray(first_frame(direction_of(normal, "normal"), None), total.dtype)
    radial = rotations.rotate(outward, across)
    tangent = rotations.cross(axis, radial)
    first = jnp.asarray(first_frame(tangent, axis), total.dtype)
    # an element turns by exp(phi), its node's frames by exp(phi/2) from its own; from one to the
    # next the body turns by the plane's bend B and the twist T: exp(phi/2) T^-1 exp(phi/2) = B
    within = about(rotations.rotate_inverse(first, axis), bend)
    half, back = about(along, 0.5 * twist), about(along, -0.5 * twist)
    product = lambda *factors: _product(factors)
    root = halfway(product(back, within, back)[None])[0]
    into = rotations.conjugate(product(half, root, half))
    number = jnp.arange(n + 1, dtype=total.dtype)[:, None]
    around, spun = about(axis[None], bend * number), about(along[None], twist * number)
    start = jnp.broadcast_to(rotations.multiply(first, into), (n + 1, 4))
    quaternion = _product((around, start, spun))
    edges = ds * rotations.rotate(around[:-1], jnp.broadcast_to(tangent, (n, 3)))
    # the middle of the first edge lies at the inner radius
    begin = 0.5 * ds / jnp.tan(0.5 * bend) * radial - 0.5 * ds * tangent
    position = begin[None] + jnp.concatenate([jnp.zeros((1, 3)), jnp.cumsum(edges, 0)])
    position = jnp.asarray(vector(center, "center"))[None] + position.at[-1].set(position[0])
    nodes = ds * jnp.arange(n + 1, dtype=total.dtype)
    rod = build_rod(nodes, position, quaternion, section, natural_curvature)
    if not stress_free:
        return rod
    relative = rotations.multiply(rotations.conjugate(quaternion[:-1]), quaternion[1:])
    natural = tuple(jnp.moveaxis(rotations.logarithm(relative) / ds, 1, 0))
    return build_rod(nodes, position, quaternion, section, natural)


def _product(factors):
    result = factors[0]
    for factor in factors[1:]:
        result = rotations.multiply(result, factor)
    return result
