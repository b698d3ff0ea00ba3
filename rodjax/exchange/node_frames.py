"""Frames of nodes from those of elements, of which theirs are again halfway between."""

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

_REACH = 4  # elements that the frame of a node is of


def node_frames(
    element_frames: Float[np.ndarray, "k n 4"], length: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "k n+1 4"]:
    """Quaternions of the nodes whose halfway ones are those of the elements.

    Halfway frames do not determine those of the nodes: a zigzag of these leaves them. So a node's
    frame is the smooth one: of a cubic in the arc length whose means over the four nearest elements
    are theirs, in rotation vectors from halfway between its two neighbours. Frames come back
    to fourth order in the length of the elements.

    Args:
        element_frames: unit, real part first, at every time; at least 2 elements.
        length: of the elements at rest.
    """
    count, n, _ = element_frames.shape
    places = np.concatenate([[0.0], np.cumsum(length)])
    whole = lambda quaternions: Rotation.from_quat(quaternions, scalar_first=True)
    elements = [whole(element_frames[:, i]) for i in range(n)]
    nodes = [Rotation.identity(count)] * (n + 1)
    for i in range(1, n):
        low = min(max(i - _REACH // 2, 0), max(n - _REACH, 0))
        near = range(low, min(low + _REACH, n))
        between = (elements[i - 1].inv() * elements[i]).as_rotvec()
        middle = elements[i - 1] * Rotation.from_rotvec(0.5 * between)
        vectors = np.stack([(middle.inv() * elements[j]).as_rotvec() for j in near])
        weights = _weights((places[low : near[-1] + 2] - places[i]) / length[i])
        nodes[i] = middle * Rotation.from_rotvec(np.einsum("j,jkc->kc", weights, vectors))
    # the end elements' own frames are kept
    nodes[0] = elements[0] * nodes[1].inv() * elements[0]
    nodes[n] = elements[-1] * nodes[n - 1].inv() * elements[-1]
    found = np.stack([node.as_quat(scalar_first=True) for node in nodes], 1)
    same = np.sum(found[:, 1:] * found[:, :-1], -1) >= 0
    signs = np.cumprod(np.where(same, 1.0, -1.0), 1)
    return found * np.concatenate([np.ones((count, 1)), signs], 1)[..., None]


def _weights(places: Float[np.ndarray, " nodes"]) -> Float[np.ndarray, " m"]:
    """Of means of two nodes each, by which polynomials come back at the place 0."""
    powers = places[None] ** np.arange(len(places) - 1)[:, None]
    wanted = np.zeros(len(powers))
    wanted[0] = 1.0
    return np.linalg.solve(0.5 * (powers[:, 1:] + powers[:, :-1]), wanted)
