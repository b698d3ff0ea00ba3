"""Generalised-alpha on R^3 x SO(3), its coefficients and kinematic update.

Source: Arnold & Bruels 2007; Bruels, Cardona & Arnold 2012; Arnold, Bruels & Cardona 2015. With
the spectral radius rho at infinite step, a_m = (2 rho - 1)/(rho + 1), a_f = rho/(rho + 1),
gamma = 1/2 + a_f - a_m, beta = (gamma + 1/2)^2/4:
    increment = dt V_n + dt^2 ((1/2 - beta) a_n + beta a_{n+1}),
    V_{n+1}   = V_n + dt ((1 - gamma) a_n + gamma a_{n+1}),
    (1 - a_m) a_{n+1} + a_m a_n = (1 - a_f) V'_{n+1} + a_f V'_n.
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from rodjax.inputs.validation import (
    all_known,
    as_float,
    as_float_or_none,
    as_integer,
    check_integer,
    check_positive,
    check_scalar,
    known,
)

_MOST_ITERATIONS = 10_000  # a step that needs more is lost


def _as_count(value):
    """A whole number as an array; what is none is left for the check."""
    whole = as_integer(value)
    small = type(whole) is int and abs(whole) < 2**31
    return jnp.asarray(whole, jnp.int32) if small else value


def _check_count(**values):
    for name, value in values.items():
        if jnp.issubdtype(getattr(value, "dtype", float), jnp.integer):
            check_scalar(**{name: value})
            if known(value):
                check_integer(1, _MOST_ITERATIONS, **{name: int(value)})
        else:
            check_integer(1, _MOST_ITERATIONS, **{name: value})


class GeneralizedAlpha(eqx.Module):
    """Time integration and Newton settings; all of them are traced numbers.

    Args:
        spectral_radius: rho_inf in [0, 1): numerical damping of the fastest modes (0 most). The
            default damps the chatter of strands in contact, which 0.8 lets ring on: there the
            example's adaptive run took five times the steps.
            Linear motion is stable for every rho and step, large motion is not: where a rod
            without damping flails in waves that a step does not resolve, their energy can grow
            until a step fails (a bent rod let go, with 14 steps in its slowest period: at 0.8,
            not at 0.6).
        tolerance: predicted error after the last Newton update, in rotations [rad] and
            displacements over the mean element length; None takes 1e-10 in float64 and 2e-5 in
            float32. The stretch of an inextensible rod is kept to 1e-12 whatever it says (in
            float32, and in every rod, as well as rounding of the positions lets it).
        max_iterations: Newton iterations allowed in a step.

    Example:
        >>> lively = rx.GeneralizedAlpha(spectral_radius=0.8)
    """

    spectral_radius: Float[Array, ""] = eqx.field(converter=as_float, default=0.5)
    tolerance: Float[Array, ""] | None = eqx.field(converter=as_float_or_none, default=None)
    max_iterations: Int[Array, ""] = eqx.field(converter=_as_count, default=20)

    def __check_init__(self):
        rho = self.spectral_radius
        check_scalar(spectral_radius=rho)
        if known(rho) and not 0 <= float(rho) < 1:
            raise ValueError(
                f"spectral_radius: must be in [0, 1), got {rho}; at 1 the constraint forces of"
                " the inextensible rod and its ends are not stable (index 3)"
            )
        if self.tolerance is not None:
            check_scalar(tolerance=self.tolerance)
            check_positive(tolerance=self.tolerance)
        _check_count(max_iterations=self.max_iterations)

    def check_precision(self, dtype) -> None:
        """Raise ValueError if the tolerance is out of reach of the rod's precision."""
        if self.tolerance is None or not all_known(self.tolerance):
            return
        floor = 100 * float(jnp.finfo(dtype).eps)
        if np.any(np.asarray(self.tolerance) < floor):
            raise ValueError(
                f"tolerance: {float(self.tolerance):g} is out of reach of {np.dtype(dtype).name};"
                f" use at least {floor:.1g}, or float64 (jax.config.update('jax_enable_x64', True))"
            )

    def newton_tolerance(self, dtype) -> Float[Array, ""]:
        """The tolerance in use."""
        if self.tolerance is not None:
            return self.tolerance.astype(dtype)
        return jnp.asarray(1e-10 if jnp.finfo(dtype).eps < 1e-12 else 2e-5, dtype)

    def newton_error(self, dtype, steps: int) -> float:
        """What Newton's tolerance lets the ends be off after so many steps (outside traced code).

        In element lengths and radians.
        """
        return 10 * steps * float(self.newton_tolerance(dtype))


class Coefficients(NamedTuple):
    """Numbers of one step."""

    dt: Float[Array, ""]
    alpha_m: Float[Array, ""]
    alpha_f: Float[Array, ""]
    beta: Float[Array, ""]
    gamma: Float[Array, ""]

    @property
    def by_velocity(self):
        """dV_{n+1} / d increment."""
        return self.gamma / (self.beta * self.dt)

    @property
    def by_acceleration(self):
        """dV'_{n+1} / d increment."""
        return (1 - self.alpha_m) / ((1 - self.alpha_f) * self.beta * self.dt**2)


def coefficients(rho: Float[Array, ""], dt: Float[Array, ""]) -> Coefficients:
    """Coefficients for a spectral radius and a step."""
    alpha_m = (2 * rho - 1) / (rho + 1)
    alpha_f = rho / (rho + 1)
    gamma = 0.5 + alpha_f - alpha_m
    return Coefficients(dt, alpha_m, alpha_f, 0.25 * (gamma + 0.5) ** 2, gamma)


def opening(c: Coefficients, rate, auxiliary, jerk):
    """(V, a) to begin a motion with, from V, V' and the normal part of V'' at its start.

    With s = a_m - a_f and a_n = V'(t_n + s dt) a step of exact velocity would move by
    dt^3 (1/6 - s/2 - beta) V'' too little. Where constraints fix the increment that error enters
    the accelerations, hence the internal force, at first order, until the scheme's velocities
    have settled at V + dt^2 (1/6 - s/2 - beta) V''. They begin there instead, along the
    constraints' normals, where alone it matters: V'' of the elastic motion, large for modes
    faster than a step, does not enter. Source: Arnold, Bruels & Cardona 2015 (perturbed starts).
    """
    shift = c.alpha_m - c.alpha_f
    lacking = 1 / 6 - 0.5 * shift - c.beta
    return rate + lacking * c.dt**2 * jerk, auxiliary + shift * c.dt * jerk


def predicted_increment(c: Coefficients, rate, auxiliary):
    """Increment of the step for a_{n+1} = 0; the unknown adds beta dt^2 a_{n+1} to it."""
    return c.dt * rate + c.dt**2 * (0.5 - c.beta) * auxiliary


def advance(c: Coefficients, rate, acceleration, auxiliary, correction):
    """(V, V', a) at the step's end for a correction beta dt^2 a_{n+1} of the increment.

    Taking the correction, not the increment, as the unknown keeps all digits as dt -> 0.
    """
    new_auxiliary = correction / (c.beta * c.dt**2)
    new_rate = rate + c.dt * ((1 - c.gamma) * auxiliary + c.gamma * new_auxiliary)
    new_acceleration = (
        (1 - c.alpha_m) * new_auxiliary + c.alpha_m * auxiliary - c.alpha_f * acceleration
    ) / (1 - c.alpha_f)
    return new_rate, new_acceleration, new_auxiliary


def local_error(c: Coefficients, auxiliary, new_auxiliary):
    """Local error of the increments: (1/12 + (a_m - a_f)^2/4) dt^2 (a_{n+1} - a_n)."""
    scale = 1 / 12 + 0.25 * (c.alpha_m - c.alpha_f) ** 2
    return scale * c.dt**2 * (new_auxiliary - auxiliary)
