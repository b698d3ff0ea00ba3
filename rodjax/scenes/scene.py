"""A scene: rods, what holds them, what loads them, and whether they touch."""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple, no_type_check

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from rodjax.constraints.ends import AbstractEnd, Free
from rodjax.constraints.joints import AbstractJoint
from rodjax.constraints.supports import Support
from rodjax.inputs.brief import brief
from rodjax.inputs.validation import all_known, as_traced, known
from rodjax.interactions.contact import Contact
from rodjax.interactions.interaction import AbstractInteraction
from rodjax.interactions.load import AbstractLoad
from rodjax.interactions.self_contact import FoundContact, SelfContact
from rodjax.rods.chain import rods_of
from rodjax.rods.constitution import recalled
from rodjax.rods.lump import Lump
from rodjax.rods.rod import Rod
from rodjax.rods.state import Memory
from rodjax.scenes import closure, probing, scene_checks
from rodjax.scenes.body import Body, with_all
from rodjax.scenes.holds import Held, Node
from rodjax.scenes.material_probing import check_law
from rodjax.scenes.potentials import check_potential
from rodjax.scenes.scene_checks import as_one, ends_of
from rodjax.scenes.scene_sheet import sheet_of_scene

_FREE = Free()


class Found(NamedTuple):
    """What a scene's interactions find near the nodes."""

    by_loads: tuple[Any, ...] = ()
    contact: FoundContact | None = None  # strands of the rod near each other

    @property
    def each(self) -> tuple[Any, ...]:
        """By each of `Scene.interactions`."""
        return self.by_loads if self.contact is None else (*self.by_loads, self.contact)


def _with_arrays(part):
    """The part with floating point numbers in it as arrays; whole ones may be indices or sizes."""
    is_number = lambda leaf: isinstance(leaf, float | np.floating | np.ndarray)
    return jax.tree.map(lambda leaf: as_traced(leaf) if is_number(leaf) else leaf, part)


class Scene(eqx.Module):
    """Everything that is given; what is None or empty is absent from the traced program.

    Of several rods `Scene(rods=(a, b))` is made, which stand on one axis of nodes (`rods.chain`):
    those of a, then those of b. `first_end` is then at the first rod's s = 0 and `last_end` at the
    last rod's s = L; a tuple of ends has one for each rod. `rods` and `states_of` take a scene and
    its states apart again. `lumps=`, masses and bodies fixed to nodes, are kept by the rod
    (`Rod.lumps`). `bodies=`, rigid bodies by themselves, stand behind the rods on the axis of
    nodes, one node each (`Rod.bodies`).

    Attributes:
        rod: the rod, at rest and as it is placed at first; several as one.
        first_end, last_end: what holds it at s = 0 and at s = L.
        loads: what acts on it, a tuple of loads.
        contact: whether and how it touches itself, and rods each other; None for strands that pass
            through each other.
        supports: what holds it between its ends, a tuple of `Support`.
        inner_ends: of several rods, the last end of the first, the first of the second, and so on;
            then what holds each of the bodies.
        joints: what joins points of rods and bodies, a tuple of `Weld`, `Ball`, `Hinge`, `Slide`.

    Example:
        >>> scene = rx.Scene(rod, rx.Clamped(), loads=(rx.Gravity((0, 0, -9.81)),))
        >>> start = rx.start(scene)
    """

    rod: Rod
    # Python's numbers in classes of the user's would be compiled in, each anew
    first_end: AbstractEnd = eqx.field(converter=_with_arrays, default=Free())
    last_end: AbstractEnd = eqx.field(converter=_with_arrays, default=Free())
    loads: tuple[AbstractLoad, ...] = eqx.field(converter=_with_arrays, default=())
    contact: Contact | None = eqx.field(converter=_with_arrays, default=None)
    supports: tuple[Support, ...] = eqx.field(converter=_with_arrays, default=())
    inner_ends: tuple[AbstractEnd, ...] = eqx.field(converter=_with_arrays, default=())
    joints: tuple[AbstractJoint, ...] = eqx.field(converter=_with_arrays, default=())

    @no_type_check  # what is given wrongly is told by the checks
    def __init__(
        self,
        rod: Rod | None = None,
        first_end: AbstractEnd | tuple[AbstractEnd, ...] = _FREE,
        last_end: AbstractEnd | tuple[AbstractEnd, ...] = _FREE,
        loads: tuple[AbstractLoad, ...] = (),
        contact: Contact | None = None,
        supports: tuple[Support, ...] = (),
        inner_ends: tuple[AbstractEnd, ...] = (),
        joints: tuple[AbstractJoint, ...] = (),
        *,
        rods: Sequence[Rod] | None = None,
        lumps: tuple[Lump, ...] = (),
        bodies: tuple[Body, ...] = (),
    ):
        if rods is not None:
            rod = as_one(rod, rods)
            first_end, last_end, inner_ends = ends_of(len(rods), first_end, last_end)
        rod = with_all(scene_checks.carrying(rod, lumps), bodies)
        inner_ends = (*inner_ends, *(body.end for body in bodies))
        if isinstance(contact, Contact) and isinstance(rod, Rod):
            contact = contact.fitted(rod)
        given = (rod, first_end, last_end, loads, contact, supports, inner_ends, joints)
        for field, value in zip(dataclasses.fields(self), given, strict=True):
            setattr(self, field.name, value)
        if isinstance(contact, Contact) and isinstance(rod, Rod) and rod.breaks:
            self.contact = dataclasses.replace(contact, rings=scene_checks.rings_of(self))

    def __check_init__(self):
        scene_checks.check_kinds(self)
        for one in self.interactions:
            one.check(self.rod)
        for load in self.loads:
            if load.inertia and self.rod.mass is None:
                raise ValueError("loads: added mass on a rod with mass=None, which has no inertia")
        for i, load in enumerate(self.loads):
            probing.check_local(load, self.rod, f"loads[{i}]")
            check_potential(load, self.rod, f"loads[{i}]")
        scene_checks.check_supports(self)
        check_law(self.rod)
        scene_checks.check_joints(self)
        for held in self.holds:
            probing.check_end(held.end, held.name)
        if self.rod.mass is None:
            scene_checks.check_inertialess(self)

    def __repr__(self) -> str:
        fields = [f.name for f in dataclasses.fields(self)]
        for name in ("supports", "inner_ends", "joints"):
            if not getattr(self, name):
                fields.remove(name)
        parts = [f"    {name}={brief(getattr(self, name))}," for name in fields]
        rod = f"    rod={self.rod!r},"
        return "\n".join(["Scene(", rod, *parts[1:], ")"])

    def __str__(self) -> str:
        return sheet_of_scene(self).text

    def _repr_html_(self) -> str:
        return sheet_of_scene(self).html

    @property
    def rods(self) -> tuple[Rod, ...]:
        """The rods by themselves, without bodies; of several the compliance is zero where it was
        None.
        """
        return rods_of(self.rod)

    @property
    def ends(self) -> tuple[AbstractEnd, AbstractEnd]:
        """Both ends, that at s = 0 first."""
        return self.first_end, self.last_end

    @property
    def holds(self) -> tuple[Held, ...]:
        """What holds the rod: both ends, then the supports."""
        parts = self.rod.parts
        places = (x.place(parts[x.rod]) for x in self.supports)
        supports = enumerate(zip(places, self.supports, strict=True))
        held = (Held(f"supports[{i}]", place, x.end) for i, (place, x) in supports)
        return (*self.held_ends, *held)

    @property
    def held_ends(self) -> tuple[Held, ...]:
        """The ends of all rods, the scene's two first, then what holds the bodies."""
        first, *inner, last = (node for part in self.rod.strands for node in part)
        ends = Held("first_end", first, self.first_end), Held("last_end", last, self.last_end)
        rods = range(len(inner) // 2)
        names = [name for i in rods for name in (f"last_end[{i}]", f"first_end[{i + 1}]")]
        bodies = self.rod.bodies
        names += [f"bodies[{i}].end" for i in range(len(bodies))]
        return (*ends, *map(Held, names, (*inner, *bodies), self.inner_ends))

    @property
    def holding(self) -> str:
        """Their names, for messages."""
        return ", ".join(held.name for held in self.holds)

    @property
    def held_nodes(self) -> tuple[Node, ...]:
        """Their nodes."""
        return tuple(held.node for held in self.holds)

    @property
    def self_contact(self) -> SelfContact | None:
        """Contact of the rod with itself, as one of what acts on it."""
        return None if self.contact is None else SelfContact(self.contact)

    @property
    def resting(self) -> "Scene":
        """The scene without what acts on motion alone: friction of strands on each other."""
        if self.contact is None or self.contact.friction is None:
            return self
        return eqx.tree_at(lambda scene: scene.contact.friction, self, None)

    @property
    def interactions(self) -> tuple[AbstractInteraction, ...]:
        """What acts on the rod: its loads, then contact with itself if there is any."""
        own = self.self_contact
        return self.loads if own is None else (*self.loads, own)

    @property
    def between_nodes(self) -> bool:
        """Whether a load's wrench on a node hangs on its neighbours, see `AbstractLoad`."""
        return any(load.between_nodes for load in self.loads)

    @property
    def remembers(self) -> bool:
        """Whether anything of it remembers the motion before, see `State.memory`."""
        material = self.rod.material
        own = material is not None and material.remembers
        return any(load.remembers for load in self.loads) or own

    @property
    def rubs(self) -> bool:
        """Whether Newton's method needs duals, see `AbstractFriction.dual`."""
        return any(one.rubs for one in self.interactions)

    def with_duals(self, duals: tuple[Any, ...]) -> "Scene":
        """The scene whose interactions have these duals."""

        rubbing = [i for i, load in enumerate(self.loads) if load.rubs]
        own = len(duals) > len(self.loads) and duals[-1] is not None

        def where(scene):
            found = [scene.loads[i].dual for i in rubbing]
            return [*found, scene.contact.dual] if own else found

        values = [duals[i] for i in rubbing] + ([duals[-1]] if own else [])
        return eqx.tree_at(where, self, values, is_leaf=lambda leaf: leaf is None)

    def recalling(self, memory: Memory | None) -> "Scene":
        """The scene of which all parts know what they remember."""
        if memory is None or not self.remembers:
            return self
        pairs = zip(self.loads, memory.loads, strict=True)
        loads = tuple(load.recalling(its) for load, its in pairs)
        scene = eqx.tree_at(lambda scene: scene.loads, self, loads)
        if memory.material is None:
            return scene
        rod = recalled(self.rod, memory.material)
        return eqx.tree_at(lambda scene: scene.rod, scene, rod)

    @jax.named_scope("find")
    def find(
        self, position: Float[Array, "nodes 3"], displacement: Float[Array, "nodes 3"] | None = None
    ) -> Found:
        """What each of them finds near the nodes, before a motion of the expected displacement."""
        given = self.rod, position, displacement
        by_loads = tuple(load.find(*given) for load in self.loads)
        own = None if self.contact is None else self.find_contact(position, displacement)
        return Found(by_loads, own)

    def find_contact(
        self, position: Float[Array, "nodes 3"], displacement: Float[Array, "nodes 3"] | None = None
    ) -> FoundContact:
        """As `find`, of contact with itself alone, which there is."""
        assert self.contact is not None
        return SelfContact(self.contact).find(self.rod, position, displacement, self.closed)

    @property
    def closed(self) -> bool | Bool[Array, ""]:
        """Whether both ends are held at one place for good, as those of a ring.

        Parts beside the junction are then neighbours: along the rod the shorter way counts. False
        where the kinds of the ends exclude it; else it follows from where the rod is placed, in
        traced code as well.
        """
        return closure.closed(self)

    @property
    def switch_times(self) -> tuple[Float[Array, ""], ...]:
        """Times at which a constraint changes, as the rod's precision has them; steps end there."""
        dtype = self.rod.position.dtype
        own = lambda t: t if jnp.result_type(t) == dtype else jnp.asarray(t, dtype)
        return tuple(own(t) for held in self.holds for t in held.end.switch_times)

    @property
    def schedules(self) -> list:
        """Everything prescribed over time, with its name."""
        found = []
        for name, _, end in self.holds:
            parts = {"displacement": end.displacement, "rotation": end.rotation}
            found += [(f"{name}.{part}", x) for part, x in parts.items() if x is not None]
        if self.rod.actuation is not None:
            found.append(("rod.actuation", self.rod.actuation))
        for i, load in enumerate(self.loads):
            found += [(f"loads[{i}].{part}", x) for part, x in load.schedules.items()]
        for i, joint in enumerate(self.joints):
            found += [(f"joints[{i}].{part}", x) for part, x in joint.schedules.items()]
        return found

    @property
    def corners(self) -> Float[Array, " k"]:
        """Times at which a derivative of a drive jumps; adaptive steps end on them."""
        corners = [jnp.asarray(schedule.corners, float) for _, schedule in self.schedules]
        return jnp.concatenate([jnp.zeros((0,)), *corners])

    def check_until(self, time: float) -> None:
        """Raise ValueError if a schedule ends before `time` (outside traced code only)."""
        for name, schedule in self.schedules:
            if not all_known(schedule.until):
                continue
            until = float(schedule.until)
            if until < time - 1e-9 * abs(time):
                raise ValueError(
                    f"{name}: its schedule ends at {until:g}, before the run's end at {time:g};"
                    " extend the schedule or shorten the run"
                )


def directions(scene: Scene, time: Float[Array, ""]) -> Float[Array, "h 6 6"]:
    """Projectors that the kinds of what holds the rod say, wherever that is."""
    dtype = scene.rod.position.dtype
    ends = (*scene.ends, *scene.inner_ends, *(support.end for support in scene.supports))
    return jnp.stack([end.projector(time).astype(dtype) for end in ends])


def projectors(scene: Scene, time: Float[Array, ""]) -> Float[Array, "h 6 6"]:
    """Projectors of what holds the rod, for a step that starts at `time`."""
    found = directions(scene, time)
    for i, support in enumerate(scene.supports, 2 + len(scene.inner_ends)):
        if not known(support.node):  # a traced node that cannot be held makes no number
            part = scene.rod.parts[support.rod]
            node = support.place(part)
            others = [other for j, other in enumerate(scene.held_nodes) if j != i]
            taken = jnp.any(jnp.stack([node == other for other in others]))
            wrong = taken | (node < part.first) | (node > part.last)
            found = found.at[i].set(jnp.where(wrong, jnp.nan, found[i]))
    return found
