"""What acts on the nodes of a rod besides the rod itself: a load, or contact of its strands."""

import abc
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from rodjax.inputs.schedules import AbstractSchedule
from rodjax.interactions.roles import Role
from rodjax.rods.rod import Rod
from rodjax.rods.state import NodeMotion, at_rest

Positions = Float[Array, "nodes 3"]
Wrenches = Float[Array, "nodes 6"]


class AbstractInteraction(eqx.Module):
    """One of what acts on a rod; a scene has a list of them.

    It says how its work is booked and how much of a motion it can bear. What it finds near the rod
    is looked for once a step and held while Newton's method iterates.
    """

    @abc.abstractmethod
    def exerted(self, rod: Rod, motion: NodeMotion, found: Any) -> Wrenches:
        """Force (inertial) [N] and moment (body) [N m] on each node."""

    @property
    def role(self) -> Role:
        """How its work is booked: as put in, unless it says that it is stored or lost."""
        return Role.DRIVEN

    @property
    def conservative(self) -> bool | Bool[Array, ""]:
        """Whether what it exerts on a rod at rest has a potential, where its role is to store."""
        return True

    def stored(self, rod: Rod, motion: NodeMotion, found: Any) -> Float[Array, ""]:
        """Potential energy [J], zero where there is no potential."""
        raise ValueError(f"{type(self).__name__}: it stores no energy")

    def lost(self, rod: Rod, motion: NodeMotion, found: Any, exerted: Wrenches) -> Wrenches:
        """The part of what it exerts that is no slope of `stored`: here what motion adds."""
        # zero to the last digit where motion makes no difference
        return exerted - self.exerted(rod, at_rest(*motion[:3]), found)

    @property
    def remembers(self) -> bool:
        """Whether what it exerts hangs on the motion before, see `recalling`."""
        return False

    def first_memory(self, rod: Rod, motion: NodeMotion) -> Any:
        """What it remembers at a start, any pytree of arrays."""
        return None

    def next_memory(self, rod: Rod, motion: NodeMotion) -> Any:
        """What it remembers after an accepted step to this motion, of the same kind.

        Asked of what recalls the memory before the step. What it exerts on this motion must be the
        same with either. Derivatives pass through it.
        """
        return None

    def recalling(self, memory: Any) -> "AbstractInteraction":
        """It with what it remembers, in its field `memory`, held while Newton's method iterates.

        That field is None else, as for a look at what it would exert without a past.
        """
        if memory is None:
            return self
        where = lambda one: one.memory
        return eqx.tree_at(where, self, memory, is_leaf=lambda leaf: leaf is None)

    @property
    def rubs(self) -> bool:
        """Whether Newton's method needs a dual of it, see `AbstractFriction.dual`."""
        return False

    def first_dual(
        self, rod: Rod, motion: NodeMotion, found: Any, before: NodeMotion | None
    ) -> Any:
        """The dual that iterations begin with at this motion, for the field `dual`.

        `before` is the motion that a step begins from, of which more is known; None at rest.
        """
        return None

    def next_dual(self, rod: Rod, motion: NodeMotion, found: Any) -> Any:
        """The dual after an iteration, asked of what has the one before."""
        return None

    def lost_before(self) -> Float[Array, ""] | None:
        """What has been lost by what it remembers [J], besides `lost`; None for nothing."""
        return None

    def driving(
        self, exerted: Wrenches, time: Float[Array, ""]
    ) -> tuple[Float[Array, " k"], Float[Array, " k"]] | None:
        """Forces by which something is moved that exerts this, and its coordinates at the time.

        Their work is put in, as that of ends that move is. None where nothing is moved.
        """
        return None

    def held_at(self, time: Float[Array, ""]) -> "AbstractInteraction":
        """It as it is at a time, for `safe_fraction` and `verdict`."""
        return self

    def displaced(self, time: Float[Array, ""]) -> Float[Array, "3"] | None:
        """How far it has itself been moved by then, as a whole [m]; None: it rests."""
        return None

    def find(
        self,
        rod: Rod,
        position: Positions,
        displacement: Positions | None = None,
        closed: bool | Bool[Array, ""] = False,
    ) -> Any:
        """What is near the nodes, before a motion of the expected displacement if one is given.

        `closed` says whether the rod's ends are at one place, see `Scene.closed`.
        """
        return None

    def safe_fraction(
        self, rod: Rod, position: Positions, change: Positions, found: Any
    ) -> Float[Array, ""] | None:
        """How much of a change of the nodes' positions may be taken at once, in (0, 1].

        None for any change. No derivative is asked of it.
        """
        return None

    def verdict(
        self, rod: Rod, before: Positions, after: Positions, found: Any
    ) -> Int[Array, ""] | None:
        """The `Result` that a step between these positions has for it; None for success.

        Of what moves itself they are relative to where it is at the step's end, see `as_seen`.
        """
        return None

    def path_verdict(self, rod: Rod, before: Positions, after: Positions) -> Int[Array, ""] | None:
        """As `verdict`, of a step along a path of equilibria, which may be a long one."""
        return None

    def check(self, rod: Rod) -> None:
        """Raise ValueError where the rod lacks what it needs."""

    @property
    def schedules(self) -> dict[str, AbstractSchedule]:
        """What it prescribes over time, by argument."""
        return {}


def as_seen(
    now: AbstractInteraction,
    time: Float[Array, ""],
    position: Positions,
    since: Float[Array, ""],
    then: AbstractInteraction | None = None,
) -> Positions:
    """Where the nodes were at an earlier time for what stands where it does at `time`.

    So what moves itself sees them come by as much as it goes, and cannot sweep over them unseen.

    Args:
        now: as it is at `time`.
        then: as it was `since`; by default the same.
    """
    moved = now.displaced(time)
    before = (now if then is None else then).displaced(since)
    if moved is None and before is None:
        return position
    zero = jnp.zeros_like(position[0])
    there, here = (zero if shift is None else shift.astype(zero.dtype) for shift in (moved, before))
    return position + (there - here)[None]
