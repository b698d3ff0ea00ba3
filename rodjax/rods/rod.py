"""The rod: geometry at rest, section properties, and how they sit on nodes and elements.

Node i = 0..n carries a position and a cross-section frame; element i between the nodes i and
i + 1 carries the strains. Section properties are constant within an element, so a jump of B(s)
at a node is exact.
"""

import dataclasses
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rodjax.inputs.argument_types import AnyArray, Number, Vector
from rodjax.inputs.brief import named
from rodjax.inputs.user_functions import called
from rodjax.inputs.validation import (
    as_float,
    as_float_or_none,
    check_flag,
    check_instance,
    check_numbers,
    check_scalar,
    given,
    known,
    shown,
)
from rodjax.numerics import rotations
from rodjax.numerics.results import ModelWarning
from rodjax.rods import curves
from rodjax.rods.framing import (
    carried,
    direction_of,
    first_frame,
    grid,
    module_of,
    multiply,
    of_one_sign,
    shortest,
    vector,
)
from rodjax.rods.section import (
    COMPLIANCE,
    CURVATURE,
    INERTIA,
    STIFFNESS,
    Property,
    Section,
    Three,
    circular_section,
    components,
    sample,
)

__all__ = [
    "Property",
    "Rod",
    "Section",
    "build_rod",
    "circular_section",
    "curved_rod",
    "grid",
    "sample",
    "straight_rod",
]

# by these names scripts made placings of their own before there was `framing`
_frame, _shortest, _multiply = first_frame, shortest, multiply


def _as_frames(value) -> Any:
    """Known quaternions of frames as floating point numbers, of one sign along the rod."""
    frames = as_float(value)
    if not (known(frames) and np.ndim(frames) == 2):
        return frames
    given = np.asarray(frames)
    with np.errstate(all="ignore"):  # the check will refuse what is not finite
        signed = of_one_sign(given)
    return frames if np.array_equal(signed, given) else jnp.asarray(signed)


class Rod(eqx.Module):
    """A rod of n elements; every leaf is an array, per element unless said otherwise.

    Made by `straight_rod` and `curved_rod`. Units are free but must be consistent; the ones in
    brackets are SI. Components of the body frame are in the order a_1, a_2 (across the rod), a_3
    (along it).

    Attributes:
        position: (n+1, 3), nodes of the initial placing, inertial axes [m].
        quaternion: (n+1, 4), real part first: frames of the initial placing, body to inertial. An
            element's two are taken to be less than half a turn apart (q and -q are one frame).
        length: (n,), ds of the elements at rest [m].
        stiffness: (n, 3), A1, A2, C: bending about a_1 and a_2, torsion [N m^2].
        natural_curvature: (n, 3), kappa0 in the body frame: about a_1, a_2, and twist [1/m].
        mass: (n,), per length [kg/m]. None leaves all inertia out (drag then balances elasticity,
            as in Klapper 1996).
        rotary_inertia: (n, 3), moments of inertia per length about a_1, a_2, a_3 [kg m]. None
            leaves rotary inertia out.
        compliance: (n, 3), 1/GA1, 1/GA2, 1/EA: shear along a_1 and a_2, stretch [1/N]; zero where
            there is none. None is Kirchhoff's inextensible, unshearable rod.
        diameter: (n,) [m], needed by drag and contact only; or None.
        area: (n,), of the section [m^2], needed by buoyancy and added mass only; or None.
    """

    position: Float[Array, "nodes 3"] = eqx.field(converter=as_float)
    quaternion: Float[Array, "nodes 4"] = eqx.field(converter=_as_frames)
    length: Float[Array, " n"] = eqx.field(converter=as_float)
    stiffness: Float[Array, "n 3"] = eqx.field(converter=as_float)
    natural_curvature: Float[Array, "n 3"] = eqx.field(converter=as_float)
    mass: Float[Array, " n"] | None = eqx.field(converter=as_float_or_none)
    rotary_inertia: Float[Array, "n 3"] | None = eqx.field(converter=as_float_or_none)
    compliance: Float[Array, "n 3"] | None = eqx.field(converter=as_float_or_none)
    diameter: Float[Array, " n"] | None = eqx.field(converter=as_float_or_none)
    area: Float[Array, " n"] | None = eqx.field(converter=as_float_or_none)

    def __check_init__(self):
        check_numbers(length=self.length)
        if len(jnp.shape(self.length)) != 1:
            raise ValueError(f"length: give one a element, got {shown(self.length)}")
        n = self.elements
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
        }
        optional = ("mass", "rotary_inertia", "compliance", "diameter", "area")
        for name, shape in shapes.items():
            value = getattr(self, name)
            if value is None and name in optional:
                continue
            check_numbers(**{name: value})
            found: Any = value
            if tuple(jnp.shape(found)) != shape:
                raise ValueError(
                    f"{name}: expected shape {shape} for {n} elements, got {jnp.shape(found)}"
                )
            if found.dtype != self.position.dtype:
                raise ValueError(
                    f"{name}: must be of one precision with the position, {self.position.dtype};"
                    f" got {found.dtype}"
                )
            if known(value):
                _check_values(name, np.asarray(value))
        if self.mass is None and self.rotary_inertia is not None:
            raise ValueError(
                "rotary_inertia: a rod without mass has none; pass rotary_inertia=None"
            )
        self._check_slender()

    def _check_slender(self):
        if not (known(self.diameter) and known(self.length)):
            return
        thickest = float(np.max(np.asarray(self.diameter)))
        length = float(np.sum(np.asarray(self.length)))
        if thickest > 0.5 * length:
            warnings.warn(
                f"diameter: {thickest:g} is no small part of the length {length:g}, which is a rod"
                " no more; are both in one unit?",
                ModelWarning,
                stacklevel=2,
            )

    def __repr__(self) -> str:
        given = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        del given["position"], given["quaternion"], given["length"]
        if known(self.length) and self.length.ndim == 1:
            size = {"elements": self.elements, "length": np.sum(np.asarray(self.length))}
        else:
            size = {"length": self.length}
        return named("Rod", {**size, **given})

    @property
    def elements(self) -> int:
        """Number of elements n."""
        return self.length.shape[0]

    @property
    def node_length(self) -> Float[Array, " nodes"]:
        """Rest length that belongs to each node: half of each neighbouring element."""
        return self.to_nodes(jnp.ones_like(self.length))

    @property
    def arc_length(self) -> Float[Array, " nodes"]:
        """Rest arc length s of the nodes."""
        return jnp.concatenate([jnp.zeros_like(self.length[:1]), jnp.cumsum(self.length)])

    @property
    def midpoints(self) -> Float[Array, " n"]:
        """Rest arc length s of the element centres."""
        return self.arc_length[:-1] + 0.5 * self.length

    def to_nodes(self, density: Float[Array, "n *k"]) -> Float[Array, "nodes *k"]:
        """Lump a quantity per length to the nodes: half of each element's amount at either end."""
        weight = self.length.reshape((-1,) + (1,) * (density.ndim - 1))
        half = 0.5 * weight * density
        zero = jnp.zeros_like(half[:1])
        return jnp.concatenate([half, zero]) + jnp.concatenate([zero, half])


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


def straight_rod(
    length: Number | AnyArray,
    elements: int,
    section: Section | Callable[[np.ndarray], Section],
    *,
    direction: Vector = (0.0, 0.0, 1.0),
    first_director: Vector | None = None,
    origin: Vector = (0.0, 0.0, 0.0),
    natural_curvature: Three = (0.0, 0.0, 0.0),
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
        jumps: arc lengths at which properties jump [m]; they become nodes.
    """
    nodes = grid(length, elements, jumps)
    tangent = direction_of(direction, "direction")
    frame = first_frame(tangent, first_director)
    position = vector(origin, "origin")[None] + nodes[:, None] * tangent[None]
    quaternion = module_of(frame).broadcast_to(frame, (len(nodes), 4))
    return build_rod(nodes, position, quaternion, section, natural_curvature)


def curved_rod(
    curve: Callable[[Array], Array] | Sequence | AnyArray,
    length: Number | AnyArray | None,
    elements: int,
    section: Section | Callable[[np.ndarray], Section],
    *,
    first_director: Vector | None = None,
    stress_free: bool = True,
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
        jumps: arc lengths at which properties jump [m]; they become nodes.

    The nodes are put at distances ds along the frames, R_{i+1} = R_i + ds a_3, so the discrete
    rod starts exactly unstretched; it follows the curve to second order in ds.
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
    return build_rod(nodes, position, quaternion, section, tuple(jnp.moveaxis(natural, 1, 0)))


def build_rod(
    nodes: AnyArray,
    position: AnyArray,
    quaternion: AnyArray,
    section: Section | Callable[[np.ndarray], Section],
    natural_curvature: Three,
) -> Rod:
    """A `Rod` from node arc lengths, a placing and a section; the other builders end here."""
    midpoints = 0.5 * (nodes[1:] + nodes[:-1])
    chosen: Any = section
    if callable(section) and not isinstance(section, type):
        chosen = called("section", section, midpoints)
    check_instance(Section, "give a Section, or circular_section(...)", section=chosen)
    default = lambda a: jnp.asarray(a, jnp.result_type(float))
    one = lambda value, name: sample(value, midpoints, name)
    ones = given(mass=chosen.mass, diameter=chosen.diameter, area=chosen.area)
    triples = {
        "stiffness": (chosen.stiffness, STIFFNESS),
        "natural_curvature": (natural_curvature, CURVATURE),
        "rotary_inertia": (chosen.rotary_inertia, INERTIA),
        "compliance": (chosen.compliance, COMPLIANCE),
    }
    fields: dict[str, Any] = dict.fromkeys(("mass", "diameter", "area", *triples))
    fields |= {name: one(value, name) for name, value in ones.items()}
    for name, (value, meaning) in triples.items():
        if value is not None or name in ("stiffness", "natural_curvature"):
            fields[name] = components(value, midpoints, name, meaning)
    return Rod(
        position=default(position),
        quaternion=default(quaternion),
        length=default(nodes[1:] - nodes[:-1]),
        **fields,
    )
