"""Several rods laid end to end on one axis of nodes.

Between the last node of a rod and the first of the next stands an element that is none: it has no
length and no stiffness, its strain is that of an element at rest whatever its nodes do, and its
internal force is zero. So a system of rods is one rod to all that is local to nodes and elements,
and the same block tridiagonal matrix solves it. See `Rod.breaks`. A rigid body by itself is a node
behind the last rod with such elements on both sides, and a lump on it.
"""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.inputs.validation import check_instance
from rodjax.rods.lump import Lump
from rodjax.rods.rod import Part, Rod, parts_of
from rodjax.rods.shared_out import (
    ActuationsOfRods,
    MaterialsOfRods,
    own_actuations,
    own_materials,
)
from rodjax.rods.state import State


def chain(rods: Sequence[Rod]) -> Rod:
    """The rods laid end to end; one rod alone is itself.

    Args:
        rods: at least one, each of its own length, section and grid, and all in one precision.

    Raises:
        ValueError: they are of two precisions, or a property is None for some of them only.
    """
    mend = "give rods of straight_rod or curved_rod"
    check_instance(Rod, mend, **{f"rods[{i}]": rod for i, rod in enumerate(rods)})
    if not rods:
        raise ValueError("rods: give at least one")
    for i, rod in enumerate(rods):
        if rod.bodies and len(rods) > 1:
            raise ValueError(f"rods[{i}]: it has bodies; give these to the scene, as bodies=(...)")
    if len(rods) == 1:
        return rods[0]
    dtypes = {rod.position.dtype.name for rod in rods}
    if len(dtypes) > 1:
        raise ValueError(f"rods: must be of one precision, got {' and '.join(sorted(dtypes))}")
    for name in ("mass", "rotary_inertia", "diameter", "area"):
        have = [i for i, rod in enumerate(rods) if getattr(rod, name) is not None]
        if have and len(have) < len(rods):
            lacking = min(set(range(len(rods))) - set(have))
            raise ValueError(
                f"rods[{lacking}]: {name}: it is None, and given for rods[{have[0]}]; give it to"
                " all rods of a scene, or to none"
            )
    breaks, nodes = [], 0
    for rod in rods:
        breaks += [nodes + i for i in rod.breaks]
        nodes += rod.elements + 1
        breaks.append(nodes - 1)

    def laid(name, between=0.0):
        """A property of all elements, with what stands between rods."""
        if getattr(rods[0], name) is None:
            return None
        rows = [getattr(rods[0], name)]
        for rod in rods[1:]:
            own = getattr(rod, name)
            rows += [jnp.full_like(own[:1], between), own]
        return jnp.concatenate(rows)

    rows = [_compliance(rods[0])]
    for rod in rods[1:]:
        # any number makes the force of an element without strain zero; this one is of a size with
        # the others
        soft = rod.length[:1, None] ** 2 / rod.stiffness[:1, :1]
        rows += [jnp.broadcast_to(soft, (1, 3)), _compliance(rod)]
    return Rod(
        position=jnp.concatenate([rod.position for rod in rods]),
        quaternion=jnp.concatenate([rod.quaternion for rod in rods]),
        length=laid("length"),
        stiffness=laid("stiffness"),
        natural_curvature=laid("natural_curvature"),
        mass=laid("mass"),
        rotary_inertia=laid("rotary_inertia"),
        compliance=jnp.concatenate(rows),
        diameter=_laid_diameter(rods),
        area=laid("area"),
        coupling=_laid_or_zero(rods, "coupling"),
        torque_per_tension=_laid_or_zero(rods, "torque_per_tension"),
        material=_materials(rods),
        actuation=_actuations(rods),
        breaks=tuple(breaks[:-1]),
        lumps=_lumps(rods),
    )


def with_bodies(
    rod: Rod,
    position: Float[Array, "b 3"],
    quaternion: Float[Array, "b 4"],
    lumps: tuple[Lump, ...],
) -> Rod:
    """The rod, or rods, with bodies by themselves behind, one at least.

    Args:
        rod: without bodies.
        position, quaternion: of the bodies' centres of mass.
        lumps: what each is, with any node and rod.
    """
    count, nodes, before = len(lumps), rod.elements + 1, len(rod.parts)

    def behind(name, row: Any = 0.0):
        """A property of the elements, with such a row for each that is none."""
        value = getattr(rod, name)
        if value is None:
            return None
        rows = jnp.broadcast_to(jnp.asarray(row, value.dtype), (count, *value.shape[1:]))
        return jnp.concatenate([value, rows])

    compliance = _compliance(rod)
    soft = jnp.broadcast_to(rod.length[0] ** 2 / rod.stiffness[0, 0], (count, 3))
    material, actuation = rod.material, rod.actuation
    if material is not None:
        own = own_materials(material, before)
        material = MaterialsOfRods.of(own, _counts([rod]), count)
    if actuation is not None:
        own = own_actuations(actuation, before)
        actuation = ActuationsOfRods(tuple(own), tuple(_counts([rod])), count)
    placed = (dataclasses.replace(lump, node=0, rod=before + i) for i, lump in enumerate(lumps))
    return Rod(
        position=jnp.concatenate([rod.position, position.astype(rod.position.dtype)]),
        quaternion=jnp.concatenate([rod.quaternion, quaternion.astype(rod.position.dtype)]),
        length=behind("length"),
        stiffness=behind("stiffness"),
        natural_curvature=behind("natural_curvature"),
        mass=behind("mass"),
        rotary_inertia=behind("rotary_inertia"),
        compliance=jnp.concatenate([compliance, soft]),
        diameter=None if rod.diameter is None else behind("diameter", rod.diameter[-1]),
        area=behind("area"),
        coupling=behind("coupling"),
        torque_per_tension=behind("torque_per_tension"),
        material=material,
        actuation=actuation,
        breaks=(*rod.breaks, *range(nodes - 1, nodes - 1 + count)),
        lumps=(*rod.lumps, *placed),
    )


def _lumps(rods: Sequence[Rod]) -> tuple[Lump, ...]:
    """Those of all rods, each at the rod's place among all."""
    found, before = [], 0
    for rod in rods:
        own = (dataclasses.replace(lump, rod=lump.rod + before) for lump in rod.lumps)
        found, before = [*found, *own], before + len(rod.parts)
    return tuple(found)


def _counts(rods: Sequence[Rod]) -> list[int]:
    """How many elements each of all rods has, those of chains one by one."""
    return [part.last - part.first for rod in rods for part in rod.strands]


def _materials(rods: Sequence[Rod]) -> MaterialsOfRods | None:
    """What each of all rods is made of; None where all are linear."""
    own = [one for rod in rods for one in own_materials(rod.material, len(rod.parts))]
    return None if all(one is None for one in own) else MaterialsOfRods.of(own, _counts(rods))


def _actuations(rods: Sequence[Rod]) -> ActuationsOfRods | None:
    """How each of all rods is driven; None where none is."""
    own = [one for rod in rods for one in own_actuations(rod.actuation, len(rod.parts))]
    if all(one is None for one in own):
        return None
    return ActuationsOfRods(tuple(own), tuple(_counts(rods)))


def _compliance(rod: Rod):
    return jnp.zeros_like(rod.stiffness) if rod.compliance is None else rod.compliance


def _laid_or_zero(rods: Sequence[Rod], name: str):
    """A property that is zero where it is None, of all elements; None if no rod has it."""
    if all(getattr(rod, name) is None for rod in rods):
        return None
    rows = []
    for rod in rods:
        value = getattr(rod, name)
        if value is None:
            value = jnp.zeros_like(rod.stiffness if name == "coupling" else rod.length)
        rows += [jnp.zeros_like(value[:1]), value]
    return jnp.concatenate(rows[1:])


def _laid_diameter(rods: Sequence[Rod]):
    """Of an element that is none that of the one after it, so that it is no thinnest of all."""
    if rods[0].diameter is None:
        return None
    rows = [rods[0].diameter]
    for rod in rods[1:]:
        assert rod.diameter is not None
        rows += [rod.diameter[:1], rod.diameter]
    return jnp.concatenate(rows)


def rods_of(rod: Rod) -> tuple[Rod, ...]:
    """The rods that a chain is made of, without bodies; of a rod by itself that one.

    Their compliance is an array, zero where it was None.
    """
    if not rod.breaks:
        return (rod,)

    materials = own_materials(rod.material, len(rod.strands))
    actuations = own_actuations(rod.actuation, len(rod.strands))

    def one(index: int, part: Part, material, actuation) -> Rod:
        of_nodes = lambda value: value[part.nodes]
        of_elements = lambda value: None if value is None else value[part.elements]
        return Rod(
            position=of_nodes(rod.position),
            quaternion=of_nodes(rod.quaternion),
            length=of_elements(rod.length),
            stiffness=of_elements(rod.stiffness),
            natural_curvature=of_elements(rod.natural_curvature),
            mass=of_elements(rod.mass),
            rotary_inertia=of_elements(rod.rotary_inertia),
            compliance=of_elements(rod.compliance),
            diameter=of_elements(rod.diameter),
            area=of_elements(rod.area),
            coupling=of_elements(rod.coupling),
            torque_per_tension=of_elements(rod.torque_per_tension),
            material=material,
            actuation=actuation,
            lumps=tuple(
                dataclasses.replace(lump, rod=0) for lump in rod.lumps if lump.rod == index
            ),
        )

    return tuple(map(one, range(len(rod.strands)), rod.strands, materials, actuations))


def states_of(state: State) -> tuple[State, ...]:
    """The states of the rods of a scene by themselves; of one state, or of a run's stacked ones.

    Then those of its bodies, each of one node and no element.

    Args:
        state: of one rod or of several, or with bodies.

    Example:
        >>> (only,) = rx.states_of(run.final)
        >>> only.position.shape
        (21, 3)
    """
    if not state.breaks:
        return (state,)

    def one(part: Part, state: State) -> State:
        nodes = lambda value: value[part.nodes]
        return State(
            state.time,
            nodes(state.position),
            nodes(state.quaternion),
            nodes(state.rate),
            nodes(state.acceleration),
            nodes(state.auxiliary),
            state.force[part.elements],
            state.settling,
            None if state.jerk is None else nodes(state.jerk),
        )

    def taken(part: Part) -> State:
        of = functools.partial(one, part)
        for _ in range(state.time.ndim):
            of = jax.vmap(of)
        return of(jax.tree.map(jnp.asarray, state))

    return tuple(map(taken, parts_of(state.breaks, state.force.shape[-2])))


def alone(state: State, asked: str) -> State:
    """The state, if it is of one rod.

    Raises:
        ValueError: it is of several, of which `asked` is not to be had as one.
    """
    if state.breaks:
        raise ValueError(
            f"state: it is of {len(state.breaks) + 1} rods or bodies, and {asked} is of one rod:"
            " give one of rodjax.states_of(state)"
        )
    return state


def check_alone(rod: Rod, asked: str) -> None:
    """Raise ValueError if a rod is several, of which `asked` is not to be had as one."""
    if rod.breaks:
        raise ValueError(
            f"rod: it is {len(rod.parts)} rods or bodies, and {asked} is of one rod: do it before"
            " they are given to the scene, or take one of `scene.rods`"
        )
