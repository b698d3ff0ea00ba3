"""Where straight segments are nearest to each other."""


def closest(xp, p, to_p, q, to_q):
    """Where the segments from p and q are nearest, as parts of them, and their distance.

    Args:
        xp: numpy or jax.numpy.
        p, to_p, q, to_q: (k, 3), the ends of k pairs of segments.
    """
    d, e, r = to_p - p, to_q - q, p - q
    dot = lambda x, y: xp.sum(x * y, 1)
    dd, de, ee = dot(d, d), dot(d, e), dot(e, e)
    determinant = dd * ee - de**2
    skew = determinant > 1e-12 * dd * ee
    u = xp.where(skew, de * dot(e, r) - ee * dot(d, r), 0.0) / xp.where(skew, determinant, 1.0)
    v = (de * xp.clip(u, 0.0, 1.0) + dot(e, r)) / ee
    v = xp.clip(v, 0.0, 1.0)
    u = xp.clip((de * v - dot(d, r)) / dd, 0.0, 1.0)
    return u, v, xp.sqrt(xp.sum((r + u[:, None] * d - v[:, None] * e) ** 2, 1))
