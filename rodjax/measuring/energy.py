"""Energies of a state, reactions of the ends, and the energy ledger of a run.

The ledger says where the work of drives and loads went:
    W_drives + W_loads = change of (bending + torsion + axial + kinetic + gravity energy)
                         + change of contact energy + losses of contact, drag and damping
                         + projection losses.
Every term is integrated for itself, none is a remainder; what the two sides differ by is the
numerical loss of the time integration plus the error of the quadrature.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from rodjax.dynamics.run import Run
from rodjax.equations.coupling import Nearby, find_nearby
from rodjax.interactions import contact_forces
from rodjax.interactions.contact_energy import has_potential, stored
from rodjax.interactions.contact_laws import PairProperties, ignores_approach
from rodjax.interactions.loads import total_wrench
from rodjax.interactions.roles import Role
from rodjax.measuring.energies import (
    axial_energy,
    bending_energy,
    contact_energy,
    contact_wrench,
    gravity_energy,
    kinetic_energy,
    node_motion,
    strain_energy_density,
    torsion_energy,
)
from rodjax.measuring.reactions import Reactions, reactions, unbalanced
from rodjax.numerics import rotations
from rodjax.numerics.compilation import compiled
from rodjax.rods.state import State, at_rest
from rodjax.scenes.holds import rows_at
from rodjax.scenes.scene import Scene, projectors

__all__ = [
    "Ledger",
    "Reactions",
    "axial_energy",
    "bending_energy",
    "contact_energy",
    "contact_wrench",
    "gravity_energy",
    "kinetic_energy",
    "ledger",
    "node_motion",
    "reactions",
    "strain_energy_density",
    "torsion_energy",
]


class Ledger(NamedTuple):
    """Where the energy of a run is at its saved times; work and losses count from the first.

    Work is positive when it is done on the rod, except `contact_work`, which the rod does on its
    contacts: stored there as `contact_energy` or lost. With an aperture, which leaves the forces
    without potential, all of it counts as lost. Losses are positive when energy is lost.

    Attributes:
        time: [s]; all that follows [J].
        drive_work: done by the prescribed motion of ends and supports.
        load_work: done by loads whose role is DRIVEN (`Role`).
        bending, torsion: stored by Eq. (4), in A1 and A2, and in C.
        axial: stored in stretch and shear.
        kinetic: Eq. (6), with added mass.
        gravity: potential of the weight less buoyancy, and of your own loads that store energy.
        contact_work: done by the rod on its contacts: stored there or lost.
        drag_loss: to `MorisonDrag`, and your own loads whose role is DRAG.
        damping_loss: to `LinearDrag`, your own loads whose role is DAMPING, and what those that
            store energy exert by motion.
        projection_loss: kinetic energy lost where a constraint began.
        contact_energy: stored between the strands.
        contact_loss: to the damping of the contact law; all its work where nothing is stored.
    """

    time: Float[Array, " k"]
    drive_work: Float[Array, " k"]  # of prescribed motions [J]
    load_work: Float[Array, " k"]  # of loads that are DRIVEN [J]
    bending: Float[Array, " k"]
    torsion: Float[Array, " k"]
    axial: Float[Array, " k"]
    kinetic: Float[Array, " k"]
    gravity: Float[Array, " k"]
    contact_work: Float[Array, " k"]
    drag_loss: Float[Array, " k"]  # of loads that are DRAG
    damping_loss: Float[Array, " k"]  # of loads that are DAMPING
    projection_loss: Float[Array, " k"]  # kinetic energy lost where a constraint began
    contact_energy: Float[Array, " k"] | None = None  # None: of a file of an earlier version
    contact_loss: Float[Array, " k"] | None = None  # part of contact_work

    @property
    def work(self) -> Float[Array, " k"]:
        """Work of drives and loads [J]."""
        return self.drive_work + self.load_work

    @property
    def strain(self) -> Float[Array, " k"]:
        """Strain energy [J]."""
        return self.bending + self.torsion + self.axial

    @property
    def residual(self) -> Float[Array, " k"]:
        """Work less everything that it is accounted to have become [J]: the numerical loss."""
        stored = self.strain + self.kinetic + self.gravity
        losses = self.drag_loss + self.damping_loss + self.projection_loss
        if self.contact_energy is None or self.contact_loss is None:
            losses = losses + self.contact_work
        else:
            stored, losses = stored + self.contact_energy, losses + self.contact_loss
        return self.work - (stored - stored[0]) - losses

    @property
    def balance_error(self) -> Float[Array, ""]:
        """Largest |residual| over the work at the end.

        For a motion that nothing drives compare `residual` with an energy of the motion instead.
        """
        return jnp.max(jnp.abs(self.residual)) / jnp.abs(self.work[-1])


class _Acting(NamedTuple):
    """Wrenches that do work on the rod at one state; None where the scene has none of the kind."""

    ends: Float[Array, "h 6"]  # and supports
    loads: Float[Array, "nodes 6"] | None
    drag: Float[Array, "nodes 6"] | None
    damping: Float[Array, "nodes 6"] | None
    contact: Float[Array, "nodes 6"] | None
    contact_damping: Float[Array, "nodes 6"] | None  # what of it is lost


def _nearby(scene: Scene, state: State) -> Nearby | None:
    """The strands near each other, searched for once for forces and energies."""
    return None if scene.contact is None else find_nearby(scene, state.position)


def _acting(scene: Scene, state: State, nearby: Nearby | None) -> _Acting:
    motion = node_motion(state)
    touching = None if nearby is None else _pushed(scene, state.position, state.velocity, nearby)

    def total(role):
        loads = tuple(load for load in scene.loads if load.role is role)
        return total_wrench(loads, scene.rod, motion) if loads else None

    damping, resting = total(Role.DAMPING), at_rest(*motion[:3])
    for load in scene.loads:
        if load.role is Role.STORED:  # zero to the last digit where motion makes no difference
            lost = load.wrench(scene.rod, motion) - load.wrench(scene.rod, resting)
            damping = lost if damping is None else damping + lost

    return _Acting(
        unbalanced(scene, state, touching),
        total(Role.DRIVEN),
        total(Role.DRAG),
        damping,
        touching,
        None if nearby is None else _contact_damping(scene, state, touching, nearby),
    )


def _pushed(scene: Scene, position, velocity, nearby: Nearby) -> Float[Array, "nodes 6"]:
    """`contact_wrench` for a list of pairs found before."""
    assert scene.contact is not None
    force = contact_forces.forces(scene.contact, scene.rod, *nearby, position, velocity)
    return jnp.concatenate([force, jnp.zeros_like(force)], 1)


def _contact_damping(scene: Scene, state: State, touching, nearby: Nearby):
    """What contact exerts beyond its forces at rest; all of it where these have no potential."""
    contact, where = scene.contact, nearby.where
    assert contact is not None
    resting = touching
    if not ignores_approach(contact.law, PairProperties(where.diameter, where.mass)):
        resting = _pushed(scene, state.position, jnp.zeros_like(state.velocity), nearby)
    return touching - jnp.where(has_potential(contact), resting, 0.0)


def _stored_in_contact(scene: Scene, state: State, nearby: Nearby | None) -> Float[Array, ""]:
    """`contact_energy`, zero where there is no potential."""
    if nearby is None:
        return jnp.zeros((), state.position.dtype)
    assert scene.contact is not None
    energy = stored(scene.contact, *nearby, state.position)
    return jnp.where(has_potential(scene.contact), energy, 0.0)


def _increment(before: State, after: State) -> Float[Array, "nodes 6"]:
    """Displacement (inertial) and rotation vector (body) of the nodes between two states.

    The rotation vector has the same components in the frames before, after and halfway, so the
    mean of body moments at either end times it is their work to second order.
    """
    turn = rotations.multiply(rotations.conjugate(before.quaternion), after.quaternion)
    return jnp.concatenate([after.position - before.position, rotations.logarithm(turn)], 1)


def _added_mass_loss(scene: Scene, before: State, after: State) -> Float[Array, ""]:
    """-v . dM v / 2 of the added mass M.

    Its force -M v' gives the fluid v . M v' = d(v . M v / 2) - v . dM v / 2 a unit of time; the
    first part is in the kinetic energy.
    """
    loss = jnp.zeros((), before.position.dtype)
    velocity = 0.5 * (before.velocity + after.velocity)
    for load in scene.loads:
        first = load.added_mass(scene.rod, node_motion(before))
        second = load.added_mass(scene.rod, node_motion(after))
        if first is not None and second is not None:
            loss = loss - 0.5 * jnp.einsum("ni,nij,nj", velocity, second - first, velocity)
    return loss


@compiled
def ledger(scene: Scene, run: Run) -> Ledger:
    """Energy ledger of a run of the scene over its saved states.

    Work between two saved states is the mean of the forces at both times the actual displacements
    and rotations: second order in the time between them. One scan, so memory does not grow with
    the number of states beyond that of the run. At a time at which a constraint begins the forces
    are those before; a drive that acts in a direction from the moment that it becomes constrained
    therefore loses half of its first interval's work. So does one whose velocity jumps: what it
    does in the jolt is not booked (give it a `Smooth` schedule).
    """
    states = run.states

    def energies(state, nearby):
        parts = bending_energy, torsion_energy, axial_energy, kinetic_energy, gravity_energy
        values = [part(scene, state) for part in parts]
        return jnp.stack([*values, _stored_in_contact(scene, state, nearby)])

    def interval(carry, after):
        before, old = carry
        nearby = _nearby(scene, after)
        new = _acting(scene, after, nearby)
        moved = _increment(before, after)
        zero = jnp.zeros((), moved.dtype)

        def work(a, b):
            return zero if a is None else 0.5 * jnp.sum((a + b) * moved)

        held_moved = rows_at(moved, scene.held_nodes)
        constrained = jnp.einsum("eij,ej->ei", projectors(scene, before.time), held_moved)
        gains = jnp.stack(
            [
                0.5 * jnp.sum((old.ends + new.ends) * constrained),
                work(old.loads, new.loads),
                -work(old.contact, new.contact),
                _added_mass_loss(scene, before, after) - work(old.drag, new.drag),
                -work(old.damping, new.damping),
                -work(old.contact_damping, new.contact_damping),
            ]
        )
        return (after, new), (gains, energies(after, nearby))

    # the first interval is from the first state to itself, so what acted before does not matter
    first = run.state(0)
    nothing = jax.tree.map(
        lambda leaf: jnp.zeros(leaf.shape, leaf.dtype),
        jax.eval_shape(lambda: _acting(scene, first, _nearby(scene, first))),
    )
    _, (gains, energy) = lax.scan(interval, (first, nothing), states)
    intervals = gains.shape[0] - 1
    steps = run.infos.projection_loss
    lost = steps.reshape(intervals, steps.shape[0] // max(intervals, 1)).sum(1)
    lost = jnp.concatenate([jnp.zeros_like(lost[:1]), lost])
    total = jnp.cumsum(jnp.concatenate([gains, lost[:, None]], 1), 0)
    total = total - total[:1]
    drive_work, load_work, contact_work, drag, damping, contact_loss, projection = total.T
    bending, torsion, axial, kinetic, gravity, contact = energy.T
    return Ledger(
        states.time,
        drive_work,
        load_work,
        bending,
        torsion,
        axial,
        kinetic,
        gravity,
        contact_work,
        drag,
        damping,
        projection,
        contact,
        contact_loss,
    )
