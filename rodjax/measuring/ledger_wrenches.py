"""What acts on the rod at one state, by the columns of the ledger that its work is booked in."""

from typing import NamedTuple

import equinox as eqx
from jaxtyping import Array, Float

from rodjax.equations import joint_terms
from rodjax.interactions.roles import Role
from rodjax.measuring.energies import node_motion
from rodjax.measuring.reactions import unbalanced
from rodjax.rods.state import State
from rodjax.scenes.scene import Found, Scene


class LedgerWrenches(NamedTuple):
    """Wrenches that do work on the rod at one state; None where the scene has none of the kind."""

    ends: Float[Array, "h 6"]  # and supports
    loads: Float[Array, "nodes 6"] | None
    drag: Float[Array, "nodes 6"] | None
    damping: Float[Array, "nodes 6"] | None
    contact: Float[Array, "nodes 6"] | None
    contact_damping: Float[Array, "nodes 6"] | None  # what of it is lost
    damping_before: Float[Array, ""] | None  # lost so far by what is remembered
    contact_before: Float[Array, ""] | None
    driving: tuple  # of what else is moved: forces and coordinates


@eqx.filter_jit  # traced once, for its shapes and for the scan
def ledger_wrenches(scene: Scene, state: State) -> tuple[LedgerWrenches, Found]:
    """What acts, and what the interactions found, searched for once for forces and energies."""
    scene = scene.recalling(state.memory)
    motion, by_role, lost = node_motion(state), {}, {}
    found = scene.find(state.position)

    def book(column, role, wrench):
        column[role] = column[role] + wrench if role in column else wrench

    wrenches, before, driving = [], {}, []
    for one, its in zip(scene.interactions, found.each, strict=True):
        exerted = one.exerted(scene.rod, motion, its)
        wrenches.append(exerted)
        book(by_role, one.role, exerted)
        so_far, moved = one.lost_before(), one.driving(exerted, state.time)
        if so_far is not None:
            book(before, Role.CONTACT if one.role is Role.CONTACT else Role.DAMPING, so_far)
        if moved is not None:
            driving.append(moved)
        if one.role in (Role.STORED, Role.CONTACT):
            column = Role.DAMPING if one.role is Role.STORED else Role.CONTACT
            book(lost, column, one.lost(scene.rod, motion, its, exerted))
        elif one.role is Role.DAMPING:
            book(lost, Role.DAMPING, exerted)
    driving += joint_terms.driving(scene, state)
    whole = LedgerWrenches(
        unbalanced(scene, state, tuple(wrenches)),
        by_role.get(Role.DRIVEN),
        by_role.get(Role.DRAG),
        lost.get(Role.DAMPING),
        by_role.get(Role.CONTACT),
        lost.get(Role.CONTACT),
        before.get(Role.DAMPING),
        before.get(Role.CONTACT),
        tuple(driving),
    )
    return whole, found
