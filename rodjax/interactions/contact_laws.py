"""The laws of contact and of remote interaction that the library has, see `contact_law`."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rodjax.inputs.validation import (
    as_float,
    check_finite,
    check_not_negative,
    check_positive,
    check_scalar,
)
from rodjax.interactions.contact_law import AbstractLaw, PairProperties


def _check_numbers(law: AbstractLaw) -> None:
    """Raise ValueError unless each field is one real number."""
    check_scalar(**{field.name: getattr(law, field.name) for field in dataclasses.fields(law)})


class DampedInversePower(AbstractLaw):
    """Eq. (13): rho_c A_c (k1 / (d - offset D)^k2 + (k3 / d) c |c|^k4) / reference_spacing.

    The paper's law acts between grid points a `reference_spacing` apart; divided by it, and with
    the points that far apart, this is Eq. (13) as printed. Table 1, in metres and seconds:
    k1 = 1e-7, k3 = 1e-6, a spacing of 1e-3, k2 = 3 and k4 = 1.

    Args:
        k1: strength of the repulsion [m^(k2+1)/s^2].
        k3: of the damping [m^(1-k4) s^(k4-1)].
        reference_spacing: [m].
        k2, k4: exponents.
        offset: where the pole is, in diameters.
        gap_floor: closer than so many diameters to the pole the law is continued by its tangent.

    Example:
        >>> law = rx.DampedInversePower(k1=1e-7, k3=1e-6, reference_spacing=1e-3)  # the paper's
        >>> contact = rx.Contact(law, segments=200, cutoff=15e-3)
    """

    k1: Float[Array, ""] = eqx.field(converter=as_float)
    k3: Float[Array, ""] = eqx.field(converter=as_float)
    reference_spacing: Float[Array, ""] = eqx.field(converter=as_float)
    k2: Float[Array, ""] = eqx.field(converter=as_float, default=3.0)
    k4: Float[Array, ""] = eqx.field(converter=as_float, default=1.0)
    offset: Float[Array, ""] = eqx.field(converter=as_float, default=0.5)
    gap_floor: Float[Array, ""] = eqx.field(converter=as_float, default=0.01)

    def __check_init__(self):
        _check_numbers(self)
        check_positive(
            k1=self.k1,
            k2=self.k2,
            reference_spacing=self.reference_spacing,
            gap_floor=self.gap_floor,
        )
        check_finite(k3=self.k3, k4=self.k4, offset=self.offset)

    def uses_mass(self):
        return True

    def default_aperture(self):
        return 0.5 * np.pi

    def smallest(self, pair: PairProperties) -> Array:
        return (self.offset + self.gap_floor) * pair.diameter

    def repulsion(self, distance, approach, pair):
        assert pair.mass is not None  # `Contact.check` has seen to it
        gap = distance - self.offset * pair.diameter
        speed = jnp.abs(approach)
        resting = speed == 0
        power = jnp.where(resting, 0.0, jnp.where(resting, 1.0, speed) ** self.k4)
        static = self.k1 * jnp.exp(-self.k2 * jnp.log(gap))
        return pair.mass / self.reference_spacing * (static + self.k3 / distance * approach * power)

    def potential(self, distance, pair):
        assert pair.mass is not None
        gap = (distance - self.offset * pair.diameter) / pair.diameter
        integral = _power_integral(gap, self.k2) * pair.diameter ** (1 - self.k2)
        return pair.mass / self.reference_spacing * self.k1 * integral


class InversePower(AbstractLaw):
    """psi = strength / d^exponent (Klapper 1996); continued below `floor` D.

    Example:
        >>> law = rx.InversePower(strength=1e-6, exponent=4.0)
        >>> contact = rx.Contact(law, segments=40, cutoff=0.02)
    """

    strength: Float[Array, ""] = eqx.field(converter=as_float)
    exponent: Float[Array, ""] = eqx.field(converter=as_float)
    floor: Float[Array, ""] = eqx.field(converter=as_float, default=0.1)

    def __check_init__(self):
        _check_numbers(self)
        check_positive(strength=self.strength, exponent=self.exponent, floor=self.floor)

    def smallest(self, pair: PairProperties) -> Array:
        return self.floor * pair.diameter

    def repulsion(self, distance, approach, pair):
        return self.strength * jnp.exp(-self.exponent * jnp.log(distance))

    def potential(self, distance, pair):
        integral = _power_integral(distance / pair.diameter, self.exponent)
        return self.strength * pair.diameter ** (1 - self.exponent) * integral


def _power_integral(x, exponent):
    """Integral of x^-exponent from x to 1."""
    above = exponent - 1
    logarithm = -jnp.log(x)
    usual = jnp.abs(above) > 1e-12
    power = jnp.expm1(above * logarithm) / jnp.where(usual, above, 1.0)
    return jnp.where(usual, power, logarithm)


class LennardJones(AbstractLaw):
    """psi = (24 energy / d) (2 (range/d)^12 - (range/d)^6), attractive beyond 2^(1/6) range.

    `energy` [J/m^2] per length of either strand, `range` [m]; continued below half the range.

    Example:
        >>> law = rx.LennardJones(energy=1e-6, range=0.012)
        >>> contact = rx.Contact(law, segments=40, cutoff=0.02)
    """

    energy: Float[Array, ""] = eqx.field(converter=as_float)
    range: Float[Array, ""] = eqx.field(converter=as_float)

    def __check_init__(self):
        _check_numbers(self)
        check_positive(energy=self.energy, range=self.range)

    def smallest(self, pair: PairProperties) -> Array:
        return 0.5 * self.range * jnp.ones_like(pair.diameter)

    def repulsion(self, distance, approach, pair):
        sixth = (self.range / distance) ** 6
        return 24 * self.energy / distance * (2 * sixth**2 - sixth)

    def potential(self, distance, pair):
        sixth = (self.range / distance) ** 6
        return 4 * self.energy * (sixth**2 - sixth)


class DebyeHueckel(AbstractLaw):
    """Screened charges: psi = strength exp(-d/screening) (1/d + 1/screening) / d.

    `strength` [N] is the product of the line charge densities over 4 pi permittivity (per length
    of either strand: k_B T l_B (charges per length)^2), `screening` the Debye length [m];
    continued below `floor` D.

    Example:
        >>> law = rx.DebyeHueckel(strength=1e-3, screening=2e-3)
        >>> contact = rx.Contact(law, segments=40, cutoff=0.02)
    """

    strength: Float[Array, ""] = eqx.field(converter=as_float)
    screening: Float[Array, ""] = eqx.field(converter=as_float)
    floor: Float[Array, ""] = eqx.field(converter=as_float, default=0.1)

    def __check_init__(self):
        _check_numbers(self)
        check_positive(strength=self.strength, screening=self.screening, floor=self.floor)

    def smallest(self, pair: PairProperties) -> Array:
        return self.floor * pair.diameter

    def repulsion(self, distance, approach, pair):
        decay = jnp.exp(-distance / self.screening)
        return self.strength * decay * (1 / distance + 1 / self.screening) / distance

    def potential(self, distance, pair):
        return self.strength * jnp.exp(-distance / self.screening) / distance


class Barrier(AbstractLaw):
    """Two solids: a smooth barrier that acts for D < d < D (1 + reach) and diverges at d = D.

    psi = -db/dd with b = -stiffness x^2 ln(y), y = (d - D)/(reach D), x = (y - 1) reach D: the
    clamped log barrier of incremental potential contact (Li et al. 2020), C2 where it begins.
    `stiffness` [N/m^3]; continued by its tangent below y = `floor`.

    Example:
        >>> law = rx.Barrier(stiffness=1e6)
        >>> contact = rx.Contact(law, segments=40, cutoff=0.02)
    """

    stiffness: Float[Array, ""] = eqx.field(converter=as_float)
    reach: Float[Array, ""] = eqx.field(converter=as_float, default=0.2)
    floor: Float[Array, ""] = eqx.field(converter=as_float, default=0.02)

    def __check_init__(self):
        _check_numbers(self)
        check_positive(stiffness=self.stiffness, reach=self.reach, floor=self.floor)

    def smallest(self, pair: PairProperties) -> Array:
        return pair.diameter * (1 + self.floor * self.reach)

    def extent(self, pair) -> Array:
        return pair.diameter * (1 + self.reach)

    def repulsion(self, distance, approach, pair):
        width = self.reach * pair.diameter
        y = jnp.minimum((distance - pair.diameter) / width, 1.0)
        return self.stiffness * width * ((y - 1) ** 2 / y + 2 * (y - 1) * jnp.log(y))

    def potential(self, distance, pair):
        width = self.reach * pair.diameter
        y = jnp.minimum((distance - pair.diameter) / width, 1.0)
        return -self.stiffness * (width * (y - 1)) ** 2 * jnp.log(y)


class Penalty(AbstractLaw):
    """Two solids pressed flat: psi = stiffness (e + relaxation de/dt), e the indentation [m].

    With the depth x = D - d and width = softness D: e = 0 for x < 0, x^2 / (2 width) up to the
    width, x - width / 2 beyond it: C1, linear but for a short beginning. `stiffness` [N/m^3]. The
    second term damps: `relaxation` [s] is the time in which the indentation of unloaded strands
    falls by e. It may pull while strands part, as a spring and a dashpot side by side do
    (PyElastica's `RodSelfContact`, of k and nu for a pair of elements, is one with relaxation
    nu / k and no soft beginning).

    Strands side by side, at d = D - x with width << x << D, push each other by
    (4/3) stiffness x sqrt(2 D x) per length, the integral of psi along either.

    Example:
        >>> law = rx.Penalty(stiffness=1e6, relaxation=1e-3)
        >>> contact = rx.Contact(law, segments=40, cutoff=0.02)
    """

    stiffness: Float[Array, ""] = eqx.field(converter=as_float)
    softness: Float[Array, ""] = eqx.field(converter=as_float, default=0.05)
    relaxation: Float[Array, ""] = eqx.field(converter=as_float, default=0.0)

    def __check_init__(self):
        _check_numbers(self)
        check_positive(stiffness=self.stiffness, softness=self.softness)
        check_not_negative(relaxation=self.relaxation)

    def smallest(self, pair: PairProperties) -> Array:
        return jnp.zeros_like(pair.diameter)

    def extent(self, pair) -> Array:
        return pair.diameter

    def repulsion(self, distance, approach, pair):
        depth = jnp.maximum(pair.diameter - distance, 0.0)
        width = self.softness * pair.diameter
        begins = depth < width
        indentation = jnp.where(begins, 0.5 * depth**2 / width, depth - 0.5 * width)
        rate = jnp.where(begins, depth / width, 1.0) * approach
        return self.stiffness * (indentation + self.relaxation * rate)

    def potential(self, distance, pair):
        depth = jnp.maximum(pair.diameter - distance, 0.0)
        width = self.softness * pair.diameter
        beyond = jnp.maximum(depth - width, 0.0)
        soft = jnp.minimum(depth, width) ** 3 / (6 * width)
        return self.stiffness * (soft + 0.5 * beyond * (beyond + width))
