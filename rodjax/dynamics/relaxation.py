"""How fast small motions of a rod without inertia relax: what a step must follow, and outlast."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from rodjax.dynamics.bath import check_thermal
from rodjax.dynamics.explicit_thermal import welds_of, wrenches
from rodjax.dynamics.thermal_state import elastic_force
from rodjax.equations.node_drag import node_drag
from rodjax.inputs.validation import all_known
from rodjax.numerics.compilation import compiled
from rodjax.rods.state import State, at_rest, moved
from rodjax.scenes.arguments import check_motion, check_scene
from rodjax.scenes.placing import placing
from rodjax.scenes.scene import Scene, projectors

# a rate of this part of the fastest is none
_NONE = 1e-12


def relaxation_times(scene: Scene, state: State | None = None) -> Float[np.ndarray, " m"]:
    """Times in which small motions about a state relax in their drag, the longest first [s].

    Those of Z x' = -K x, K the stiffness and Z the drag of the nodes; infinite where nothing drives
    a motion back (a free rod's motion as a whole), or drives it on. Explicit steps of a `Bath` are
    stable below twice the shortest, and have right averages below about half of it; a rod is in
    equilibrium with its bath after some times the longest finite one.

    Args:
        scene: of a rod that stretches and shears, whose loads have linear drag.
        state: about which; by default as the rod was placed.

    Raises:
        ValueError: the scene has no equilibrium with a bath, or is traced.

    Example:
        >>> drag = rx.LinearDrag(normal=0.2, tangential=0.1, rotational=1e-6)
        >>> times = rx.relaxation_times(rx.Scene(rx.yielding(rod), rx.Clamped(), loads=(drag,)))
        >>> dt = 0.4 * times[-1]
    """
    check_scene(scene)
    check_thermal(scene)
    state = placing(scene) if state is None else state
    check_motion(scene, state)
    if not all_known(scene, state):
        raise ValueError("scene: relaxation times are found outside traced code only")
    stiffness, drag, held = (np.asarray(one, float) for one in _matrices(scene, state))
    basis = _basis(scene, state, held)
    inner = basis.T @ _block_diagonal(drag) @ basis
    lower = np.linalg.cholesky(0.5 * (inner + inner.T))
    half = np.linalg.solve(lower, basis.T @ stiffness.reshape(len(basis), -1) @ basis)
    whole = np.linalg.solve(lower, half.T)
    rates = np.linalg.eigvalsh(0.5 * (whole + whole.T))
    driven = rates > _NONE * np.max(np.abs(rates))
    return np.where(driven, 1 / np.where(driven, rates, 1.0), np.inf)


@compiled
def _matrices(scene: Scene, state: State):
    """-d(wrenches)/d(displacements, body spins), the drag, and the projectors of what is held."""
    motion = at_rest(state.time, state.position, state.quaternion)
    found = scene.find(state.position)

    def exerted(z):
        there = moved(motion, z)
        force = elastic_force(scene.rod, there.time, there.position, there.quaternion)
        return wrenches(scene, there, force, found)

    zero = jnp.zeros_like(state.rate)
    drag = node_drag(scene, motion)
    return -jax.jacfwd(exerted)(zero), drag, projectors(scene, state.time)


def _block_diagonal(blocks: Float[np.ndarray, "k 6 6"]) -> Float[np.ndarray, "m m"]:
    whole = np.zeros((len(blocks), 6, len(blocks), 6))
    index = np.arange(len(blocks))
    whole[index, :, index] = blocks
    return whole.reshape(6 * len(blocks), -1)


def _basis(scene: Scene, state: State, held: Float[np.ndarray, "h 6 6"]) -> np.ndarray:
    """Motions that ends, supports and welds allow, as columns."""
    nodes = scene.rod.elements + 1
    blocks = np.broadcast_to(np.eye(6), (nodes, 6, 6)).copy()
    for node, projector in zip(scene.held_nodes, held, strict=True):
        blocks[int(node)] = np.eye(6) - projector
    basis = _block_diagonal(blocks)
    for one in welds_of(scene, state):
        turn = np.eye(6)
        turn[3:, 3:] = np.asarray(one.turn).T
        rows = basis.reshape(nodes, 6, -1)
        rows[one.second] = turn @ rows[one.first]
    left, sizes, _ = np.linalg.svd(basis, full_matrices=False)
    return left[:, sizes > 1e-6]
