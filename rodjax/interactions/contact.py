"""Self-contact: its parameters, and how the rod is divided for it.

For contact the rod is a chain of equal segments of its own, whatever the grid: their vertices move
with the nodes beside them, and each segment carries a few quadrature points. `screening` finds
the segments near each other, `contact_forces` sums the law over the points of such pairs.
"""

import dataclasses

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Float

from rodjax.inputs.argument_types import Number
from rodjax.inputs.sheets import sheet_of
from rodjax.inputs.validation import (
    all_known,
    as_float,
    as_float_or_none,
    as_integer,
    check_instance,
    check_integer,
    check_positive,
    check_scalar,
    given,
    known,
)
from rodjax.interactions.contact_checks import check_friction, check_law
from rodjax.interactions.contact_law import AbstractLaw
from rodjax.interactions.contact_laws import Penalty
from rodjax.interactions.friction import AbstractFriction, Dual
from rodjax.rods.rod import Rod


class Contact(eqx.Module):
    """Which parts of the rod interact, and by what law.

    Args:
        law: the pair interaction.
        segments: number of equal segments the rod is divided into for contact, or rods by their
            lengths. They set the cost, which does not grow with the grid; chords of the grid's own
            length are a good choice.
        cutoff: no force beyond this distance of the centrelines [m].
        points_per_segment: quadrature points of a segment. Their spacing h must resolve the law:
            for a force ripple under 2 %, h <= d/3 and h <= sqrt(2 d w)/2, with d the settled
            distance and w = |psi/psi'| there.
        aperture: screening aperture theta [rad] (Fig. 4): a pair acts if the line between the
            points lies within theta/2 of either cross-section plane. 0 is the plane, pi all
            space. The force fades smoothly from the plane to the aperture's edge. Default: the
            law's (`AbstractLaw.default_aperture`), which is all space but for Eq. (13).
        edge: the force fades to the cut-off over this last part of the distance, unless the law
            vanishes by itself before (`AbstractLaw.extent`).
        exclusion: points closer than this along the rod never interact [m]; default 1.5 cutoff.
            Must not be less than the cut-off, or a straight rod would repel itself.
        capacities: numbers of vertices in contact for which a dense solver is compiled, increasing;
            the smallest that holds what acts is taken, and a run in which more come near each other
            than the largest holds says so. Default: 16, 64 and on by fours, and all vertices (on
            CPUs up to 3,100 unknowns, three a vertex, or six with friction); beside them, on CPUs
            and where there are more than a hundred, solvers for strips of strands whose cost is
            linear in the elements (`contact_capacities`). Under `vmap` give one.
        pairs_per_segment: capacity of the list of near pairs, per vertex of `capacities`. Default:
            what two strands side by side need, by the rod of the scene; 4 where its length or the
            cut-off is not known, as in traced code.
        friction: of the strands' surfaces, `SlidingFriction`; None: they are smooth.
        laid_on: length and least diameter of the rod that the segments are for [m]: a scene whose
            rods are longer in all, or thinner, has as many more; None: so many whatever they are.
        listed, shares: set by the scene, see `fitted`.
        rings: set by the scene, which of several rods are closed; None: none of them.
        dual: set by the equations of a step, see `AbstractFriction.dual`.

    Example:
        >>> law = rx.Penalty(stiffness=1e6)
        >>> contact = rx.Contact(law, segments=40, cutoff=0.012)  # of rods 10 mm thick
        >>> touching = rx.Scene(rod, rx.Clamped(), contact=contact)
    """

    law: AbstractLaw
    segments: int = eqx.field(static=True)
    cutoff: Float[Array, ""] = eqx.field(converter=as_float)
    points_per_segment: int = eqx.field(static=True, default=4)
    aperture: Float[Array, ""] | None = eqx.field(converter=as_float_or_none, default=None)
    edge: Float[Array, ""] = eqx.field(converter=as_float, default=0.25)
    exclusion: Float[Array, ""] | None = eqx.field(converter=as_float_or_none, default=None)
    capacities: tuple[int, ...] | None = eqx.field(static=True, default=None)
    pairs_per_segment: int | None = eqx.field(static=True, default=None)
    friction: AbstractFriction | None = None
    laid_on: tuple[float, float] | None = eqx.field(static=True, default=None, repr=False)
    listed: int | None = eqx.field(static=True, default=None, repr=False)
    shares: tuple[int, ...] | None = eqx.field(static=True, default=None, repr=False)
    rings: tuple[bool, ...] | None = eqx.field(static=True, default=None, repr=False)
    dual: Dual | None = eqx.field(default=None, repr=False)

    def __str__(self) -> str:
        return sheet_of(self).text

    def _repr_html_(self) -> str:
        return sheet_of(self).html

    def __check_init__(self):
        check_instance(AbstractLaw, "give a law such as Penalty(stiffness)", law=self.law)
        check_friction(self.friction)
        # what is compared or listed: segments with each other, points of pairs in blocks
        check_integer(2, 10_000, segments=self.segments)
        check_integer(1, 256, points_per_segment=self.points_per_segment)
        check_integer(1, 10_000, **given(pairs_per_segment=self.pairs_per_segment))
        numbers = given(aperture=self.aperture, exclusion=self.exclusion)
        check_scalar(cutoff=self.cutoff, edge=self.edge, **numbers)
        check_positive(cutoff=self.cutoff, **numbers)
        for name, high, unit in (("aperture", np.pi, " radians"), ("edge", 1.0, "")):
            value = getattr(self, name)
            if known(value) and not 0 < float(value) <= high:
                raise ValueError(f"{name}: must be in (0, {high:g}]{unit}, got {value}")
        concrete = known(self.exclusion) and known(self.cutoff)
        if concrete and np.any(np.asarray(self.exclusion) < np.asarray(self.cutoff)):
            raise ValueError(
                f"cutoff: {self.cutoff} exceeds the excluded neighbour distance"
                f" {self.exclusion}; a straight rod would repel itself: raise `exclusion`"
            )
        sizes = self.capacities
        if sizes is not None:
            if not isinstance(sizes, tuple) or not sizes:
                raise ValueError(f"capacities: give a tuple of numbers of vertices, got {sizes!r}")
            check_integer(2, **{f"capacities[{i}]": size for i, size in enumerate(sizes)})
            if list(sizes) != sorted(set(sizes)):
                raise ValueError(f"capacities: must increase, got {sizes}")
        vertices = min(self.sizes[-1], self.segments + 1)
        pairs = (self.pairs_per_segment or 1) * vertices
        if pairs > 1_000_000:
            raise ValueError(
                f"pairs_per_segment: lists of {pairs} pairs are too long;"
                " leave it out, and what two strands side by side need is taken"
            )

    @classmethod
    def solid(
        cls,
        rod: Rod,
        force: Number | Float[Array, ""],
        *,
        indentation: float = 0.05,
        relaxation: Number | Float[Array, ""] = 0.0,
        friction: AbstractFriction | None = None,
        segments: int | None = None,
        capacities: tuple[int, ...] | None = None,
    ) -> "Contact":
        """Contact of solid strands of the rod's diameter D, from the load that it must carry.

        Args:
            rod: with a diameter; its length and diameters must be known (not traced). Of several
                any one, the thinnest by preference; a scene gives all of them segments so short.
            force: largest force expected between two strands [N].
            indentation: how far strands that cross at right angles under this force come into each
                other [D], at most 0.2. Less is stiffer, and asks for more points.
            relaxation: damping of the contact, see `Penalty` [s].
            friction: of the strands' surfaces.
            segments: how many on this rod; default: of eight points each.
            capacities: see `Contact`; where few strands touch one small size compiles faster.

        The law is a `Penalty` whose stiffness k follows from the force F between crossing strands
        at d = (1 - indentation) D: with the energy k depth^3/(6 softness D) of its soft beginning,
        softness = indentation, F = 2 pi d k (indentation D)^2/6. Of a taper the thinnest part
        counts. Strands that cross at another angle give way less, a tip that presses on a strand
        somewhat more. They are overcome, which a run reports as CONTACT_OVERCOME, by 0.4 k D^3 or
        so: 170 times the force at 0.05, 45 at 0.1. Side by side they carry about 3 F/D per length.

        Points lie sqrt(depth d)/2 apart, where the ripple of the force is under 2 %, eight or more
        to a segment. The cut-off, 1.1 D, does not touch the law, which acts in all space.

        Points are on chords of their segments: strands that wind about each other with a curvature
        kappa are held kappa l^2/6 farther apart, l the length of a segment. Where that counts take
        more `segments`, of fewer points each.

        Raises:
            ValueError: an argument is out of its range, or the rod is so long and thin that more
                than 1,500 segments of 256 points would be needed.
        """
        if rod.diameter is None:
            raise ValueError("diameter: contact needs the rod's diameter; give it to the section")
        if not (known(rod.length) and known(rod.diameter)):
            raise ValueError(
                "rod: the points follow from its length and diameter, which must be known; make the"
                " contact outside jit and vmap"
            )
        check_positive(force=as_float(force))
        if not (isinstance(indentation, int | float) and 0 < indentation <= 0.2):
            raise ValueError(f"indentation: must be in (0, 0.2] diameters, got {indentation}")
        thin, thick = np.min(np.asarray(rod.diameter)), np.max(np.asarray(rod.diameter))
        length = float(np.sum(np.asarray(rod.length)))
        spacing = 0.5 * np.sqrt(indentation * (1 - indentation)) * float(thin)
        if segments is None:
            segments = int(np.clip(np.ceil(length / (8 * spacing)), 2, 1500))
        segments = as_integer(segments)
        check_integer(2, 10_000, segments=segments)
        points = int(np.ceil(length / segments / spacing))
        if points > 256:
            raise ValueError(
                f"rod: its {length / thin:.3g} diameters are too many for points {spacing:.3g}"
                " apart; allow more indentation, or set up a `Contact` of your own"
            )
        size = np.pi * (1 - indentation) * indentation**2 * float(thin) ** 3
        law = Penalty(3 * as_float(force) / size, softness=indentation, relaxation=relaxation)
        cutoff = 1.1 * float(thick)
        chosen, laid = {"friction": friction, "capacities": capacities}, (length, float(thin))
        return cls(law, segments, cutoff, points_per_segment=points, laid_on=laid, **chosen)

    def check(self, rod: Rod) -> None:
        """Raise ValueError where the rod lacks what contact needs."""
        if rod.diameter is None:
            raise ValueError("diameter: contact needs the rod's diameter; give it to the section")
        if self.law.uses_mass() and rod.mass is None:
            raise ValueError("mass: this contact law scales with the rod's mass per length")
        check_law(self.law, self.cutoff, rod)
        reach = self.cutoff if self.exclusion is None else self.exclusion
        if not all_known((rod.length, reach)):
            return
        reach, length = np.asarray(reach), np.sum(np.asarray(rod.length))
        reach = 1.5 * reach if self.exclusion is None else reach
        if np.any(reach >= length):
            name = "cutoff" if self.exclusion is None else "exclusion"
            raise ValueError(
                f"{name}: points within {np.max(reach):.3g} of each other along the rod never"
                f" interact, which is all of its length {np.min(length):.3g}; give less, about the"
                " distance at which the law has faded"
            )
        needed = self._partners(rod)
        if self.pairs_per_segment is not None and needed > self.pairs_per_segment:
            raise ValueError(
                f"pairs_per_segment: {self.pairs_per_segment} cannot hold the pairs within the"
                f" cut-off; raise it to {needed} (or leave it out), or use fewer segments or a"
                " smaller cut-off"
            )

    def fitted(self, rod: Rod) -> "Contact":
        """The contact with room for the near pairs of its rod (`listed`), where that is known,
        with more segments where the rods are longer or thinner than that it was laid out on
        (`laid_on`), and with these shared out to several rods (`shares`; by elements if lengths are
        traced).

        `Scene` sees to it. Less room than is needed shows as `CAPACITY_OVERFLOW`.
        """
        known_parts = known(rod.length) and all(
            x is None or known(x) for x in (self.cutoff, self.aperture)
        )
        one = self._extended(rod)
        shares = _shared_out(one.segments, rod) if rod.breaks else None
        listed = max(4, one._partners(rod)) if known_parts else one.listed
        return dataclasses.replace(one, listed=listed, shares=shares)

    def _extended(self, rod: Rod) -> "Contact":
        """With more segments where the rods are longer or thinner than what it was laid out on."""
        if self.laid_on is None or rod.diameter is None:
            return self
        if not (known(rod.length) and known(rod.diameter)):
            return self
        solid = [np.delete(np.asarray(x), list(rod.breaks), -1) for x in (rod.length, rod.diameter)]
        laid = float(np.max(np.sum(solid[0], -1))), float(np.min(solid[1]))
        finer = laid[0] / self.laid_on[0] * self.laid_on[1] / laid[1]
        if finer <= 1 + 1e-6:
            return self
        segments = int(np.ceil(self.segments * finer * (1 - 1e-9)))
        return dataclasses.replace(self, segments=segments, laid_on=laid)

    @property
    def width(self) -> int:
        """Components of what acts on a vertex: a force, and with friction a moment."""
        return 3 if self.friction is None else 6

    @property
    def shared(self) -> tuple[int, ...]:
        """How many segments each rod has."""
        return self.shares or (self.segments,)

    @property
    def vertices(self) -> int:
        """Vertices of all rods."""
        return sum(self.shared) + len(self.shared)

    @property
    def idle(self) -> Bool[np.ndarray, " g"] | None:
        """Which of the segments between all vertices are none; None where all of them are."""
        if self.shares is None:
            return None
        none = np.zeros(self.vertices - 1, bool)
        none[np.cumsum(np.array(self.shares) + 1)[:-1] - 1] = True
        return none

    def _partners(self, rod: Rod) -> int:
        """Partners of a vertex on one strand beside it, at the worst distance, each pair once."""
        length = np.max(np.sum(np.asarray(rod.length), -1)) / self.segments
        reach = np.asarray(self.cutoff)
        if self.acting_aperture is None:
            # also those of which only some points are within reach, or come there in the step
            partners = np.max(reach) / length + 3
        else:
            partners = np.max(reach * np.sin(0.5 * np.asarray(self.acting_aperture))) / length + 1
        return int(min(np.ceil(partners), self.segments)) if np.isfinite(partners) else 1

    @property
    def acting_aperture(self) -> Float[Array, ""] | float | None:
        """The aperture in use [rad]; None: all space."""
        return self.law.default_aperture() if self.aperture is None else self.aperture

    @property
    def room(self) -> int:
        """Near pairs that the list holds, per vertex of `capacities`."""
        return self.pairs_per_segment or self.listed or 4

    @property
    def excluded(self) -> Float[Array, ""]:
        """Arc distance below which points never interact."""
        return 1.5 * self.cutoff if self.exclusion is None else self.exclusion

    @property
    def sizes(self) -> tuple[int, ...]:
        """Numbers of vertices for which a solver is compiled."""
        vertices = self.vertices
        if self.capacities is not None:
            return tuple(sorted({min(size, vertices) for size in self.capacities}))
        sizes = [16]
        while sizes[-1] < vertices:
            sizes.append(4 * sizes[-1])
        # each size costs compile time: none that nearly is all vertices
        return (*[size for size in sizes if size < 0.7 * vertices], vertices)


def _shared_out(segments: int, rod: Rod) -> tuple[int, ...]:
    """So many segments, by the lengths of rods: two or more each, of nearly one length."""
    if known(rod.length):
        sizes = [float(np.sum(np.asarray(rod.length)[part.elements])) for part in rod.strands]
    else:
        sizes = [part.last - part.first for part in rod.strands]
    return tuple(max(2, round(segments * size / sum(sizes))) for size in sizes)
