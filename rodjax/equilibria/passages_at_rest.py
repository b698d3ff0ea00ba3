"""What a rod passed along a path of equilibria, that its balance alone does not tell."""

from collections.abc import Callable

from jaxtyping import Array, Float, Int

from rodjax.interactions.interaction import as_seen
from rodjax.scenes.scene import Scene

Positions = Float[Array, "nodes 3"]
At = tuple[Scene, Float[Array, ""]]


def passages(
    then: Callable[[], At], now: At, before: Positions, after: Positions
) -> list[Int[Array, ""]]:
    """Codes of what acts on the rod for a step between these positions; none where none looks.

    Args:
        then, now: the scene and when its schedules are evaluated, before and after. What was is
            asked for only where something moves itself.
    """
    scene, time = now
    moving = any(one.displaced(time) is not None for one in scene.loads)
    earlier, since = then() if moving else now
    codes = []
    for was, one in zip(earlier.loads, scene.loads, strict=True):
        began = as_seen(one, time, before, since, was)
        codes.append(one.held_at(time).path_verdict(scene.rod, began, after))
    return [code for code in codes if code is not None]
