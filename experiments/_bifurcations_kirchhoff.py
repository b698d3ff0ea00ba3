"""Kirchhoff's rod between clamped ends by shooting: a scheme that shares nothing with the library.

Position r, frame q and moment m of a uniform rod of unit length and bending stiffness,

    r' = t,     q' = q (0, k)/2,     m' = n x t,     k = (m_1, m_2, m_3/C) in the frame,

are integrated from one clamped end. The force n, the same all along, and the moment there are six
numbers, such that the other end is where and as it should be.
"""

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq
from scipy.special import ellipe, ellipk

STEP = 1e-6  # of differences


def product(p, q):
    """Of quaternions, their four numbers first."""
    a, b, u, v = p[0], q[0], p[1:], q[1:]
    vector = a * v + b * u + np.cross(u, v, axis=0)
    return np.concatenate([(a * b - np.sum(u * v, 0))[None], vector])


def turned(q, vector):
    """The vector of the body's axes in inertial ones."""
    twice = 2 * np.cross(q[1:], vector, axis=0)
    return vector + q[0] * twice + np.cross(q[1:], twice, axis=0)


class Clamped:
    """A rod of this torsional over bending stiffness whose end is turned so often."""

    def __init__(self, ratio: float, turns: float):
        self.ratio, self.turns = ratio, turns

    def shape(self, ends: np.ndarray, at: float = 1.0) -> np.ndarray:
        """Position, frame and moment (10, ...) at an arc length, of forces and moments (6, ...)."""
        ends = np.asarray(ends, float)
        force = ends[:3].reshape(3, -1)
        tangent = np.array([0.0, 0.0, 1.0])[:, None] * np.ones_like(force)

        def slopes(_, flat):
            y = flat.reshape(10, -1)
            q, m = y[3:7], y[7:]
            back = q * np.array([1.0, -1.0, -1.0, -1.0])[:, None]
            k = turned(back, m)
            k[2] /= self.ratio
            along = turned(q, tangent)
            spun = 0.5 * product(q, np.concatenate([0 * k[:1], k]))
            return np.concatenate([along, spun, np.cross(force, along, axis=0)]).ravel()

        begun = np.zeros((10, force.shape[1]))
        begun[3], begun[7:] = 1.0, ends[3:].reshape(3, -1)
        run = solve_ivp(slopes, (0.0, at), begun.ravel(), method="DOP853", rtol=1e-10, atol=1e-11)
        return run.y[:, -1].reshape(10, *ends.shape[1:])

    def lacking(self, ends: np.ndarray, shortening: float) -> np.ndarray:
        """How far the other end is from its place, and from its frame."""
        y = self.shape(ends)
        half = np.pi * self.turns
        wanted = np.array([np.cos(half), 0.0, 0.0, -np.sin(half)])
        off = product(wanted.reshape(4, *[1] * (ends.ndim - 1)) * np.ones_like(y[3:7]), y[3:7])
        place = np.array([0.0, 0.0, 1 - shortening]).reshape(3, *[1] * (ends.ndim - 1))
        # q and -q are one frame
        return np.concatenate([y[:3] - place, 2 * np.sign(off[0]) * off[1:]])

    def slope(self, ends: np.ndarray, shortening: float) -> np.ndarray:
        """The derivative of that by force and moment."""
        steps = STEP * np.diag(np.maximum(np.abs(ends), 1.0))
        moved = np.concatenate([ends[:, None] + steps, ends[:, None] - steps], 1)
        ahead, behind = np.split(self.lacking(moved, shortening), 2, axis=1)
        return (ahead - behind) / (2 * np.diag(steps))

    def solve(self, ends: np.ndarray, shortening: float) -> np.ndarray:
        """Force and moment, from a guess; a turn of all about the axis stays as it is guessed."""
        for _ in range(20):
            lacking = self.lacking(ends, shortening)
            if np.max(np.abs(lacking)) < 1e-8:
                return ends
            slope = self.slope(ends, shortening)
            ends = ends + np.linalg.lstsq(slope, -lacking, rcond=1e-6)[0]
        raise ValueError(f"shooting found no rod shortened by {shortening:g}")

    def out_of_plane(self, low: float, high: float) -> float:
        """The shortening between two at which the plane elastica of no turns may leave its plane.

        In its plane, y = 0, all turns about the axis cost nothing and move the moment out of it by
        m_x alone. What else of force and moment points out of it, n_y and m_z, moves the end by
        y and turns it about the axis: singular where the rod is free to leave.
        """

        def determinant(shortening):
            ends = self.solve(plane_elastica(shortening), shortening)
            return np.linalg.det(self.slope(ends, shortening)[np.ix_([1, 5], [1, 5])])

        return brentq(determinant, low, high, xtol=1e-9)


def plane_elastica(shortening: float) -> np.ndarray:
    """Force and moment of the clamped elastica, of modulus m: P = 16 K^2, m_y = 2 sqrt(m P)."""
    m = brentq(lambda m: 2 - 2 * ellipe(m) / ellipk(m) - shortening, 1e-12, 1 - 1e-9)
    thrust = 16 * ellipk(m) ** 2
    return np.array([0.0, 0.0, -thrust, 0.0, 2 * np.sqrt(m * thrust), 0.0])
