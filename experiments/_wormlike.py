"""The wormlike chain under a pull: what is exact, and for elements of a finite length."""

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import eval_legendre


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


def elements_under(
    force: float,
    stiffness: tuple[float, float],
    spacing: float,
    kt: float,
    count: int | None = None,
) -> float:
    """Mean of an element's tangent along the pull, of a chain of elements.

    Relative rotations phi of neighbouring frames have the density
    exp(-phi . B phi/(2 ds kT)) (sin(|phi|/2)/(|phi|/2))^2, and the pull acts on the tangent half
    way. Both stiffnesses of bending are alike, so what the transfer operator makes of a function of
    the frame's angle with the pull is such a function again: it is found by quadrature over phi, on
    Legendre's polynomials.

    Args:
        stiffness: of bending and of twist.
        count: of elements, of which the middle third is looked at; None for an infinite chain.
    """
    pull, step = force * spacing / kt, 1e-3
    at = _operator(pull, stiffness, spacing, kt)
    beside = [_operator(pull * (1 + sign * step), stiffness, spacing, kt) for sign in (1, -1)]
    if count is None:
        logs = [np.log(np.max(np.linalg.eigvals(one).real)) for one in beside]
        return float((logs[0] - logs[1]) / (2 * step * pull))
    outer = np.linalg.matrix_power(at, count // 3)
    inner = count - 2 * (count // 3)
    # the mean over angles of a sum of Legendre's polynomials is its first coefficient
    whole = [(outer @ np.linalg.matrix_power(one, inner) @ outer)[0, 0] for one in beside]
    return float(np.log(whole[0] / whole[1]) / (2 * step * pull * inner))


def _operator(pull: float, stiffness, spacing: float, kt: float, degrees: int = 24) -> np.ndarray:
    """The transfer operator over an element, on coefficients of Legendre's polynomials."""
    phi, weights = _rotations(stiffness, spacing, kt)
    angle = np.linalg.norm(phi, axis=1)
    cosine, surface = np.polynomial.legendre.leggauss(degrees + 4)
    sine = np.sqrt(1 - cosine**2)

    def along(part):  # of the turned tangent, for a pull in the plane of a_1 and a_3
        by, half = part * angle, np.sin(0.5 * part * angle) ** 2
        direct = np.cos(by) + 2 * half * (phi[:, 2] / angle) ** 2
        across = np.sin(by) / angle * phi[:, 1] + 2 * half * phi[:, 0] * phi[:, 2] / angle**2
        return cosine[:, None] * direct + sine[:, None] * across

    kernel = weights * np.exp(pull * along(0.5))
    turned = np.stack([np.sum(kernel * eval_legendre(l, along(1.0)), 1) for l in range(degrees)], 1)
    own = np.stack([eval_legendre(l, cosine) * (l + 0.5) for l in range(degrees)])
    return (own * surface) @ turned


def _rotations(stiffness, spacing: float, kt: float) -> tuple[np.ndarray, np.ndarray]:
    """Points phi (k, 3) and their weights: Laguerre, Hermite, and evenly about the tangent."""
    bent, of_bent = np.polynomial.laguerre.laggauss(10)
    twist, of_twist = np.polynomial.hermite_e.hermegauss(8)
    around = 2 * np.pi * np.arange(16) / 16
    size, twist, around = np.meshgrid(
        np.sqrt(2 * bent * kt * spacing / stiffness[0]),
        twist * np.sqrt(kt * spacing / stiffness[1]),
        around,
        indexing="ij",
    )
    phi = np.stack([size * np.cos(around), size * np.sin(around), twist], -1).reshape(-1, 3)
    weights = np.repeat(np.outer(of_bent, of_twist).ravel(), 16)
    weights = weights * np.sinc(np.linalg.norm(phi, axis=1) / (2 * np.pi)) ** 2
    return phi, weights / np.sum(weights)


def crumpled(
    elements: int, stiffness: tuple[float, float], spacing: float, kt: float, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Positions and frames of a chain in equilibrium without a pull, far from that with one.

    Relative rotations are drawn from their density, volume included; its first frame looks any way.
    """
    random = np.random.default_rng(seed)
    deviation = np.sqrt(kt * spacing / np.array([stiffness[0], stiffness[0], stiffness[1]]))
    drawn = random.normal(size=(8 * elements, 3)) * deviation
    volume = np.sinc(np.linalg.norm(drawn, axis=1) / (2 * np.pi)) ** 2
    phi = drawn[random.uniform(size=len(drawn)) < volume][:elements]
    frames = [Rotation.random(random_state=random)]
    for one in phi:
        frames.append(frames[-1] * Rotation.from_rotvec(one))
    half = [
        frame * Rotation.from_rotvec(0.5 * one) for frame, one in zip(frames, phi, strict=False)
    ]
    edges = spacing * np.array([one.apply([0.0, 0.0, 1.0]) for one in half])
    position = np.concatenate([np.zeros((1, 3)), np.cumsum(edges, 0)])
    return position, np.array([frame.as_quat()[[3, 0, 1, 2]] for frame in frames])
