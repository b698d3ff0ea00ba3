"""Cubic splines through points, or as near to them as their noise is large."""

import numpy as np
from jaxtyping import Float
from scipy.interpolate import splev, splprep

_GAUSS = np.polynomial.legendre.leggauss(8)
_FINE = 8  # places between two points, at which arc lengths are looked up


def _spline(points: Float[np.ndarray, "k 3"], noise: float | None):
    """The spline and its parameters at the points: lengths along the chords."""
    chords = np.linalg.norm(np.diff(points, axis=0), axis=1)
    along = np.concatenate([[0.0], np.cumsum(chords)])
    # the sum of squared distances that noise makes
    allowed = 0.0 if noise is None else points.size * noise**2
    return splprep(points.T, u=along, s=allowed, k=min(3, len(points) - 1))[0], along


def _lengths(spline, along: Float[np.ndarray, " k"]) -> Float[np.ndarray, " k"]:
    """Arc lengths at parameters, from the first."""
    half = 0.5 * np.diff(along)[:, None]
    places = along[:-1, None] + half * (1 + _GAUSS[0])
    speed = np.sqrt(np.sum(np.square(splev(places.ravel(), spline, der=1)), 0))
    each = np.sum(half * _GAUSS[1] * speed.reshape(places.shape), 1)
    return np.concatenate([[0.0], np.cumsum(each)])


def lengths_along(points: Float[np.ndarray, "k 3"]) -> Float[np.ndarray, " k"]:
    """Arc lengths of the points along the cubic spline through them."""
    return _lengths(*_spline(points, None))


def resampled(
    points: Float[np.ndarray, "k 3"], count: int, noise: float | None = None
) -> tuple[Float[np.ndarray, "m 3"], float]:
    """Points equally spaced along the spline, and how far it is from those given.

    Args:
        count: how many.
        noise: standard deviation of each coordinate; None lays the spline through the points.

    Returns:
        The points, and the root mean square of the distances of those given to the spline.
    """
    spline, along = _spline(points, noise)
    off = np.stack(splev(along, spline), -1) - points
    steps = np.arange(_FINE) / _FINE
    fine = np.append((along[:-1, None] + np.diff(along)[:, None] * steps).ravel(), along[-1])
    lengths = _lengths(spline, fine)
    wanted = np.interp(np.linspace(0.0, lengths[-1], count), lengths, fine)
    found = np.stack(splev(wanted, spline), -1)
    return found, float(np.sqrt(np.mean(np.sum(off**2, 1))))
