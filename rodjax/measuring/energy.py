"""Energies of a state, reactions of the ends, and the energy ledger of a run.

The ledger says where the work of drives and loads went:
    W_drives + W_loads + W_actuation
                       = change of (bending + torsion + axial + kinetic + gravity energy)
                         + change of contact energy + losses of contact, drag and damping
                         + losses of the material + projection losses.
Every term is integrated for itself, none is a remainder; what the two sides differ by is the
numerical loss of the time integration plus the error of the quadrature.
"""

import warnings
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rodjax.dynamics.run import Run
from rodjax.inputs.validation import all_known
from rodjax.interactions.roles import Role
from rodjax.measuring.blocks import scan_states
from rodjax.measuring.energies import (
    axial_energy,
    bending_energy,
    contact_energy,
    contact_wrench,
    gravity_energy,
    kinetic_energy,
    node_motion,
    stored,
    strain_energy_density,
    torsion_energy,
)
from rodjax.measuring.ledger_sheet import sheet_of_ledger
from rodjax.measuring.ledger_wrenches import ledger_wrenches
from rodjax.measuring.material_work import booked, material_work
from rodjax.measuring.reactions import Reactions, reactions
from rodjax.numerics import rotations
from rodjax.numerics.results import ModelWarning
from rodjax.rods.state import State
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

    Work and losses are summed over the saved states, by the trapezoidal rule between them: what
    snaps or slips within fewer steps than are saved is missed, and stands in `residual`. Save every
    step of such a run.

    Attributes:
        time: [s]; all that follows [J].
        drive_work: done by the prescribed motion of ends, supports, joints and obstacles.
        load_work: done by loads whose role is DRIVEN (`Role`).
        bending, torsion: stored by Eq. (4), in A1 and A2, and in C.
        axial: stored in stretch and shear.
        kinetic: Eq. (6), with added mass.
        gravity: potential of the weight less buoyancy, and of your own loads that store energy.
        contact_work: done by the rod on its contacts, with itself and with your own loads whose
            role is CONTACT: stored there or lost.
        drag_loss: to `MorisonDrag`, and your own loads whose role is DRAG.
        damping_loss: to `LinearDrag`, your own loads whose role is DAMPING, and what those that
            store energy exert by motion.
        projection_loss: kinetic energy lost where a constraint began.
        contact_energy: stored between the strands, and by such loads.
        contact_loss: to the damping of the contact law and of such loads, and to friction; all its
            work where nothing is stored.
        actuation_work: done by the schedule of the natural curvature, and by what else changes a
            material in time; None where there is neither.
        material_loss: of the rod's material, by its strain rates; None of a linear rod.
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
    actuation_work: Float[Array, " k"] | None = None
    material_loss: Float[Array, " k"] | None = None

    def __repr__(self) -> str:
        return sheet_of_ledger(self).title.removesuffix("; at its end:")

    def __str__(self) -> str:
        return sheet_of_ledger(self).text

    def _repr_html_(self) -> str:
        return sheet_of_ledger(self).html

    @property
    def work(self) -> Float[Array, " k"]:
        """Work of drives, loads and actuation [J]."""
        return _work(self)

    @property
    def strain(self) -> Float[Array, " k"]:
        """Strain energy [J]."""
        return self.bending + self.torsion + self.axial

    @property
    def residual(self) -> Float[Array, " k"]:
        """Work less everything that it is accounted to have become [J]: the numerical loss."""
        return _residual(self)

    @property
    def balance_error(self) -> Float[Array, ""]:
        """Largest |residual| over the work at the end.

        For a motion that nothing drives compare `residual` with an energy of the motion instead.
        """
        return abs(self.residual).max() / abs(self.work[-1])  # of numpy's arrays by numpy


def _residual(ledger):
    """Of arrays of numpy or jax alike."""
    stored = _stored(ledger)
    losses = ledger.drag_loss + ledger.damping_loss + ledger.projection_loss
    if ledger.material_loss is not None:
        losses = losses + ledger.material_loss
    if ledger.contact_energy is None or ledger.contact_loss is None:
        losses = losses + ledger.contact_work
    else:
        stored, losses = stored + ledger.contact_energy, losses + ledger.contact_loss
    return _work(ledger) - (stored - stored[0]) - losses


def _work(ledger):
    given = ledger.drive_work + ledger.load_work
    return given if ledger.actuation_work is None else given + ledger.actuation_work


def _stored(ledger):
    strain = ledger.bending + ledger.torsion + ledger.axial
    return strain + ledger.kinetic + ledger.gravity


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


def ledger(scene: Scene, run: Run) -> Ledger:
    """Energy ledger of a run of the scene over its saved states.

    Work between two saved states is the mean of the forces at both times the actual displacements
    and rotations: second order in the time between them. One scan, so memory does not grow with
    the number of states beyond that of the run. At a time at which a constraint begins the forces
    are those before; a drive that acts in a direction from the moment that it becomes constrained
    therefore loses half of its first interval's work. So does one whose velocity jumps: what it
    does in the jolt is not booked (give it a `Smooth` schedule).
    """
    if not all_known(scene, run):
        return _booked(jnp, run, *_intervals(scene, run))
    # in numpy: programs fit any number of states but for this, which costs nothing
    run = jax.tree.map(np.asarray, run)
    booked = _booked(np, run, *jax.tree.map(np.asarray, _intervals(scene, run)))
    _warn_if_missed(booked, run)
    return jax.tree.map(jax.device_put, booked)


# Part of the energy that comes and goes which a thinned run's ledger may miss unsaid.
_MISSED = 0.05


def _warn_if_missed(booked: Ledger, run: Run) -> None:
    """ModelWarning where a ledger does not close over states that are not those of all steps."""
    most = int(np.max(np.diff(run.step_counts), initial=1))
    size = max(float(np.max(np.abs(_work(booked)))), float(np.ptp(np.asarray(_stored(booked)))))
    missed = float(np.max(np.abs(_residual(booked))))
    if most == 1 or not missed > _MISSED * size:
        return
    warnings.warn(
        f"ledger: {missed:.3g} of {size:.3g} that came and went are not accounted for, of a run"
        f" with up to {most} steps between two saved states, over which work and losses are"
        " summed; save every step to see them",
        ModelWarning,
        stacklevel=3,
    )


def _intervals(scene: Scene, run: Run) -> tuple[Float[Array, "k works"], Float[Array, "k 6"]]:
    """Works and losses of the intervals, that from the first state to itself first; energies."""
    first = jax.tree.map(lambda leaf: leaf[0], run.states)
    # from the first state to itself what acted before does not matter
    shapes = eqx.filter_eval_shape(ledger_wrenches, scene, first)[0]
    nothing = jax.tree.map(lambda leaf: jnp.asarray(np.zeros(leaf.shape), leaf.dtype), shapes)
    return _interval((first, nothing), run.states, scene)[1]


@scan_states
def _interval(carry, after: State, scene: Scene):
    before, old = carry
    new, found = ledger_wrenches(scene, after)
    moved = _increment(before, after)
    zero = jnp.zeros((), moved.dtype)

    def work(a, b):
        return zero if a is None else 0.5 * jnp.sum((a + b) * moved)

    held_moved = rows_at(moved, scene.held_nodes)
    constrained = jnp.einsum("eij,ej->ei", projectors(scene, before.time), held_moved)
    since = lambda a, b: zero if a is None else b - a
    driven = 0.5 * jnp.sum((old.ends + new.ends) * constrained)
    for (old_force, start), (force, stop) in zip(old.driving, new.driving, strict=True):
        driven = driven + 0.5 * jnp.sum((old_force + force) * (stop - start))
    gains = jnp.stack(
        [
            driven,
            work(old.loads, new.loads),
            -work(old.contact, new.contact),
            _added_mass_loss(scene, before, after) - work(old.drag, new.drag),
            since(old.damping_before, new.damping_before) - work(old.damping, new.damping),
            since(old.contact_before, new.contact_before)
            - work(old.contact_damping, new.contact_damping),
        ]
    )
    if booked(scene.rod):
        gains = jnp.concatenate([gains, jnp.stack(material_work(scene.rod, before, after))])
    parts = bending_energy, torsion_energy, axial_energy, kinetic_energy, gravity_energy
    values = [part(scene, after) for part in parts]
    energies = jnp.stack([*values, stored(scene, after, Role.CONTACT, found)])
    return (after, new), (gains, energies)


def _booked(xp, run: Run, gains, energy) -> Ledger:
    """The ledger of works and losses of the intervals and energies; `xp` is numpy or jax's."""
    steps = run.infos.projection_loss
    lost = xp.cumsum(xp.concatenate([xp.zeros((1,), steps.dtype), steps]))[run.step_counts]
    total = xp.concatenate([xp.cumsum(gains, 0), lost[:, None]], 1)
    total = total - total[:1]
    drive_work, load_work, contact_work, drag, damping, contact_loss, *own, projection = total.T
    actuation, material_loss = own if own else (None, None)
    bending, torsion, axial, kinetic, gravity, contact = energy.T
    return Ledger(
        run.states.time,
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
        actuation,
        material_loss,
    )
