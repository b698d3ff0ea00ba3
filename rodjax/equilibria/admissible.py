"""Stiffness, mass and damping on the motions that constraint and ends allow.

Admissible motions are parametrised by the displacement of node 0, the spins of the nodes and, in
a compliant rod, the variations g of the elements' stretch and shear:

    u_{i+1} = u_i + ds E (g - gamma x d theta_e)        (see `balance`),

which solves the constraint exactly; the ends' conditions are linear in the parameters y and are
projected out by who uses them. K = d(internal - external wrench) on these motions is, where all
loads have a potential and the state is an equilibrium, the second variation of the energy (plus
the compliance's ds g^2 / compliance), and symmetric.

Everything is without unit: lengths over the rod's L, stiffness over A/L with the mean bending
stiffness A, mass over m L^3 with the mean mass per length m, times over sqrt(m L^4/A). So numbers
of any size, those of a molecule in SI, stay within single precision.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from rodjax.equations import joint_terms
from rodjax.equations.imbalance import static_imbalance
from rodjax.interactions.load import total_wrench
from rodjax.numerics.eigenvalues import far_above
from rodjax.rods import balance
from rodjax.rods.inertia import inertial_wrench, node_jacobian
from rodjax.rods.rod import Rod
from rodjax.rods.state import NodeMotion, State, at_rest, moved
from rodjax.rods.strains import strains
from rodjax.scenes.scene import Scene, projectors


class Admissible(NamedTuple):
    """The motions and the tangent on them, before the ends are projected out (see the module)."""

    basis: Float[Array, "m nodes 6"]  # displacement over L and body spin, for each parameter
    stiffness: Float[Array, "m m"]
    norm: Float[Array, " m"]  # weights of the rotational norm (diagonal)
    ends: Float[Array, "6*h m"]  # rows that must vanish

    def on_motions(self, nodes: Float[Array, "nodes 6 6"]) -> Float[Array, "m m"]:
        """A matrix of the nodes on the motions."""
        m = self.basis.shape[0]
        pushed = jnp.einsum("nij,mnj->mni", nodes, self.basis)
        return self.basis.reshape(m, -1) @ pushed.reshape(m, -1).T

    def motion(self, scene: Scene, y: Complex[Array, "k m"]) -> Complex[Array, "k nodes 6"]:
        """Displacements [m] and body spins [rad] for parameters."""
        basis = self.basis * _units(scene)[None, None]
        return jnp.einsum("km,mni->kni", y, basis.astype(y.dtype))


def _units(scene: Scene) -> Float[Array, "6"]:
    """L for displacements, 1 for rotations."""
    length = jnp.sum(scene.rod.length)
    return jnp.repeat(jnp.stack([length, jnp.ones_like(length)]), 3)


def mean_bending(scene: Scene) -> Float[Array, ""]:
    """A [N m^2], the unit of stiffness times L."""
    return scene.rod.mean_bending


def rate_of(scene: Scene) -> Float[Array, ""]:
    """The unit of frequencies, sqrt(A/m)/L^2 [1/s]; for a rod without mass with m = 1."""
    length = jnp.sum(scene.rod.length)
    mass = 1.0 if scene.rod.mass is None else total_mass(scene.rod) / length
    return jnp.sqrt(mean_bending(scene) / mass) / length**2


def total_mass(rod: Rod) -> Float[Array, ""]:
    """Mass of the rod, which must have one [kg]."""
    assert rod.mass is not None
    return jnp.sum(rod.mass * rod.length)


def allowed(
    rod: Rod, position: Float[Array, "nodes 3"], quaternion: Float[Array, "nodes 4"]
) -> Float[Array, "m nodes 6"]:
    """The motions that the constraint allows: displacement over L and body spin of the nodes.

    Of several rods each has a displacement of its own.
    """
    n, dtype = rod.elements, position.dtype
    kinematics = strains(rod, position, quaternion)
    shear = balance.constraint_tangent(rod, kinematics).constraint_spin  # gamma x d theta_e
    length = jnp.sum(rod.length)
    give = None if rod.compliance is None else (rod.compliance > 0).astype(dtype)

    rods = len(rod.parts)
    # of every node, its rod and the first node of that
    numbers = np.repeat(np.arange(rods), [part.last - part.first + 1 for part in rod.parts])
    begins = np.array([part.first for part in rod.parts])[numbers]

    def expand(y):
        """Motion of the nodes for the parameters y = (u_0 / L, of each rod, spins, g)."""
        begin, y = y[: 3 * rods].reshape(rods, 3), y[3 * rods - 3 :]
        spins = y[3 : 3 * n + 6].reshape(n + 1, 3)
        stretch = -jnp.einsum("nij,nj->ni", shear, jnp.concatenate([spins[:-1], spins[1:]], 1))
        if give is not None:
            stretch = stretch + give * y[3 * n + 6 :].reshape(n, 3)
        edge = (rod.length / length)[:, None]
        edge = edge * jnp.einsum("nij,nj->ni", kinematics.frame, stretch)
        moved = jnp.cumsum(jnp.concatenate([0 * begin[:1], edge]), 0)
        # each counts from its own first node
        moved = moved - moved[begins] + begin[numbers] if rod.breaks else begin + moved
        return jnp.concatenate([moved, spins], 1)

    parameters = 3 * rods + 3 * (n + 1) + (0 if give is None else 3 * n)
    return jax.vmap(expand)(jnp.eye(parameters, dtype=dtype))


def constrained(
    scene: Scene,
    state: State,
    basis: Float[Array, "m nodes 6"],
    stiffness: Float[Array, "m m"],
) -> Admissible:
    """Allowed motions with the tangent of the balances on them, the compliance's springs added."""
    both = projectors(scene, state.time)
    rod, compliance = scene.rod, scene.rod.compliance
    length = jnp.sum(rod.length)
    norm = jnp.repeat(rod.weighing_length / length, 3)
    norm = jnp.concatenate([jnp.zeros((3 * len(rod.parts),), norm.dtype), norm])
    if compliance is not None:
        # components without compliance stay put: a spring far stiffer than all else holds them
        ds = jnp.repeat(rod.length / length, 3)
        stiff = far_above(stiffness) * jnp.repeat(rod.gauge_length / length, 3)
        force = mean_bending(scene) / length**2
        spring = ds / jnp.where(compliance > 0, compliance * force, 1.0).ravel()
        soft = rod.at_breaks(compliance > 0, False)
        spring = jnp.where(soft.ravel(), spring, stiff)
        stiffness = stiffness + jnp.diag(jnp.concatenate([jnp.zeros_like(norm), spring]))
        norm = jnp.concatenate([norm, ds])
    held = [p @ basis[:, i].T for p, i in zip(both, scene.held_nodes, strict=True)]
    if scene.joints:
        slopes = joint_terms.slopes(scene, at_rest(state.time, state.position, state.quaternion))
        moved = jax.vmap(lambda one: joint_terms.at_points(scene, one))(
            basis * _units(scene)[None, None]
        )
        rows = jnp.einsum("jikl,mjkl->jim", slopes, moved) / _units(scene)[None, :, None]
        held.append(rows.reshape(-1, len(basis)))
    return Admissible(basis, stiffness, norm, jnp.concatenate(held))


def admissible(scene: Scene, state: State) -> Admissible:
    """The motions that the constraint allows at a state, and the tangent on them."""
    scene = scene.recalling(state.memory)
    basis = allowed(scene.rod, state.position, state.quaternion)
    motion = at_rest(state.time, state.position, state.quaternion)
    units, energy = _units(scene)[None], mean_bending(scene) / jnp.sum(scene.rod.length)

    def work(z):
        """The imbalance, as work over A/L on a displacement of L or a spin of 1."""
        after = moved(motion, units * z)
        wrench = static_imbalance(scene, after, state.force)[0]
        if state.joints is not None:
            wrench = wrench - joint_terms.exerted(scene, after, state.joints)
        return wrench * (units / energy)

    push = lambda z: jax.jvp(work, (jnp.zeros_like(z),), (z,))[1]
    stiffness = basis.reshape(len(basis), -1) @ jax.vmap(push)(basis).reshape(len(basis), -1).T
    return constrained(scene, state, basis, stiffness)


def mass_matrix(scene: Scene, state: State, motions: Admissible) -> Float[Array, "m m"]:
    """Mass of the nodes, with rotary inertia if the rod has it and with added mass."""
    motion = at_rest(state.time, state.position, state.quaternion)
    zero = jnp.zeros_like(state.rate)
    matrix = node_jacobian(lambda rate: inertial_wrench(scene, motion, rate), zero)
    return motions.on_motions(_scaled(matrix / total_mass(scene.rod), scene))


def damping_matrix(scene: Scene, state: State, motions: Admissible) -> Float[Array, "m m"]:
    """Minus the derivative of the loads by the velocities, at rest; with that of the material."""
    motion = at_rest(state.time, state.position, state.quaternion)
    zero = jnp.zeros_like(state.rate)
    inner = _material_damping(scene, motion, motions)
    if not scene.loads:
        return jnp.zeros_like(motions.stiffness) if inner is None else inner

    def wrench(rate):
        moving = motion._replace(velocity=rate[:, :3], angular_velocity=rate[:, 3:])
        return -total_wrench(scene.loads, scene.rod, moving)

    # over A T / L^3, before the lengths of the motions are put in
    unit = mean_bending(scene) / jnp.sum(scene.rod.length) ** 2 / jnp.sum(scene.rod.length)
    if scene.between_nodes:
        # all motions of it, of which each node's neighbours are part
        unit = unit / rate_of(scene)
        over = (_units(scene) / jnp.sum(scene.rod.length))[None]
        push = lambda z: over * jax.jvp(wrench, (zero,), (over * z,))[1] / unit
        basis = motions.basis.reshape(len(motions.basis), -1)
        outer = basis @ jax.vmap(push)(motions.basis).reshape(len(basis), -1).T
    else:
        matrix = node_jacobian(wrench, zero) * (rate_of(scene) / unit)
        outer = motions.on_motions(_scaled(matrix, scene))
    return outer if inner is None else outer + inner


def _material_damping(
    scene: Scene, motion: NodeMotion, motions: Admissible
) -> Float[Array, "m m"] | None:
    """The derivative of the internal moments by the velocities, of a viscous material."""
    material = scene.rod.material
    if material is None or not material.viscous:
        return None
    force = jnp.zeros_like(motion.position[1:])
    # over A T / L, of spins a unit of time
    unit = mean_bending(scene) / jnp.sum(scene.rod.length) / rate_of(scene)

    def wrench(rate):
        moving = motion._replace(angular_velocity=rate[:, 3:])
        return balance.internal(scene.rod, moving, force).moment / unit

    zero = jnp.zeros_like(motions.basis[0])
    push = lambda z: jax.jvp(wrench, (zero,), (z,))[1]
    spins = motions.basis[:, :, 3:].reshape(len(motions.basis), -1)
    return spins @ jax.vmap(push)(motions.basis).reshape(len(spins), -1).T


def _scaled(matrix: Float[Array, "nodes 6 6"], scene: Scene) -> Float[Array, "nodes 6 6"]:
    """Rows and columns of spins over L."""
    over = _units(scene) / jnp.sum(scene.rod.length)
    return over[None, :, None] * matrix * over[None, None]
