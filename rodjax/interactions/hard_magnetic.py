"""Hard-magnetic rods in a magnetic field."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.inputs.schedules import AbstractSchedule, check_schedule
from rodjax.inputs.user_functions import check_function
from rodjax.inputs.validation import (
    as_float,
    as_float_or_none,
    as_traced,
    check_arrays_of_numbers,
    check_finite,
    check_numbers,
    check_shape,
    given,
    shown,
)
from rodjax.interactions.load import AbstractLoad
from rodjax.interactions.roles import Role
from rodjax.numerics import rotations


class HardMagnetic(AbstractLoad):
    """Magnetic moments that are fixed to the sections, in a given field: m x B and grad(m . B).

    The field of the rod's own moments is left out. A field that changes in time does work that is
    booked as `load_work`; that of a steady one is a potential, -m . B, booked as `gravity`.

    Attributes:
        moment: m per length in the body frame: three components, or a row an element (n, 3), along
            a_3 for a rod magnetised along itself [A m, so that m B is in N].
        field: B, uniform, three inertial components [T]; or None, with a function.
        function: B at a place, called as `function(parameters, position)` with one position (3,)
            [m] and returning (3,) [T]; written with jax.numpy.
        parameters: of the function, any pytree of numbers and arrays, which can be differentiated.
        amplitude: schedule of a number that multiplies B; None for a field that is steady.

    Example:
        >>> magnet = rx.HardMagnetic(moment=(0.0, 0.0, 2.0), field=(0.0, 0.01, 0.0))
    """

    moment: Float[Array, "*n 3"] = eqx.field(converter=as_float)
    field: Float[Array, "3"] | None = eqx.field(converter=as_float_or_none, default=None)
    function: Callable | None = eqx.field(static=True, default=None)
    parameters: object = eqx.field(converter=as_traced, default=None)
    amplitude: AbstractSchedule | None = None

    def __check_init__(self):
        check_numbers(moment=self.moment)
        shape = jnp.shape(self.moment)
        if shape[-1:] != (3,) or len(shape) > 2:
            raise ValueError(
                "moment: give three components in the body frame, along the rod (0, 0, m), or a"
                f" row an element (n, 3); got {shown(self.moment)}"
            )
        check_finite(moment=self.moment)
        if (self.field is None) == (self.function is None):
            raise ValueError(
                "field: give the field, three components where it is uniform, or a function of"
                " the position: one of both"
            )
        check_shape((3,), **given(field=self.field))
        check_finite(**given(field=self.field))
        check_function(**given(function=self.function))
        check_arrays_of_numbers(parameters=self.parameters)
        mend = "give a schedule of one number, as Smooth([0, 1], [0.0, 1.0])"
        check_schedule((), mend, **given(amplitude=self.amplitude))

    def check(self, rod):
        if self.moment.ndim == 2 and self.moment.shape[0] != rod.elements:
            raise ValueError(
                f"moment: expected {(rod.elements, 3)}, a row an element; got {self.moment.shape}"
            )

    @property
    def role(self):
        return Role.STORED if self.amplitude is None else Role.DRIVEN

    @property
    def schedules(self):
        return {} if self.amplitude is None else {"amplitude": self.amplitude}

    @property
    def may_hold(self):
        return True

    def _moments(self, rod, motion) -> Float[Array, "nodes 3"]:
        """Of the nodes, inertial components, times the amplitude."""
        density = jnp.broadcast_to(self.moment, (rod.elements, 3)).astype(motion.position.dtype)
        amounts = rotations.rotate(motion.quaternion, rod.to_nodes(density))
        if self.amplitude is None:
            return amounts
        return self.amplitude(motion.time).astype(amounts.dtype) * amounts

    def _field(self, position) -> Float[Array, "nodes 3"]:
        if self.function is None:
            assert self.field is not None  # one of both
            return jnp.broadcast_to(self.field, position.shape).astype(position.dtype)
        function = self.function
        return jax.vmap(lambda x: function(self.parameters, x))(position)

    def energy(self, rod, motion):
        return -jnp.sum(self._moments(rod, motion) * self._field(motion.position))

    def wrench(self, rod, motion):
        moments = self._moments(rod, motion)
        if self.function is None:
            field, force = self._field(motion.position), jnp.zeros_like(moments)
        else:
            field, pull = jax.vjp(self._field, motion.position)
            force = pull(moments)[0]
        torque = rotations.rotate_inverse(motion.quaternion, jnp.cross(moments, field))
        return jnp.concatenate([force, torque], 1)
