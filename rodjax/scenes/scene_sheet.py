"""A scene in a few lines: the rods, what holds them, what acts on them."""

from typing import TYPE_CHECKING

from rodjax.inputs.sheets import Sheet, told
from rodjax.inputs.validation import known
from rodjax.rods.rod_sheet import sheet_of_rod

if TYPE_CHECKING:
    from rodjax.scenes.scene import Scene


def sheet_of_scene(scene: "Scene") -> Sheet:
    """Of what is traced the shapes."""
    if not known(scene.rod.length) or scene.rod.length.ndim != 1:
        return Sheet(repr(scene))
    title, rows = sheet_of_rod(scene.rod)
    held = [(one.name.replace("_", " "), told(one.end)) for one in scene.holds]
    nodes = zip(scene.holds, held, strict=True)
    held = [
        (name, f"{said} at node {one.node}" if name.startswith("supports") else said)
        for one, (name, said) in nodes
    ]
    acting = [(f"loads[{i}]", told(load)) for i, load in enumerate(scene.loads)]
    if scene.contact is not None:
        acting.append(("contact", told(scene.contact)))
    joined = [(f"joints[{i}]", told(joint)) for i, joint in enumerate(scene.joints)]
    return Sheet(f"Scene of {title}", (*rows, *held, *acting, *joined))
