"""The rod: geometry at rest, section properties, and how they sit on nodes and elements.

Node i = 0..n carries a position and a cross-section frame; element i between the nodes i and
i + 1 carries the strains. Section properties are constant within an element, so a jump of B(s)
at a node is exact.
"""

import dataclasses
from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rodjax import rotations
from rodjax.brief import named

Number = float | int
Vector = Sequence[Number] | np.ndarray | Array
Property = Number | np.ndarray | Array | Callable[[np.ndarray], np.ndarray]


class Rod(eqx.Module):
    """A rod of n elements; every leaf is an array, per element unless said otherwise.

    Units are free but must be consistent; the ones in brackets are SI.
    `rotary_inertia = None` leaves rotary inertia out, `mass = None` leaves all inertia out (drag
    then balances elasticity, as in Klapper 1996), `compliance = None` is Kirchhoff's
    inextensible, unshearable rod. `diameter` is needed by drag and contact only, `area` by
    buoyancy and added mass.
    """

    position: Float[Array, "nodes 3"]  # nodes of the initial placing [m]
    quaternion: Float[Array, "nodes 4"]  # frames of the initial placing
    length: Float[Array, " n"]  # ds at rest [m]
    stiffness: Float[Array, "n 3"]  # A1, A2, C [N m^2]
    natural_curvature: Float[Array, "n 3"]  # kappa0 in the body frame [1/m]
    mass: Float[Array, " n"] | None  # per length [kg/m]
    rotary_inertia: Float[Array, "n 3"] | None  # per length [kg m]
    compliance: Float[Array, "n 3"] | None  # 1/GA1, 1/GA2, 1/EA [1/N]
    diameter: Float[Array, " n"] | None  # [m]
    area: Float[Array, " n"] | None  # [m^2]

    def __check_init__(self):
        if isinstance(self.position, jax.core.Tracer) or not hasattr(self.position, "shape"):
            return
        n = self.length.shape[-1]
        if n < 2:
            raise ValueError(f"elements: a rod needs at least 2, got {n}")
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
        for name, shape in shapes.items():
            value = getattr(self, name)
            if value is None:
                continue
            if tuple(value.shape) != shape:
                raise ValueError(
                    f"{name}: expected shape {shape} for {n} elements, got {value.shape}"
                )
            if isinstance(value, jax.core.Tracer):
                continue
            if not np.all(np.isfinite(value)):
                raise ValueError(f"{name}: must be finite everywhere")
            if name in ("length", "stiffness", "mass", "diameter", "area") and np.any(
                np.asarray(value) <= 0
            ):
                raise ValueError(
                    f"{name}: must be positive in every element"
                    + ("; for a rod without inertia pass mass=None" if name == "mass" else "")
                )
            if name in ("rotary_inertia", "compliance") and np.any(np.asarray(value) < 0):
                raise ValueError(f"{name}: must not be negative; pass None to leave it out")
            if name == "quaternion" and np.any(abs(np.linalg.norm(value, axis=1) - 1) > 1e-3):
                raise ValueError("quaternion: must have unit length at every node")
        if self.mass is None and self.rotary_inertia is not None:
            raise ValueError(
                "rotary_inertia: a rod without mass has none; pass rotary_inertia=None"
            )

    def __repr__(self) -> str:
        given = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        del given["position"], given["quaternion"], given["length"]
        known = isinstance(self.length, jax.Array | np.ndarray)
        if known and not isinstance(self.length, jax.core.Tracer) and self.length.ndim == 1:
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


class Section(eqx.Module):
    """Section properties as functions of s, arrays per element, or constants (see `Rod`)."""

    stiffness: Sequence[Property]  # A1, A2, C
    mass: Property | None = None
    rotary_inertia: Sequence[Property] | None = None
    compliance: Sequence[Property] | None = None
    diameter: Property | None = None
    area: Property | None = None


def sample(value: Property, midpoints: np.ndarray, name: str) -> Array:
    """Values per element of a constant, an array or a function of s (taken at the centres)."""
    result = jnp.asarray(value(midpoints) if callable(value) else value)
    result = result.astype(jnp.result_type(float))
    if result.ndim == 0:
        return jnp.broadcast_to(result, midpoints.shape)
    if result.shape != midpoints.shape:
        raise ValueError(
            f"{name}: give a number, a function of s, or {midpoints.size} values (one an element);"
            f" got shape {result.shape}"
        )
    return result


def circular_section(
    diameter: Property,
    youngs_modulus: Number | Array,
    shear_modulus: Number | Array,
    density: Number | Array | None,
    *,
    rotary_inertia: bool = True,
    extensible: bool = False,
    shear_factor: Number = 1.0,
) -> Callable[[np.ndarray], Section]:
    """Solid circular section: A_c = pi D^2/4, A1 = A2 = E A_c D^2/16, C = G A_c D^2/8.

    Arguments: diameter D [m] (number, per element, or function of s); E, G [Pa]; density
    [kg/m^3] or None for a rod without inertia; `rotary_inertia=False` leaves I = rho J out;
    `extensible=True` adds the axial and shear compliances 1/(E A_c) and 1/(k G A_c), k the
    `shear_factor`. Source: Table 1 of Goyal, Perkins & Lee.
    """
    _check_positive(
        youngs_modulus=youngs_modulus, shear_modulus=shear_modulus, shear_factor=shear_factor
    )
    if density is not None:
        _check_positive(density=density)

    def at(midpoints: np.ndarray) -> Section:
        d = sample(diameter, midpoints, "diameter")
        _check_positive(diameter=d)
        area = jnp.pi * d**2 / 4
        bend = area * d**2 / 16
        inertia = None if density is None or not rotary_inertia else density * bend
        shear = 1 / (shear_factor * shear_modulus * area)
        return Section(
            stiffness=(youngs_modulus * bend, youngs_modulus * bend, 2 * shear_modulus * bend),
            mass=None if density is None else density * area,
            rotary_inertia=None if inertia is None else (inertia, inertia, 2 * inertia),
            compliance=(shear, shear, 1 / (youngs_modulus * area)) if extensible else None,
            diameter=d,
            area=area,
        )

    return at


def _check_positive(**values):
    for name, value in values.items():
        if isinstance(value, jax.core.Tracer):
            continue
        if not (np.all(np.asarray(value) > 0) and np.all(np.isfinite(value))):
            raise ValueError(f"{name}: must be positive and finite, got {value}")


def _vector(value: Vector, name: str) -> np.ndarray:
    vector = np.asarray(value, float)
    if vector.shape != (3,) or not np.all(np.isfinite(vector)):
        raise ValueError(f"{name}: must have three finite components, got {value}")
    return vector


def grid(length: Number, elements: int, jumps: Sequence[Number] = ()) -> np.ndarray:
    """Arc lengths of the nodes, equally spaced between the given `jumps` of the properties.

    Every jump becomes a node, so that no element straddles it; elements are shared out so that
    their lengths are as equal as can be.
    """
    if not (np.ndim(length) == 0 and 0 < length < np.inf):
        raise ValueError(f"length: must be a positive number, got {length}")
    if not (elements >= 2 and elements % 1 == 0):
        raise ValueError(f"elements: must be a whole number of at least 2, got {elements}")
    marks = np.array([0.0, *sorted(jumps), length])
    if not np.all(np.diff(marks) > 0):
        raise ValueError(f"jumps: must be distinct and inside (0, {length}), got {tuple(jumps)}")
    if len(marks) - 1 > elements:
        raise ValueError(f"elements: {len(marks) - 1} pieces between jumps need as many elements")
    share = np.diff(marks) / length * elements
    count = np.maximum(1, np.round(share).astype(int))
    while count.sum() != elements:  # repair rounding where it hurts least
        step = 1 if count.sum() < elements else -1
        cost = np.where((count + step) >= 1, np.abs(count + step - share), np.inf)
        # pieces of equal length keep equal counts where the total allows it
        count[np.argmin(cost)] += step
    pieces = [
        np.linspace(a, b, k + 1)[1:] for a, b, k in zip(marks[:-1], marks[1:], count, strict=True)
    ]
    return np.concatenate([[0.0], *pieces])


def straight_rod(
    length: Number,
    elements: int,
    section: Section | Callable[[np.ndarray], Section],
    *,
    direction: Vector = (0.0, 0.0, 1.0),
    first_director: Vector | None = None,
    origin: Vector = (0.0, 0.0, 0.0),
    natural_curvature: Sequence[Property] = (0.0, 0.0, 0.0),
    jumps: Sequence[Number] = (),
) -> Rod:
    """A rod placed straight along `direction`, its node s = 0 at `origin`.

    `natural_curvature` is kappa0 in the body frame [1/m], each component a number, one value an
    element or a function of s: a rod with kappa0 != 0 is straight in this placing but not at
    rest. `first_director` (default: any normal) fixes a_1. `jumps` are the arc lengths where
    properties jump; they become nodes.
    """
    nodes = grid(length, elements, jumps)
    tangent = _vector(direction, "direction")
    if not np.any(tangent):
        raise ValueError("direction: must not be zero")
    tangent = tangent / np.linalg.norm(tangent)
    frame = _frame(tangent, first_director)
    position = _vector(origin, "origin") + nodes[:, None] * tangent
    quaternion = np.broadcast_to(frame, (len(nodes), 4))
    return build_rod(nodes, position, quaternion, section, natural_curvature)


def curved_rod(
    curve: Callable[[Array], Array],
    length: Number,
    elements: int,
    section: Section | Callable[[np.ndarray], Section],
    *,
    first_director: Vector | None = None,
    stress_free: bool = True,
    jumps: Sequence[Number] = (),
) -> Rod:
    """A rod placed along a space curve.

    Args:
        curve: position (3,) as a function of arc length s [m]; |dcurve/ds| must be 1 to 1 %.
        stress_free: if true kappa0 is the curvature of this placing, so that it is at rest;
            otherwise kappa0 = 0 and the placing is a bent state of a straight rod.
        first_director: a_1 at s = 0; the frames are carried along without twist from it.

    The nodes are put at distances ds along the frames, R_{i+1} = R_i + ds a_3, so the discrete
    rod starts exactly unstretched; it follows the curve to second order in ds.
    """
    nodes = grid(length, elements, jumps)
    ds = np.diff(nodes)
    at = lambda s: _vector(np.asarray(curve(s)), "curve")
    step = 1e-4 * length / elements
    tangents = np.stack([at(s + step) - at(s - step) for s in nodes])
    speed = np.linalg.norm(tangents, axis=1) / (2 * step)
    if np.any(np.abs(speed - 1) > 0.01):
        raise ValueError(
            "curve: must be parametrised by arc length; |d curve/ds| ranges over"
            f" [{speed.min():.4g}, {speed.max():.4g}]"
        )
    tangents /= np.linalg.norm(tangents, axis=1)[:, None]
    frames = [_frame(tangents[0], first_director)]
    for before, after in zip(tangents[:-1], tangents[1:], strict=True):
        frames.append(_multiply(_shortest(before, after), frames[-1]))
    quaternion = np.stack(frames)
    # element frames halfway between the nodes', and nodes placed along them
    halfway = quaternion[:-1] + quaternion[1:]
    halfway /= np.linalg.norm(halfway, axis=1)[:, None]
    edges = ds[:, None] * np.asarray(rotations.tangent_director(jnp.asarray(halfway)))
    position = at(0.0) + np.concatenate([np.zeros((1, 3)), np.cumsum(edges, 0)])
    before, after = jnp.asarray(quaternion[:-1]), jnp.asarray(quaternion[1:])
    relative = rotations.multiply(rotations.conjugate(before), after)
    curvature = rotations.logarithm(relative) / ds[:, None]
    natural = curvature if stress_free else jnp.zeros_like(curvature)
    return build_rod(nodes, position, quaternion, section, tuple(jnp.moveaxis(natural, 1, 0)))


def build_rod(
    nodes: np.ndarray,
    position: np.ndarray,
    quaternion: np.ndarray,
    section: Section | Callable[[np.ndarray], Section],
    natural_curvature: Sequence[Property],
) -> Rod:
    """A `Rod` from node arc lengths, a placing and a section; the other builders end here."""
    nodes = np.asarray(nodes, float)
    midpoints = 0.5 * (nodes[1:] + nodes[:-1])
    chosen = section if isinstance(section, Section) else section(midpoints)
    many = lambda values, name: jnp.stack([sample(v, midpoints, name) for v in values], -1)
    optional = lambda how, value, name: None if value is None else how(value, name)
    one = lambda value, name: sample(value, midpoints, name)
    as_float = lambda a: jnp.asarray(a, jnp.result_type(float))
    return Rod(
        position=as_float(position),
        quaternion=as_float(quaternion),
        length=as_float(np.diff(nodes)),
        stiffness=many(chosen.stiffness, "stiffness"),
        natural_curvature=many(natural_curvature, "natural_curvature"),
        mass=optional(one, chosen.mass, "mass"),
        rotary_inertia=optional(many, chosen.rotary_inertia, "rotary_inertia"),
        compliance=optional(many, chosen.compliance, "compliance"),
        diameter=optional(one, chosen.diameter, "diameter"),
        area=optional(one, chosen.area, "area"),
    )


def _frame(tangent, first_director) -> np.ndarray:
    """Quaternion of the frame (a_1, a_2, a_3 = tangent) with a_1 as near as can be to the given."""
    if first_director is None:
        first_director = np.eye(3)[np.argmin(np.abs(tangent))]
    given = _vector(first_director, "first_director")
    first = given - (given @ tangent) * tangent
    if not np.linalg.norm(first) > 1e-6 * np.linalg.norm(given):
        raise ValueError("first_director: must not be parallel to the rod")
    first /= np.linalg.norm(first)
    columns = np.stack([first, np.cross(tangent, first), tangent], 1)
    # largest-component rule: exact for the half-turn frames that other formulas lose
    trace = np.trace(columns)
    candidates = np.array([trace, *np.diag(columns)])
    k = int(np.argmax(candidates))
    m = columns
    if k == 0:
        q = np.array([1 + trace, m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]])
    else:
        i = k - 1
        j, l = (i + 1) % 3, (i + 2) % 3
        q = np.empty(4)
        q[0] = m[l, j] - m[j, l]
        q[1 + i] = 1 + m[i, i] - m[j, j] - m[l, l]
        q[1 + j] = m[j, i] + m[i, j]
        q[1 + l] = m[l, i] + m[i, l]
    return q / np.linalg.norm(q)


def _shortest(a, b) -> np.ndarray:
    """Quaternion of the smallest rotation that takes the unit vector a to b."""
    q = np.concatenate([[1 + a @ b], np.cross(a, b)])
    return q / np.linalg.norm(q)


def _multiply(p, q) -> np.ndarray:
    return np.concatenate(
        [[p[0] * q[0] - p[1:] @ q[1:]], p[0] * q[1:] + q[0] * p[1:] + np.cross(p[1:], q[1:])]
    )
