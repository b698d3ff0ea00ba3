"""Materials: the moment of an element from its strain, and the energy that it stores.

A rod without one is linear, q = B (kappa - kappa0), and traces nothing of this.
"""

import abc
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


class ElementMotion(NamedTuple):
    """What a material sees of all elements at once: a row each, components in the body frame.

    Attributes:
        arc_length: (n,), s of the element centres at rest [m].
        stiffness: (n, 3), A1, A2, C of the rod's section [N m^2].
        coupling: (n, 3), entries (1, 2), (1, 3), (2, 3) of the section's stiffness, or None.
        curvature: (n, 3), kappa: about a_1, about a_2, and twist [1/m].
        natural: (n, 3), kappa0 at this time, actuation included [1/m].
        rate: (n, 3), of kappa in time, unchanged by rigid motion [1/(m s)].
        time: [s].
        memory: what the material remembers of the last accepted step; None where it forgets, or
            for a look at it without a past.

    Example:
        >>> class Soft(rx.AbstractMaterial):
        ...     def moment(self, at):  # `at` is an ElementMotion
        ...         return at.stiffness * jnp.tanh(at.bent)
    """

    arc_length: Float[Array, " n"]
    stiffness: Float[Array, "n 3"]
    coupling: Float[Array, "n 3"] | None
    curvature: Float[Array, "n 3"]
    natural: Float[Array, "n 3"]
    rate: Float[Array, "n 3"]
    time: Float[Array, ""]
    memory: Any = None

    @property
    def bent(self) -> Float[Array, "n 3"]:
        """kappa - kappa0 [1/m]."""
        return self.curvature - self.natural

    def linear(self, change: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
        """B times a change of curvature, with the section's stiffness [N m]."""
        return linear_moment(self.stiffness, self.coupling, change)


def linear_moment(
    stiffness: Float[Array, "n 3"],
    coupling: Float[Array, "n 3"] | None,
    change: Float[Array, "n 3"],
) -> Float[Array, "n 3"]:
    """B times a change of curvature [N m]."""
    moment = stiffness * change
    if coupling is None:
        return moment
    b12, b13, b23 = coupling.T
    one, two, three = change.T
    mixed = b12 * two + b13 * three, b12 * one + b23 * three, b13 * one + b23 * two
    return moment + jnp.stack(mixed, 1)


def stiffness_matrix(
    stiffness: Float[Array, "n 3"], coupling: Float[Array, "n 3"] | None
) -> Float[Array, "n 3 3"]:
    """B of every element [N m^2]."""
    columns = jnp.eye(3, dtype=stiffness.dtype)
    act = lambda column: linear_moment(
        stiffness, coupling, jnp.broadcast_to(column, stiffness.shape)
    )
    return jax.vmap(act, out_axes=2)(columns)


class AbstractMaterial(eqx.Module):
    """How an element resists. Your own is a subclass: `moment`, and `energy` for the ledger.

    Both are given all elements at once and must treat each by its own row (`ElementMotion`);
    written with jax.numpy. The derivative is taken by jax unless `slopes` gives it.

    Example:
        >>> class Cubic(rx.AbstractMaterial):
        ...     def moment(self, at):
        ...         return at.stiffness * at.bent * (1 + at.bent**2)
        ...     def energy(self, at):
        ...         return at.stiffness * at.bent**2 * (0.5 + 0.25 * at.bent**2)
        >>> hard = rx.straight_rod(1.0, 10, rx.Section((1.0, 1.0, 0.8), mass=1.0, material=Cubic()))
    """

    @abc.abstractmethod
    def moment(self, at: ElementMotion) -> Float[Array, "n 3"]:
        """Internal moment about a_1, about a_2, and torque [N m]."""

    def energy(self, at: ElementMotion) -> Float[Array, " n"] | Float[Array, "n 3"]:
        """Energy stored per length [J/m]: one number an element, or shares of bending and torsion.

        Its slope by the curvature is the moment, but for what motion adds, which is lost.
        """
        raise ValueError(f"{type(self).__name__}: the ledger needs energy(at) of the material")

    @property
    def viscous(self) -> bool:
        """Whether the moment hangs on the strain rates. One that says no is given zero rates."""
        return True

    @property
    def stretch_time(self) -> Float[Array, "*n"] | None:
        """Retardation of stretch and shear where the rod is compliant, f = (g + T g')/compliance
        with the strain g; None for none [s].
        """
        return None

    def slopes(self, at: ElementMotion) -> tuple[Float[Array, "n 3 3"], Float[Array, "n 3 3"]]:
        """Derivatives of the moment by curvature [N m^2] and by its rate [N m^2 s]."""
        by_curvature = row_jacobian(lambda x: self.moment(at._replace(curvature=x)), at.curvature)
        if not self.viscous:
            return by_curvature, jnp.zeros_like(by_curvature)
        by_rate = row_jacobian(lambda x: self.moment(at._replace(rate=x)), at.rate)
        return by_curvature, by_rate

    @property
    def forgetting(self) -> "AbstractMaterial":
        """It without what it remembers."""
        return self

    @property
    def remembers(self) -> bool:
        """Whether what it exerts hangs on the motion before, see `ElementMotion.memory`."""
        return False

    def first_memory(self, at: ElementMotion) -> Any:
        """What it remembers at a start, a pytree of arrays with a row an element."""
        return None

    def next_memory(self, at: ElementMotion) -> Any:
        """What it remembers after an accepted step to this motion, of the same kind.

        `at.memory` is that before the step. The moment there must be the same with either.
        Derivatives pass through it.
        """
        return None

    def lost(self, before: ElementMotion, after: ElementMotion) -> Float[Array, " n"]:
        """Energy lost per length between two saved states [J/m].

        Here the work of what is no slope of the energy; each state with its own memory.
        """
        both = excess(self, before) + excess(self, after)
        return 0.5 * jnp.sum(both * (after.curvature - before.curvature), 1)

    def driven(self, before: ElementMotion, after: ElementMotion) -> Float[Array, " n"]:
        """Work per length that what changes kappa0 does between two states, or time does [J/m].

        Here what the energy gains by them at the curvatures before and after, the mean of both.
        """

        def gain(at: ElementMotion):
            ends = (at._replace(natural=end.natural, time=end.time) for end in (before, after))
            first, last = (self.energy(end) for end in ends)
            return (last - first).reshape(len(first), -1).sum(1)

        return 0.5 * (gain(before) + gain(after))

    def check(
        self,
        stiffness: Float[Array, "n 3"],
        coupling: Float[Array, "n 3"] | None,
        compliance: Float[Array, "n 3"] | None,
        mass: Float[Array, " n"] | None,
    ) -> None:
        """Raise ValueError where a rod of such a section cannot be made of it."""


def excess(material: AbstractMaterial, at: ElementMotion) -> Float[Array, "n 3"]:
    """The moment less the slope of the energy [N m]."""
    energy = lambda x: jnp.sum(material.energy(at._replace(curvature=x)))
    return material.moment(at) - jax.grad(energy)(at.curvature)


class Recalled(AbstractMaterial):
    """A material that knows what it remembers, held while Newton's method iterates."""

    material: AbstractMaterial
    memory: Any

    @classmethod
    def of(cls, material: AbstractMaterial, memory: Any) -> "Recalled":
        """The material with this memory, whatever it knew before."""
        return cls(material.forgetting, memory)

    @property
    def forgetting(self):
        return self.material

    def _with(self, at):
        return at._replace(memory=self.memory)

    def moment(self, at):
        return self.material.moment(self._with(at))

    def energy(self, at):
        return self.material.energy(self._with(at))

    @property
    def viscous(self):
        return self.material.viscous

    @property
    def stretch_time(self):
        return self.material.stretch_time

    def slopes(self, at):
        return self.material.slopes(self._with(at))

    @property
    def remembers(self):
        return True

    def first_memory(self, at):
        return self.material.first_memory(at)

    def next_memory(self, at):
        return self.material.next_memory(self._with(at))


def row_jacobian(function, x: Float[Array, "n k"]) -> Float[Array, "n m k"]:
    """Derivative of a function whose rows depend on the same rows of x only."""
    push = lambda direction: jax.jvp(function, (x,), (jnp.broadcast_to(direction, x.shape),))[1]
    return jax.vmap(push, out_axes=2)(jnp.eye(x.shape[1], dtype=x.dtype))


def mixes_rows(material: AbstractMaterial, at: ElementMotion) -> Bool[Array, ""]:
    """Whether `slopes` is not the derivative of `moment`, as where a row hangs on another's."""
    wave = jnp.cos(1.0 + jnp.arange(at.curvature.size, dtype=at.curvature.dtype))
    direction = wave.reshape(at.curvature.shape)
    ahead = lambda x, y: material.moment(at._replace(curvature=x, rate=y))
    still = jnp.zeros_like(direction)
    rate = direction if material.viscous else still
    found = jax.jvp(ahead, (at.curvature, at.rate), (direction, rate))[1]
    by_curvature, by_rate = material.slopes(at)
    expected = jnp.einsum("nij,nj->ni", by_curvature, direction)
    expected = expected + jnp.einsum("nij,nj->ni", by_rate, rate)
    rounding = jnp.sqrt(jnp.finfo(direction.dtype).eps)
    return jnp.max(jnp.abs(found - expected)) > rounding * jnp.max(
        jnp.abs(found) + jnp.abs(expected)
    )
