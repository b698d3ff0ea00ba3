"""A step of a rod in a heat bath without solving anything, for steps that follow its fastest mode.

    x_{n+1} = x_n (+) (dt M w(x_n) + sqrt(2 kT dt) M^(1/2) (xi_n + xi_{n+1})/2),

w the wrenches on the nodes, M = Z^-1 their mobility, and each noise used in two steps (Leimkuhler &
Matthews 2013). Of a linear mode of stiffness k it leaves <x^2> = kT/k exactly, as long as it is
stable, dt < 2 Z/k; of others the error is of second order in dt, where one noise a step would leave
the first. It is stable below twice the shortest of `relaxation_times`.

A node that is held moves as it is told in the directions P that are taken away, and by the mobility
of what is left, (1 - P) ((1 - P) Z (1 - P) + P)^-1 (1 - P). Two nodes that are welded move as one
that has the drag and the wrenches of both.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.constraints import ends
from rodjax.dynamics.bath import Bath
from rodjax.equations.imbalance import imbalance, of_loads
from rodjax.equations.node_drag import node_drag
from rodjax.numerics import rotations, small_roots
from rodjax.rods.state import NodeMotion, State, at_rest
from rodjax.scenes.holds import rows_at, with_row
from rodjax.scenes.scene import Found, Scene, projectors


class Welded(NamedTuple):
    """Two nodes that move as one."""

    first: int
    second: int
    turn: Float[Array, "3 3"]  # from axes of the second frame to those of the first


def explicit(
    scene: Scene,
    state: State,
    bath: Bath,
    dt: Float[Array, ""],
    white: Float[Array, "nodes 6"],
) -> tuple[Float[Array, "nodes 6"], Found]:
    """Increments of a step with this noise (xi_n + xi_{n+1})/2, and what was found near."""
    dtype = state.position.dtype
    motion = at_rest(state.time, state.position, state.quaternion)
    drag, welds = node_drag(scene, motion), welds_of(scene, state)
    for one in welds:
        drag = drag.at[one.first].add(_carried(one, drag[one.second]))
    nodes = scene.held_nodes
    held = projectors(scene, state.time)
    free = jnp.eye(6, dtype=dtype)[None] - held
    left = jnp.einsum("hij,hjk,hkl->hil", free, rows_at(drag, nodes), free) + held
    for node, row in zip(nodes, left, strict=True):
        drag = with_row(drag, node, row)
    root = small_roots.root(drag)
    size = jnp.sqrt(2 * bath.thermal_energy.astype(dtype) * dt)
    shaken = size * small_roots.solve_transpose(root, white)
    found = Found()
    if scene.interactions:
        found = scene.find(state.position, shaken[:, :3])
    wrench = wrenches(scene, motion, state.force, found)
    for one in welds:
        wrench = wrench.at[one.first].add(_wrench_carried(one, wrench[one.second]))
    allowed = jnp.einsum("hij,hj->hi", free, rows_at(wrench, nodes))
    for node, row in zip(nodes, allowed, strict=True):
        wrench = with_row(wrench, node, row)
    driven = small_roots.solve_transpose(root, small_roots.solve(root, wrench))
    change = shaken + dt * driven
    aims = _aims(scene, state, dt)
    told = jnp.einsum("hij,hj->hi", free, rows_at(change, nodes))
    told = told + jnp.einsum("hij,hj->hi", held, aims)
    for node, row in zip(nodes, told, strict=True):
        change = with_row(change, node, row)
    for one in welds:
        change = change.at[one.second].set(_motion_carried(one, change[one.first]))
    return change, found


def wrenches(
    scene: Scene, motion: NodeMotion, force: Float[Array, "n 3"], found: Found
) -> Float[Array, "nodes 6"]:
    """What acts on the nodes at rest, the rod itself included: forces inertial, moments body."""
    acting = of_loads(scene, motion)
    contact = scene.self_contact
    if contact is not None and found.contact is not None:
        acting = (*acting, contact.exerted(scene.rod, motion, found.contact))
    return -imbalance(scene, motion, force, acting)[0]


def _aims(scene: Scene, state: State, dt) -> Float[Array, "h 6"]:
    """How what holds the nodes moves them in the step."""
    frames = rows_at(state.quaternion, scene.held_nodes)
    stop = state.time + dt
    each = zip(scene.holds, frames, strict=True)
    return jnp.stack([ends.increments(one.end, state.time, stop, frame) for one, frame in each])


def welds_of(scene: Scene, state: State) -> list[Welded]:
    """The nodes that the scene's joints weld together."""
    found = []
    for joint in scene.joints:
        first, second = (x.place(scene.rod.parts) for x in (joint.first, joint.second))
        frames = state.quaternion[first], state.quaternion[second]
        turn = rotations.multiply(rotations.conjugate(frames[0]), frames[1])
        found.append(Welded(first, second, rotations.matrix(turn)))
    return found


def _carried(weld: Welded, drag: Float[Array, "6 6"]) -> Float[Array, "6 6"]:
    """The second node's drag in axes of the first."""
    turn = jnp.eye(6, dtype=drag.dtype).at[3:, 3:].set(weld.turn)
    return turn @ drag @ turn.T


def _wrench_carried(weld: Welded, wrench: Float[Array, "6"]) -> Float[Array, "6"]:
    return wrench.at[3:].set(weld.turn @ wrench[3:])


def _motion_carried(weld: Welded, change: Float[Array, "6"]) -> Float[Array, "6"]:
    return change.at[3:].set(weld.turn.T @ change[3:])
