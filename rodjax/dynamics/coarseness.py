"""Elements that turn too far for a chord to stand for an arc, from the saved states of a run."""

import warnings
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from rodjax.dynamics.run import Run
from rodjax.numerics.results import ModelWarning

BEND = 0.5  # of an element [rad], beyond which a grid is coarse
HOPELESS = 1.2  # at which a run says so by itself [rad]
TWIST = 1.5  # of an element [rad]; a straight rod holds more exactly, a bent one does not


class Turns(NamedTuple):
    """Largest turns of any element at any saved time [rad]."""

    bend: float
    twist: float


def largest_turns(
    quaternion: Float[np.ndarray, "*k nodes 4"], breaks: tuple[int, ...] = ()
) -> Turns:
    """Largest parts of the elements' rotation vectors across the tangent and along it.

    Those of `breaks`, between rods, are no elements.
    """
    turns = np.delete(turns_of_elements(quaternion), list(breaks), -2)
    bend = np.max(np.linalg.norm(turns[..., :2], axis=-1))
    return Turns(float(bend), float(np.max(np.abs(turns[..., 2]))))


def turns_of_elements(quaternion: Float[np.ndarray, "*k nodes 4"]) -> Float[np.ndarray, "*k n 3"]:
    """Rotation vectors of the elements in the body frame [rad]."""
    before, after = quaternion[..., :-1, :], quaternion[..., 1:, :]
    # q_i^-1 q_{i+1} in numpy: no length of a run is compiled
    scalar = np.sum(before * after, -1)
    vector = (
        before[..., :1] * after[..., 1:]
        - after[..., :1] * before[..., 1:]
        - np.cross(before[..., 1:], after[..., 1:])
    )
    size = np.linalg.norm(vector, axis=-1)
    over = 2 * np.arctan2(size, scalar) / np.where(size > 0, size, 1.0)
    return over[..., None] * vector


def warn_if_hopeless(run: Run) -> None:
    """ModelWarning where elements bend by more than `HOPELESS` (outside traced code)."""
    bend = largest_turns(np.asarray(run.states.quaternion), run.states.breaks).bend
    if bend > HOPELESS:
        warnings.warn(
            f"an element bends by {bend:.2g} rad, which the grid does not resolve: use"
            f" {int(np.ceil(bend / BEND))} times the elements (`check` says more of a run)",
            ModelWarning,
            stacklevel=3,
        )
