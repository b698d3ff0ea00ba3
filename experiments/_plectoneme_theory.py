"""The uniform ply of Clauvelin, Audoly & Neukirch (Biophys. J. 96, 3716, 2009).

Two strands of bending stiffness A that touch without friction, of contour length l together, are
wound about each other at the angle theta to their axis, between tails under T and M. The ply turns
the ends by l sin(2 theta)/(2 R) and brings them l nearer, so the energy
A sin^4(theta) l/(2 R^2) + T l - M l sin(2 theta)/(2 R) is stationary in theta and in l (the ply
grows at the tails' expense, whatever its loop), and its slope in R is the contact's:

    M = 2 A sin^3(theta) cos(theta)/(R cos 2 theta)
    T = (A/R^2) sin^4(theta) (1/2 + 1/cos 2 theta)
    p = A sin^4(theta)/(R^3 cos 2 theta)
"""

from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq


class Theory(NamedTuple):
    """Torque [N m], tension [N] and contact force per length [N/m] of a uniform ply."""

    torque: float
    tension: float
    pressure: float


def closed_form(stiffness: float, radius: float, angle: float) -> Theory:
    """Clauvelin, Audoly & Neukirch: see above."""
    sine, cosine, double = np.sin(angle), np.cos(angle), np.cos(2 * angle)
    return Theory(
        float(2 * stiffness * sine**3 * cosine / (radius * double)),
        float(stiffness / radius**2 * sine**4 * (0.5 + 1 / double)),
        float(stiffness / radius**3 * sine**4 / double),
    )


def angle_of(stiffness: float, radius: float, torque: float) -> float:
    """Angle of the uniform ply of a radius under a torque [rad]."""
    gap = lambda angle: closed_form(stiffness, radius, angle).torque - torque
    return float(brentq(gap, 0.0, 0.25 * np.pi - 1e-9))


def ratios(found: Theory, expected: Theory) -> dict[str, float]:
    """What was measured over the theory."""
    return {
        name: float(value) / float(getattr(expected, name))
        for name, value in found._asdict().items()
    }
