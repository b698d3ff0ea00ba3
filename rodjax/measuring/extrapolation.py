"""Richardson's extrapolation: two runs, one refined, combined into a more exact result.

The error of a smooth motion is c_2 h^2 + c_3 h^3 + ..., with h the element length and the step
refined together; what two runs find at common points and times then gives c_2, and without it the
error is of the next order: h^4 on the grid, h^3 in the step.
`experiments/error_vs_runtime.py` measures what it gains.

It gains nothing where that expansion does not hold: before the steps follow the motion, where
waves of the start ring on unresolved, through contact, whose first touch falls between steps.
"""

from typing import TypeVar

import jax
import jax.numpy as jnp

from rodjax.inputs.argument_types import Number
from rodjax.inputs.validation import check_numbers, check_scalar

Values = TypeVar("Values")


def extrapolate(
    coarse: Values, fine: Values, *, order: Number = 2.0, ratio: Number = 2.0
) -> Values:
    """fine + (fine - coarse) / (ratio^order - 1), leaf by leaf.

    Args:
        coarse, fine: the same quantities at the same material points and times, as arrays or
            pytrees of them: positions, strains, forces, energies, writhe. Not quaternions, which
            would not stay of unit length.
        order: of the leading error, 2 for the library's steps and statics.
        ratio: of the two element lengths and of the two steps.

    The difference of the result from `fine` estimates the error of `fine`. Differentiable.

    Raises:
        ValueError: shapes or structures differ, or `order` or `ratio` leave nothing to extrapolate.

    Example:
        >>> exact = 1.0
        >>> coarse, fine = exact + 0.04, exact + 0.01  # errors of second order, grids of 20 and 40
        >>> round(float(rx.extrapolate(coarse, fine)), 12)
        1.0
    """
    check_scalar(order=order, ratio=ratio)
    if not (ratio > 1 and order > 0):
        raise ValueError(f"ratio, order: must be above 1 and 0, got {ratio} and {order}")
    weight = 1 / (ratio**order - 1)

    def one(a, b):
        a, b = jnp.asarray(a), jnp.asarray(b)
        if jnp.shape(a) != jnp.shape(b):
            raise ValueError(
                f"coarse, fine: shapes {jnp.shape(a)} and {jnp.shape(b)} differ; take common"
                " points and times, such as every second node and step of the finer run"
            )
        return b + weight * (b - a)

    if jax.tree.structure(coarse) != jax.tree.structure(fine):
        raise ValueError("coarse, fine: give the same quantities, as pytrees of one structure")
    for leaf in jax.tree.leaves((coarse, fine)):
        check_numbers(**{"coarse, fine": leaf})
    return jax.tree.map(one, coarse, fine)
