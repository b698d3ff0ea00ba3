"""The rod: geometry at rest, section properties, and how they sit on nodes and elements.

Node i = 0..n carries a position and a cross-section frame; element i between the nodes i and
i + 1 carries the strains. Section properties are constant within an element, so a jump of B(s)
at a node is exact.
"""

import dataclasses
import warnings
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rodjax.inputs.brief import named
from rodjax.inputs.validation import (
    as_float,
    as_float_or_none,
    check_numbers,
    known,
    shown,
)
from rodjax.numerics.results import ModelWarning
from rodjax.rods.framing import (
    of_one_sign,
)


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
