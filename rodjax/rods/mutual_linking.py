"""The linking number of two lines with each other."""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from rodjax.inputs.argument_types import AnyArray
from rodjax.rods.solid_angles import PAIRS, difference, half_solid_angle, triple


def mutual_linking(
    one: Float[AnyArray, "nodes 3"],
    other: Float[AnyArray, "others 3"],
    *,
    closed: tuple[bool, bool] = (False, False),
) -> Float[Array, ""]:
    """Linking number of two polygons with each other: the signed number of their crossings, halved,
    averaged over all views.

    The Gauss double integral Lk = 1/(4 pi) int int (r1 - r2) . (t1 x t2) / |r1 - r2|^3 ds1 ds2 over
    the segments of both, each pair in closed form as in `writhe`. Work grows as nodes times others.

    Args:
        one, other: vertices [m], consecutive ones distinct. In either order.
        closed: whether the last vertex of each is joined to its first, which is not repeated.

    Returns:
        Linking number [-]. Of two closed lines a whole number to rounding, which a passage of one
        through the other changes by 1; else any number, differentiable, and 1/2 or -1/2 for two
        long lines that cross. Right-handed crossings are positive.

    Example:
        >>> turn = np.linspace(0, 2 * np.pi, 40, endpoint=False)
        >>> ring = np.stack([np.cos(turn), np.sin(turn), 0 * turn], 1)
        >>> chained = ring[:, [0, 2, 1]] + np.array([1.0, 0, 0])
        >>> abs(round(float(rx.topology.mutual_linking(ring, chained, closed=(True, True)))))
        1
    """
    one, other = jnp.asarray(one), jnp.asarray(other)
    size = jnp.max(jnp.abs(lax.stop_gradient(one - other[:1]))) + jnp.max(jnp.abs(other - one[:1]))
    size = lax.stop_gradient(size)

    def segments(vertices, ring):
        vertices = vertices / size  # so that products stay in range
        after = jnp.roll(vertices, -1, axis=0)
        return (vertices, after) if ring else (vertices[:-1], after[:-1])

    rows, columns = segments(one, closed[0]), segments(other, closed[1])
    start_2, end_2 = (list(vertices.T) for vertices in columns)

    def of_segment(ends):
        start_1, end_1 = (list(vertex) for vertex in ends)
        a, b = difference(start_2, start_1), difference(end_2, start_1)
        c, d = difference(end_2, end_1), difference(start_2, end_1)
        volume = triple(a, difference(end_2, start_2), difference(end_1, start_1))
        return jnp.sum(half_solid_angle(a, b, c, d, volume, volume))

    together = max(1, PAIRS // len(columns[0]))
    return jnp.sum(lax.map(of_segment, rows, batch_size=together)) / (2 * jnp.pi)
