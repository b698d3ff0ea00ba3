"""Where the nodes of a new rod lie, and how frames are carried along it.

What is known is computed by numpy, at once and without a compilation; as soon as something is
traced, by jax.numpy, with the same formulas.
"""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jax import lax

from rodjax.inputs.argument_types import AnyArray, Number, Vector
from rodjax.inputs.validation import (
    all_known,
    array_of,
    as_integer,
    check_finite,
    check_integer,
    check_numbers,
    check_positive,
    check_scalar,
    check_shape,
    known,
    shown,
)


def module_of(*arrays):
    """jax.numpy where one of them is traced, else numpy."""
    return np if all_known(arrays) else jnp


def vector(value: Vector, name: str) -> AnyArray:
    """Three finite components."""
    check_shape((3,), **{name: value})
    check_finite(**{name: value})
    return array_of(value)


def direction_of(value: Vector, name: str) -> AnyArray:
    """The unit vector along one that is not zero."""
    along = vector(value, name)
    if not known(along):
        return along / jnp.linalg.norm(along)
    largest = np.max(np.abs(along))
    if not largest > 0:
        raise ValueError(f"{name}: must not be zero")
    along = along / largest  # whose length neither overflows nor vanishes
    return along / np.linalg.norm(along)


def grid(length: Number | AnyArray, elements: int, jumps: Sequence[Number] = ()) -> AnyArray:
    """Arc lengths of the nodes, equally spaced between the given `jumps` of the properties.

    Every jump becomes a node, so that no element straddles it; elements are shared out so that
    their lengths are as equal as can be. The length may be traced if there are no jumps.
    """
    check_scalar(length=length)
    check_positive(length=length)
    elements = as_integer(elements)
    check_integer(2, elements=elements)
    check_numbers(jumps=jumps)
    inside, total = array_of(jumps), array_of(length)
    if inside.ndim != 1 or not known(inside):
        raise ValueError(f"jumps: give a tuple of known arc lengths, got {shown(jumps)}")
    if not known(total):
        if inside.size:
            raise ValueError("jumps: their elements cannot be counted where the length is traced")
        return total * np.linspace(0.0, 1.0, elements + 1)
    marks = np.array([0.0, *np.sort(inside), total])
    if not np.all(np.diff(marks) > 0):
        raise ValueError(f"jumps: must be distinct and inside (0, {length}), got {shown(jumps)}")
    if len(marks) - 1 > elements:
        raise ValueError(f"elements: {len(marks) - 1} pieces between jumps need as many elements")
    share = np.diff(marks) / total * elements
    count = np.maximum(1, np.round(share).astype(int))
    while count.sum() != elements:  # repair rounding where it hurts least
        step = 1 if count.sum() < elements else -1
        cost = np.where((count + step) >= 1, np.abs(count + step - share), np.inf)
        # pieces of equal length keep equal counts where the total allows it
        count[np.argmin(cost)] += step
    pieces = [
        np.linspace(a, b, k + 1)[1:] for a, b, k in zip(marks[:-1], marks[1:], count, strict=True)
    ]
    return np.concatenate([[0.0], *pieces])


def first_frame(tangent, first_director) -> AnyArray:
    """Quaternion of the frame (a_1, a_2, a_3 = tangent) with a_1 as near as can be to the given."""
    xp = module_of(tangent)
    if first_director is None:
        given = xp.eye(3)[xp.argmin(xp.abs(tangent))]
    else:
        given = direction_of(first_director, "first_director")
        xp = module_of(tangent, given)
    first = given - (given @ tangent) * tangent
    size = xp.linalg.norm(first)
    if known(size) and not size > 1e-6:
        raise ValueError("first_director: must not be parallel to the rod")
    first = first / size
    columns = xp.stack([first, xp.cross(tangent, first), tangent], 1)
    # largest-component rule: exact for the half-turn frames that other formulas lose
    trace = xp.trace(columns)
    largest = xp.argmax(xp.stack([trace, *xp.diagonal(columns)]))
    q = xp.stack([_from_matrix(xp, columns, trace, k) for k in range(4)])[largest]
    return q / xp.linalg.norm(q)


def _from_matrix(xp, m, trace, k):
    """Quaternion of a rotation matrix by the formula that divides by its component k, unscaled."""
    if k == 0:
        parts = [1 + trace, m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]]
        return xp.stack(parts)
    i = k - 1
    j, l = (i + 1) % 3, (i + 2) % 3
    parts = {
        0: m[l, j] - m[j, l],
        1 + i: 1 + m[i, i] - m[j, j] - m[l, l],
        1 + j: m[j, i] + m[i, j],
        1 + l: m[l, i] + m[i, l],
    }
    return xp.stack([parts[place] for place in range(4)])


def carried(tangents, first) -> AnyArray:
    """Frames (k, 4) along unit tangents (k, 3), from the first without twist."""
    turns = shortest(tangents[:-1], tangents[1:])
    if module_of(tangents, first) is np:
        frames = [first]
        for turn in turns:
            frames.append(multiply(turn, frames[-1]))
        return np.stack(frames)

    def one(frame, turn):
        frame = multiply(turn, frame)
        return frame, frame

    first = jnp.asarray(first, turns.dtype)
    return jnp.concatenate([first[None], lax.scan(one, first, turns)[1]])


def shortest(a, b) -> AnyArray:
    """Quaternions of the smallest rotations that take unit vectors a to b."""
    xp = module_of(a, b)
    q = xp.concatenate([1 + xp.sum(a * b, -1, keepdims=True), xp.cross(a, b)], -1)
    return q / xp.sqrt(xp.sum(q * q, -1, keepdims=True))


def multiply(p, q) -> AnyArray:
    """Products of quaternions."""
    xp = module_of(p, q)
    real = p[..., :1] * q[..., :1] - xp.sum(p[..., 1:] * q[..., 1:], -1, keepdims=True)
    rest = p[..., :1] * q[..., 1:] + q[..., :1] * p[..., 1:] + xp.cross(p[..., 1:], q[..., 1:])
    return xp.concatenate([real, rest], -1)


def of_one_sign(quaternion) -> AnyArray:
    """Frames (k, 4) with the signs that take neighbours less than half a turn apart.

    q and -q are one frame, but neighbours of opposite sign would count as a turn apart.
    """
    xp = module_of(quaternion)
    turned = xp.sum(quaternion[1:] * quaternion[:-1], 1) < 0
    sign = xp.cumprod(xp.where(turned, -1, 1)).astype(quaternion.dtype)
    return xp.concatenate([quaternion[:1], sign[:, None] * quaternion[1:]])
