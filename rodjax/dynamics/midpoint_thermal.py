"""A step of a rod in a heat bath by the implicit midpoint rule, see `equations.overdamped`."""

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from rodjax.dynamics.bath import Bath
from rodjax.equations.equations import Equations
from rodjax.equations.goals import Goals, goals_of, scales_of
from rodjax.equations.node_drag import node_drag
from rodjax.equations.overdamped import Overdamped
from rodjax.numerics import newton, rotations, small_roots
from rodjax.rods.state import State, at_rest
from rodjax.scenes.scene import Found, Scene, projectors

Moved = tuple[Float[Array, "nodes 6"], Found, Int[Array, ""], Int[Array, ""]]


def midpoint(
    scene: Scene,
    state: State,
    bath: Bath,
    dt: Float[Array, ""],
    white: Float[Array, "nodes 6"],
    patient: Int[Array, ""],
) -> Moved:
    """Increments of a step with this white noise, what was found near, a code, and iterations.

    Args:
        patient: how many Newton iterations may be made.
    """
    dtype = state.position.dtype
    drag = node_drag(scene, at_rest(state.time, state.position, state.quaternion))
    root = small_roots.root(drag)
    size = jnp.sqrt(2 * bath.thermal_energy.astype(dtype) / dt)
    noise = size * jnp.einsum("nij,nj->ni", root, white)
    scheme = Overdamped((state.position, state.quaternion), dt, (2 / dt) * drag, noise)
    found = Found()
    if scene.interactions:
        free = dt * size * small_roots.solve_transpose(root, white)
        found = scene.find(state.position, free[:, :3])
    equations = Equations(
        scene,
        scheme,
        state.time + 0.5 * dt,
        scales_of(scene, scheme),
        projectors(scene, state.time),
        _halfway(goals_of(scene, scheme, state, state.time + dt)),
        found,
    )
    guess = equations.guess(state.force)
    x, solved = newton.solve(equations, guess, bath.tolerance.astype(dtype), patient)
    return 2 * equations.change(x), found, solved.result, solved.iterations


def _halfway(goals: Goals) -> Goals:
    """Half of what is held moves: the other half follows in the same way."""
    turn = rotations.exponential(0.5 * rotations.logarithm(goals.turn))
    return Goals(0.5 * goals.shift, turn)
