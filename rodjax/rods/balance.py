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

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.numerics import rotations
from rodjax.rods import constitution
from rodjax.rods.constitution import (
    along_tangent,
    middle_spin,
    natural_curvature,
    node_spins,
    rotation_rate,
    shortening,
)
from rodjax.rods.material import row_jacobian
from rodjax.rods.rod import Rod
from rodjax.rods.state import Moving, NodeMotion
from rodjax.rods.strains import Strains, strains


class Internal(NamedTuple):
    """Internal wrenches to be balanced at the nodes, and the constraint of the elements."""

    force: Float[Array, "nodes 3"]  # inertial components [N]
    moment: Float[Array, "nodes 3"]  # body components [N m]
    constraint: Float[Array, "n 3"]  # gamma - e3 - compliance f, see `constraint`


class ElementTangent(NamedTuple):
    """Derivatives of `Internal` element by element; columns (node i, node i+1) by body spins."""

    frame: Float[Array, "n 3 3"]  # E: force by f, and (transposed, over ds) constraint by edge
    force_spin: Float[Array, "n 3 6"]
    moment_edge: Float[Array, "n 6 3"]
    moment_spin: Float[Array, "n 6 6"]
    moment_force: Float[Array, "n 6 3"]
    constraint_spin: Float[Array, "n 3 6"]
    constraint_edge: Float[Array, "n 3 3"] | None = None  # by u_{i+1} - u_i; None: E^T / ds


def gap(stretch: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    """gamma - e3."""
    return stretch - jnp.asarray([[0.0, 0.0, 1.0]], stretch.dtype)


def force_strain(rod: Rod, kinematics: Strains, motion: NodeMotion) -> Float[Array, "n 3"]:
    """The strain g that f belongs to: gamma - e3, with b tau in a cable that shortens by twist."""
    found = gap(kinematics.stretch)
    turned = shortening(rod, kinematics.rotation, motion.time)
    return found if turned is None else found + turned


def constraint(
    rod: Rod, kinematics: Strains, force: Float[Array, "n 3"], motion: NodeMotion
) -> Float[Array, "n 3"]:
    """g + T g' - compliance f, g the strain of `force_strain`: zero for an admissible motion."""
    strain = damped_strain(rod, kinematics, motion)
    return strain if rod.compliance is None else strain - rod.compliance * force


def damped_strain(rod: Rod, kinematics: Strains, motion: NodeMotion) -> Float[Array, "n 3"]:
    """g + T g', which is compliance f."""
    strain, time = force_strain(rod, kinematics, motion), stretch_time(rod)
    if time is None:
        return strain
    return strain + time * force_strain_rate(rod, kinematics, motion)


def stretch_time(rod: Rod) -> Float[Array, "n 3"] | None:
    """T of the elements where they are compliant [s]; None without damping of stretch."""
    if rod.material is None or rod.compliance is None or rod.material.stretch_time is None:
        return None
    time = jnp.broadcast_to(rod.material.stretch_time, rod.length.shape)
    return rod.at_breaks(jnp.where(rod.compliance > 0, time[:, None], 0.0), 0.0)


def force_strain_rate(rod: Rod, kinematics: Strains, motion: NodeMotion) -> Float[Array, "n 3"]:
    """g', zero in rigid motion [1/s]."""
    edge = (motion.velocity[1:] - motion.velocity[:-1]) / rod.gauge_length[:, None]
    spin = motion.angular_velocity
    across = jnp.einsum("nji,nj->ni", kinematics.frame, edge)
    return _strain_rate(
        rod, kinematics.rotation, kinematics.stretch, across, spin[:-1], spin[1:], motion.time
    )


def _strain_rate(rod, rotation, stretch, across, first, second, time):
    """g' of the edge's rate in the element frame and the spins of both nodes."""
    found = across - rotations.cross(middle_spin(rotation, first, second), stretch)
    if rod.torque_per_tension is None:
        return found
    twisting = rotation_rate(rotation, first, second)[:, 2] / rod.gauge_length
    if rod.actuation is not None:
        twisting = twisting - _rate_of(lambda t: natural_curvature(rod, t)[:, 2], time)
    return found + along_tangent(rod.torque_per_tension * twisting)


def _rate_of(function, time):
    """Derivative of a function of time."""
    return jax.jvp(function, (time,), (jnp.ones_like(time),))[1]


def internal(rod: Rod, motion: NodeMotion, force: Float[Array, "n 3"]) -> Internal:
    """Internal nodal wrenches and the constraint of a motion with internal force f."""
    kinematics = strains(rod, motion.position, motion.quaternion)
    phi = kinematics.rotation
    q = constitution.internal_moment(rod, phi, motion)
    squared = jnp.sum(phi * phi, -1, keepdims=True)
    once = rotations.cross(phi, q)
    even = q + rotations.inverse_tangent_coefficient(squared) * rotations.cross(phi, once)
    constraining = constraint_wrench(rod, kinematics, force)
    return Internal(
        force=constraining[:, :3],
        moment=constraining[:, 3:] + scatter(-even - 0.5 * once, even - 0.5 * once),
        constraint=constraint(rod, kinematics, force, motion),
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
    if rod.torque_per_tension is not None:
        q = along_tangent(rod.torque_per_tension * force[:, 2])
        once = rotations.cross(phi, q)
        even = q + rotations.inverse_tangent_coefficient(squared) * rotations.cross(phi, once)
        first, second = half + turned - even - 0.5 * once, half - turned + even - 0.5 * once
        return jnp.concatenate([scatter(-spatial, spatial), scatter(first, second)], 1)
    return jnp.concatenate([scatter(-spatial, spatial), scatter(half + turned, half - turned)], 1)


def scatter(first: Float[Array, "n *k"], second: Float[Array, "n *k"]) -> Float[Array, "nodes *k"]:
    """Sum of element contributions to their first and second nodes."""
    zero = jnp.zeros_like(first[:1])
    return jnp.concatenate([first, zero]) + jnp.concatenate([zero, second])


def _kinematic_maps(rod: Rod, kinematics: Strains):
    """A and [N^T, N] of every element; the latter zero where there is none."""
    phi = kinematics.rotation
    squared = jnp.sum(phi * phi, -1)[:, None, None]
    skew = rotations.hat(phi)
    eye = jnp.eye(3, dtype=phi.dtype)[None]
    outer = phi[:, :, None] * phi[:, None, :] - squared * eye  # hat(phi)^2
    a = eye + 0.5 * skew + rotations.inverse_tangent_coefficient(squared) * outer
    turn = rotations.midframe_coefficient(squared) * skew
    spin = jnp.concatenate([0.5 * eye - turn, 0.5 * eye + turn], 2)
    return a, rod.at_breaks(spin, 0.0)


def constraint_tangent(rod: Rod, kinematics: Strains) -> ElementTangent:
    """The tangent at zero internal force and moment: the constraint and its transpose alone.

    With a mass matrix on the nodes it makes the system for accelerations and for projections.
    """
    a, spin = _kinematic_maps(rod, kinematics)
    constraint_spin = _constraint_spin(rod, kinematics, a, spin)
    zero = jnp.zeros((rod.elements, 6, 3), spin.dtype)
    return ElementTangent(
        frame=kinematics.frame,
        force_spin=jnp.zeros_like(spin),
        moment_edge=zero,
        moment_spin=jnp.zeros((rod.elements, 6, 6), spin.dtype),
        moment_force=rod.length[:, None, None] * jnp.swapaxes(constraint_spin, 1, 2),
        constraint_spin=constraint_spin,
    )


def _product(a: Float[Array, "n i 3"], b: Float[Array, "n 3 j"]) -> Float[Array, "n i j"]:
    """a @ b, by sums that fuse with what is around them."""
    first, second, third = (a[:, :, k, None] * b[:, k, None, :] for k in range(3))
    return first + second + third


def _constraint_spin(rod: Rod, kinematics: Strains, a, spin) -> Float[Array, "n 3 6"]:
    """Derivative of g by the spins of both nodes."""
    found = rotations.hat(kinematics.stretch) @ spin
    if rod.torque_per_tension is None:
        return found
    twist = jnp.concatenate([-jnp.swapaxes(a, 1, 2), a], 2)[:, 2]
    return found.at[:, 2].add((rod.torque_per_tension / rod.gauge_length)[:, None] * twist)


def _damped_constraint(
    rod: Rod, kinematics: Strains, motion: NodeMotion, moving: Moving, spin, phi
):
    """Derivatives of T g' by the edge (n, 3, 3) and by the spins (n, 3, 6) in a step."""
    time = stretch_time(rod)
    assert time is not None
    edge = (motion.velocity[1:] - motion.velocity[:-1]) / rod.gauge_length[:, None]
    across = lambda v: jnp.einsum("nji,nj->ni", kinematics.frame, v)
    act = lambda matrix, v: jnp.einsum("nij,nj->ni", matrix, v)

    def rate(z):
        moved, turned = across(z[:, :3]) / rod.gauge_length[:, None], act(spin, z[:, 3:])
        rate = across(edge)
        rate = rate + moving.by_velocity * moved + rotations.cross(rate, turned)
        stretch = kinematics.stretch
        stretch = stretch + moved + rotations.cross(stretch, turned)
        rotation = kinematics.rotation + act(phi, z[:, 3:])
        spins = node_spins(motion, moving, z[:, 3:])
        return time * _strain_rate(rod, rotation, stretch, rate, *spins, motion.time)

    found = row_jacobian(rate, jnp.zeros((rod.elements, 9), edge.dtype))
    return found[:, :, :3], found[:, :, 3:]


def element_tangent(
    rod: Rod,
    motion: NodeMotion,
    force: Float[Array, "n 3"],
    moving: Moving | None = None,
) -> ElementTangent:
    """Exact derivative of `internal`, element by element.

    Args:
        moving: how rates follow increments; None at rest.
    """
    kinematics = strains(rod, motion.position, motion.quaternion)
    phi, gamma = kinematics.rotation, kinematics.stretch
    ds = rod.length[:, None, None]
    q = constitution.internal_moment(rod, phi, motion)
    if rod.torque_per_tension is not None:
        q = q + along_tangent(rod.torque_per_tension * force[:, 2])
    w = rod.length[:, None] * rotations.cross(force, gamma)
    squared = jnp.sum(phi * phi, -1)[:, None, None]
    eye = jnp.eye(3, dtype=phi.dtype)[None]
    outer = lambda x, y: x[:, :, None] * y[:, None, :]
    dot = lambda x, y: jnp.sum(x * y, -1)[:, None, None] * eye
    hat = rotations.hat
    transpose = lambda m: jnp.swapaxes(m, 1, 2)

    a, spin = _kinematic_maps(rod, kinematics)
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
    by_rate = None
    if constitution.diagonal(rod):
        bend = (rod.stiffness / rod.gauge_length[:, None])[:, None, :]
        pushed = a * bend, transpose(a) * bend
    else:
        by_curvature, by_rate = constitution.moment_slopes(rod, phi, motion)
        bend = by_curvature / rod.gauge_length[:, None, None]
        pushed = _product(a, bend), _product(transpose(a), bend)
    by_phi = jnp.concatenate([alike - opposite - pushed[0], alike + opposite + pushed[1]], 1)
    phi_spin = jnp.concatenate([-transpose(a), a], 2)
    force_skew = hat(force)
    constraint_spin = _constraint_spin(rod, kinematics, a, spin)
    constraint_edge = None
    moment_force = ds * transpose(constraint_spin)
    spin_transposed = transpose(spin)
    moment_spin = by_phi @ phi_spin
    if moving is not None and by_rate is not None:

        def rate(z):
            turned = phi + jnp.einsum("nij,nj->ni", phi_spin, z)
            return rotation_rate(turned, *node_spins(motion, moving, z)) / rod.gauge_length[:, None]

        rate_spin = row_jacobian(rate, jnp.zeros((rod.elements, 6), phi.dtype))
        moment_spin = moment_spin + transpose(phi_spin) @ (by_rate @ rate_spin)
    if moving is not None and stretch_time(rod) is not None:
        slopes = _damped_constraint(rod, kinematics, motion, moving, spin, phi_spin)
        constraint_edge = transpose(kinematics.frame) / rod.gauge_length[:, None, None] + slopes[0]
        constraint_spin = constraint_spin + slopes[1]
    return ElementTangent(
        frame=kinematics.frame,
        force_spin=-(kinematics.frame @ force_skew) @ spin,
        moment_edge=spin_transposed @ (force_skew @ transpose(kinematics.frame)),
        # ds N^T hat(f) hat(gamma) N, with hat(f) hat(gamma) = gamma f^T - f.gamma I
        moment_spin=moment_spin
        + spin_transposed @ ((ds * (outer(gamma, force) - dot(gamma, force))) @ spin),
        moment_force=moment_force,
        constraint_spin=constraint_spin,
        constraint_edge=constraint_edge,
    )
