"""Energies of a state."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.equations.imbalance import of_contact
from rodjax.interactions.roles import Role
from rodjax.numerics import rotations
from rodjax.numerics.compilation import compiled
from rodjax.rods import balance, inertia
from rodjax.rods.constitution import in_state, moment_energy_density
from rodjax.rods.rod import Rod
from rodjax.rods.state import State, node_motion
from rodjax.rods.strains import element_rotation, strains
from rodjax.scenes.scene import Found, Scene


def _moment_energy_density(rod: Rod, state: State) -> Float[Array, "n 3"]:
    """The three terms of Eq. (4), or what the rod's material stores."""
    rod = in_state(rod, state)
    rotation = rotations.logarithm(element_rotation(rod, state.quaternion))
    return moment_energy_density(rod, rotation, node_motion(state))


def _force_energy_density(rod: Rod, state: State) -> Float[Array, "n 3"]:
    """f . compliance f / 2 with the f that the strains store; zero where nothing gives."""
    if rod.compliance is None:
        return jnp.zeros_like(rod.stiffness)
    kinematics = strains(rod, state.position, state.quaternion)
    gap = balance.force_strain(rod, kinematics, node_motion(state))
    gives = rod.compliance > 0
    return jnp.where(gives, 0.5 * gap**2 / jnp.where(gives, rod.compliance, 1.0), 0.0)


@compiled
def strain_energy_density(rod: Rod, state: State) -> Float[Array, " n"]:
    """Strain energy per length of the elements of a rod in this state [J/m].

    Eq. (4), (kappa - kappa0)^T B (kappa - kappa0) / 2, or what the rod's material stores, plus
    that of f. With an actuation kappa0 is that at the state's time.
    """
    density = jnp.sum(_moment_energy_density(rod, state), 1)
    return density + jnp.sum(_force_energy_density(rod, state), 1)


def bending_energy(scene: Scene, state: State) -> Float[Array, ""]:
    """The part of Eq. (4) in A1 and A2, over the rod of the scene in this state [J].

    And half of what couples bending with twist, and what a material does not share out.
    """
    rod = scene.rod
    return jnp.sum(rod.length[:, None] * _moment_energy_density(rod, state)[:, :2])


def torsion_energy(scene: Scene, state: State) -> Float[Array, ""]:
    """The part of Eq. (4) in C, over the rod of the scene in this state [J]."""
    return jnp.sum(scene.rod.length * _moment_energy_density(scene.rod, state)[:, 2])


def axial_energy(scene: Scene, state: State) -> Float[Array, ""]:
    """Energy of stretch and shear of the scene's rod in this state [J]; zero if inextensible."""
    return jnp.sum(scene.rod.length[:, None] * _force_energy_density(scene.rod, state))


def kinetic_energy(scene: Scene, state: State) -> Float[Array, ""]:
    """Eq. (6) over the scene's rod in this state, with the added mass of the loads [J]."""
    return inertia.kinetic_energy(scene, node_motion(state))


def gravity_energy(scene: Scene, state: State) -> Float[Array, ""]:
    """Potential of the scene's weight less buoyancy in this state, zero at the origin [J].

    And of your own loads that store energy.
    """
    return stored(scene, state, Role.STORED)


def contact_energy(scene: Scene, state: State) -> Float[Array, ""]:
    """What strands at rest have stored in the law between them [J], zero without contact.

    And your own loads whose role is CONTACT. Not a number where an aperture leaves the contact
    force without potential.
    """
    energy = stored(scene, state, Role.CONTACT)
    for one in scene.interactions:
        if one.role is Role.CONTACT:
            energy = jnp.where(one.conservative, energy, jnp.nan)
    return energy


def stored(scene: Scene, state: State, role: Role, found: Found | None = None) -> Float[Array, ""]:
    """Potential energy of what acts in a role that stores, zero where there is no potential [J].

    Args:
        found: by what acts, see `Scene.find`; None: looked for in the state.
    """
    scene, rod, motion = scene.recalling(state.memory), scene.rod, node_motion(state)
    energy = jnp.zeros((), state.position.dtype)
    for i, one in enumerate(scene.interactions):
        if one.role is role:
            look = lambda one=one: one.find(rod, motion.position, None, scene.closed)
            energy = energy + one.stored(rod, motion, look() if found is None else found.each[i])
    return energy


def contact_wrench(scene: Scene, state: State) -> Float[Array, "nodes 6"]:
    """What the scene's contact exerts on the nodes of this state.

    Columns: force, inertial (3) [N], and moment in the body frame (3) [N m].
    """
    return sum(of_contact(scene, node_motion(state)), jnp.zeros_like(state.rate))
