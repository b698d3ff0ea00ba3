"""What a rod passed along a path of equilibria, that its balance alone does not tell."""

from jaxtyping import Array, Float, Int

from rodjax.interactions.interaction import as_seen
from rodjax.scenes.scene import Scene

Positions = Float[Array, "nodes 3"]


At = tuple[Scene, Float[Array, ""]]


def passages(then: At, now: At, before: Positions, after: Positions) -> list[Int[Array, ""]]:
    """Codes of what acts on the rod for a step between these positions; none where none looks.

    Args:
        then, now: the scene and when its schedules are evaluated, before and after.
    """
    (earlier, since), (scene, time) = then, now
    codes = []
    for was, one in zip(earlier.loads, scene.loads, strict=True):
        began = as_seen(one, time, before, since, was)
        codes.append(one.held_at(time).path_verdict(scene.rod, began, after))
    return [code for code in codes if code is not None]
