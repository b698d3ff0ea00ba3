"""Distributed and point loads."""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from rodjax.inputs.schedules import AbstractSchedule, check_schedule
from rodjax.inputs.user_functions import check_function
from rodjax.inputs.validation import (
    as_float,
    as_float_or_none,
    as_node,
    as_traced,
    check_arrays_of_numbers,
    check_finite,
    check_flag,
    check_node,
    check_not_negative,
    check_numbers,
    check_scalar,
    check_shape,
    given,
    known,
    shown,
)
from rodjax.interactions.load import AbstractLoad
from rodjax.interactions.roles import Role
from rodjax.numerics import rotations
from rodjax.rods.lumped import lumped
from rodjax.rods.rod import Rod


def _check_coefficients(**values):
    """One finite number >= 0 each."""
    check_scalar(**values)
    check_not_negative(**values)


def _check_vector(**values):
    """Three finite components each."""
    check_shape((3,), **values)
    check_finite(**values)


def _need(rod: Rod, name: str, load: str) -> Float[Array, " n"]:
    """A property that the rod may lack."""
    value = getattr(rod, name)
    if value is None:
        raise ValueError(f"{name}: {load} needs the rod's {name}; give it to the rod's section")
    return value


class Gravity(AbstractLoad):
    """Weight less buoyancy, (m - rho_f A_c) g per length; of a lump (m - rho_f V) g.

    Attributes:
        acceleration: g, three inertial components [m/s^2]; downwards along z (0, 0, -9.81).
        fluid_density: rho_f of the fluid around [kg/m^3]; None for no buoyancy. Needs the rod's
            `area`, and of lumps takes the `volume`.

    Example:
        >>> in_water = rx.Gravity((0, 0, -9.81), fluid_density=1025.0)
    """

    acceleration: Float[Array, "3"] = eqx.field(converter=as_float)
    fluid_density: Float[Array, ""] | None = eqx.field(converter=as_float_or_none, default=None)

    def __check_init__(self):
        check_numbers(acceleration=self.acceleration)
        if jnp.shape(self.acceleration) == ():
            raise ValueError(
                "acceleration: must be three real numbers, the components of g along the inertial"
                f" axes as in (0, 0, -9.81); got {shown(self.acceleration)}"
            )
        _check_vector(acceleration=self.acceleration)
        _check_coefficients(**given(fluid_density=self.fluid_density))

    def check(self, rod):
        _need(rod, "mass", "Gravity")
        if self.fluid_density is not None:
            _need(rod, "area", "Gravity with buoyancy")

    @property
    def role(self):
        return Role.STORED

    def energy(self, rod, motion):
        energy = -jnp.sum(self.weight(rod) * motion.position)
        if rod.lumps:
            energy = energy - jnp.sum(self._of_lumps(rod) * lumped(rod).centre(motion))
        return energy

    def weight(self, rod: Rod) -> Float[Array, "nodes 3"]:
        """Weight of the nodes in the fluid, without lumps [N]."""
        density = _need(rod, "mass", "Gravity")
        if self.fluid_density is not None:
            area = _need(rod, "area", "Gravity with buoyancy")
            density = density - self.fluid_density * area
        return rod.to_nodes(density)[:, None] * self.acceleration[None]

    def wrench(self, rod, motion):
        weight = self.weight(rod)
        wrench = jnp.concatenate([weight, jnp.zeros_like(weight)], 1)
        if rod.lumps:
            lumps = lumped(rod)
            own = lumps.about_node(motion, self._of_lumps(rod))
            wrench = wrench + lumps.at_nodes(own, wrench)
        return wrench

    def _of_lumps(self, rod: Rod) -> Float[Array, "k 3"]:
        """Weight of the lumps in the fluid [N]."""
        lumps = lumped(rod)
        mass = lumps.mass
        if self.fluid_density is not None and lumps.volume is not None:
            mass = mass - self.fluid_density * lumps.volume
        return mass[:, None] * self.acceleration[None]


class MorisonDrag(AbstractLoad):
    """Eq. (14): -rho_f D/2 (C_n |v_n| v_n + pi C_t |v_t| v_t) per length.

    v_n, v_t are the parts across and along the tangent of the velocity relative to `current`
    (inertial, uniform). (The printed second term lacks a v: it must read pi C_t (v.t)|v.t| t.)
    `added_mass_coefficient` C_a adds the mass rho_f A_c C_a per length across the tangent, which
    moves with the rod (current taken as steady). Source: Morison et al. 1950.

    Attributes:
        fluid_density: rho_f [kg/m^3].
        normal_coefficient, tangential_coefficient: C_n and C_t, numbers without unit.
        current: velocity of the fluid, three inertial components [m/s]; None for still fluid.
        added_mass_coefficient: C_a, a number without unit (1 for a circular cylinder); None for
            no added mass. Needs the rod's `area`.

    Example:
        >>> stream = rx.MorisonDrag(1025.0, 1.2, 0.01, current=(0.5, 0, 0))
    """

    fluid_density: Float[Array, ""] = eqx.field(converter=as_float)
    normal_coefficient: Float[Array, ""] = eqx.field(converter=as_float)
    tangential_coefficient: Float[Array, ""] = eqx.field(converter=as_float)
    current: Float[Array, "3"] | None = eqx.field(converter=as_float_or_none, default=None)
    added_mass_coefficient: Float[Array, ""] | None = eqx.field(
        converter=as_float_or_none, default=None
    )

    def __check_init__(self):
        _check_coefficients(
            fluid_density=self.fluid_density,
            normal_coefficient=self.normal_coefficient,
            tangential_coefficient=self.tangential_coefficient,
            **given(added_mass_coefficient=self.added_mass_coefficient),
        )
        _check_vector(**given(current=self.current))

    def check(self, rod):
        _need(rod, "diameter", "MorisonDrag")
        if self.added_mass_coefficient is not None:
            _need(rod, "area", "MorisonDrag with added mass")

    @property
    def role(self):
        return Role.DRAG

    def wrench(self, rod, motion):
        diameter = _need(rod, "diameter", "MorisonDrag")
        velocity = motion.velocity
        if self.current is not None:
            velocity = velocity - self.current[None]
        tangent = rotations.tangent_director(motion.quaternion)
        along = jnp.sum(velocity * tangent, 1, keepdims=True)
        across = velocity - along * tangent
        squared = jnp.sum(across * across, 1, keepdims=True)
        resting = squared == 0
        speed = jnp.where(resting, 0.0, jnp.sqrt(jnp.where(resting, 1.0, squared)))
        scale = 0.5 * self.fluid_density * rod.to_nodes(diameter)[:, None]
        force = -scale * (
            self.normal_coefficient * speed * across
            + jnp.pi * self.tangential_coefficient * jnp.abs(along) * along * tangent
        )
        return jnp.concatenate([force, jnp.zeros_like(force)], 1)

    @property
    def inertia(self):
        return self.added_mass_coefficient is not None

    def added_mass(self, rod, motion):
        if self.added_mass_coefficient is None:
            return None
        tangent = rotations.tangent_director(motion.quaternion)
        area = _need(rod, "area", "MorisonDrag with added mass")
        amount = self.fluid_density * self.added_mass_coefficient * rod.to_nodes(area)
        across = jnp.eye(3, dtype=tangent.dtype)[None] - (tangent[:, :, None] * tangent[:, None, :])
        return amount[:, None, None] * across


class LinearDrag(AbstractLoad):
    """-c_n v_n - c_t v_t per length, and the moment -c_r omega_3 about the tangent per length.

    With `rod.mass = None` this is what the elastic forces balance (Klapper 1996); it then needs
    all three coefficients positive.

    Attributes:
        normal, tangential: c_n and c_t, force per length and velocity [N s/m^2].
        rotational: c_r, moment per length and spin about the tangent [N s].

    Example:
        >>> viscous = rx.LinearDrag(normal=0.2, tangential=0.1, rotational=1e-6)
    """

    normal: Float[Array, ""] = eqx.field(converter=as_float)
    tangential: Float[Array, ""] = eqx.field(converter=as_float)
    rotational: Float[Array, ""] = eqx.field(converter=as_float, default=0.0)

    def __check_init__(self):
        _check_coefficients(
            normal=self.normal, tangential=self.tangential, rotational=self.rotational
        )

    @property
    def role(self):
        return Role.DAMPING

    @property
    def resistance(self):
        return self.normal, self.tangential, self.rotational

    def wrench(self, rod, motion):
        tangent = rotations.tangent_director(motion.quaternion)
        along = jnp.sum(motion.velocity * tangent, 1, keepdims=True)
        length = rod.node_length[:, None]
        force = -length * (
            self.normal * motion.velocity + (self.tangential - self.normal) * along * tangent
        )
        axial = -length * self.rotational * motion.angular_velocity[:, 2:]
        zero = jnp.zeros_like(axial)
        return jnp.concatenate([force, zero, zero, axial], 1)


class DistributedLoad(AbstractLoad):
    """A user's force and moment per length.

    Attributes:
        function: called as `function(parameters, s, motion)` with the arc lengths s (n+1,) of the
            nodes [m] and their `NodeMotion`; returns (n+1, 6): force per length in inertial axes
            [N/m], moment per length in body axes [N], each row from its own node only. Written
            with jax.numpy.
        parameters: any pytree of numbers and arrays, which can be differentiated and change
            without a new compilation (the function cannot: pass the same).

    Example:
        >>> def wind(p, s, time):  # force per length, inertial axes
        ...     return p * jnp.stack([0 * s, s, 0 * s], -1)
        >>> blown = rx.DistributedLoad(wind, 0.1)
    """

    function: Callable = eqx.field(static=True)
    parameters: object = eqx.field(converter=as_traced, default=None)

    def __check_init__(self):
        check_function(function=self.function)
        check_arrays_of_numbers(parameters=self.parameters)

    @property
    def may_hold(self):
        return True

    def wrench(self, rod, motion):
        per_length = self.function(self.parameters, rod.arc_length, motion)
        return rod.node_length[:, None] * per_length


class PointLoad(AbstractLoad):
    """Force and moment on one node, dead or following the cross-section.

    Attributes:
        node: its number, 0 at the end s = 0, negative from the end s = L (-1 is the last). One
            that the rod lacks is refused by the scene, and gives NaN where it is traced.
        force: schedule of three components [N], along inertial axes, of a follower body axes.
        moment: schedule of three components [N m], about the same axes as the force.
        follower: whether force and moment turn with the cross-section of the node.

    Example:
        >>> thrust = rx.PointLoad(-1, force=rx.Constant((0.0, 0.0, -5.0)), follower=True)
    """

    node: Int[Array, ""] = eqx.field(converter=as_node)
    force: AbstractSchedule | None = None
    moment: AbstractSchedule | None = None
    follower: bool = eqx.field(static=True, default=False)

    def __check_init__(self):
        check_node(self.node)
        check_flag(follower=self.follower)
        mend = "give a schedule of three components, for one that stays Constant((0, 0, 1))"
        check_schedule((3,), mend, **given(force=self.force, moment=self.moment))

    @property
    def schedules(self):
        both = {"force": self.force, "moment": self.moment}
        return {name: schedule for name, schedule in both.items() if schedule is not None}

    def check(self, rod):
        if known(self.node) and not -rod.elements - 1 <= int(self.node) <= rod.elements:
            raise ValueError(
                f"node: a rod of {rod.elements} elements has the nodes 0 to {rod.elements}, or"
                f" {-rod.elements - 1} to -1, got {int(self.node)}"
            )

    def wrench(self, rod, motion):
        nodes = rod.elements + 1
        node = jnp.where(self.node < 0, self.node + nodes, self.node)
        frame = motion.quaternion[node]
        zero = jnp.zeros((3,), frame.dtype)
        force = zero if self.force is None else self.force(motion.time)
        moment = zero if self.moment is None else self.moment(motion.time)
        if self.follower:
            force = rotations.rotate(frame, force)
        else:
            moment = rotations.rotate_inverse(frame, moment)
        both = jnp.concatenate([force, moment])
        here = jnp.arange(nodes, dtype=node.dtype)[:, None] == node
        elsewhere = jnp.where((node >= 0) & (node < nodes), 0.0, jnp.nan)
        return jnp.where(here, both, elsewhere.astype(both.dtype))
