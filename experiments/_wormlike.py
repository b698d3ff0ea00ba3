"""The wormlike chain under a pull: what is exact, and for elements of a finite length."""

import numpy as np
from scipy.special import roots_legendre


def marko_siggia(force: float, persistence: float, kt: float) -> float:
    """Extension over length by the interpolation f = 1/(4 (1 - z)^2) - 1/4 + z, f = F P/kT."""
    f = force * persistence / kt
    low, high = 0.0, 1.0 - 1e-9
    for _ in range(80):
        z = 0.5 * (low + high)
        low, high = (z, high) if 0.25 / (1 - z) ** 2 - 0.25 + z < f else (low, z)
    return 0.5 * (low + high)


def exact(force: float, persistence: float, kt: float, degrees: int = 80) -> float:
    """Extension over length of the infinite chain, by the ground state of l(l + 1)/2 - f cos."""
    f = force * persistence / kt
    l = np.arange(degrees)
    beside = (l[1:]) / np.sqrt(4 * l[1:] ** 2 - 1.0)  # cos between neighbouring degrees
    matrix = np.diag(0.5 * l * (l + 1.0)) - f * (np.diag(beside, 1) + np.diag(beside, -1))
    state = np.linalg.eigh(matrix)[1][:, 0]
    return float(2 * np.sum(beside * state[1:] * state[:-1]))


def discrete(force: float, stiffness: float, spacing: float, kt: float) -> float:
    """Mean of an element's tangent along the pull, of an infinite chain of elements.

    The pull acts on the elements' tangents, each midway between the frames of its nodes, by the
    transfer matrix from node to node (twist left out, which matters to fourth order).
    """

    def logarithm(pull):
        x, weights = roots_legendre(120)
        angle = np.linspace(0, np.pi, 96, endpoint=False) + np.pi / 192
        across = np.sqrt(np.outer(1 - x**2, 1 - x**2))
        cosine = np.outer(x, x)[..., None] + across[..., None] * np.cos(angle)
        between = np.arccos(np.clip(cosine, -1, 1))
        variance = kt * spacing / stiffness
        volume = np.sinc(between / (2 * np.pi)) ** 2 / np.maximum(np.sinc(between / np.pi), 1e-9)
        mid = (x[:, None] + x[None])[..., None] / np.sqrt(np.maximum(2 + 2 * cosine, 1e-12))
        kernel = np.exp(-(between**2) / (2 * variance) + pull * spacing / kt * mid) * volume
        root = np.sqrt(weights)
        whole = np.mean(kernel, -1) * root[:, None] * root[None]
        return np.log(np.linalg.eigvalsh(whole)[-1])

    step = 1e-3 * force
    slope = (logarithm(force + step) - logarithm(force - step)) / (2 * step)
    return float(slope * kt / spacing)
