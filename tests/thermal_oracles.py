"""Averages of elements in a heat bath, by quadrature of their own distribution.

The relative rotations phi of elements are independent of each other, with the density
exp(-phi . B phi / (2 ds kT)) (sin(|phi|/2)/(|phi|/2))^2, the second factor the volume of frames.
"""

import numpy as np

_POINTS, _WEIGHTS = np.polynomial.hermite_e.hermegauss(24)


def relative_rotations(stiffness, spacing, energy):
    """Points phi (k, 3) and their weights."""
    deviation = np.sqrt(energy * spacing / np.asarray(stiffness))
    points = np.stack(np.meshgrid(_POINTS, _POINTS, _POINTS, indexing="ij"), -1).reshape(-1, 3)
    weights = np.prod(np.meshgrid(_WEIGHTS, _WEIGHTS, _WEIGHTS, indexing="ij"), 0).ravel()
    phi = points * deviation
    angle = np.linalg.norm(phi, axis=1)
    weights = weights * np.sinc(angle / (2 * np.pi)) ** 2
    return phi, weights / np.sum(weights)


def mean_squares(stiffness, spacing, energy):
    """<phi_i^2> [rad^2]."""
    phi, weights = relative_rotations(stiffness, spacing, energy)
    return weights @ phi**2


def _mean_cosine(phi, weights):
    """<e3 . exp(phi) e3>."""
    squared = np.sum(phi**2, 1)
    along = phi[:, 2] ** 2 / squared
    return weights @ (np.cos(np.sqrt(squared)) * (1 - along) + along)


def end_to_end(elements, stiffness, compliance, spacing, energy):
    """<|R|^2> of a chain whose ends are free [m^2], edges ds E (e3 + g) with <g^2> = kT c/ds."""
    phi, weights = relative_rotations(stiffness, spacing, energy)
    half, whole = _mean_cosine(0.5 * phi, weights), _mean_cosine(phi, weights)
    own = elements * (1 + 3 * energy * compliance / spacing)
    apart = np.arange(1, elements)
    pairs = (elements - apart) * half**2 * whole ** (apart - 1)
    return spacing**2 * (own + 2 * np.sum(pairs))
