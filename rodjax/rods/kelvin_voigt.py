"""Kelvin-Voigt material: moments that grow with the strain rates."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rodjax.inputs.validation import (
    as_float,
    as_float_or_none,
    check_instance,
    check_not_negative,
    check_numbers,
    given,
    known,
)
from rodjax.rods.linear_material import LinearMaterial
from rodjax.rods.material import AbstractMaterial


class KelvinVoigt(AbstractMaterial):
    """Damping in the strain rates besides an elastic law: q = elastic + (A1 T, A2 T, C T) kappa'.

    Strain rates are those of the body frame, which no rigid motion has: a rod that spins or flies
    is not damped. A mode of bending of angular frequency w is damped by the fraction T w / 2 of
    critical damping. Not for rods with mass=None.

    Attributes:
        bending: retardation time T of bending [s]; a number, or one an element (n,).
        torsion: of torsion [s]; that of bending by default.
        stretch: of stretch and shear, where the rod is compliant [s]: f = (g + T g') / compliance
            with the strain g; None leaves them undamped.
        elastic: the law besides; by default linear with the section's stiffness.

    Example:
        >>> silicone = rx.circular_section(0.01, 4e5, 1.3e5, 1070.0, material=rx.KelvinVoigt(0.01))
        >>> arm = rx.straight_rod(0.2, 20, silicone)
    """

    bending: Float[Array, "*n"] = eqx.field(converter=as_float)
    torsion: Float[Array, "*n"] | None = eqx.field(converter=as_float_or_none, default=None)
    stretch: Float[Array, "*n"] | None = eqx.field(converter=as_float_or_none, default=None)
    elastic: AbstractMaterial = LinearMaterial()

    def __check_init__(self):
        times = given(bending=self.bending, torsion=self.torsion, stretch=self.stretch)
        check_numbers(**times)
        check_not_negative(**times)
        check_instance(AbstractMaterial, "give a material, or leave it out", elastic=self.elastic)

    @property
    def stretch_time(self):
        return self.stretch

    def _retarded(self, at):
        """A1 T, A2 T, C T of the elements [N m^2 s]."""
        torsion = self.bending if self.torsion is None else self.torsion
        both = [jnp.broadcast_to(time, at.stiffness.shape[:1]) for time in (self.bending, torsion)]
        return at.stiffness * jnp.stack([both[0], both[0], both[1]], 1)

    def moment(self, at):
        return self.elastic.moment(at) + self._retarded(at) * at.rate

    def energy(self, at):
        return self.elastic.energy(at)

    def slopes(self, at):
        by_curvature, by_rate = self.elastic.slopes(at)
        eye = jnp.eye(3, dtype=by_rate.dtype)[None]
        return by_curvature, by_rate + self._retarded(at)[:, :, None] * eye

    @property
    def remembers(self):
        return self.elastic.remembers

    def first_memory(self, at):
        return self.elastic.first_memory(at)

    def next_memory(self, at):
        return self.elastic.next_memory(at)

    def lost(self, before, after):
        mean = 0.5 * (self._retarded(before) * before.rate + self._retarded(after) * after.rate)
        damped = jnp.sum(mean * (after.curvature - before.curvature), 1)
        return self.elastic.lost(before, after) + damped

    def driven(self, before, after):
        return self.elastic.driven(before, after)

    def check(self, stiffness, coupling, compliance, mass):
        self.elastic.check(stiffness, coupling, compliance, mass)
        if mass is None:
            raise ValueError(
                "material: a rod with mass=None cannot be of KelvinVoigt: its rates follow from its"
                " drag alone; give its section a mass"
            )
        for name in ("bending", "torsion", "stretch"):
            time = getattr(self, name)
            if time is not None and jnp.shape(time) not in ((), stiffness.shape[:1]):
                raise ValueError(
                    f"{name}: give one time, or one for each of {len(stiffness)} elements; got"
                    f" shape {jnp.shape(time)}"
                )
        if self.stretch is None:
            return
        if compliance is None or (known(compliance) and not np.any(np.asarray(compliance) > 0)):
            raise ValueError(
                "stretch: a rod without compliance does not stretch, so nothing damps it; give the"
                " section compliance=(0, 0, 1 / EA), or stretch=None"
            )
