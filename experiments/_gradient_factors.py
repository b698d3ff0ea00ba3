"""The inputs of the example that `gradient_check.py` differentiates by, as factors on them."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.dynamics.consistency import start
from rodjax.equations.generalized_alpha import GeneralizedAlpha
from rodjax.rods.state import State
from rodjax.scenes.scene import Scene

# differences must not see where Newton's iteration stopped
TOLERANCE = 1e-13


class Factors(eqx.Module):
    """What is differentiated: factors on inputs of the scene, all 1 in the run recorded."""

    k1: Float[Array, ""]
    k2: Float[Array, ""]
    k3: Float[Array, ""]
    k4: Float[Array, ""]
    cutoff: Float[Array, ""]
    aperture: Float[Array, ""]
    normal_drag: Float[Array, ""]
    tangential_drag: Float[Array, ""]
    youngs_modulus: Float[Array, ""]
    shear_modulus: Float[Array, ""]
    density: Float[Array, ""]
    natural_curvature: Float[Array, ""]
    drive: Float[Array, ""]
    initial_velocity: Float[Array, ""]
    spectral_radius: Float[Array, ""]

    @classmethod
    def ones(cls) -> "Factors":
        """The run recorded."""
        return cls(*(jnp.ones(()) for _ in dataclasses.fields(cls)))


NAMES = tuple(field.name for field in dataclasses.fields(Factors))


def varied(base: Scene, by: Factors) -> tuple[Scene, State, GeneralizedAlpha]:
    """Scene, start and method with the factors in them."""
    rod, contact = base.rod, base.contact
    assert contact is not None and rod.mass is not None
    turn = base.first_end.rotation
    assert turn is not None
    moduli = jnp.stack([by.youngs_modulus, by.youngs_modulus, by.shear_modulus])
    drag = dataclasses.replace(
        base.loads[0],
        normal_coefficient=by.normal_drag * base.loads[0].normal_coefficient,
        tangential_coefficient=by.tangential_drag * base.loads[0].tangential_coefficient,
    )
    law = dataclasses.replace(
        contact.law,
        k1=by.k1 * contact.law.k1,
        k2=by.k2 * contact.law.k2,
        k3=by.k3 * contact.law.k3,
        k4=by.k4 * contact.law.k4,
    )
    new = dataclasses.replace(
        base,
        rod=dataclasses.replace(
            rod,
            stiffness=moduli * rod.stiffness,
            mass=by.density * rod.mass,
            natural_curvature=by.natural_curvature * rod.natural_curvature,
        ),
        first_end=eqx.tree_at(
            lambda end: end.rotation.angle.values,
            base.first_end,
            by.drive * turn.angle.values,
        ),
        loads=(drag,),
        contact=dataclasses.replace(
            contact,
            law=law,
            cutoff=by.cutoff * contact.cutoff,
            # what would follow the cut-off is held
            exclusion=contact.excluded,
            aperture=by.aperture * contact.aperture,
        ),
    )
    s = rod.arc_length / jnp.sum(rod.length)
    across = jnp.asarray([0.0, 0.0, 1e-6])  # [m/s]
    velocity = by.initial_velocity * jnp.sin(jnp.pi * s)[:, None] ** 2 * across
    method = GeneralizedAlpha(0.5 * by.spectral_radius, tolerance=TOLERANCE)
    return new, start(new, velocity=velocity), method
