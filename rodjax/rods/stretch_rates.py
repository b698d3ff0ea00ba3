"""Derivatives in time of the stretch of the elements, which constraints prescribe."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.numerics import rotations
from rodjax.rods.constitution import natural_curvature
from rodjax.rods.strains import element_rotation


def derivatives(
    rod, quaternion, kinematics, rate, acceleration, order
) -> list[Float[Array, "n 3"]]:
    """First derivatives in time, up to `order` <= 3, of gamma in a motion of these accelerations.

    By the product rule from gamma' = E^T dv/ds - omega_e x gamma and E' = E [omega_e x], with
    omega_e = (omega_i + omega_{i+1})/2 + u x (omega_{i+1} - omega_i), u = p/(2 (1 + w)),
    (w, p) = r = q_i^-1 q_{i+1} and r' = (r omega_{i+1} - omega_i r)/2. Of a cable that shortens by
    twist, those of gamma + b kappa_3.
    """
    cross = rotations.cross
    across = lambda v: jnp.einsum(
        "nji,nj->ni", kinematics.frame, (v[1:, :3] - v[:-1, :3]) / rod.gauge_length[:, None]
    )
    pure = lambda v: jnp.concatenate([jnp.zeros_like(v[:, :1]), v], 1)
    mean = lambda v: 0.5 * (v[:-1, 3:] + v[1:, 3:])
    jump = lambda v: v[1:, 3:] - v[:-1, 3:]
    before = lambda v, r: rotations.multiply(pure(v[:-1, 3:]), r)
    after = lambda r, v: rotations.multiply(r, pure(v[1:, 3:]))

    relative = element_rotation(rod, quaternion)
    over = 2 * (1 + relative[:, :1])
    u = relative[:, 1:] / over
    spin = mean(rate) + cross(u, jump(rate))
    still = lambda values: rod.at_breaks(values, 0.0)
    stretch, edge = kinematics.stretch, across(rate)
    stretch1 = edge - cross(spin, stretch)
    coupled = rod.torque_per_tension is not None
    if order == 1 and not coupled:
        return [still(stretch1)]

    relative1 = 0.5 * (after(relative, rate) - before(rate, relative))
    if order == 1:
        return _with_twist(rod, [still(stretch1)], relative, relative1)
    over1 = 2 * relative1[:, :1]
    u1 = (relative1[:, 1:] - u * over1) / over
    spin1 = mean(acceleration) + cross(u1, jump(rate)) + cross(u, jump(acceleration))
    pull = across(acceleration)
    edge1 = pull - cross(spin, edge)
    stretch2 = edge1 - cross(spin1, stretch) - cross(spin, stretch1)
    if order == 2 and not coupled:
        return [still(stretch1), still(stretch2)]

    relative2 = after(relative1, rate) + after(relative, acceleration)
    relative2 = 0.5 * (relative2 - before(acceleration, relative) - before(rate, relative1))
    if order == 2:
        return _with_twist(rod, [still(stretch1), still(stretch2)], relative, relative1, relative2)
    u2 = (relative2[:, 1:] - 2 * u1 * over1 - 2 * u * relative2[:, :1]) / over
    spin2 = cross(u2, jump(rate)) + 2 * cross(u1, jump(acceleration))
    edge2 = -cross(spin, pull) - cross(spin1, edge) - cross(spin, edge1)
    stretch3 = edge2 - cross(spin2, stretch) - 2 * cross(spin1, stretch1) - cross(spin, stretch2)
    found = [still(stretch1), still(stretch2), still(stretch3)]
    if not coupled:
        return found
    # of constant accelerations but for what the relative rotation makes of them
    relative3 = after(relative2, rate) + 2 * after(relative1, acceleration)
    relative3 = relative3 - before(rate, relative2) - 2 * before(acceleration, relative1)
    return _with_twist(rod, found, relative, relative1, relative2, 0.5 * relative3)


def _with_twist(rod, found, relative, *rates) -> list[Float[Array, "n 3"]]:
    """Derivatives of gamma with those of b kappa_3 added, of relative rotations and their rates."""
    twist = lambda r: rotations.logarithm(r)[:, 2] * (rod.torque_per_tension / rod.gauge_length)
    along = lambda values: jnp.stack([jnp.zeros_like(values)] * 2 + [values], 1)
    function, arguments, result = twist, (relative,), []
    for before, rate in zip(found, rates, strict=True):
        function = _rate_of(function, len(arguments))
        arguments = (*arguments, rate)
        result.append(before + along(function(*arguments)))
    return result


def _rate_of(function, count):
    """Derivative in time of a function of a quantity and its first derivatives."""

    def derivative(*arguments):
        return jax.jvp(function, arguments[:count], arguments[1:])[1]

    return derivative


def driven(rod, time, order) -> list[Float[Array, "n 3"]]:
    """First derivatives in time of what actuation adds to the strain of a cable, -b kappa0_3."""
    natural = lambda t: -rod.torque_per_tension * natural_curvature(rod, t)[:, 2]
    along = lambda values: jnp.stack([jnp.zeros_like(values)] * 2 + [values], 1)
    function, found = natural, []
    for _ in range(order):
        function = lambda t, f=function: jax.jvp(f, (t,), (jnp.ones_like(t),))[1]
        found.append(along(function(time)))
    return found
