"""What a scene is refused for, when it is made."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, no_type_check

import jax
import numpy as np

from rodjax.constraints.ends import AbstractEnd, Free, check_end
from rodjax.constraints.joints import AbstractJoint, Point
from rodjax.constraints.supports import Support
from rodjax.inputs.validation import all_known, check_instance, known
from rodjax.interactions.contact import Contact
from rodjax.interactions.load import AbstractLoad
from rodjax.rods.chain import chain
from rodjax.rods.lump import Lump
from rodjax.rods.rod import Rod
from rodjax.rods.rod_checks import check_lumps
from rodjax.scenes.closure import welded

if TYPE_CHECKING:
    from rodjax.scenes.scene import Scene


def as_one(rod: Rod | None, rods: Sequence[Rod]) -> Rod:
    """The rods laid end to end."""
    if rod is not None:
        raise ValueError("rods: give one rod as `rod` or several as `rods`, not both")
    if not isinstance(rods, list | tuple):
        raise ValueError("rods: give a tuple of rods, for one rod (rod,)")
    return chain(rods)


@no_type_check  # what is given wrongly is told here
def carrying(rod: Rod, lumps: tuple[Lump, ...]) -> Rod:
    """The rod with these lumps besides its own."""
    if isinstance(lumps, tuple) and not lumps:
        return rod
    one = "give one rod, of straight_rod or curved_rod, or several as rods=(one, another)"
    check_instance(Rod, one, rod=rod)
    if not isinstance(lumps, tuple):
        raise ValueError("lumps: give a tuple, for one lump (lump,)")
    loaded = rod.with_lumps(lumps)
    check_lumps(loaded)
    return loaded


def ends_of(count: int, first, last) -> tuple[AbstractEnd, AbstractEnd, tuple[AbstractEnd, ...]]:
    """The scene's ends, and the inner ones in the order of the nodes, of as many rods."""
    both = {}
    for name, given in (("first_end", first), ("last_end", last)):
        if isinstance(given, tuple) and len(given) != count:
            raise ValueError(f"{name}: give one end for each of {count} rods, got {len(given)}")
        others = [Free()] * (count - 1)
        alone = (given, *others) if name == "first_end" else (*others, given)
        both[name] = given if isinstance(given, tuple) else alone
        check_end(**{f"{name}[{i}]": end for i, end in enumerate(both[name])})
    firsts, lasts = both["first_end"], both["last_end"]
    inner = [end for pair in zip(lasts[:-1], firsts[1:], strict=True) for end in pair]
    return firsts[0], lasts[-1], tuple(inner)


def check_kinds(scene: "Scene") -> None:
    """Raise ValueError where what is given is no rod, end, load and so on."""
    one = "give one rod, of straight_rod or curved_rod, or several as rods=(one, another)"
    check_instance(Rod, one, rod=scene.rod)
    check_end(first_end=scene.first_end, last_end=scene.last_end)
    if not isinstance(scene.loads, tuple):
        raise ValueError("loads: give a tuple, for one load (load,)")
    mend = "give a load such as Gravity((0, 0, -9.81))"
    check_instance(AbstractLoad, mend, **{f"loads[{i}]": x for i, x in enumerate(scene.loads)})
    if not isinstance(scene.supports, tuple):
        raise ValueError("supports: give a tuple, for one support (support,)")
    mend = "give a support such as Support(node, Pinned())"
    named = {f"supports[{i}]": x for i, x in enumerate(scene.supports)}
    check_instance(Support, mend, **named)
    check_instance(
        AbstractEnd, "give an end such as Free()",
        **{f"inner_ends[{i}]": end for i, end in enumerate(scene.inner_ends)},
    )  # fmt: skip
    rods, bodies = len(scene.rod.strands), len(scene.rod.bodies)
    if len(scene.inner_ends) != 2 * (rods - 1) + bodies:
        raise ValueError(
            f"inner_ends: {rods} rods and {bodies} bodies have {2 * (rods - 1) + bodies}, got"
            f" {len(scene.inner_ends)}; give the rods as rods=(one, another), bodies as"
            " bodies=(...)"
        )
    if scene.contact is not None:
        mend = "give Contact(law, segments, cutoff), or None for no contact"
        check_instance(Contact, mend, contact=scene.contact)


def check_supports(scene: "Scene") -> None:
    """Raise ValueError where a support is at no node of its rod, or at one that is held."""
    taken = {held.node: held.name for held in scene.held_ends}
    for i, support in enumerate(scene.supports):
        name = f"supports[{i}]"
        if support.rod >= len(scene.rod.strands):
            raise ValueError(
                f"{name}: rod: the scene's rods are 0 to {len(scene.rod.strands) - 1}, got"
                f" {support.rod}"
            )
        if not known(support.node):
            continue
        part = scene.rod.parts[support.rod]
        node, last = int(support.place(part)), part.last - part.first
        if not part.first <= node <= part.last:
            raise ValueError(
                f"{name}: node: a rod of {last} elements has the nodes 0 to {last}, or"
                f" {-last - 1} to -1, got {int(support.node)}"
            )
        if node in taken:
            raise ValueError(
                f"{name}: node {node} is held by {taken[node]} already; give one thing that"
                " takes away all directions of both"
            )
        taken[node] = name


def check_joints(scene: "Scene") -> None:
    """Raise ValueError where a joint has points at no nodes, or that are apart."""
    if not isinstance(scene.joints, tuple):
        raise ValueError("joints: give a tuple, for one joint (joint,)")
    mend = "give a joint such as Ball(Point(-1, rod=0), Point(0, rod=1))"
    check_instance(
        AbstractJoint, mend, **{f"joints[{i}]": joint for i, joint in enumerate(scene.joints)}
    )
    for i, joint in enumerate(scene.joints):
        frames = []
        for which, point in (("first", joint.first), ("second", joint.second)):
            name = f"joints[{i}].{which}"
            node = _node_of(scene, point, name)
            frames.append((node, (scene.rod.position[node], scene.rod.quaternion[node])))
        (a, first), (b, second) = frames
        if a == b:
            raise ValueError(f"joints[{i}]: both points are at node {a}; give two nodes")
        with jax.ensure_compile_time_eval():
            apart = joint.projector()[:3, :3] @ joint.translation(first, second)
        length = scene.rod.length
        if not all_known((apart, length)):
            continue
        most = 1e-6 * float(np.sum(np.asarray(length)))
        if not np.linalg.norm(np.asarray(apart)) <= most:
            raise ValueError(
                f"joints[{i}]: its points are {np.linalg.norm(np.asarray(apart)):.3g} apart in"
                " directions that it holds, as the rods are placed; place them so that they"
                " meet, or give the points offsets"
            )


def _node_of(scene: "Scene", point: Point, name: str) -> int:
    """The node of a point, which must be there."""
    rods, bodies = len(scene.rod.strands), len(scene.rod.bodies)
    if point.body is not None:
        if point.body >= bodies:
            there = f"are 0 to {bodies - 1}" if bodies else "are none; give bodies=(...)"
            raise ValueError(f"{name}: body: the scene's bodies {there}, got {point.body}")
        return point.place(scene.rod.parts)
    if point.rod >= rods:
        raise ValueError(f"{name}: rod: the scene's rods are 0 to {rods - 1}, got {point.rod}")
    part = scene.rod.parts[point.rod]
    node, last = point.place(scene.rod.parts), part.last - part.first
    if not part.first <= node <= part.last:
        raise ValueError(
            f"{name}: node: a rod of {last} elements has the nodes 0 to {last}, or"
            f" {-last - 1} to -1, got {point.node}"
        )
    return node


def rings_of(scene: "Scene") -> tuple[bool, ...] | None:
    """Which of several rods are closed by a weld of their ends; None where none is."""
    joints = scene.joints if isinstance(scene.joints, tuple) else ()
    if not all(isinstance(joint, AbstractJoint) for joint in joints):
        return None  # a check says so
    try:
        closed = tuple(welded(scene, i) for i in range(len(scene.rod.strands)))
    except IndexError:  # a rod that is not there: a check says so
        return None
    return closed if any(closed) else None


def check_inertialess(scene: "Scene") -> None:
    """Raise ValueError where nothing balances the elasticity of a rod without inertia."""
    found = [load.resistance for load in scene.loads]
    drags = [resistance for resistance in found if resistance is not None]
    if not drags:
        raise ValueError("loads: a rod with mass=None needs a LinearDrag to balance elasticity")
    names = ("normal", "tangential", "rotational")
    for name, values in zip(names, zip(*drags, strict=True), strict=True):
        if any(not all_known(v) or not hasattr(v, "shape") for v in values):
            continue
        if not np.all(sum(np.asarray(v) for v in values) > 0):
            raise ValueError(f"{name}: a rod with mass=None needs a positive {name} LinearDrag")
