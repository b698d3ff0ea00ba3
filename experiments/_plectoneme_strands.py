"""Strands of a ply that touch: where, how far apart, at which angle by each of three measures."""

from typing import NamedTuple

import jax
import numpy as np
from _plectoneme_scene import LENGTH, RADIUS
from scipy.interpolate import CubicSpline

import rodjax as rx
from rodjax.rods.strains import curvature

TOUCHING = 1.02  # distance of strands that count as touching [D]


class Strands(NamedTuple):
    """Nodes of one strand of the ply, from the tails to the loop, and the nearest places opposite.

    Attributes:
        node: numbers.
        opposite: arc length of the nearest place on the other strand [m].
        distance: of the centrelines [m].
        angle: of the strands to their axis, by the curvature of a helix [rad].
        between_lines: half the angle between the centrelines [rad].
        between_normals: half the angle between the normals of the cross-sections [rad].
    """

    node: np.ndarray
    opposite: np.ndarray
    distance: np.ndarray
    angle: np.ndarray
    between_lines: np.ndarray
    between_normals: np.ndarray


def fine_line(rod: rx.Rod, state, pieces: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Arc lengths, places and tangents between the nodes too, on the spline through the nodes."""
    nodes = LENGTH / rod.elements * np.arange(rod.elements + 1)
    line = CubicSpline(nodes, np.asarray(state.position))
    s = LENGTH / (rod.elements * pieces) * np.arange(rod.elements * pieces + 1)
    return s, line(s), unit(line(s, 1))


def unit(vectors: np.ndarray) -> np.ndarray:
    """Vectors over their lengths."""
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def touching(rod: rx.Rod, state, pieces: int = 8) -> Strands:
    """Where strands are within `TOUCHING` of each other, listed on the one that comes first."""
    step = LENGTH / rod.elements
    s, places, directions = fine_line(rod, state, pieces)
    nodes = np.arange(rod.elements + 1)
    gap = np.sum((places[None] - places[nodes * pieces][:, None]) ** 2, -1)
    # a loop as tight as rods can make comes back to itself beyond two diameters
    gap[s[None] < step * nodes[:, None] + 4 * RADIUS] = np.inf
    near = np.clip(np.argmin(gap, 1), 1, len(places) - 2)
    before, at, after = (gap[nodes, near + k] for k in (-1, 0, 1))
    known = np.isfinite(before) & np.isfinite(at) & (before > at) & (after >= at)
    nodes, near, before, at, after = (v[known] for v in (nodes, near, before, at, after))
    shift = 0.5 * (before - after) / (before - 2 * at + after)
    distance = np.sqrt(at - 0.25 * (before - after) * shift)
    keep = distance < 2 * RADIUS * TOUCHING
    node, near, shift, distance = (v[keep] for v in (nodes, near, shift, distance))
    opposite = s[near] + shift * s[1]
    half = lambda one, other: 0.5 * np.arccos(np.clip(-np.sum(one * other, 1), -1, 1))
    normals = CubicSpline(s[::pieces], np.asarray(tangents(state.quaternion)))
    bent = np.linalg.norm(np.asarray(curvature(rod, state.quaternion))[:, :2], axis=1)
    bent = 0.5 * (bent[node - 1] + bent[node])
    return Strands(
        node,
        opposite,
        distance,
        np.arcsin(np.sqrt(np.clip(0.5 * distance * bent, 0, 1))),
        half(directions[node * pieces], directions[near]),
        half(normals(s[node * pieces]), unit(normals(opposite))),
    )


tangents = jax.vmap(rx.rotations.tangent_director)


def middle(strands: Strands) -> Strands | None:
    """The middle half of the arc on which strands touch; None where they hardly do."""
    count = len(strands.node)
    if count < 8:
        return None
    arc = strands.node[-1] - strands.node[0]
    low, high = strands.node[0] + 0.25 * arc, strands.node[-1] - 0.25 * arc
    inside = (strands.node >= low) & (strands.node <= high)
    return Strands(*(values[inside] for values in strands))
