"""Loads: what acts on every node by that node's own motion, or by that of its neighbours too.

So the tangent of a load is one 6x6 block a node, or three. A scene holds a tuple of loads; they are
summed.
"""

import abc
import functools
import operator

from jaxtyping import Array, Float

from rodjax.interactions.interaction import AbstractInteraction
from rodjax.rods.rod import Rod
from rodjax.rods.state import NodeMotion


class AbstractLoad(AbstractInteraction):
    """A load on the nodes. Your own is a subclass: `wrench`, and what else it has of the rest.

    What a rod runs into (a wall, a bed that gets stiff) says by `safe_fraction` how near one
    iteration of Newton's method may come to it, and has the role CONTACT.

    Example:
        >>> class Tide(rx.AbstractLoad):
        ...     strength: jax.Array
        ...     def wrench(self, rod, motion):
        ...         push = self.strength * jnp.sin(motion.time) * jnp.ones_like(motion.position)
        ...         return jnp.concatenate([push, jnp.zeros_like(push)], 1)
        >>> washed = rx.Scene(rod, rx.Clamped(), loads=(Tide(0.1),))
    """

    @abc.abstractmethod
    def wrench(self, rod: Rod, motion: NodeMotion) -> Float[Array, "nodes 6"]:
        """Force (inertial) [N] and moment (body) [N m] on each node.

        From its own motion only, unless it is `between_nodes`.
        """

    def energy(self, rod: Rod, motion: NodeMotion) -> Float[Array, ""]:
        """Potential energy of a load whose role is STORED or CONTACT [J].

        Its slope is minus the wrench on a rod at rest: for displacements (inertial) of the force,
        for body spins of the moment.
        """
        raise ValueError(
            f"{type(self).__name__}: a load whose role is {self.role.name} needs"
            " energy(rod, motion)"
        )

    def exerted(self, rod, motion, found):
        """`wrench`; a load finds nothing."""
        return self.wrench(rod, motion)

    def stored(self, rod, motion, found):
        """`energy`."""
        return self.energy(rod, motion)

    @property
    def between_nodes(self) -> bool:
        """Whether a node's wrench hangs on the motion of the nodes beside it in its rod too.

        By default it does not, which costs less. Its added mass hangs on its own motion always.
        """
        return False

    @property
    def may_hold(self) -> bool:
        """Whether it might hold a rod that ends leave free, for all that a look at it tells."""
        return False

    @property
    def resistance(self) -> tuple[Array, Array, Array] | None:
        """Force per length and velocity, normal and tangential [N s/m^2], and moment per length and
        spin about the tangent [N s]: what a rod without inertia rests on. None for a load that
        gives it none.
        """
        return None

    @property
    def inertia(self) -> bool:
        """Whether the load adds mass to the nodes."""
        return False

    def added_mass(self, rod: Rod, motion: NodeMotion) -> Float[Array, "nodes 3 3"] | None:
        """Mass matrix of the nodes that the load adds (inertial axes), or None."""
        return None


def total_wrench(
    loads: tuple[AbstractLoad, ...], rod: Rod, motion: NodeMotion
) -> Float[Array, "nodes 6"]:
    """Sum of the loads on the nodes; there must be at least one."""
    return functools.reduce(operator.add, (load.wrench(rod, motion) for load in loads))
