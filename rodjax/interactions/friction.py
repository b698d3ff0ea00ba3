"""Friction between the surfaces of a rod and of what it touches.

Coulomb's law with the normal force of the same instant. What stays where it is needs an elastic
stick: forces that follow from a speed alone let it creep.
"""

import abc
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from rodjax.inputs.validation import (
    as_float,
    as_float_or_none,
    check_not_negative,
    check_positive,
    check_scalar,
    given,
)


class Dual(NamedTuple):
    """What stands for the direction of slip in a derivative, see `AbstractFriction.dual`.

    Attributes:
        estimate: of the traction, in the unit of the slip or per length.
        slip, limit: where it was made.
    """

    estimate: Float[Array, "nodes 3"]
    slip: Float[Array, "nodes 3"]
    limit: Float[Array, "nodes 1"]


class Rubbing(NamedTuple):
    """What friction sees of the surfaces at the nodes.

    Attributes:
        load: normal force per length, not negative [N/m].
        stiffness: of the obstacle, normal force per length and depth [N/m^2].
        velocity: of the rod's surface relative to the other, tangential [m/s].
        stretch: of the stick since the surfaces met, as if it did not slip [m].
        dual: the estimate of the traction; None for its exact derivative.
    """

    load: Float[Array, " nodes"]
    stiffness: Float[Array, ""]
    velocity: Float[Array, "nodes 3"]
    stretch: Float[Array, "nodes 3"]
    dual: Float[Array, "nodes 3"] | None = None


class AbstractFriction(eqx.Module):
    """A law of friction.

    Attributes:
        coefficient: mu, the limit of the traction over the normal force.

    Example:
        >>> isinstance(rx.SlidingFriction(0.3, 1e-4), rx.AbstractFriction)
        True
    """

    coefficient: eqx.AbstractVar[Float[Array, ""]]

    @property
    @abc.abstractmethod
    def remembers(self) -> bool:
        """Whether it stretches a stick, which it remembers."""

    @abc.abstractmethod
    def traction(self, rubbing: Rubbing) -> Float[Array, "nodes 3"]:
        """Force on the rod's surface per length [N/m]."""

    @abc.abstractmethod
    def stretch(self, rubbing: Rubbing) -> Float[Array, "nodes 3"]:
        """What is left of the stretch where it slips [m]."""

    @abc.abstractmethod
    def stored(self, rubbing: Rubbing) -> Float[Array, " nodes"]:
        """Energy per length of the stretched sticks [J/m]."""

    @abc.abstractmethod
    def dual(self, rubbing: Rubbing) -> Dual:
        """What stands for the direction of slip in the derivative of the traction, at first.

        By the exact derivative a surface that slips in an iterate of Newton's method resists no
        further slip, so what must stick is thrown from one side to the other for ever. In its
        place the derivative of |s| t = m s is taken, with s the slip, m its limit and t, the dual,
        an estimate of the traction, of its own: it follows its own linear prediction, within the
        limit. Both agree at the solution (Chan, Golub & Mulet 1999).
        """

    @abc.abstractmethod
    def next_dual(self, before: Dual, rubbing: Rubbing) -> Dual:
        """The dual after an iteration, from the one before."""

    @abc.abstractmethod
    def slipped(self, rubbing: Rubbing, before: Float[Array, "nodes 3"]) -> Float[Array, " nodes"]:
        """Energy per length lost by slipping since the sticks were stretched like that [J/m]."""


def _lengths(rows: Float[Array, "nodes 3"]) -> Float[Array, "nodes 1"]:
    """Of vectors, with a zero derivative where they vanish."""
    squared = jnp.sum(rows**2, 1, keepdims=True)
    nowhere = squared == 0
    return jnp.where(nowhere, 0.0, jnp.sqrt(jnp.where(nowhere, 1.0, squared)))


def _limited(
    most: Float[Array, "nodes 1"],
    slip: Float[Array, "nodes 3"],
    length: Float[Array, "nodes 1"],
    dual: Float[Array, "nodes 3"] | None,
) -> Float[Array, "nodes 3"]:
    """most slip/length, where a dual is given with the derivative that it stands for."""
    if dual is None:
        return most * slip / length
    now = lax.stop_gradient(length)
    return (most * slip - dual * (length - now)) / now


def _foretold(
    before: Dual,
    slip: Float[Array, "nodes 3"],
    limit: Float[Array, "nodes 1"],
    length: Float[Array, "nodes 1"],
) -> Float[Array, "nodes 3"]:
    """What `_limited` becomes by its derivative; `length` is that of the slip before."""
    along = jnp.sum(before.slip * (slip - before.slip), 1, keepdims=True) / length
    changed = before.limit * slip + (limit - before.limit) * before.slip
    return (changed - before.estimate * along) / length


def _within(most: Float[Array, "nodes 1"], dual: Float[Array, "nodes 3"]):
    """The dual, shortened to the limit."""
    length = _lengths(dual)
    beyond = length > most
    return jnp.where(beyond, most / jnp.where(beyond, length, 1.0), 1.0) * dual


def continued(before: Dual, here: Dual) -> Dual:
    """The first dual of a step: the traction that the last ended with, within the limit of here.

    What sticks and what slides is mostly what did, and not what a motion without forces would tell.
    """
    return here._replace(estimate=_within(here.limit, before.estimate))


class Friction(AbstractFriction):
    """Coulomb friction with an elastic stick: what is to hold does hold, without creep.

    Each node has an anchor on the other surface. The force per length on it is -k s, s the
    tangential displacement from the anchor of the surface (spin included, so that a rod may roll),
    up to mu times the normal force; beyond, the anchor is dragged along. Marine practice, and
    linear elasticity with perfect plasticity. A rod put down has its anchors where it lies.

    Attributes:
        coefficient: mu, a number without unit.
        stick_stiffness: k, force per length and displacement [N/m^2]; None: as much as the
            obstacle has against depth. A rod at the limit has moved by mu N/k.

    Example:
        >>> floor = rx.Obstacle(rx.Plane(), stiffness=1e5, friction=rx.Friction(0.4))
    """

    coefficient: Float[Array, ""] = eqx.field(converter=as_float)
    stick_stiffness: Float[Array, ""] | None = eqx.field(converter=as_float_or_none, default=None)

    def __check_init__(self):
        optional = given(stick_stiffness=self.stick_stiffness)
        check_scalar(coefficient=self.coefficient, **optional)
        check_not_negative(coefficient=self.coefficient)
        check_positive(**optional)

    @property
    def remembers(self):
        return True

    def _stiffness(self, rubbing: Rubbing):
        return rubbing.stiffness if self.stick_stiffness is None else self.stick_stiffness

    def traction(self, rubbing):
        return -self._stiffness(rubbing) * self.stretch(rubbing)

    def _most(self, rubbing: Rubbing):
        """The largest stretch that does not slip."""
        return (self.coefficient * rubbing.load / self._stiffness(rubbing))[:, None]

    def stretch(self, rubbing):
        most, length = self._most(rubbing), _lengths(rubbing.stretch)
        slips = length > most
        limited = _limited(most, rubbing.stretch, jnp.where(slips, length, 1.0), rubbing.dual)
        return jnp.where(slips, limited, rubbing.stretch)

    def dual(self, rubbing):
        return Dual(self.stretch(rubbing), rubbing.stretch, self._most(rubbing))

    def next_dual(self, before, rubbing):
        most, length = self._most(rubbing), _lengths(before.slip)
        slips = length > before.limit
        foretold = _foretold(before, rubbing.stretch, most, jnp.where(slips, length, 1.0))
        estimate = _within(most, jnp.where(slips, foretold, rubbing.stretch))
        return Dual(estimate, rubbing.stretch, most)

    def stored(self, rubbing):
        return 0.5 * self._stiffness(rubbing) * jnp.sum(self.stretch(rubbing) ** 2, 1)

    def slipped(self, rubbing, before):
        after = self.stretch(rubbing)
        mean = 0.5 * self._stiffness(rubbing) * (before + after)
        return jnp.sum(mean * (rubbing.stretch - after), 1)


class SlidingFriction(AbstractFriction):
    """Coulomb friction smoothed by speed: -mu N v/sqrt(|v|^2 + slip^2).

    Without memory, and smooth, so that gradients have no jumps; but what should hold creeps, by up
    to `slip_speed` or so, and at rest (`equilibrium`) there is none.

    Attributes:
        coefficient: mu, a number without unit.
        slip_speed: below it surfaces creep [m/s].

    Example:
        >>> rough = rx.SlidingFriction(0.3, slip_speed=1e-4)
        >>> contact = rx.Contact.solid(rod, force=10.0, friction=rough)
    """

    coefficient: Float[Array, ""] = eqx.field(converter=as_float)
    slip_speed: Float[Array, ""] = eqx.field(converter=as_float)

    def __check_init__(self):
        check_scalar(coefficient=self.coefficient, slip_speed=self.slip_speed)
        check_not_negative(coefficient=self.coefficient)
        check_positive(slip_speed=self.slip_speed)

    @property
    def remembers(self):
        return False

    def traction(self, rubbing):
        most, speed = self._most(rubbing), self._speed(rubbing.velocity)
        return -_limited(most, rubbing.velocity, speed, rubbing.dual)

    def _most(self, rubbing: Rubbing):
        return (self.coefficient * rubbing.load)[:, None]

    def _speed(self, velocity: Float[Array, "nodes 3"]):
        return jnp.sqrt(jnp.sum(velocity**2, 1, keepdims=True) + self.slip_speed**2)

    def dual(self, rubbing):
        return Dual(-self.traction(rubbing), rubbing.velocity, self._most(rubbing))

    def next_dual(self, before, rubbing):
        most = self._most(rubbing)
        foretold = _foretold(before, rubbing.velocity, most, self._speed(before.slip))
        return Dual(_within(most, foretold), rubbing.velocity, most)

    def stretch(self, rubbing):
        return jnp.zeros_like(rubbing.stretch)

    def stored(self, rubbing):
        return jnp.zeros_like(rubbing.load)

    def slipped(self, rubbing, before):
        return jnp.zeros_like(rubbing.load)
