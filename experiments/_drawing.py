"""What several experiments draw alike."""

import numpy as np


def draw_tube(axis, shape: np.ndarray, nearness: np.ndarray, width: float, color: str) -> None:
    """A line seen from one side as a strand, the nearest of its pieces last and with an outline.

    Args:
        shape: (n+1, 2), its points on the page.
        nearness: (n+1,), larger is nearer.
        width: [points].
    """
    for i in np.argsort(0.5 * (nearness[1:] + nearness[:-1])):
        a, b = shape[i : i + 2]
        outline = np.array([a + 0.2 * (b - a), b - 0.2 * (b - a)])
        axis.plot(*outline.T, color="white", lw=1.6 * width, solid_capstyle="butt")
        axis.plot(*np.array([a, b]).T, color=color, lw=width, solid_capstyle="round")
