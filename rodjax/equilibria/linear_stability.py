"""Stability of an equilibrium: the tangent on the motions that constraint and ends allow."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from rodjax.equations.rigid_motions import check_held
from rodjax.equilibria.admissible import (
    Admissible,
    admissible,
    damping_matrix,
    mass_matrix,
    mean_bending,
)
from rodjax.numerics.compilation import compiled
from rodjax.numerics.eigenvalues import grows, lowest
from rodjax.rods.state import State
from rodjax.scenes.arguments import check_motion
from rodjax.scenes.scene import Scene


class Stability(NamedTuple):
    """Eigenvalues of the tangent by ascending real part, their modes, and what they say.

    `antisymmetry` measures the part of the tangent that has no potential: its work over the work
    of the rest, at most, among all motions (0 for dead forces, gravity and contact laws with a
    potential, at an equilibrium). `symmetric` says which problem was solved:

    - true (antisymmetry no more than rounding): eigenvalues are those of the second variation of
      the energy, real, and `stable` says that the lowest is positive.
    - false (follower loads, dead end moments, drag in a current, a contact law without potential;
      or a state that is not in equilibrium): there is no energy to be least. Eigenvalues are those
      of the general problem and may be complex; a real one that passes zero means divergence, as
      above, but none of them tells of flutter. So `stable` is then judged by the motion itself,
      M x'' + D x' + K x = 0 with the mass and the damping that the loads have: whether no solution
      grows.

    Attributes:
        eigenvalues, imaginary: real and imaginary parts [N].
        modes, imaginary_modes: real and imaginary parts of the displacement, inertial (3) [m], and
            of the body spin (3) [rad] of every node.
        stable: whether small disturbances stay small.
        antisymmetry: 0 where there is a potential.
        symmetric: which problem was solved.
    """

    eigenvalues: Float[Array, " k"]  # real parts [N]
    modes: Float[Array, "k nodes 6"]  # displacement [m] and body spin [rad]; real parts
    stable: Bool[Array, ""]
    imaginary: Float[Array, " k"]  # imaginary parts of the eigenvalues [N]
    imaginary_modes: Float[Array, "k nodes 6"]
    antisymmetry: Float[Array, ""]
    symmetric: Bool[Array, ""]


def stability(scene: Scene, state: State, count: int = 1) -> Stability:
    """The `count` lowest eigenvalues of a scene's tangent at an equilibrium; whether it is stable.

    The norm is the integral of |spin|^2 ds (and, in a compliant rod, of the squared variation of
    stretch and shear), so eigenvalues are forces [N]: for a straight column under a thrust P the
    lowest is P_critical - P. Constraints are those in force from `state.time` on, loads those at
    `state.time`. A negative eigenvalue means instability. What is said of loads that have no
    potential (follower loads, dead end moments, drag in a current) stands in `Stability`: look at
    its `symmetric`.

    Eigenvalues can be differentiated at an equilibrium (those that coincide as their mean; where
    two are about to become complex the derivative is infinite), modes cannot. The general problem
    runs inside compiled programs too: LAPACK on the CPU, cuSOLVER or the host's LAPACK on a GPU.

    Dense: cost grows as n^3, meant for up to a few hundred elements.

    Raises:
        ValueError: the ends leave the rod free to move, or `count` does not fit.

    Example:
        >>> state, _ = rx.equilibrium(scene, rx.placing(scene))
        >>> bool(rx.stability(scene, state).eigenvalues[0] > 0)
        True
    """
    check_motion(scene, state)
    check_held(scene, state)
    check_count(scene, count)
    return _stability(scene, state, count)


def check_count(scene: Scene, count: int) -> None:
    """Raise ValueError for a number of modes that the rod does not have."""
    if not 1 <= count <= scene.rod.elements:
        raise ValueError(f"count: from 1 to the {scene.rod.elements} elements, got {count}")


@compiled
def _stability(scene, state, count):
    motions = admissible(scene, state)
    unit = jnp.full((), 10.0, state.position.dtype)
    found = lowest(motions.stiffness, jnp.diag(motions.norm), motions.ends, unit, count)
    constant = lambda leaf: lax.stop_gradient(leaf) if eqx.is_array(leaf) else leaf
    fixed = jax.tree.map(constant, (scene, state, motions))
    lowest_is_positive = lambda: found.values[0].real > 0
    stable = lax.cond(found.symmetric, lowest_is_positive, lambda: ~_grows(*fixed))
    modes = fixed[-1].motion(scene, found.vectors)
    scale = mean_bending(scene) / jnp.sum(scene.rod.length) ** 2
    values = found.values * scale.astype(found.values.dtype)
    return Stability(
        values.real,
        lax.stop_gradient(modes.real),
        stable,
        values.imag,
        lax.stop_gradient(modes.imag),
        found.antisymmetry,
        found.symmetric,
    )


def _grows(scene: Scene, state: State, motions: Admissible) -> Bool[Array, ""]:
    """Whether a small motion about the state grows."""
    damping = damping_matrix(scene, state, motions)
    mass = None if scene.rod.mass is None else mass_matrix(scene, state, motions)
    weight = damping if mass is None else mass
    # about the lowest eigenvalues of K by the weight, as the shifted problem wants
    unit = 10 * jnp.max(motions.norm) / jnp.max(jnp.diag(weight))
    return grows(motions.stiffness, damping, mass, motions.ends, unit)
