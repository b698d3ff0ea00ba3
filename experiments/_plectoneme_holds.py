"""What is measured at the end of a hold of `plectoneme.py`: the clamps, and the ply."""

from typing import Any, NamedTuple

import numpy as np
from _plectoneme_scene import AXIS, LENGTH, RADIUS
from _plectoneme_strands import middle, touching
from _plectoneme_theory import Theory, angle_of, closed_form, ratios

import rodjax as rx
from rodjax import energy
from rodjax.measuring.reactions import reactions

OTHER_ANGLES = ("between_lines", "between_normals")


class At(NamedTuple):
    """What is measured at the end of a hold; `ply` is None where strands hardly touch."""

    turns: float
    torque: float
    torque_of_other_clamp: float
    tension: float
    kinetic_over_strain: float
    ply: dict[str, Any] | None


def ply_of(whole: rx.Scene, state, torque: float, tension: float) -> dict[str, Any] | None:
    """The ply of a state at rest, beside the theory."""
    strands = touching(whole.rod, state)
    inner = middle(strands)
    if inner is None:
        return None
    stiffness, step = float(whole.rod.stiffness[0, 0]), LENGTH / whole.rod.elements
    radius, angle = 0.5 * float(np.mean(inner.distance)), float(np.mean(inner.angle))
    force = np.linalg.norm(energy.contact_wrench(whole, state)[:, :3], axis=1)
    pressure = float(np.mean((force / np.asarray(whole.rod.node_length))[inner.node]))
    found = Theory(torque, tension, pressure)
    contour = 2 * step * float(strands.node[-1] - strands.node[0])  # one of two strands is listed
    others = {name: float(np.mean(getattr(inner, name))) for name in OTHER_ANGLES}
    # the radius and the torque alone, whatever the angle
    expected = angle_of(stiffness, radius, torque)
    return {
        "contour": contour,
        "crossings": float(np.sin(angle) * contour / (2 * np.pi * radius)),
        "radius": radius,
        "radius_deviation": 0.5 * float(np.std(inner.distance)),
        "radius_over_rods": radius / RADIUS,
        "angle_degrees": float(np.degrees(angle)),
        "angle_deviation_degrees": float(np.degrees(np.std(inner.angle))),
        "other_angles_degrees": {name: float(np.degrees(v)) for name, v in others.items()},
        "pressure": pressure,
        "theory": closed_form(stiffness, radius, angle)._asdict(),
        "ratio": ratios(found, closed_form(stiffness, radius, angle)),
        "ratio_by_other_angles": {
            name: ratios(found, closed_form(stiffness, radius, v)) for name, v in others.items()
        },
        "angle_of_radius_and_torque_degrees": float(np.degrees(expected)),
        "ratio_by_radius_and_torque": ratios(found, closed_form(stiffness, radius, expected)),
    }


def at_hold(whole: rx.Scene, state, turns: float) -> At:
    """The clamps and the ply of a state at rest."""
    held = reactions(whole, state)
    first, last = (float(moment @ np.array(AXIS)) for moment in held.torque)
    tension = float(held.force[1] @ np.array(AXIS))
    motion = energy.kinetic_energy(whole, state) / (
        energy.bending_energy(whole, state) + energy.torsion_energy(whole, state)
    )
    ply = ply_of(whole, state, -first, tension)
    return At(turns, -first, last, tension, float(motion), ply)


def printed(found: list[At]) -> None:
    """A table of the holds."""
    print(
        f"{'turns':>5} {'M [mN m]':>9} {'T [mN]':>8} {'crossings':>9} {'R/(D/2)':>8} {'theta':>7}"
        f" {'lines':>7} {'normals':>7} {'of R, M':>7}  {'M':>6} {'T':>6} {'p':>6} over theory"
    )
    for at in found:
        row = f"{at.turns:5g} {1e3 * at.torque:9.5f} {1e3 * at.tension:8.3f}"
        if at.ply is not None:
            ply = at.ply
            angles = (ply["angle_degrees"], *ply["other_angles_degrees"].values())
            angles += (ply["angle_of_radius_and_torque_degrees"],)
            row += f" {ply['crossings']:9.2f} {ply['radius_over_rods']:8.4f}"
            row += "".join(f" {v:7.3f}" for v in angles) + " "
            row += "".join(f" {v:6.4f}" for v in ply["ratio"].values())
        print(row)
