"""A scene: one rod, what holds its ends, what loads it, and whether it touches itself."""

import dataclasses

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from rodjax.constraints.ends import AbstractEnd, Free, check_end
from rodjax.inputs.brief import brief
from rodjax.inputs.validation import as_traced, check_instance
from rodjax.interactions.contact import Contact
from rodjax.interactions.loads import AbstractLoad
from rodjax.rods.rod import Rod
from rodjax.scenes import probing
from rodjax.scenes.potentials import check_potential


def _with_arrays(part):
    """The part with floating point numbers in it as arrays; whole ones may be indices or sizes."""
    is_number = lambda leaf: isinstance(leaf, float | np.floating | np.ndarray)
    return jax.tree.map(lambda leaf: as_traced(leaf) if is_number(leaf) else leaf, part)


class Scene(eqx.Module):
    """Everything that is given; what is None or empty is absent from the traced program.

    Attributes:
        rod: the rod, at rest and as it is placed at first.
        first_end, last_end: what holds it at s = 0 and at s = L.
        loads: what acts on it, a tuple of loads.
        contact: whether and how it touches itself; None for strands that pass through each other.
    """

    rod: Rod
    # Python's numbers in classes of the user's would be compiled in, each anew
    first_end: AbstractEnd = eqx.field(converter=_with_arrays, default=Free())
    last_end: AbstractEnd = eqx.field(converter=_with_arrays, default=Free())
    loads: tuple[AbstractLoad, ...] = eqx.field(converter=_with_arrays, default=())
    contact: Contact | None = eqx.field(converter=_with_arrays, default=None)

    def __post_init__(self):
        if isinstance(self.contact, Contact) and isinstance(self.rod, Rod):
            self.contact = self.contact.fitted(self.rod)

    def __check_init__(self):
        self._check_kinds()
        for load in self.loads:
            load.check(self.rod)
            if load.inertia and self.rod.mass is None:
                raise ValueError("loads: added mass on a rod with mass=None, which has no inertia")
        for i, load in enumerate(self.loads):
            probing.check_local(load, self.rod, f"loads[{i}]")
            check_potential(load, self.rod, f"loads[{i}]")
        for name, end in zip(("first_end", "last_end"), self.ends, strict=True):
            probing.check_end(end, name)
        if self.contact is not None:
            self.contact.check(self.rod)
        if self.rod.mass is None:
            self._check_inertialess()

    def _check_kinds(self):
        one = "give one rod, of straight_rod or curved_rod (a scene has no second)"
        check_instance(Rod, one, rod=self.rod)
        check_end(first_end=self.first_end, last_end=self.last_end)
        if not isinstance(self.loads, tuple):
            raise ValueError("loads: give a tuple, for one load (load,)")
        mend = "give a load such as Gravity((0, 0, -9.81))"
        check_instance(AbstractLoad, mend, **{f"loads[{i}]": x for i, x in enumerate(self.loads)})
        if self.contact is not None:
            mend = "give Contact(law, segments, cutoff), or None for no contact"
            check_instance(Contact, mend, contact=self.contact)

    def _check_inertialess(self):
        found = [load.resistance for load in self.loads]
        drags = [resistance for resistance in found if resistance is not None]
        if not drags:
            raise ValueError("loads: a rod with mass=None needs a LinearDrag to balance elasticity")
        names = ("normal", "tangential", "rotational")
        for name, values in zip(names, zip(*drags, strict=True), strict=True):
            if any(isinstance(v, jax.core.Tracer) or not hasattr(v, "shape") for v in values):
                continue
            if not np.all(sum(np.asarray(v) for v in values) > 0):
                raise ValueError(f"{name}: a rod with mass=None needs a positive {name} LinearDrag")

    def __repr__(self) -> str:
        parts = [f"    {f.name}={brief(getattr(self, f.name))}," for f in dataclasses.fields(self)]
        rod = f"    rod={self.rod!r},"
        return "\n".join(["Scene(", rod, *parts[1:], ")"])

    @property
    def ends(self) -> tuple[AbstractEnd, AbstractEnd]:
        """Both ends, that at s = 0 first."""
        return self.first_end, self.last_end

    @property
    def closed(self) -> bool | Bool[Array, ""]:
        """Whether both ends are held at one place for good, as those of a ring.

        Parts beside the junction are then neighbours: along the rod the shorter way counts. False
        where the kinds of the ends exclude it; else it follows from where the rod is placed, in
        traced code as well.
        """
        fixed = [end.fixed for end in self.ends]
        diameter = self.rod.diameter
        if diameter is None or any(one is False for one in fixed):
            return False
        gap = self.rod.position[-1] - self.rod.position[0]
        # nearer than any two solid strands
        closed = jnp.sum(gap**2) < (0.5 * jnp.min(diameter)) ** 2
        for one in fixed:
            closed = closed & one
        return closed

    @property
    def switch_times(self) -> tuple[Float[Array, ""], ...]:
        """Times at which a constraint changes, as the rod's precision has them; steps end there."""
        dtype = self.rod.position.dtype
        own = lambda t: t if jnp.result_type(t) == dtype else jnp.asarray(t, dtype)
        return tuple(own(t) for end in self.ends for t in end.switch_times)

    @property
    def schedules(self) -> list:
        """Everything prescribed over time, with its name."""
        found = []
        for name, end in zip(("first_end", "last_end"), self.ends, strict=True):
            parts = {"displacement": end.displacement, "rotation": end.rotation}
            found += [(f"{name}.{part}", x) for part, x in parts.items() if x is not None]
        for i, load in enumerate(self.loads):
            found += [(f"loads[{i}].{part}", x) for part, x in load.schedules.items()]
        return found

    @property
    def corners(self) -> Float[Array, " k"]:
        """Times at which a derivative of a drive jumps; adaptive steps end on them."""
        corners = [jnp.asarray(schedule.corners, float) for _, schedule in self.schedules]
        return jnp.concatenate([jnp.zeros((0,)), *corners])

    def check_until(self, time: float) -> None:
        """Raise ValueError if a schedule ends before `time` (outside traced code only)."""
        for name, schedule in self.schedules:
            if isinstance(schedule.until, jax.core.Tracer):
                continue
            until = float(schedule.until)
            if until < time - 1e-9 * abs(time):
                raise ValueError(
                    f"{name}: its schedule ends at {until:g}, before the run's end at {time:g};"
                    " extend the schedule or shorten the run"
                )


def projectors(scene: Scene, time: Float[Array, ""]) -> Float[Array, "2 6 6"]:
    """Projectors of the two ends for a step that starts at `time`."""
    dtype = scene.rod.position.dtype
    return jnp.stack([end.projector(time).astype(dtype) for end in scene.ends])
