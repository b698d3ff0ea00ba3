"""A material line of every element, across its chord, through a run."""

import numpy as np
from jaxtyping import Float

from rodjax.rods.framing import multiply


def material_lines(
    position: Float[np.ndarray, "t nodes 3"],
    quaternion: Float[np.ndarray, "t nodes 4"],
    at_first: Float[np.ndarray, "n 3"],
) -> Float[np.ndarray, "t n 3"]:
    """Unit vectors across the elements' chords that turn with their sections.

    Args:
        position, quaternion: of the nodes of one rod at successive times.
        at_first: the lines at the first of the times, across the chords there.
    """
    chords = np.diff(position, axis=1)
    chords = chords / np.linalg.norm(chords, axis=2, keepdims=True)
    # between frames less than half a turn apart, which are of one sign
    middle = quaternion[:, :-1] + quaternion[:, 1:]
    middle = middle / np.linalg.norm(middle, axis=2, keepdims=True)
    first = _turned(middle, np.array([1.0, 0.0, 0.0]))
    first = first - np.sum(first * chords, 2, keepdims=True) * chords
    first = first / np.linalg.norm(first, axis=2, keepdims=True)
    second = np.cross(chords, first)
    cosine, sine = np.sum(at_first * first[0], 1), np.sum(at_first * second[0], 1)
    return cosine[:, None] * first + sine[:, None] * second


def _turned(q: Float[np.ndarray, "*k 4"], vector: Float[np.ndarray, "3"]) -> np.ndarray:
    """A vector rotated by unit quaternions."""
    pure = np.broadcast_to(np.append(0.0, vector), q.shape)
    back = q * np.array([1.0, -1.0, -1.0, -1.0])
    return np.asarray(multiply(multiply(q, pure), back))[..., 1:]
