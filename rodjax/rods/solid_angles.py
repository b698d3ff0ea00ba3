"""Solid angles under which straight segments see each other, whose sums are writhe and linking."""

import jax.numpy as jnp
from jaxtyping import Array

PAIRS = 1 << 15
"""Segment pairs handled at once: 0.25 MB for each temporary in double precision."""


def half_solid_angle(a, b, c, d, volume_abc: Array, volume_acd: Array) -> Array:
    """Half the signed solid angle of the spherical quadrilateral a, b, c, d (each x, y, z).

    It is cut into the triangles abc and acd, tan(angle / 2) = triple product / denominator for
    each, and their half angles are added as the arguments of complex numbers. The sum is below pi
    in size, because the directions from one segment to another lie in a half space.
    """
    squares = [dot(side, side) for side in (a, b, c, d)]
    apart = (squares[0] > 0) & (squares[1] > 0) & (squares[2] > 0) & (squares[3] > 0)
    norm_a, norm_b, norm_c, norm_d = (jnp.sqrt(jnp.where(apart, s, 1.0)) for s in squares)
    dot_ac = dot(a, c)
    abc = norm_a * norm_b * norm_c + dot_ac * norm_b + dot(a, b) * norm_c + dot(b, c) * norm_a
    acd = norm_a * norm_c * norm_d + dot_ac * norm_d + dot(a, d) * norm_c + dot(c, d) * norm_a
    real = abc * acd - volume_abc * volume_acd
    imaginary = volume_abc * acd + volume_acd * abc
    regular = apart & ((real != 0) | (imaginary != 0))
    return jnp.arctan2(jnp.where(regular, imaginary, 0.0), jnp.where(regular, real, 1.0))


def difference(u, v):
    return [component_u - component_v for component_u, component_v in zip(u, v, strict=True)]


def dot(u, v) -> Array:
    return u[0] * v[0] + u[1] * v[1] + u[2] * v[2]


def triple(u, v, w) -> Array:
    cross = (v[1] * w[2] - v[2] * w[1], v[2] * w[0] - v[0] * w[2], v[0] * w[1] - v[1] * w[0])
    return dot(u, cross)
