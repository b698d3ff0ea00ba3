"""Rods straight or along a curve, from a section and what their shape at rest is."""

from collections.abc import Callable, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from rodjax.inputs.argument_types import AnyArray, Number, Vector
from rodjax.inputs.schedules import AbstractSchedule
from rodjax.inputs.user_functions import called
from rodjax.inputs.validation import (
    as_float,
    check_flag,
    check_instance,
    check_scalar,
    given,
    known,
)
from rodjax.numerics import rotations
from rodjax.rods import curves
from rodjax.rods.framing import (
    carried,
    direction_of,
    first_frame,
    grid,
    module_of,
    vector,
)
from rodjax.rods.rod import Rod
from rodjax.rods.section import (
    COMPLIANCE,
    COUPLING,
    CURVATURE,
    INERTIA,
    STIFFNESS,
    Section,
    Three,
    as_matrices,
    components,
    diagonal_and_coupling,
    sample,
)


def straight_rod(
    length: Number | AnyArray,
    elements: int,
    section: Section | Callable[[np.ndarray], Section],
    *,
    direction: Vector = (0.0, 0.0, 1.0),
    first_director: Vector | None = None,
    origin: Vector = (0.0, 0.0, 0.0),
    natural_curvature: Three = (0.0, 0.0, 0.0),
    actuation: AbstractSchedule | None = None,
    jumps: Sequence[Number] = (),
) -> Rod:
    """A rod placed straight along `direction`, its node s = 0 at `origin`.

    Lengths, vectors and properties may be traced (a length only without jumps).

    Args:
        length: L at rest [m].
        elements: n, at least 2.
        section: a `Section`, or a function of arc lengths such as `circular_section` returns.
        direction: of the rod, from s = 0 on, inertial axes; of any length.
        first_director: a_1 points this way, as far as it is across the rod; any normal by default.
        origin: node s = 0 [m].
        natural_curvature: kappa0 in the body frame [1/m]: about a_1, about a_2, and twist; each a
            number, one value an element or a function of s, or all as an array (n, 3). A rod with
            kappa0 != 0 is straight in this placing but not at rest. (A uniform one does not start
            the buckling of a rod between two clamps: see `imperfect`.)
        actuation: schedule of what is added to kappa0 in time, as tendons, pneumatics or swelling
            do: three components, or a row an element (n, 3) [1/m].
        jumps: arc lengths at which properties jump [m]; they become nodes.

    Example:
        >>> rod = rx.straight_rod(2.0, 40, section, direction=(1, 0, 0), origin=(0, 0, 5))
        >>> rod.position[-1]
        Array([2., 0., 5.], dtype=float64)
    """
    nodes = grid(length, elements, jumps)
    tangent = direction_of(direction, "direction")
    frame = first_frame(tangent, first_director)
    position = vector(origin, "origin")[None] + nodes[:, None] * tangent[None]
    quaternion = module_of(frame).broadcast_to(frame, (len(nodes), 4))
    return build_rod(nodes, position, quaternion, section, natural_curvature, actuation)


def curved_rod(
    curve: Callable[[Array], Array] | Sequence | AnyArray,
    length: Number | AnyArray | None,
    elements: int,
    section: Section | Callable[[np.ndarray], Section],
    *,
    first_director: Vector | None = None,
    stress_free: bool = True,
    actuation: AbstractSchedule | None = None,
    jumps: Sequence[Number] = (),
) -> Rod:
    """A rod placed along a space curve.

    Lengths, curves, points and properties may be traced (a curve that is, or whose length is,
    must be written with jax.numpy).

    Args:
        curve: position (3,) as a function of arc length s [m], |dcurve/ds| = 1 to 1 %; or points
            (k, 3) through which a smooth curve is laid and measured [m].
        length: L at rest [m]; None for the length of the curve through points, from which a given
            one may differ by 1 %.
        elements: n, at least 2.
        section: a `Section`, or a function of arc lengths such as `circular_section` returns.
        first_director: a_1 at s = 0, as far as it is across the rod; the frames are carried along
            without twist from it.
        stress_free: if true kappa0 is the curvature of this placing, so that it is at rest;
            otherwise kappa0 = 0 and the placing is a bent state of a straight rod.
        actuation: see `straight_rod`.
        jumps: arc lengths at which properties jump [m]; they become nodes.

    The nodes are put at distances ds along the frames, R_{i+1} = R_i + ds a_3, so the discrete
    rod starts exactly unstretched; it follows the curve to second order in ds.

    Example:
        >>> helix = lambda s: jnp.stack([0.1 * jnp.cos(8 * s), 0.1 * jnp.sin(8 * s), 0.6 * s], -1)
        >>> coil = rx.curved_rod(helix, 1.0, 40, section)
        >>> coil.natural_curvature.shape  # it is at rest as it is placed
        (40, 3)
    """
    check_flag(stress_free=stress_free)
    if callable(curve) and not isinstance(curve, type):
        at = lambda s: curves.along(curve, s)
    else:
        along, measured = curves.through(curve, length)
        wanted: Any = measured if length is None else length
        check_scalar(length=wanted)
        if known(as_float(wanted)) and known(measured) and abs(wanted / measured - 1) > 0.01:
            raise ValueError(
                f"length: the curve through the points is {float(measured):.6g} long, not"
                f" {float(wanted):.6g}; give length=None for its own"
            )
        length = wanted

        def at(s):
            positions, slopes = along(s * (measured / wanted))
            return positions[0], slopes

    total: Any = length
    nodes = grid(total, elements, jumps)
    ds = nodes[1:] - nodes[:-1]
    begin, slopes = at(nodes)
    xp = module_of(slopes)
    speed = xp.sqrt(xp.sum(slopes**2, 1))
    if known(speed) and not np.all(np.abs(speed - 1) <= 0.01):
        raise ValueError(
            "curve: must be parametrised by arc length; |d curve/ds| ranges over"
            f" [{np.min(speed):.4g}, {np.max(speed):.4g}]; where it has another parameter give its"
            " points (k, 3) instead, which are measured"
        )
    tangents = slopes / speed[:, None]
    if known(tangents) and np.any(np.sum(tangents[1:] * tangents[:-1], 1) < -0.9):
        raise ValueError("curve: turns back from node to node; use more elements")
    quaternion = carried(tangents, first_frame(tangents[0], first_director))
    # element frames halfway between the nodes', and nodes placed along them
    halfway = quaternion[:-1] + quaternion[1:]
    halfway = halfway / xp.sqrt(xp.sum(halfway**2, 1, keepdims=True))
    edges = rotations.tangent_director(jnp.asarray(halfway))
    xp = module_of(edges, ds, begin)
    edges = ds[:, None] * (np.asarray(edges) if xp is np else edges)
    position = begin[None] + xp.concatenate([xp.zeros((1, 3)), xp.cumsum(edges, 0)])
    before, after = jnp.asarray(quaternion[:-1]), jnp.asarray(quaternion[1:])
    relative = rotations.multiply(rotations.conjugate(before), after)
    curvature = rotations.logarithm(relative) / ds[:, None]
    natural = curvature if stress_free else jnp.zeros_like(curvature)
    natural = tuple(jnp.moveaxis(natural, 1, 0))
    return build_rod(nodes, position, quaternion, section, natural, actuation)


def build_rod(
    nodes: AnyArray,
    position: AnyArray,
    quaternion: AnyArray,
    section: Section | Callable[[np.ndarray], Section],
    natural_curvature: Three,
    actuation: AbstractSchedule | None = None,
) -> Rod:
    """A `Rod` from node arc lengths, a placing and a section; the other builders end here."""
    midpoints = 0.5 * (nodes[1:] + nodes[:-1])
    chosen: Any = section
    if callable(section) and not isinstance(section, type):
        chosen = called("section", section, midpoints)
    check_instance(Section, "give a Section, or circular_section(...)", section=chosen)
    default = lambda a: jnp.asarray(a, jnp.result_type(float))
    one = lambda value, name: sample(value, midpoints, name)
    single = ("mass", "diameter", "area", "torque_per_tension")
    ones = given(**{name: getattr(chosen, name) for name in single})
    stiffness, coupling = chosen.stiffness, chosen.coupling
    matrices = as_matrices(stiffness)
    if matrices is not None and (matrices.ndim == 3 or len(midpoints) != 3):
        stiffness, coupling = diagonal_and_coupling(matrices, len(midpoints))
    triples = {
        "stiffness": (stiffness, STIFFNESS),
        "coupling": (coupling, COUPLING),
        "natural_curvature": (natural_curvature, CURVATURE),
        "rotary_inertia": (chosen.rotary_inertia, INERTIA),
        "compliance": (chosen.compliance, COMPLIANCE),
    }
    fields: dict[str, Any] = dict.fromkeys((*single, *triples))
    fields |= {name: one(value, name) for name, value in ones.items()}
    for name, (value, meaning) in triples.items():
        if value is not None or name in ("stiffness", "natural_curvature"):
            fields[name] = components(value, midpoints, name, meaning)
    return Rod(
        position=default(position),
        quaternion=default(quaternion),
        length=default(nodes[1:] - nodes[:-1]),
        material=chosen.material,
        actuation=actuation,
        **fields,
    )
