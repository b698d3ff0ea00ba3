"""Whether the two ends of a rod are held at one place, and by which joints."""

from typing import TYPE_CHECKING

import jax.numpy as jnp
from jaxtyping import Array, Bool

from rodjax.constraints.joints import AbstractJoint

if TYPE_CHECKING:
    from rodjax.scenes.scene import Scene


def closed(scene: "Scene") -> bool | Bool[Array, ""]:
    """Whether both ends of a scene's rod are held at one place for good, see `Scene.closed`."""
    if scene.rod.breaks:
        return False
    if welded(scene, 0):
        return True
    fixed = [end.fixed for end in scene.ends]
    diameter = scene.rod.diameter
    if diameter is None or any(one is False for one in fixed):
        return False
    gap = scene.rod.position[-1] - scene.rod.position[0]
    # nearer than any two solid strands
    both = jnp.sum(gap**2) < (0.5 * jnp.min(diameter)) ** 2
    for one in fixed:
        both = both & one
    return both


def welded(scene: "Scene", index: int) -> bool:
    """Whether a joint holds the two ends of one of the rods together, frames and all."""
    return bool(closings(scene, index))


def closings(scene: "Scene", index: int) -> list[tuple[str, AbstractJoint, int]]:
    """The joints that do: name, joint, and 1 if its first point is at s = 0, else -1."""
    part, found = scene.rod.parts[index], []
    sense = {(part.first, part.last): 1, (part.last, part.first): -1}
    for i, joint in enumerate(scene.joints):
        places = joint.first.place(scene.rod.parts), joint.second.place(scene.rod.parts)
        if joint.rejoins and places in sense:
            found.append((f"joints[{i}]", joint, sense[places]))
    return found
