"""Schemes: how the motion of the nodes follows from the unknowns of their balance.

The unknown is a change of every node, displacement and rotation vector (n+1, 6), that the scheme
adds to what it predicts. A step of generalised-alpha is one, rest on a path of loads another, a
step without inertia in a heat bath a third (`overdamped`).
"""

import abc
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.equations.generalized_alpha import Coefficients, advance, predicted_increment
from rodjax.numerics import rotations
from rodjax.rods.balance import Internal
from rodjax.rods.rod import Rod
from rodjax.rods.state import NodeMotion, State, node_motion

Change = Float[Array, "nodes 6"]
Reference = tuple[Float[Array, "nodes 3"], Float[Array, "nodes 4"]]
Balance = tuple[Float[Array, "nodes 6"], Float[Array, "n 3"]]


class HalfStep(NamedTuple):
    """How the rates of a step without inertia follow its half increment; nothing accelerates."""

    by_velocity: Float[Array, ""]  # 2/dt [1/s]
    by_acceleration: Float[Array, ""]  # 0


class AbstractScheme(eqx.Module):
    """What makes equations of an imbalance."""

    @abc.abstractmethod
    def origin(self) -> Reference:
        """Positions and frames of the nodes that increments count from."""

    @abc.abstractmethod
    def beginning(self) -> NodeMotion | None:
        """The motion that it begins from; None at rest."""

    @abc.abstractmethod
    def expected(self) -> Change:
        """The changes that Newton's iteration begins with."""

    @abc.abstractmethod
    def increment(self, change: Change) -> Change:
        """Displacement [m] and rotation vector [rad] of the nodes."""

    @abc.abstractmethod
    def rates(self, change: Change) -> tuple[Change, Change] | None:
        """Their rates and accelerations; None at rest."""

    @abc.abstractmethod
    def slopes(self) -> Coefficients | HalfStep | None:
        """What holds the derivatives of rates and accelerations by increments; None at rest."""

    @abc.abstractmethod
    def load_part(self) -> Float[Array, ""] | None:
        """What part of the loads acts; None for all of it."""

    @abc.abstractmethod
    def turn_limit(self) -> Float[Array, ""] | None:
        """How far a node may turn in one Newton iteration [rad]; None for any turn."""

    @abc.abstractmethod
    def lever(self, rod: Rod) -> int:
        """How many element lengths of displacement Newton's tolerance takes for a radian."""

    @abc.abstractmethod
    def exact_constraint(self) -> bool:
        """Whether the elements' constraint is to be kept beyond Newton's tolerance."""

    @abc.abstractmethod
    def completed(self, change: Change, wrench: Change, constraint: Float[Array, "n 3"]) -> Balance:
        """The imbalance and the constraint with what the scheme adds of its own."""

    @abc.abstractmethod
    def stiffened(
        self, change: Change, node: Float[Array, "nodes 6 6"]
    ) -> Float[Array, "nodes 6 6"]:
        """The nodes' tangents with the derivative of that, by displacements and body spins."""


class Step(AbstractScheme):
    """A step of generalised-alpha; changes are beta dt^2 a_{n+1}, see `advance`."""

    coefficients: Coefficients
    state: State

    def origin(self):
        return self.state.position, self.state.quaternion

    def beginning(self):
        return node_motion(self.state)

    def advanced(self, change: Change) -> tuple[Change, Change, Change]:
        """Rates, accelerations and algorithmic accelerations at the step's end."""
        old = self.state.rate, self.state.acceleration, self.state.auxiliary
        return advance(self.coefficients, *old, change)

    def expected(self):
        c = self.coefficients
        return c.beta * c.dt**2 * self.state.auxiliary

    def increment(self, change):
        old = self.state.rate, self.state.auxiliary
        return predicted_increment(self.coefficients, *old) + change

    def rates(self, change):
        return self.advanced(change)[:2]

    def slopes(self):
        return self.coefficients

    def load_part(self):
        return None

    def turn_limit(self):
        return None

    def lever(self, rod):
        return 1

    def exact_constraint(self):
        return True

    def completed(self, change, wrench, constraint):
        return wrench, constraint

    def stiffened(self, change, node):
        return node


class FromReference(AbstractScheme):
    """A scheme without rates whose changes are increments from a reference.

    Attributes:
        reference: positions and frames of the nodes that increments count from.
    """

    reference: Reference

    def origin(self):
        return self.reference

    def beginning(self):
        return None

    def expected(self):
        zero = jnp.zeros_like(self.reference[0])
        return jnp.concatenate([zero, zero], 1)

    def increment(self, change):
        return change

    def rates(self, change):
        return None


def resisting(resistance: Float[Array, "nodes 6 6"], change: Change) -> Float[Array, "nodes 6 6"]:
    """Derivative of `resistance` times the changes, by displacements and body spins."""
    turned = rotations.tangent_inverse(change[:, 3:])
    by_spin = jnp.einsum("nij,njk->nik", resistance[:, :, 3:], turned)
    return resistance.at[:, :, 3:].set(by_spin)


class AtRest(FromReference):
    """Rest on a path of loads from a start, moved against a resistance if one is given.

    With the path's parameter p from 0 to 1 the balance is

        inner - p loads - (1 - p) inner_0 = 0,

    inner the internal forces less those of self-contact, inner_0 those of the start, which so
    solves it at p = 0 whatever it is.

    Attributes:
        reference: positions and frames of the nodes that increments count from.
        max_rotation: of a node in one Newton iteration [rad].
        load_factor: p.
        lacking: (1 - p) inner_0; see `rest_on_path`.
        resistance: of the nodes to displacements and rotations from the reference [N/m, N m].
    """

    max_rotation: Float[Array, ""]
    load_factor: Float[Array, ""]
    lacking: Internal
    resistance: Float[Array, "nodes 6"] | None = None

    def slopes(self):
        return None

    def load_part(self):
        return self.load_factor

    def turn_limit(self):
        return self.max_rotation

    def lever(self, rod):
        return rod.elements

    def exact_constraint(self):
        return True

    def completed(self, change, wrench, constraint):
        lacking = self.lacking
        wrench = wrench - jnp.concatenate([lacking.force, lacking.moment], 1)
        if self.resistance is not None:
            wrench = wrench + self.resistance * change
        return wrench, constraint - lacking.constraint

    def stiffened(self, change, node):
        if self.resistance is None:
            return node
        return node + resisting(jax.vmap(jnp.diag)(self.resistance), change)


def rest_on_path(
    reference: Reference,
    max_rotation: Float[Array, ""],
    factor: Float[Array, ""],
    lacking_at_start: Internal,
    resistance: Float[Array, "nodes 6"] | None = None,
) -> AtRest:
    """Rest at this parameter of a path whose start lacked so much, from a reference."""
    left = jax.tree.map(lambda rows: (1 - factor) * rows, lacking_at_start)
    return AtRest(reference, max_rotation, factor, left, resistance)
