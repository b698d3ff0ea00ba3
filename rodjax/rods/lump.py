"""A rigid body that is fixed to a node: a point mass, or one with moments of inertia.

Of a body of mass m whose centre of mass is c from the node (both in the frame of the node, R from
body to inertial axes), with the moments of inertia I about that centre, the motion of the node
demands

    F = m (a + R (omega' x c + omega x (omega x c)))              inertial axes
    M = I omega' + omega x I omega + c x R^T F                    body axes, about the node

and its weight exerts m g, and c x R^T m g.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rodjax.inputs.validation import (
    as_float,
    as_float_or_none,
    check_finite,
    check_integer,
    check_not_negative,
    check_numbers,
    check_positive,
    check_scalar,
    check_shape,
    given,
    known,
    shown,
)

# Part of the largest moment by which rounded ones may be off: a flat body's has the sum of two.
_ROUNDING = 1e-6


class Lump(eqx.Module):
    """A point mass, or a rigid body, that is fixed to a node of a rod.

    It takes part in inertia, weight (`Gravity`) and energies; nothing else acts on it.

    Attributes:
        node: its number, from 0 at s = 0 of its rod; negative from s = L (-1 is the last).
        mass: of the body [kg].
        inertia: moments of inertia about its centre of mass, three about the axes a_1, a_2, a_3 of
            the node, or symmetric (3, 3) in them [kg m^2]; None for a point mass.
        offset: of the centre of mass from the node, in the node's body frame [m]; None at the node.
        volume: that it displaces [m^3], for the buoyancy of `Gravity`, which acts at the centre of
            mass; None for no buoyancy.
        rod: which of the rods of the scene, from 0.

    Example:
        >>> weight = rx.Lump(-1, 0.4, inertia=(2e-3, 2e-3, 1e-3))
        >>> loaded = rx.Scene(rod, rx.Clamped(), lumps=(weight,))
    """

    node: int = eqx.field(static=True)
    mass: Float[Array, ""] = eqx.field(converter=as_float)
    inertia: Float[Array, "3"] | Float[Array, "3 3"] | None = eqx.field(
        converter=as_float_or_none, default=None
    )
    offset: Float[Array, "3"] | None = eqx.field(converter=as_float_or_none, default=None)
    volume: Float[Array, ""] | None = eqx.field(converter=as_float_or_none, default=None)
    rod: int = eqx.field(static=True, default=0)

    def __check_init__(self):
        check_integer(-1_000_000, 1_000_000, node=self.node)
        check_integer(0, 10_000, rod=self.rod)
        check_scalar(mass=self.mass)
        check_positive(mass=self.mass)
        if self.inertia is not None:
            check_inertia(self.inertia)
        check_shape((3,), **given(offset=self.offset))
        check_finite(**given(offset=self.offset))
        check_scalar(**given(volume=self.volume))
        check_not_negative(**given(volume=self.volume))

    def place(self, parts) -> int:
        """The node among those of the scene, of rods that stand in these parts."""
        part = parts[self.rod]
        return self.node + (part.last + 1 if self.node < 0 else part.first)


def check_inertia(inertia) -> None:
    """Raise ValueError unless these are moments of inertia that a body may have."""
    check_numbers(inertia=inertia)
    if jnp.shape(inertia) not in ((3,), (3, 3)):
        raise ValueError(
            "inertia: give three principal moments, or a symmetric (3, 3), about the centre of"
            f" mass; got {shown(inertia)}"
        )
    check_finite(inertia=inertia)
    if not known(inertia):
        return
    matrix = np.asarray(inertia, float)
    matrix = np.diag(matrix) if matrix.ndim == 1 else matrix
    largest = float(np.max(np.abs(matrix)))
    if np.max(np.abs(matrix - matrix.T)) > _ROUNDING * largest:
        raise ValueError("inertia: must be symmetric, about axes through the centre of mass")
    moments = np.linalg.eigvalsh(matrix)
    said = ", ".join(f"{moment:.6g}" for moment in moments)
    if not moments[0] > 0:
        raise ValueError(
            "inertia: must be positive definite, give a thin body small moments (or None, which is"
            f" a point mass); got the principal moments {said}"
        )
    if moments[2] > moments[0] + moments[1] + _ROUNDING * largest:
        raise ValueError(
            "inertia: no body has a principal moment above the sum of the other two; give those"
            f" about the centre of mass, not about the node; got {said}"
        )
