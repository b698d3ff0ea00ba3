"""What a rod passed along a path of equilibria, that its balance alone does not tell."""

from jaxtyping import Array, Float, Int

from rodjax.scenes.scene import Scene

Positions = Float[Array, "nodes 3"]


def passages(
    scene: Scene, time: Float[Array, ""], before: Positions, after: Positions
) -> list[Int[Array, ""]]:
    """Codes of what acts on the rod for a step between these positions; none where none looks."""
    held = (one.held_at(time) for one in scene.loads)
    codes = (one.path_verdict(scene.rod, before, after) for one in held)
    return [code for code in codes if code is not None]
