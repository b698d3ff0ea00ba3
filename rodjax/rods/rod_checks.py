"""What a rod is refused for, when it is made."""

import itertools
import warnings
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from rodjax.inputs.schedules import AbstractSchedule
from rodjax.inputs.user_functions import returned
from rodjax.inputs.validation import check_instance, check_numbers, known, shown
from rodjax.numerics.results import ModelWarning
from rodjax.rods.lump import Lump
from rodjax.rods.material import AbstractMaterial, stiffness_matrix

if TYPE_CHECKING:
    from rodjax.rods.rod import Rod


def check_fields(rod: "Rod") -> None:
    """Raise ValueError where a field has another shape or precision, or values that cannot be."""
    check_numbers(length=rod.length)
    if len(jnp.shape(rod.length)) != 1:
        raise ValueError(f"length: give one a element, got {shown(rod.length)}")
    n = rod.elements
    if n < 2:
        raise ValueError(f"elements: a rod needs at least 2 (a length each), got {n}")
    shapes = {
        "position": (n + 1, 3),
        "quaternion": (n + 1, 4),
        "length": (n,),
        "stiffness": (n, 3),
        "natural_curvature": (n, 3),
        "mass": (n,),
        "rotary_inertia": (n, 3),
        "compliance": (n, 3),
        "diameter": (n,),
        "area": (n,),
        "coupling": (n, 3),
        "torque_per_tension": (n,),
    }
    optional = ("mass", "rotary_inertia", "compliance", "diameter", "area", "coupling")
    optional += ("torque_per_tension",)
    for name, shape in shapes.items():
        value = getattr(rod, name)
        if value is None and name in optional:
            continue
        check_numbers(**{name: value})
        found: Any = value
        if tuple(jnp.shape(found)) != shape:
            raise ValueError(
                f"{name}: expected shape {shape} for {n} elements, got {jnp.shape(found)}"
            )
        if found.dtype != rod.position.dtype:
            raise ValueError(
                f"{name}: must be of one precision with the position, {rod.position.dtype};"
                f" got {found.dtype}"
            )
        if known(value):
            _check_values(name, np.delete(np.asarray(value), _left_out(rod, name), 0))
    if rod.mass is None and rod.rotary_inertia is not None:
        raise ValueError("rotary_inertia: a rod without mass has none; pass rotary_inertia=None")


def _left_out(rod: "Rod", name: str) -> list[int]:
    """The rows that are not checked, of elements that are none."""
    return [] if name in ("position", "quaternion") else list(rod.breaks)


def _check_values(name, value):
    if not np.all(np.isfinite(value)):
        raise ValueError(f"{name}: must be finite everywhere")
    if name in ("length", "stiffness", "mass", "diameter", "area") and np.any(value <= 0):
        raise ValueError(
            f"{name}: must be positive in every element"
            + ("; for a rod without inertia pass mass=None" if name == "mass" else "")
        )
    if name in ("rotary_inertia", "compliance") and np.any(value < 0):
        raise ValueError(f"{name}: must not be negative; pass None to leave it out")
    if name == "quaternion" and np.any(abs(np.linalg.norm(value, axis=1) - 1) > 1e-3):
        raise ValueError("quaternion: must have unit length at every node")


def check_breaks(rod: "Rod") -> None:
    """Raise ValueError where breaks leave a rod too short, or are elements all the same."""
    if not isinstance(rod.breaks, tuple):
        raise ValueError(f"breaks: give a tuple of element numbers, got {rod.breaks!r}")
    edges = (-1, *rod.breaks, rod.elements)
    counts = [after - before - 1 for before, after in itertools.pairwise(edges)]
    strands = counts[: len(counts) - len(rod.bodies)]
    if any(count < 2 for count in strands) or not strands:
        raise ValueError(
            f"breaks: every rod needs at least 2 elements, got {rod.breaks} of {rod.elements}"
        )
    heavy = {lump.rod for lump in rod.lumps if lump.inertia is not None}
    if any(i not in heavy for i in range(len(strands), len(counts))):
        raise ValueError("lumps: a body by itself needs one with mass and moments of inertia")
    index = list(rod.breaks)
    for name, value in (("length", rod.length), ("stiffness", rod.stiffness)):
        if index and known(value) and np.any(np.asarray(value)[index] != 0):
            raise ValueError(f"{name}: must be zero in {rod.breaks}, which are no elements")


def check_lumps(rod: "Rod") -> None:
    """Raise ValueError where a lump is at no node, or the rod cannot carry it."""
    if not isinstance(rod.lumps, tuple):
        raise ValueError("lumps: give a tuple, for one lump (lump,)")
    mend = "give a lump such as Lump(-1, 0.5), half a kilogram at the last node"
    check_instance(Lump, mend, **{f"lumps[{i}]": lump for i, lump in enumerate(rod.lumps)})
    for i, lump in enumerate(rod.lumps):
        name = f"lumps[{i}]"
        if lump.rod >= len(rod.parts):
            raise ValueError(
                f"{name}: rod: the scene's rods are 0 to {len(rod.parts) - 1}, got {lump.rod}"
            )
        part = rod.parts[lump.rod]
        node, last = lump.place(rod.parts), part.last - part.first
        if not part.first <= node <= part.last:
            raise ValueError(
                f"{name}: node: a rod of {last} elements has the nodes 0 to {last}, or"
                f" {-last - 1} to -1, got {lump.node}"
            )
        if rod.mass is None:
            raise ValueError(
                f"{name}: a rod with mass=None has no inertia; give its section a mass"
                " (density), or push by a PointLoad for the weight alone"
            )
        if lump.offset is not None and lump.inertia is None and rod.rotary_inertia is None:
            raise ValueError(
                f"{name}: inertia: about the line to its offset nothing would have inertia;"
                " give the lump its moments, or the rod's section rotary inertia"
                " (circular_section(rotary_inertia=True))"
            )


def check_slender(rod: "Rod") -> None:
    """ModelWarning where a rod is so thick that it is none."""
    if not (known(rod.diameter) and known(rod.length)):
        return
    thickest = float(np.max(np.asarray(rod.diameter)))
    length = float(np.sum(np.asarray(rod.length)))
    if thickest > 0.5 * length:
        warnings.warn(
            f"diameter: {thickest:g} is no small part of the length {length:g}, which is a rod"
            " no more; are both in one unit?",
            ModelWarning,
            stacklevel=2,
        )


def check_positive_definite(rod: "Rod") -> None:
    """Raise ValueError where an element's stiffness is not positive definite.

    With coupling; without it positive entries are enough.
    """
    if rod.coupling is None or not (known(rod.coupling) and known(rod.stiffness)):
        return
    with jax.ensure_compile_time_eval():
        matrices = np.asarray(stiffness_matrix(rod.stiffness, rod.coupling))
        matrices = rod.solid(matrices)
    least = np.linalg.eigvalsh(matrices)[:, 0]
    if not np.all(least > 0):
        i = int(np.argmin(least))
        raise ValueError(
            "stiffness: must be positive definite in every element, but with its coupling"
            f" element {i} has the eigenvalue {least[i]:.3g}: it would bend by itself; lessen"
            " the entries off the diagonal (each square below the product of its two diagonal"
            " ones, at least)"
        )


def check_material(rod: "Rod") -> None:
    """Raise ValueError where material or actuation is none, or does not go with the rod."""
    if rod.material is not None:
        mend = "give a material such as KelvinVoigt(1e-3), or None for a linear rod"
        check_instance(AbstractMaterial, mend, material=rod.material)
        rod.material.check(rod.stiffness, rod.coupling, rod.compliance, rod.mass)
    if rod.actuation is None:
        return
    mend = "give a schedule of what is added to kappa0, as Smooth(times, values)"
    check_instance(AbstractSchedule, mend, actuation=rod.actuation)
    time = jax.ShapeDtypeStruct((), jnp.result_type(float))
    driven: Any = rod.actuation
    found = returned("actuation", driven, time).shape
    if found not in ((3,), (rod.elements, 3)):
        raise ValueError(
            "actuation: the schedule must give three components, about a_1, about a_2 and"
            f" twist, or {(rod.elements, 3)}, a row an element; got shape {found}"
        )
