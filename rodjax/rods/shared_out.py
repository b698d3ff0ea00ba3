"""Materials and actuations of several rods that are laid end to end: each rod has its own."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.inputs.schedules import AbstractSchedule
from rodjax.rods.linear_material import LinearMaterial
from rodjax.rods.material import AbstractMaterial, ElementMotion


def laid(rows: list[Array], bodies: int = 0) -> Array:
    """Rows of the elements of all rods, with one of zeros for each element that is none: between
    two rods, and before each of the bodies behind them.
    """
    none = jnp.zeros_like(rows[0][:1])
    whole = [rows[0]]
    for own in rows[1:]:
        whole += [jnp.zeros_like(own[:1]), own]
    return jnp.concatenate([*whole, *[none] * bodies])


class MaterialsOfRods(AbstractMaterial):
    """What several rods are made of.

    Attributes:
        materials: of each rod.
        counts: the number of its elements.
        bodies: how many bodies stand behind the rods.
    """

    materials: tuple[AbstractMaterial, ...]
    counts: tuple[int, ...] = eqx.field(static=True)
    bodies: int = eqx.field(static=True, default=0)

    @classmethod
    def of(cls, materials, counts, bodies=0) -> "MaterialsOfRods":
        """Of each rod; None is linear."""
        chosen = tuple(LinearMaterial() if one is None else one for one in materials)
        return cls(chosen, tuple(counts), bodies)

    def _each(self, at: ElementMotion) -> list[tuple[AbstractMaterial, ElementMotion]]:
        """The materials, with what each sees of its own rod."""
        pairs, first = [], 0
        for i, (material, count) in enumerate(zip(self.materials, self.counts, strict=True)):
            own = slice(first, first + count)
            seen = ElementMotion(
                at.arc_length[own],
                at.stiffness[own],
                None if at.coupling is None else at.coupling[own],
                at.curvature[own],
                at.natural[own],
                at.rate[own],
                at.time,
                None if at.memory is None else at.memory[i],
            )
            pairs.append((material, seen))
            first += count + 1
        return pairs

    def moment(self, at):
        return laid([one.moment(own) for one, own in self._each(at)], self.bodies)

    def energy(self, at):
        densities = []
        for one, own in self._each(at):
            density = one.energy(own)
            if density.ndim == 1:  # what is not shared out is bending
                zero = jnp.zeros_like(density)
                density = jnp.stack([density, zero, zero], 1)
            densities.append(density)
        return laid(densities, self.bodies)

    @property
    def viscous(self):
        return any(one.viscous for one in self.materials)

    @property
    def stretch_time(self) -> Float[Array, " n"] | None:
        if all(one.stretch_time is None for one in self.materials):
            return None
        rows = []
        for one, count in zip(self.materials, self.counts, strict=True):
            time = 0.0 if one.stretch_time is None else one.stretch_time
            rows.append(jnp.broadcast_to(jnp.asarray(time), (count,)))
        return laid(rows, self.bodies)

    def slopes(self, at):
        found = [one.slopes(own) for one, own in self._each(at)]
        by_curvature, by_rate = zip(*found, strict=True)
        return laid(list(by_curvature), self.bodies), laid(list(by_rate), self.bodies)

    @property
    def remembers(self):
        return any(one.remembers for one in self.materials)

    def first_memory(self, at):
        return tuple(one.first_memory(own) for one, own in self._each(at))

    def next_memory(self, at):
        return tuple(one.next_memory(own) for one, own in self._each(at))

    def lost(self, before, after):
        pairs = zip(self._each(before), self._each(after), strict=True)
        return laid([one.lost(first, second) for (one, first), (_, second) in pairs], self.bodies)

    def driven(self, before, after):
        pairs = zip(self._each(before), self._each(after), strict=True)
        return laid([one.driven(first, second) for (one, first), (_, second) in pairs], self.bodies)


class ActuationsOfRods(AbstractSchedule):
    """How the natural curvatures of several rods are driven; None: not.

    Attributes:
        schedules: of each rod.
        counts: the number of its elements.
        bodies: how many bodies stand behind the rods.
    """

    schedules: tuple[AbstractSchedule | None, ...]
    counts: tuple[int, ...] = eqx.field(static=True)
    bodies: int = eqx.field(static=True, default=0)

    def __call__(self, time):
        rows = []
        for one, count in zip(self.schedules, self.counts, strict=True):
            value = jnp.zeros((3,)) if one is None else one(time)
            rows.append(jnp.broadcast_to(value, (count, 3)))
        return laid(rows, self.bodies)

    @property
    def _given(self) -> list[AbstractSchedule]:
        return [one for one in self.schedules if one is not None]

    @property
    def until(self):
        return jnp.min(jnp.stack([jnp.asarray(one.until, float) for one in self._given]))

    @property
    def corners(self):
        return jnp.concatenate([jnp.asarray(one.corners, float) for one in self._given])


def own_materials(material: AbstractMaterial | None, count: int) -> list[AbstractMaterial | None]:
    """The materials of the rods that a chain is made of."""
    return list(getattr(material, "materials", [material] * count))


def own_actuations(actuation: AbstractSchedule | None, count: int) -> list[AbstractSchedule | None]:
    """Their actuations."""
    return list(getattr(actuation, "schedules", [actuation] * count))
