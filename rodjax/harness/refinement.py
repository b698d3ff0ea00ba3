"""Motion on a grid, corrected by that on a coarser one."""

import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicSpline

from rodjax.measuring.extrapolation import extrapolate


def refined(
    coarse: Float[np.ndarray, "t m 3"], fine: Float[np.ndarray, "t nodes 3"]
) -> Float[np.ndarray, "t nodes 3"]:
    """Positions of the nodes of a rod, extrapolated from two grids.

    Args:
        coarse: on fewer elements of one length, which a cubic spline is laid through, and with
            steps as many times longer as the elements are.
        fine: at the same times.
    """
    elements = [positions.shape[1] - 1 for positions in (coarse, fine)]
    between = CubicSpline(np.linspace(0, 1, elements[0] + 1), coarse, axis=1)
    there = between(np.linspace(0, 1, elements[1] + 1))
    return np.asarray(extrapolate(there, fine, ratio=elements[1] / elements[0]))
