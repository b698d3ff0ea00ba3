"""Modes of an equilibrium whose eigenvalues are nearest to zero, by inverse iteration.

K y = lambda M y on the motions that constraints and ends allow, M the norm of `motion_norms`. A
subspace is multiplied by K^-1 M until its values rest, each time by one elimination of the Newton
system, which costs as much as a Newton increment. From the modes of the point before few are
needed.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from rodjax.continuation.family import Family, Parameter, Place, balanced, resistance_of
from rodjax.equilibria.motion_norms import moving_weight
from rodjax.numerics.compilation import compiled

# Iterations at most, and the change of values that ends them, of the largest of them.
_MOST, _RESTS = 60, 1e-9

# By how much of anything the first subspace is disturbed, of unit norm.
_DISTURBED = 0.1

Motions = Float[Array, "k nodes 6"]


class NearModes(NamedTuple):
    """Modes by ascending size of their eigenvalues.

    Attributes:
        values: eigenvalues [N], those of the symmetric part of the tangent in the subspace.
        modes: displacements [m] and body spins [rad] of unit norm, the integral of
            |spin|^2 + |displacement|^2/L^2 [m].
        odd: the antisymmetric part of the tangent in the subspace, over the symmetric one.
    """

    values: Float[Array, " k"]
    modes: Motions
    odd: Float[Array, ""]
    iterations: Int[Array, ""]


class _Loop(NamedTuple):
    modes: Motions
    values: Float[Array, " k"]
    odd: Float[Array, ""]
    iterations: Int[Array, ""]
    rests: Array


@compiled
def near_modes(family: Family, parameter: Parameter, place: Place, first: Motions) -> NearModes:
    """The modes that a subspace leads to.

    It is disturbed first: modes of the point before may be of one symmetry all (the torsion of a
    straight rod), and would lead to none of another, whatever its eigenvalue.
    """
    x = family.guess(parameter, place)
    derivative = family.derivative(parameter, place, x, family.pairs(parameter, place, x))
    resisted = derivative.equations
    weight = moving_weight(resisted.scene)
    level = resistance_of(resisted.scene)
    waves = first_motions(first.shape[1], len(first), x.dtype)
    sizes = jnp.einsum("kni,ni,kni->k", waves, weight, waves)
    first = first + _DISTURBED * waves / jnp.sqrt(sizes)[:, None, None]

    def pushed(modes):
        right = jax.vmap(lambda mode: balanced(resisted, weight * mode, x))(modes)
        solved = jax.vmap(derivative.solve)(right)
        return jax.vmap(resisted.change)(solved)

    def improve(loop: _Loop) -> _Loop:
        new = pushed(loop.modes)
        # the most singular of them are larger by many orders: orthogonal columns bear that,
        # products of the columns with each other do not
        columns = (jnp.sqrt(weight)[None] * new).reshape(len(new), -1).T
        root = jnp.linalg.qr(columns, mode="r").T
        inside = jnp.einsum("ani,ni,bni->ab", new, weight, loop.modes)
        inside = jax.scipy.linalg.solve_triangular(root, inside, lower=True)
        inside = jax.scipy.linalg.solve_triangular(root, inside.T, lower=True).T
        inside = inside - level * jnp.eye(len(new), dtype=new.dtype)
        values, vectors = jnp.linalg.eigh(0.5 * (inside + inside.T))
        order = jnp.argsort(jnp.abs(values))
        values, vectors = values[order], vectors[:, order]
        vectors = jax.scipy.linalg.solve_triangular(root, vectors, lower=True, trans=1)
        modes = jnp.einsum("ani,ab->bni", new, vectors)
        size = jnp.max(jnp.abs(values))
        odd = jnp.max(jnp.abs(inside - inside.T)) / jnp.maximum(size, jnp.finfo(size.dtype).tiny)
        # the last is the one that a larger subspace would change
        change = jnp.max(jnp.abs(values - loop.values)[:-1])
        rests = change <= _RESTS * size
        return _Loop(modes, values, odd, loop.iterations + 1, rests)

    going = lambda loop: ~loop.rests & (loop.iterations < _MOST)
    zero = jnp.zeros((), x.dtype)
    none = jnp.full((len(first),), jnp.inf, x.dtype)
    begun = _Loop(first, none, zero, jnp.zeros((), jnp.int32), jnp.asarray(False))
    end = lax.while_loop(going, improve, begun)
    return NearModes(end.values, end.modes, end.odd, end.iterations)


def first_motions(nodes: int, count: int, dtype) -> Motions:
    """What inverse iteration begins with: waves, in no symmetric way."""
    along = jnp.linspace(0.0, jnp.pi, nodes, dtype=dtype)[None, :, None]
    number = jnp.arange(1, count + 1, dtype=dtype)[:, None, None]
    lane = jnp.arange(1, 7, dtype=dtype)[None, None, :]
    return jnp.sin((0.7 * number + 0.13 * lane) * along + 0.9 * lane * number)
