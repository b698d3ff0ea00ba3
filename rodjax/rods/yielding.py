"""A rod that stretches and shears a little, as rods in a heat bath must."""

import dataclasses

import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.inputs.argument_types import Number
from rodjax.inputs.validation import as_float, check_instance, check_positive, check_scalar
from rodjax.rods.rod import Rod


def yielding(rod: Rod, stiffer: Number | Float[Array, ""] = 30.0) -> Rod:
    """The rod with compliance where it has none: elements `stiffer` in stretch than in bending.

    An element of length ds bends by an angle under a force A/ds^2 at its ends; it is given the
    compliance ds^2/(stiffer A) in shear and stretch, A its lesser bending stiffness. In a heat
    bath its strains are then sqrt(kT ds/(stiffer A)) (root mean square), a tension N makes it
    longer by N ds^2/(stiffer A), and bending and twist of the elements have the statistics of an
    inextensible rod whatever `stiffer` is: in the energy stretch and shear stand by themselves,
    in axes of the element that their integral does not hang on.

    Args:
        rod: of which components of the compliance that are positive stay as they are.
        stiffer: the ratio, a positive number. More of it makes steps that must follow it shorter.

    Example:
        >>> soft = rx.yielding(rod, stiffer=100.0)
        >>> bool((soft.compliance > 0).all())
        True
    """
    check_instance(Rod, "give a rod, such as straight_rod makes", rod=rod)
    check_scalar(stiffer=stiffer)
    check_positive(stiffer=stiffer)
    dtype = rod.position.dtype
    ratio = jnp.asarray(as_float(stiffer), dtype)
    bending = jnp.min(rod.stiffness[:, :2], 1)
    solid = bending > 0  # of several rods some elements are none
    own = jnp.where(solid, rod.length**2 / (ratio * jnp.where(solid, bending, 1.0)), 0.0)
    own = jnp.broadcast_to(own[:, None], (rod.elements, 3))
    given = jnp.zeros_like(own) if rod.compliance is None else rod.compliance
    return dataclasses.replace(rod, compliance=jnp.where(given > 0, given, own))
