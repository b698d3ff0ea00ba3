"""Frames of nodes whose positions are given, so that elements are sheared and bent least."""

import numpy as np
from jaxtyping import Float
from scipy.linalg import solveh_banded

from rodjax.rods.framing import carried, first_frame
from rodjax.rods.rod import Rod


def frames_at_rest(
    rod: Rod, position: Float[np.ndarray, "nodes 3"], first_director: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "nodes 4"]:
    """Frames of an untwisted rod that is let go at these positions, straight and naturally so.

    Their tangents t make the energy of shear and bending least, for elements nearly straight

        sum_i  GA |(t_i + t_{i+1})/2 - c_i|^2 ds + A |t_{i+1} - t_i|^2 / ds,

    c_i the directions of the chords: frames along bisected chords instead would begin with a
    shear that rings on.

    Args:
        rod: of one section all along; without shear compliance elements are stiff to shear.
        position: of the nodes [m].
        first_director: a_1 of the first element points this way, as far as it is across it.
    """
    ds = np.asarray(rod.length)
    chords = np.diff(position, axis=0)
    chords = chords / np.linalg.norm(chords, axis=1, keepdims=True)
    bending = np.asarray(rod.stiffness)[:, 0] / ds
    shear = 1e6 * bending
    if rod.compliance is not None:
        soft = np.asarray(rod.compliance)[:, 0]
        shear = np.where(soft > 0, ds / np.where(soft > 0, soft, 1.0), shear)
    diagonal, beside = np.zeros(len(ds) + 1), 0.25 * shear - bending
    right = np.zeros_like(position)
    for end in (slice(None, -1), slice(1, None)):
        diagonal[end] += 0.25 * shear + bending
        right[end] += 0.5 * shear[:, None] * chords
    tangents = solveh_banded(np.stack([diagonal, np.append(beside, 0.0)]), right, lower=True)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    across = first_director - (first_director @ chords[0]) * chords[0]
    return np.asarray(carried(tangents, first_frame(tangents[0], across)))
