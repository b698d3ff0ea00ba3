"""Rigid bodies that stand by themselves beside rods, for joints to connect."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rodjax.constraints.ends import AbstractEnd, Free, check_end
from rodjax.inputs.validation import (
    as_float,
    as_float_or_none,
    check_finite,
    check_instance,
    check_shape,
    known,
)
from rodjax.numerics import rotations
from rodjax.rods.chain import with_bodies
from rodjax.rods.lump import Lump
from rodjax.rods.rod import Rod


class Body(eqx.Module):
    """A rigid body: a frame that moves by itself, where no joint or end holds it.

    Its weight is that of `Gravity`; loads along rods, obstacles and contact do not act on it.

    Attributes:
        mass: [kg].
        inertia: moments of inertia about its centre of mass, three about the axes of its frame, or
            symmetric (3, 3) in them [kg m^2].
        position: of its centre of mass as it is placed, inertial axes [m].
        quaternion: of its frame as it is placed, real part first, body to inertial.
        volume: that it displaces [m^3], for the buoyancy of `Gravity`; None for no buoyancy.
        end: what holds and moves it, about its centre of mass, as an end of a rod is held.

    Example:
        >>> fish = rx.Body(1.5, inertia=(0.02, 0.02, 0.01), position=(1.1, 0, 0))
        >>> eye = rx.Ball(rx.Point(-1), rx.Point(body=0, offset=(-0.1, 0, 0)))
        >>> towed = rx.Scene(rod, rx.Pinned(), bodies=(fish,), joints=(eye,))
    """

    mass: Float[Array, ""] = eqx.field(converter=as_float)
    inertia: Float[Array, "3"] | Float[Array, "3 3"] = eqx.field(converter=as_float)
    position: Float[Array, "3"] = eqx.field(converter=as_float)
    quaternion: Float[Array, "4"] = eqx.field(converter=as_float, default=(1.0, 0.0, 0.0, 0.0))
    volume: Float[Array, ""] | None = eqx.field(converter=as_float_or_none, default=None)
    end: AbstractEnd = Free()

    def __check_init__(self):
        if self.inertia is None:
            raise ValueError(
                "inertia: give the moments of inertia of the body; a point mass is for nodes of"
                " rods, Lump(node, mass)"
            )
        self.lump()  # which checks these numbers
        check_shape((3,), position=self.position)
        check_shape((4,), quaternion=self.quaternion)
        check_finite(position=self.position, quaternion=self.quaternion)
        if known(self.quaternion) and not abs(np.linalg.norm(self.quaternion) - 1) < 1e-3:
            raise ValueError("quaternion: must have unit length")
        check_end(end=self.end)

    def lump(self) -> Lump:
        """What it is, on a node."""
        return Lump(0, self.mass, self.inertia, volume=self.volume)


def with_all(rod: Rod, bodies: tuple[Body, ...]) -> Rod:
    """The rod, or rods, with these bodies behind; of none the rod itself.

    Raises:
        ValueError: they are no bodies, or the rod cannot stand beside any.
    """
    if isinstance(bodies, tuple) and not bodies:
        return rod
    if not isinstance(bodies, tuple):
        raise ValueError("bodies: give a tuple, for one body (body,)")
    mend = "give a body such as Body(1.0, (0.1, 0.1, 0.1), position=(0, 0, 0))"
    check_instance(Body, mend, **{f"bodies[{i}]": body for i, body in enumerate(bodies)})
    one = "give one rod, of straight_rod or curved_rod, or several as rods=(one, another)"
    check_instance(Rod, one, rod=rod)
    if rod.bodies:
        raise ValueError("bodies: the rod is one of a scene that has bodies; give all in one place")
    if rod.mass is None:
        raise ValueError(
            "bodies: beside rods with mass=None nothing has inertia; give their section a mass"
        )
    position = jnp.stack([body.position for body in bodies])
    quaternion = jnp.stack([body.quaternion for body in bodies])
    lumps = tuple(body.lump() for body in bodies)
    return with_bodies(rod, position, rotations.normalize(quaternion), lumps)
