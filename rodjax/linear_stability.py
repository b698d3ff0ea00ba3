"""Stability of an equilibrium: the tangent on the motions that constraint and ends allow.

Admissible motions are parametrised by the displacement of node 0, the spins of the nodes and, in
a compliant rod, the variations g of the elements' stretch and shear:

    u_{i+1} = u_i + ds E (g - gamma x d theta_e)        (see `balance`),

which solves the constraint exactly; the ends' conditions are linear in the parameters y and are
projected out. K = d(internal - external wrench) on these motions is the second variation of the
energy (plus the compliance's ds g^2 / compliance), of which the symmetric part is taken.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from rodjax import balance
from rodjax.compilation import compiled
from rodjax.load_path import check_held
from rodjax.scene import Scene, projectors
from rodjax.state import State
from rodjax.statics import at_rest, moved, static_balance
from rodjax.strains import strains


class Stability(NamedTuple):
    """Lowest eigenvalues of the second variation, ascending, and their modes."""

    eigenvalues: Float[Array, " k"]  # [N]
    modes: Float[Array, "k nodes 6"]  # displacement [m] and body spin [rad] of the nodes
    stable: Bool[Array, ""]  # whether the lowest is positive


class Reduced(NamedTuple):
    """Tangent on the admissible motions, before the ends are projected out."""

    basis: Float[Array, "m nodes 6"]  # motion of the nodes for each parameter
    stiffness: Float[Array, "m m"]
    norm: Float[Array, " m"]  # weights of the rotational norm (diagonal)
    ends: Float[Array, "12 m"]  # rows that must vanish


def reduced_tangent(scene: Scene, state: State) -> Reduced:
    """The tangent at a state on the motions that the constraint allows."""
    rod = scene.rod
    n, dtype = rod.elements, state.position.dtype
    kinematics = strains(rod, state.position, state.quaternion)
    shear = balance.constraint_tangent(rod, kinematics).constraint_spin  # gamma x d theta_e
    length = jnp.sum(rod.length)
    compliance = rod.compliance
    give = None if compliance is None else compliance > 0

    def expand(y):
        """Motion of the nodes for the parameters y = (u_0 / L, spins, g)."""
        spins = y[3 : 3 * n + 6].reshape(n + 1, 3)
        stretch = -jnp.einsum("nij,nj->ni", shear, jnp.concatenate([spins[:-1], spins[1:]], 1))
        if give is not None:
            stretch = stretch + give * y[3 * n + 6 :].reshape(n, 3)
        edge = rod.length[:, None] * jnp.einsum("nij,nj->ni", kinematics.frame, stretch)
        first = length * y[None, :3]
        return jnp.concatenate(
            [first + jnp.cumsum(jnp.concatenate([0 * first, edge]), 0), spins], 1
        )

    parameters = 3 + 3 * (n + 1) + (0 if give is None else 3 * n)
    basis = jax.vmap(expand)(jnp.eye(parameters, dtype=dtype))
    motion = at_rest(state.time, state.position, state.quaternion)

    def wrench(z):
        return static_balance(scene, moved(motion, z), state.force)[0]

    push = lambda z: jax.jvp(wrench, (jnp.zeros_like(z),), (z,))[1]
    flat = basis.reshape(parameters, -1)
    stiffness = flat @ jax.vmap(push)(basis).reshape(parameters, -1).T
    norm = jnp.concatenate([jnp.zeros((3,), dtype), jnp.repeat(rod.node_length, 3)])
    if compliance is not None:
        # components without compliance stay put: a spring far stiffer than all else holds them
        ds = jnp.repeat(rod.length, 3)
        stiff = _far_above(stiffness) * ds / length
        spring = ds / jnp.where(compliance > 0, compliance, 1.0).ravel()
        spring = jnp.where((compliance > 0).ravel(), spring, stiff)
        stiffness = stiffness + jnp.diag(jnp.concatenate([jnp.zeros_like(norm), spring]))
        norm = jnp.concatenate([norm, ds])
    first, last = projectors(scene, state.time)
    unit = jnp.repeat(jnp.stack([1 / length, jnp.ones_like(length)]), 3)
    held = [p @ (unit[:, None] * basis[:, i].T) for p, i in ((first, 0), (last, -1))]
    return Reduced(basis, 0.5 * (stiffness + stiffness.T), norm, jnp.concatenate(held))


def _far_above(matrix):
    """More than the largest eigenvalue of a symmetric matrix."""
    return 2 * jnp.max(jnp.sum(jnp.abs(matrix), 1))


def lowest(
    stiffness: Float[Array, "m m"],
    weight: Float[Array, "m m"],
    held: Float[Array, "12 m"],
    unit: Float[Array, ""],
    count: int,
) -> tuple[Float[Array, " k"], Float[Array, "k m"]]:
    """Lowest eigenvalues of K y = mu W y on held y = 0, and y with y^T W y = 1.

    W may be singular, so the problem is solved as W y = nu (K + sigma W) y, mu = 1/nu - sigma,
    with sigma the first of unit, 4 unit, 16 unit ... that makes the matrix positive definite.
    Eigenvalues can be differentiated (also degenerate ones, as the means over their eigenspaces);
    vectors are constants.
    """
    # the ends' rows may depend on each other (two clamps of a straight inextensible rod)
    rows = jnp.linalg.pinv(held, rtol=1e-9) @ held
    keep = jnp.eye(rows.shape[0], dtype=rows.dtype) - rows
    stiff = keep @ stiffness @ keep
    weight = keep @ weight @ keep
    symmetric = lambda a: 0.5 * (a + a.T)
    k, w, far = lax.stop_gradient((symmetric(stiff), symmetric(weight), rows))
    k = k + _far_above(k) * symmetric(far)

    def factor(sigma):
        return jnp.linalg.cholesky(k + sigma * w)

    indefinite = lambda carry: ~jnp.all(jnp.isfinite(carry[1])) & (carry[0] < 1e20 * unit)
    raised = lambda carry: (4 * carry[0], factor(4 * carry[0]))
    unit = lax.stop_gradient(unit)
    sigma, lower = lax.while_loop(indefinite, raised, (unit, factor(unit)))
    half = jax.scipy.linalg.solve_triangular(lower, w, lower=True)
    inverse = jax.scipy.linalg.solve_triangular(lower, half.T, lower=True)
    nu, vectors = jnp.linalg.eigh(symmetric(inverse))
    nu, vectors = nu[::-1][:count], vectors[:, ::-1][:, :count]
    y = jax.scipy.linalg.solve_triangular(lower.T, vectors, lower=False).T
    y = lax.stop_gradient(y / jnp.sqrt(nu)[:, None])
    values = 1 / nu - sigma
    # derivative of Rayleigh's quotient; its value, which has more round-off, is not used
    work = jnp.einsum("ki,ij,kj->k", y, stiff, y) - values * jnp.einsum("ki,ij,kj->k", y, weight, y)
    return values + work - lax.stop_gradient(work), y @ lax.stop_gradient(keep)


def stability(scene: Scene, state: State, count: int = 1) -> Stability:
    """The `count` lowest eigenvalues of the second variation at an equilibrium, and their modes.

    The norm is the integral of |spin|^2 ds (and, in a compliant rod, of the squared variation of
    stretch and shear), so eigenvalues are forces [N]: for a straight column under a thrust P the
    lowest is P_critical - P. Constraints are those in force from `state.time` on, loads those at
    `state.time`. A negative eigenvalue means instability. With loads that have no potential
    (follower loads, dead end moments) only the symmetric part of the tangent is seen: divergence,
    not flutter. Eigenvalues can be differentiated at an equilibrium, modes cannot.

    Dense: cost grows as n^3, meant for up to a few hundred elements.

    Raises:
        ValueError: the ends leave the rod free to move, or `count` does not fit.
    """
    check_held(scene, state)
    check_count(scene, count)
    return _stability(scene, state, count)


def check_count(scene: Scene, count: int) -> None:
    """Raise ValueError for a number of modes that the rod does not have."""
    if not 1 <= count <= scene.rod.elements:
        raise ValueError(f"count: from 1 to the {scene.rod.elements} elements, got {count}")


@compiled
def _stability(scene, state, count):
    reduced = reduced_tangent(scene, state)
    rod = scene.rod
    unit = 10 * jnp.mean(rod.stiffness[:, :2]) / jnp.sum(rod.length) ** 2
    values, y = lowest(reduced.stiffness, jnp.diag(reduced.norm), reduced.ends, unit, count)
    modes = jnp.einsum("km,mni->kni", y, lax.stop_gradient(reduced.basis))
    return Stability(values, modes, values[0] > 0)
