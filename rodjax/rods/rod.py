"""The rod: geometry at rest, section properties, and how they sit on nodes and elements.

Node i = 0..n carries a position and a cross-section frame; element i between the nodes i and
i + 1 carries the strains. Section properties are constant within an element, so a jump of B(s)
at a node is exact. Several rods may stand on one axis of nodes, see `chain`.
"""

import dataclasses
from typing import Any, NamedTuple, no_type_check

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Shaped

from rodjax.inputs.argument_types import AnyArray
from rodjax.inputs.brief import named
from rodjax.inputs.schedules import AbstractSchedule
from rodjax.inputs.validation import as_float, as_float_or_none, as_traced, known
from rodjax.rods import rod_checks
from rodjax.rods.framing import of_one_sign
from rodjax.rods.lump import Lump
from rodjax.rods.material import AbstractMaterial
from rodjax.rods.rod_sheet import sheet_of_rod


def _as_frames(value) -> Any:
    """Known quaternions of frames as floating point numbers, of one sign along the rod."""
    frames = as_float(value)
    if not (known(frames) and np.ndim(frames) == 2):
        return frames
    given = np.asarray(frames)
    with np.errstate(all="ignore"):  # the check will refuse what is not finite
        signed = of_one_sign(given)
    return frames if np.array_equal(signed, given) else jnp.asarray(signed)


class Part(NamedTuple):
    """Where a rod stands among the nodes of several, its first and last node."""

    first: int
    last: int

    @property
    def nodes(self) -> slice:
        """Its nodes."""
        return slice(self.first, self.last + 1)

    @property
    def elements(self) -> slice:
        """Its elements."""
        return slice(self.first, self.last)


def parts_of(breaks: tuple[int, ...], elements: int) -> tuple[Part, ...]:
    """Where each of several rods stands, of which these elements are none."""
    return tuple(map(Part, (0, *(i + 1 for i in breaks)), (*breaks, elements)))


class Rod(eqx.Module):
    """A rod of n elements; every leaf is an array, per element unless said otherwise.

    What is None is absent: without coupling, material and actuation it is linear, with diagonal B.

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
        coupling: (n, 3), entries (1, 2), (1, 3), (2, 3) of the symmetric stiffness B, whose
            diagonal is `stiffness` [N m^2]; or None.
        torque_per_tension: (n,), b of a cable laid of strands: M3 = C tau + b N at the twist tau
            and the tension N, and the stretch N/EA - b tau [m]; or None.
        material: how elements resist, where not linearly; or None.
        actuation: schedule of what is added to kappa0, three components or (n, 3) [1/m]; or None.
        breaks: elements that are none, between the last node of a rod and the first of the next
            where several are laid end to end (`chain`); their length and stiffness are zero. A
            node between two of them, or behind the last, is a body by itself (`with_bodies`).
        lumps: masses and rigid bodies that are fixed to its nodes, a tuple of `Lump`; a scene is
            given them by themselves, `Scene(rod, lumps=...)`.

    Example:
        >>> rod.elements, float(rod.length.sum())
        (20, 1.0)
        >>> stiffer = dataclasses.replace(rod, stiffness=2 * rod.stiffness)
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
    coupling: Float[Array, "n 3"] | None = eqx.field(converter=as_float_or_none, default=None)
    torque_per_tension: Float[Array, " n"] | None = eqx.field(
        converter=as_float_or_none, default=None
    )
    material: AbstractMaterial | None = eqx.field(converter=as_traced, default=None)
    actuation: AbstractSchedule | None = None
    breaks: tuple[int, ...] = eqx.field(static=True, default=())
    lumps: tuple[Lump, ...] = ()

    def __check_init__(self):
        rod_checks.check_fields(self)
        rod_checks.check_breaks(self)
        rod_checks.check_lumps(self)
        rod_checks.check_slender(self)
        rod_checks.check_positive_definite(self)
        rod_checks.check_material(self)

    def __repr__(self) -> str:
        given = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        del given["position"], given["quaternion"], given["length"], given["breaks"]
        if not self.lumps:
            del given["lumps"]
        if known(self.length) and self.length.ndim == 1:
            size = {"elements": self.elements, "length": np.sum(np.asarray(self.length))}
            size |= {"rods": len(self.strands)} if len(self.strands) > 1 else {}
            size |= {"bodies": len(self.bodies)} if self.bodies else {}
        else:
            size = {"length": self.length}
        return named("Rod", {**size, **given})

    def __str__(self) -> str:
        return sheet_of_rod(self).text

    def _repr_html_(self) -> str:
        return sheet_of_rod(self).html

    @property
    def elements(self) -> int:
        """Number of elements n."""
        return self.length.shape[0]

    @property
    def parts(self) -> tuple[Part, ...]:
        """Where each of the rods stands that are laid end to end, then each of the bodies; of a rod
        by itself all of it.
        """
        return parts_of(self.breaks, self.elements)

    @property
    def strands(self) -> tuple[Part, ...]:
        """Where each of the rods stands."""
        return self.parts[: len(self.parts) - len(self.bodies)]

    @property
    def bodies(self) -> tuple[int, ...]:
        """The nodes that are bodies by themselves, which come last."""
        return tuple(part.first for part in self.parts if part.first == part.last)

    def solid(self, values: Float[AnyArray, "n *k"]) -> Float[AnyArray, "m *k"]:
        """The rows of the elements that are: all of them but `breaks`."""
        if not self.breaks:
            return values
        return values[np.delete(np.arange(self.elements), list(self.breaks))]

    def at_breaks(self, values: Shaped[Array, "n *k"], row) -> Shaped[Array, "n *k"]:
        """Values of the elements with this row where there is none."""
        if not self.breaks:
            return values
        places = values.at[np.array(self.breaks)]
        # unique, or it could not be transposed
        return places.set(jnp.asarray(row, values.dtype), unique_indices=True)

    @no_type_check  # `rod_checks.check_lumps` tells what they should be
    def with_lumps(self, lumps: tuple[Lump, ...]) -> "Rod":
        """The rod with these besides those that it has; unchecked, see `rod_checks`."""
        where, empty = lambda rod: rod.lumps, lambda part: isinstance(part, tuple) and not part
        return eqx.tree_at(where, self, (*self.lumps, *lumps), is_leaf=empty)

    @property
    def gauge_length(self) -> Float[Array, " n"]:
        """The length that strains of an element are taken over: its own, 1 where there is none."""
        return self.at_breaks(self.length, 1.0)

    @property
    def mean_length(self) -> Float[Array, ""]:
        """Mean rest length of an element [m]."""
        return jnp.mean(self.solid(self.length))

    @property
    def mean_bending(self) -> Float[Array, ""]:
        """Mean of A1 and A2 over the elements [N m^2]."""
        return jnp.mean(self.solid(self.stiffness)[:, :2])

    @property
    def node_length(self) -> Float[Array, " nodes"]:
        """Rest length that belongs to each node: half of each neighbouring element."""
        return self.to_nodes(jnp.ones_like(self.length))

    @property
    def weighing_length(self) -> Float[Array, " nodes"]:
        """The length that motions of the nodes count with in norms: their own, of a body by itself
        that of all rods.
        """
        own = self.node_length
        if not self.bodies:
            return own
        return own.at[np.array(self.bodies)].set(jnp.sum(self.length), unique_indices=True)

    @property
    def arc_length(self) -> Float[Array, " nodes"]:
        """Rest arc length s of the nodes, each rod's from its own first."""
        along = jnp.concatenate([jnp.zeros_like(self.length[:1]), jnp.cumsum(self.length)])
        if not self.breaks:
            return along
        counts = [part.last - part.first + 1 for part in self.parts]
        return along - along[np.repeat([part.first for part in self.parts], counts)]

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


def check_linear(rod: Rod, method: str) -> None:
    """Raise ValueError where a rod has more than a method for diagonal B takes in."""
    for name in ("coupling", "torque_per_tension", "material", "actuation"):
        if getattr(rod, name) is not None:
            raise ValueError(
                f"{name}: {method} is for linear rods without it; pass {name}=None, or use"
                " rollout or adaptive_rollout"
            )
