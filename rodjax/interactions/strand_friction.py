"""Friction of strands on each other, at pairs of points of their centrelines.

Strands a and b, with r = x_b - x_a, touch at the point between that divides r as their diameters
are. There the surface of b moves against that of a by v = dr/dt - W x r, with W the mean of both
spins weighted so: strands that turn together do not rub, and one that rolls or spins on the other
does. Friction F on b, -F on a, by the part of v across r, turns both by -r x F in all, so that the
two keep their angular momentum.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.interactions.friction import AbstractFriction, Dual, Rubbing
from rodjax.numerics.rotations import hat

# Components lead: q pairs of segments, with points a and b.
Vectors = Float[Array, "3 q a b"]
Numbers = Float[Array, "q a b"]


class Passing(NamedTuple):
    """How pairs of points pass each other.

    Attributes:
        apart: r, from a to b [m].
        normal: its unit vector, zero where a pair does not act.
        velocity: dr/dt [m/s].
        spin: W [rad/s].
    """

    apart: Vectors
    normal: Vectors
    velocity: Vectors
    spin: Vectors

    @property
    def surfaces(self) -> Vectors:
        """Velocity of b's surface against a's [m/s]."""
        return self.velocity - jnp.cross(self.spin, self.apart, axis=0)

    @property
    def slip(self) -> Vectors:
        """Its part across r."""
        moved = self.surfaces
        return moved - _along(self.normal, moved) * self.normal


def _along(n: Vectors, v: Vectors) -> Float[Array, "1 q a b"]:
    return jnp.sum(n * v, 0, keepdims=True)


def _rows(v: Vectors) -> Float[Array, "m 3"]:
    return jnp.moveaxis(v, 0, -1).reshape(-1, 3)


def _rubbing(load: Float[Array, " m"], slip: Float[Array, "m 3"], dual: Dual | None) -> Rubbing:
    estimate = None if dual is None else dual.estimate
    # damping may hold back strands that part
    load = jnp.maximum(load, 0.0)
    return Rubbing(load, jnp.ones((), load.dtype), slip, jnp.zeros_like(slip), estimate)


def shares(mix: Float[Array, "a b 4"], first: Numbers, second: Numbers) -> Float[Array, "q a b 4"]:
    """What part of W the spin of each of the four vertices is, by the diameters at the points."""
    whole = first + second
    both = jnp.stack([first / whole, first / whole, second / whole, second / whole], -1)
    return jnp.abs(mix)[None] * both


def traction(friction: AbstractFriction, load: Numbers, passing: Passing) -> Vectors:
    """Force on b of pairs that press on each other with this load [N]."""
    found = friction.traction(_rubbing(load.reshape(-1), _rows(passing.slip), None))
    return jnp.moveaxis(found.reshape(*load.shape, 3), -1, 0)


class Slopes(NamedTuple):
    """Friction of pairs of points and its derivatives, of which the last axes are components.

    Attributes:
        force: on b [N].
        by_load: its derivative by the load.
        by_apart: by r, with velocities that follow by the factor `by_velocity`, at a given load.
        by_turn: by the rotations that W follows by the same factor.
    """

    force: Float[Array, "q a b 3"]
    by_load: Float[Array, "q a b 3"]
    by_apart: Float[Array, "q a b 3 3"]
    by_turn: Float[Array, "q a b 3 3"]


def slopes(
    friction: AbstractFriction,
    load: Numbers,
    passing: Passing,
    distance: Numbers,
    by_velocity: Float[Array, ""],
    dual: Dual | None,
) -> Slopes:
    """Friction with its derivatives, those that a dual stands for if it is given."""
    slip, size = _rows(passing.slip), load.reshape(-1)
    at = lambda load, slip: friction.traction(_rubbing(load, slip, dual))
    force, by_load = jax.jvp(lambda load: at(load, slip), (size,), (jnp.ones_like(size),))
    column = lambda unit: jax.jvp(
        lambda slip: at(size, slip), (slip,), (jnp.broadcast_to(unit, slip.shape),)
    )[1]
    by_slip = jax.vmap(column, out_axes=2)(jnp.eye(3, dtype=slip.dtype))

    n, r, spin = _rows(passing.normal), _rows(passing.apart), _rows(passing.spin)
    moved, over = _rows(passing.surfaces), 1.0 / distance.reshape(-1)
    eye = jnp.eye(3, dtype=n.dtype)[None]
    across = eye - n[:, :, None] * n[:, None, :]
    turned = by_velocity * eye - hat(spin)
    outward = jnp.sum(n * moved, 1)[:, None, None] * across + n[:, :, None] * slip[:, None, :]
    slip_by_apart = across @ turned - over[:, None, None] * outward
    by_turn = by_velocity * (by_slip @ hat(r))
    shaped = lambda v: v.reshape(*load.shape, *v.shape[1:])
    return Slopes(*map(shaped, (force, by_load, by_slip @ slip_by_apart, by_turn)))


def on_vertices(
    mix: Float[Array, "a b 4"], share: Float[Array, "q a b 4"], passing: Passing, force: Vectors
) -> Float[Array, "q 4 6"]:
    """Forces and moments (inertial axes) on the four vertices of every pair, by friction on b."""
    turning = -jnp.cross(passing.apart, force, axis=0)
    forces = jnp.einsum("abi,kqab->qik", mix, force)
    moments = jnp.einsum("qabi,kqab->qik", share, turning)
    return jnp.concatenate([forces, moments], 2)


def by_vertices(
    mix: Float[Array, "a b 4"],
    share: Float[Array, "q a b 4"],
    passing: Passing,
    found: Slopes,
    load_by: Float[Array, "q a b 4 3"],
) -> Float[Array, "q 4 4 6 6"]:
    """Minus the derivative of `on_vertices`, by displacements and rotations of the vertices.

    Args:
        load_by: derivative of the load by the displacements.
    """
    block, points = share.shape[0], mix.shape[0] * mix.shape[1]
    flat = lambda v: v.reshape(block, points, *v.shape[3:])
    arm = hat(_rows(passing.apart)).reshape(block, points, 3, 3)
    force, by_load = flat(found.force), flat(found.by_load)
    by_apart, by_turn = flat(found.by_apart), flat(found.by_turn)
    pressed = -hat(force.reshape(-1, 3)).reshape(block, points, 3, 3)
    mix = jnp.broadcast_to(mix.reshape(1, points, 4), (block, points, 4))
    share, load_by = flat(share), flat(load_by)

    def summed(left, right, matrix):
        weights = (left[:, :, :, None] * right[:, :, None, :]).reshape(block, points, 16)
        total = jnp.swapaxes(weights, 1, 2) @ matrix.reshape(block, points, 9)
        return total.reshape(block, 4, 4, 3, 3)

    def by_loads(left, vector):
        """Sum over the points of left_i vector (load by displacements of j)^T."""
        left = (left[:, :, :, None] * vector[:, :, None, :]).reshape(block, points, 12)
        total = jnp.swapaxes(left, 1, 2) @ load_by.reshape(block, points, 12)
        return jnp.swapaxes(total.reshape(block, 4, 3, 4, 3), 2, 3)

    turned = (arm @ by_load[..., None])[..., 0]
    rows = (
        (-summed(mix, mix, by_apart) - by_loads(mix, by_load), -summed(mix, share, by_turn)),
        (
            summed(share, mix, arm @ by_apart + pressed) + by_loads(share, turned),
            summed(share, share, arm @ by_turn),
        ),
    )
    return jnp.concatenate([jnp.concatenate(row, 4) for row in rows], 3)


def first_dual(friction: AbstractFriction, load: Numbers, passing: Passing) -> Dual:
    """The dual that iterations begin with, in rows for the pairs of points."""
    return friction.dual(_rubbing(load.reshape(-1), _rows(passing.slip), None))


def next_dual(friction: AbstractFriction, before: Dual, load: Numbers, passing: Passing) -> Dual:
    """The dual after an iteration, from the one before."""
    return friction.next_dual(before, _rubbing(load.reshape(-1), _rows(passing.slip), before))
