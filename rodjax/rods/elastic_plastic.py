"""Elastic-plastic bending: beyond a yield moment a kink stays."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rodjax.inputs.validation import (
    as_float,
    check_not_negative,
    check_numbers,
    check_positive,
    known,
    shown,
)
from rodjax.rods.material import AbstractMaterial

# Newton's iterations for how far an element flows; they converge from below, and of equal bending
# stiffnesses the first is exact.
_ITERATIONS = 5


class ElasticPlastic(AbstractMaterial):
    """Bending that yields at a moment M_y and hardens linearly; torsion stays elastic.

    q = B (kappa - kappa0 - kappa_p); the plastic curvature kappa_p grows along q - H kappa_p where
    that would pass M_y in size (associated flow, kinematic hardening). It is found for each
    element by backward Euler (return mapping) from that of the last accepted step, with the exact
    derivative. What is lost, M_y |change of kappa_p|, is `Ledger.material_loss`; what hardening
    stores counts as bending. At rest steps of the load path are the history: a path loaded in one
    direction needs one, one that turns back as many as tell its turns.

    Where an element begins to yield the moment has a corner, and so has what a state depends on:
    derivatives are those of the side it is on. Without hardening (0) a section under M_y bends
    freely, and there may be no equilibrium beyond it. Not for sections with coupling.

    Attributes:
        yield_moment: M_y of bending in any direction [N m]; a number, or one an element (n,).
        hardening: H >= 0, moment per plastic curvature [N m^2]; tangent stiffness beyond yield is
            A H / (A + H).

    Example:
        >>> wire = rx.circular_section(
        ...     1e-3, 2e11, 8e10, 7800.0, material=rx.ElasticPlastic(yield_moment=0.04)
        ... )
        >>> paperclip = rx.straight_rod(0.1, 20, wire)
    """

    yield_moment: Float[Array, "*n"] = eqx.field(converter=as_float)
    hardening: Float[Array, "*n"] = eqx.field(converter=as_float, default=0.0)

    def __check_init__(self):
        check_numbers(yield_moment=self.yield_moment, hardening=self.hardening)
        check_positive(yield_moment=self.yield_moment)
        check_not_negative(hardening=self.hardening)

    @property
    def viscous(self):
        return False

    @property
    def remembers(self):
        return True

    def first_memory(self, at):
        """kappa_p about a_1 and a_2 [1/m]: none."""
        return jnp.zeros_like(at.curvature[:, :2])

    def next_memory(self, at):
        return self._flow(at)

    def _flow(self, at) -> Float[Array, "n 2"]:
        """kappa_p after a step to this motion."""
        before = self.first_memory(at) if at.memory is None else at.memory
        stiffness, hard, limit = at.stiffness[:, :2], self._of(at, self.hardening), self._limit(at)
        driving = stiffness * (at.bent[:, :2] - before) - hard * before
        size = jnp.sum(driving**2, 1, keepdims=True)
        flows = size > limit**2
        # of elements that stay elastic any numbers will do, but for their derivatives
        driving = jnp.where(flows, driving, jnp.broadcast_to(2 * limit, driving.shape))
        rate = (stiffness + hard) / limit
        grown = jnp.zeros_like(limit)
        for _ in range(_ITERATIONS):
            # 1 / |xi| is nearly linear in what flows, with xi = driving / (1 + grown rate)
            left = driving / (1 + grown * rate)
            norm = jnp.sqrt(jnp.sum(left**2, 1, keepdims=True))
            slope = jnp.sum(left**2 * rate / (1 + grown * rate), 1, keepdims=True) / norm**3
            grown = grown + (1 / limit - 1 / norm) / slope
        left = driving / (1 + grown * rate)
        return before + jnp.where(flows, grown * left / limit, 0.0)

    def _of(self, at, value) -> Float[Array, "n 1"]:
        return jnp.broadcast_to(value, at.stiffness.shape[:1])[:, None]

    def _limit(self, at) -> Float[Array, "n 1"]:
        return self._of(at, self.yield_moment)

    def _elastic(self, at, plastic) -> Float[Array, "n 3"]:
        """kappa - kappa0 - kappa_p."""
        return at.bent - jnp.pad(plastic, ((0, 0), (0, 1)))

    def moment(self, at):
        return at.stiffness * self._elastic(at, self._flow(at))

    def energy(self, at):
        plastic = self._flow(at)
        stored = 0.5 * at.stiffness * self._elastic(at, plastic) ** 2
        hardened = 0.5 * self._of(at, self.hardening) * plastic**2
        return stored + jnp.pad(hardened, ((0, 0), (0, 1)))

    def lost(self, before, after):
        plastic = self._flow(after)
        driving = self.moment(after)[:, :2] - self._of(after, self.hardening) * plastic
        return jnp.sum(driving * (plastic - self._flow(before)), 1)

    def driven(self, before, after):
        mean = 0.5 * (self.moment(before) + self.moment(after))
        return -jnp.sum(mean * (after.natural - before.natural), 1)

    def check(self, stiffness, coupling, compliance, mass):
        if known(coupling) and np.any(np.asarray(coupling) != 0):
            raise ValueError(
                "coupling: a rod of ElasticPlastic yields in bending alone; give its section no"
                " coupling"
            )
        for name, value in (("yield_moment", self.yield_moment), ("hardening", self.hardening)):
            if jnp.shape(value) not in ((), stiffness.shape[:1]):
                raise ValueError(
                    f"{name}: give a number, or one for each of {len(stiffness)} elements; got"
                    f" {shown(value)}"
                )
