"""Internal forces and moments of the nodes, the constraint, and their exact tangent.

The nodal forces are the transposed derivative of the element strains applied to ds q, with
q = B (kappa - kappa0), and to ds f (f the internal force in the element frame, the multiplier of
gamma = e3 + compliance f). In closed form, with phi = ds kappa, c and b the coefficients of
`rotations`, A = I + hat(phi)/2 + c hat(phi)^2, N = I/2 + b hat(phi):

    d phi     = A dtheta_{i+1} - A^T dtheta_i            (body increments of the two nodes)
    d theta_e = N dtheta_{i+1} + N^T dtheta_i            (rotation of the element frame E)
    d gamma   = E^T (du_{i+1} - du_i) / ds + gamma x d theta_e

    force on nodes i, i+1:   -E f,  E f                  w = ds f x gamma
    moment on node i:        -A q + N w,    on node i+1:  A^T q + N^T w

These are Eqs. (3), (8), (9) and the integrals of (10), (11) of Goyal, Perkins & Lee on the grid:
momentum follows from objectivity and f does no work. The tangent below is their derivative by
hand, because differentiating the strains twice by machine costs fifty times as much here.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.numerics import rotations
from rodjax.rods.rod import Rod
from rodjax.rods.strains import Strains, strains


class Internal(NamedTuple):
    """Internal wrenches to be balanced at the nodes, and the constraint of the elements."""

    force: Float[Array, "nodes 3"]  # inertial components [N]
    moment: Float[Array, "nodes 3"]  # body components [N m]
    constraint: Float[Array, "n 3"]  # gamma - e3 - compliance f


class ElementTangent(NamedTuple):
    """Derivatives of `Internal` element by element; columns (node i, node i+1) by body spins."""

    frame: Float[Array, "n 3 3"]  # E: force by f, and (transposed, over ds) constraint by edge
    force_spin: Float[Array, "n 3 6"]
    moment_edge: Float[Array, "n 6 3"]
    moment_spin: Float[Array, "n 6 6"]
    moment_force: Float[Array, "n 6 3"]
    constraint_spin: Float[Array, "n 3 6"]


def internal_moment(rod: Rod, rotation: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    """q = B (kappa - kappa0), Eq. (3) [N m]."""
    return rod.stiffness * (rotation / rod.length[:, None] - rod.natural_curvature)


def constraint(rod: Rod, stretch: Float[Array, "n 3"], force: Float[Array, "n 3"]):
    """gamma - e3 - compliance f: zero for an admissible motion."""
    gap = stretch - jnp.asarray([[0.0, 0.0, 1.0]], stretch.dtype)
    return gap if rod.compliance is None else gap - rod.compliance * force


def internal(
    rod: Rod,
    position: Float[Array, "nodes 3"],
    quaternion: Float[Array, "nodes 4"],
    force: Float[Array, "n 3"],
) -> Internal:
    """Internal nodal wrenches and the constraint of a configuration with internal force f."""
    kinematics = strains(rod, position, quaternion)
    phi = kinematics.rotation
    q = internal_moment(rod, phi)
    squared = jnp.sum(phi * phi, -1, keepdims=True)
    once = rotations.cross(phi, q)
    even = q + rotations.inverse_tangent_coefficient(squared) * rotations.cross(phi, once)
    constraining = constraint_wrench(rod, kinematics, force)
    return Internal(
        force=constraining[:, :3],
        moment=constraining[:, 3:] + scatter(-even - 0.5 * once, even - 0.5 * once),
        constraint=constraint(rod, kinematics.stretch, force),
    )


def constraint_wrench(
    rod: Rod, kinematics: Strains, force: Float[Array, "n 3"]
) -> Float[Array, "nodes 6"]:
    """What the internal force f adds to the balances of the nodes."""
    phi = kinematics.rotation
    squared = jnp.sum(phi * phi, -1, keepdims=True)
    w = rod.length[:, None] * rotations.cross(force, kinematics.stretch)
    half, turned = 0.5 * w, rotations.midframe_coefficient(squared) * rotations.cross(phi, w)
    spatial = jnp.einsum("nij,nj->ni", kinematics.frame, force)
    return jnp.concatenate([scatter(-spatial, spatial), scatter(half + turned, half - turned)], 1)


def scatter(first: Float[Array, "n *k"], second: Float[Array, "n *k"]) -> Float[Array, "nodes *k"]:
    """Sum of element contributions to their first and second nodes."""
    zero = jnp.zeros_like(first[:1])
    return jnp.concatenate([first, zero]) + jnp.concatenate([zero, second])


def _kinematic_maps(kinematics: Strains):
    """A and [N^T, N] of every element."""
    phi = kinematics.rotation
    squared = jnp.sum(phi * phi, -1)[:, None, None]
    skew = rotations.hat(phi)
    eye = jnp.eye(3, dtype=phi.dtype)[None]
    outer = phi[:, :, None] * phi[:, None, :] - squared * eye  # hat(phi)^2
    a = eye + 0.5 * skew + rotations.inverse_tangent_coefficient(squared) * outer
    turn = rotations.midframe_coefficient(squared) * skew
    return a, jnp.concatenate([0.5 * eye - turn, 0.5 * eye + turn], 2)


def constraint_tangent(rod: Rod, kinematics: Strains) -> ElementTangent:
    """The tangent at zero internal force and moment: the constraint and its transpose alone.

    With a mass matrix on the nodes it makes the system for accelerations and for projections.
    """
    _, spin = _kinematic_maps(kinematics)
    constraint_spin = rotations.hat(kinematics.stretch) @ spin
    zero = jnp.zeros((rod.elements, 6, 3), spin.dtype)
    return ElementTangent(
        frame=kinematics.frame,
        force_spin=jnp.zeros_like(spin),
        moment_edge=zero,
        moment_spin=jnp.zeros((rod.elements, 6, 6), spin.dtype),
        moment_force=rod.length[:, None, None] * jnp.swapaxes(constraint_spin, 1, 2),
        constraint_spin=constraint_spin,
    )


def element_tangent(
    rod: Rod,
    position: Float[Array, "nodes 3"],
    quaternion: Float[Array, "nodes 4"],
    force: Float[Array, "n 3"],
) -> ElementTangent:
    """Exact derivative of `internal`, element by element."""
    kinematics = strains(rod, position, quaternion)
    phi, gamma = kinematics.rotation, kinematics.stretch
    ds = rod.length[:, None, None]
    q = internal_moment(rod, phi)
    w = rod.length[:, None] * rotations.cross(force, gamma)
    squared = jnp.sum(phi * phi, -1)[:, None, None]
    eye = jnp.eye(3, dtype=phi.dtype)[None]
    outer = lambda x, y: x[:, :, None] * y[:, None, :]
    dot = lambda x, y: jnp.sum(x * y, -1)[:, None, None] * eye
    hat = rotations.hat
    transpose = lambda m: jnp.swapaxes(m, 1, 2)

    a, spin = _kinematic_maps(kinematics)
    once = rotations.cross(phi, q)
    twice = rotations.cross(phi, once)
    slope = rotations.inverse_tangent_slope(squared)[:, :, 0] * twice - rotations.midframe_slope(
        squared
    )[:, :, 0] * rotations.cross(phi, w)
    # derivative by phi of the parts that enter the two nodes with opposite signs ...
    opposite = (
        -rotations.inverse_tangent_coefficient(squared) * (hat(once) + outer(q, phi) - dot(q, phi))
        + rotations.midframe_coefficient(squared) * hat(w)
        + outer(slope, phi)
    )
    # ... and of -hat(phi) q / 2, which enters both alike
    alike = 0.5 * hat(q)
    bend = (rod.stiffness / rod.length[:, None])[:, None, :]
    by_phi = jnp.concatenate(
        [alike - opposite - a * bend, alike + opposite + transpose(a) * bend], 1
    )
    phi_spin = jnp.concatenate([-transpose(a), a], 2)
    force_skew = hat(force)
    constraint_spin = hat(gamma) @ spin
    spin_transposed = transpose(spin)
    return ElementTangent(
        frame=kinematics.frame,
        force_spin=-(kinematics.frame @ force_skew) @ spin,
        moment_edge=spin_transposed @ (force_skew @ transpose(kinematics.frame)),
        # ds N^T hat(f) hat(gamma) N, with hat(f) hat(gamma) = gamma f^T - f.gamma I
        moment_spin=by_phi @ phi_spin
        + spin_transposed @ ((ds * (outer(gamma, force) - dot(gamma, force))) @ spin),
        moment_force=ds * transpose(constraint_spin),
        constraint_spin=constraint_spin,
    )
