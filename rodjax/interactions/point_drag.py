"""Drag of a body at one place: of a lump on a node, or of a body by itself."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.inputs.validation import (
    as_float,
    as_float_or_none,
    check_finite,
    check_integer,
    check_not_negative,
    check_scalar,
    check_shape,
    given,
)
from rodjax.interactions.load import AbstractLoad
from rodjax.interactions.roles import Role
from rodjax.numerics import rotations


class PointDrag(AbstractLoad):
    """-(linear + quadratic |v|) v at a point, and -rotational omega about it.

    v is the velocity of the point relative to `current`. A sphere of the diameter D in a fluid of
    the density rho has `quadratic` = C_d rho pi D^2 / 8, with C_d about 0.5, and at low speeds in
    the viscosity mu `linear` = 3 pi mu D and `rotational` = pi mu D^3 (Stokes).

    Attributes:
        node: its number, from 0 at s = 0 of its rod; negative from s = L (-1 is the last).
        linear: force by velocity [N s/m].
        quadratic: force by velocity squared [N s^2/m^2].
        rotational: moment by angular velocity [N m s].
        current: velocity of the fluid, three inertial components [m/s]; None for still fluid.
        offset: of the point from the node, or from the body's centre of mass, in the body frame
            there [m]; None for none.
        rod: which of the rods of the scene, from 0.
        body: which of the scene's bodies, from 0; None for a rod. Node and rod then say nothing.

    Example:
        >>> float_drag = rx.PointDrag(-1, quadratic=4.0)  # 4 |v| v on the last node
    """

    node: int = eqx.field(static=True, default=0)
    linear: Float[Array, ""] = eqx.field(converter=as_float, default=0.0)
    quadratic: Float[Array, ""] = eqx.field(converter=as_float, default=0.0)
    rotational: Float[Array, ""] = eqx.field(converter=as_float, default=0.0)
    current: Float[Array, "3"] | None = eqx.field(converter=as_float_or_none, default=None)
    offset: Float[Array, "3"] | None = eqx.field(converter=as_float_or_none, default=None)
    rod: int = eqx.field(static=True, default=0)
    body: int | None = eqx.field(static=True, default=None)

    def __check_init__(self):
        check_integer(-1_000_000, 1_000_000, node=self.node)
        check_integer(0, 10_000, rod=self.rod, **given(body=self.body))
        if self.body is not None and (self.node, self.rod) != (0, 0):
            raise ValueError("body: the drag is of a body or at a node of a rod; give one of them")
        numbers = {name: getattr(self, name) for name in ("linear", "quadratic", "rotational")}
        check_scalar(**numbers)
        check_not_negative(**numbers)
        vectors = given(current=self.current, offset=self.offset)
        check_shape((3,), **vectors)
        check_finite(**vectors)

    @property
    def role(self):
        return Role.DRAG

    def check(self, rod):
        if self.body is not None:
            if self.body >= len(rod.bodies):
                raise ValueError(
                    f"body: the scene has {len(rod.bodies)} bodies, got the number {self.body}"
                )
            return
        if self.rod >= len(rod.strands):
            raise ValueError(
                f"rod: the scene's rods are 0 to {len(rod.strands) - 1}, got {self.rod}"
            )
        part = rod.strands[self.rod]
        last = part.last - part.first
        if not -last - 1 <= self.node <= last:
            raise ValueError(
                f"node: a rod of {last} elements has the nodes 0 to {last}, or {-last - 1} to -1,"
                f" got {self.node}"
            )

    def _place(self, rod) -> int:
        """The node among those of the scene."""
        if self.body is not None:
            return rod.bodies[self.body]
        part = rod.strands[self.rod]
        return self.node + (part.last + 1 if self.node < 0 else part.first)

    def wrench(self, rod, motion):
        node = self._place(rod)
        velocity, spin = motion.velocity[node], motion.angular_velocity[node]
        frame = motion.quaternion[node]
        if self.offset is not None:
            velocity = velocity + rotations.rotate(frame, rotations.cross(spin, self.offset))
        if self.current is not None:
            velocity = velocity - self.current
        squared = velocity @ velocity
        resting = squared == 0
        speed = jnp.where(resting, 0.0, jnp.sqrt(jnp.where(resting, 1.0, squared)))
        force = -(self.linear + self.quadratic * speed) * velocity
        moment = -self.rotational * spin
        if self.offset is not None:
            arm = self.offset
            moment = moment + rotations.cross(arm, rotations.rotate_inverse(frame, force))
        rows = jnp.zeros((rod.elements + 1, 6), force.dtype)
        return rows.at[node].set(jnp.concatenate([force, moment]))
