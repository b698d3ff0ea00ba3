"""A rod in a few lines: how long, how stiff, how heavy."""

from typing import TYPE_CHECKING

import numpy as np

from rodjax.inputs.sheets import Sheet, quantity, told
from rodjax.inputs.units import used
from rodjax.inputs.validation import known

if TYPE_CHECKING:
    from rodjax.rods.rod import Rod


def sheet_of_rod(rod: "Rod") -> Sheet:
    """Of a rod, or of several laid end to end; of one that is traced its shapes."""
    if not known(rod.length) or np.ndim(rod.length) != 1:
        return Sheet(repr(rod))
    u, rows = used(), []
    lengths = [np.sum(np.asarray(rod.length)[part.elements]) for part in rod.strands]
    counts = [part.last - part.first for part in rod.strands]
    said = ", ".join(quantity(np.asarray(length), u.length) for length in lengths[:4])
    title = (
        f"a rod of {counts[0]} elements, {said} long"
        if len(counts) == 1
        else f"{len(counts)} rods of {', '.join(map(str, counts[:4]))}"
        f"{', ...' if len(counts) > 4 else ''} elements, {said} long"
    )
    of_elements = {
        "bending stiffness A1": (rod.stiffness, 0, f"{u.force} {u.length}^2"),
        "bending stiffness A2": (rod.stiffness, 1, f"{u.force} {u.length}^2"),
        "torsional stiffness C": (rod.stiffness, 2, f"{u.force} {u.length}^2"),
        "mass": (rod.mass, None, f"{u.mass}/{u.length}"),
        "diameter": (rod.diameter, None, u.length),
        "compliance 1/EA": (rod.compliance, 2, f"1/{u.force}"),
        "torque per tension": (rod.torque_per_tension, None, u.length),
    }
    for name, (values, column, unit) in of_elements.items():
        if values is None:
            continue
        if not known(values):
            rows.append((name, quantity(values, unit)))
            continue
        own = np.delete(np.asarray(values), list(rod.breaks), 0)
        own = own if column is None else own[:, column]
        if np.any(own) or name != "compliance 1/EA":
            rows.append((name, quantity(own, unit)))
    if rod.mass is None:
        rows.append(("mass", "none: no inertia"))
    if known(rod.natural_curvature):
        own = np.delete(np.asarray(rod.natural_curvature), list(rod.breaks), 0)
        bend = np.linalg.norm(own[:, :2], axis=1)
        for name, values in (("natural curvature", bend), ("natural twist", own[:, 2])):
            if np.any(values):
                rows.append((name, quantity(values, f"rad/{u.length}")))
    for name in ("material", "actuation"):
        if getattr(rod, name) is not None:
            rows.append((name, told(getattr(rod, name))))
    if rod.bodies:
        rows.append(("bodies", str(len(rod.bodies))))
    if len(rod.lumps) > len(rod.bodies):
        rows.append(("lumps", str(len(rod.lumps) - len(rod.bodies))))
    return Sheet(title, tuple(rows))
