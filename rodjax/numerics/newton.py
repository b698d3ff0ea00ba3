"""Newton's method for a pytree of equations, with exact derivatives of its solution.

An equations object has
    residual(x) -> r                                  r = 0 is to be solved,
    newton_increment(x) -> dx                         minus the derivative's inverse times r,
    linearize(x) -> system                            system.solve(b), system.solve_transpose(b),
                                                      system.multiply(b): the derivative at x,
                                                      system.eliminate(): for several right sides,
    linearize_with_residual(x) -> system, r           both, what they share evaluated once,
    retract(x, dx) -> x                               applies the solved increment,
    lift(x, dx) -> d(x)                               the same to first order,
    limit(x, dx) -> scale in (0, 1]                   how much of the increment is safe,
    size(dx) -> scalar                                the increment in units of the tolerance,
    rotation(dx) -> scalar                            its part that constraints are curved in,
    iterate(x, tolerance, max_iterations) -> x, info  by one of the iterations below,
as far as what is called needs them.

Increments are not shortened where they raise the residual: that is often the way to the solution.
Tried were up to three halvings until the norm of the scaled residual was below the largest of the
last three. At rest (a cantilever of 24 elements under tip loads of 10 to 1,000 A/L^2 brought on at
once or in ten steps, wound up by an end moment, hung between ends) iterations rose from 176 to 433
in all, and up to sixfold in one scene. In five stout cells of the stability map (contact force
x 1e6 and x 1, k2 12, rho_inf 0.9, no drag) 100 of 110 rejected steps are so by their local error,
the others take 114 of 4,850 iterations: halvings left 4,806, each with one more residual at least.
In six hard cells of the cantilever no step fails by Newton's method.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, Bool, Float, Int

from rodjax.numerics.results import Result

# Under `jax.checkpoint` with `jax.checkpoint_policies.save_only_these_names(SOLUTION)` a reverse
# pass takes what is so named from the forward pass, and repeats no iteration and no search.
SOLUTION = "newton_solution"


# Contraction above which a held derivative is taken anew, and one with duals: held longer, one of a
# hundred starts of strands that stick fails.
_HELD, _HELD_WITH_DUALS = 0.2, 0.1

# A first increment [rad] after which it is held all the same: of the stout example's in contact all
# below it went on to shrink fivefold, of a heap's with friction half.
_SMALL = 1e-2

# What an increment may leave of a constraint, at least a few units of rounding, and how many more
# increments are made for its sake: where rounding leaves it larger they would go on for ever.
_LEFT_OF_CONSTRAINT, _ROUNDING, _FINER = 1e-12, 4, 2

# How many increments may fail to shrink before a step is given up, to be tried again by a shorter.
PATIENCE = 4

# And where friction sorts out what sticks and what slips, which no shorter step would change.
PATIENCE_WITH_DUALS = 12


class NewtonInfo(NamedTuple):
    """How the iteration went."""

    result: Int[Array, ""]
    iterations: Int[Array, ""]


class _Loop(NamedTuple):
    x: Any
    iterations: Int[Array, ""]
    size: Float[Array, ""]
    contraction: Float[Array, ""]  # of the last increment over the one before
    turned: Float[Array, ""]  # by the increments since the derivative was taken
    slow: Int[Array, ""]
    close: Int[Array, ""]  # increments that ended within the tolerance, the last among them
    exact: Bool[Array, ""]  # whether constraints are kept
    finite: Bool[Array, ""]


def iterate(
    equations, x, tolerance, max_iterations, patience: int = PATIENCE
) -> tuple[Any, NewtonInfo]:
    """Newton's iteration. Stops on the error PREDICTED after an update from two successive ones.

    With sizes s_{k-1}, s_k of the last two increments and q = s_k/s_{k-1} the error left is about
    s_k q/(1 - q) or less (it is quadratic in s_k near a solution). Gives up early when so many
    increments in all as `patience` says have failed to shrink.

    A constraint that is linear but for rotations is left with the product of the last rotation
    and those since the derivative was taken (half its square just after it was). Where that may
    be above 1e-12 the iteration goes on, which the tolerance alone would not ask for.
    """

    limits = tolerance, max_iterations, patience
    return _until_done(lambda loop: _corrected_once(equations, loop, limits), x, limits)


def iterate_held(equations, x, tolerance, max_iterations) -> tuple[Any, NewtonInfo]:
    """As `iterate`, with the derivative held while increments shrink fast (chord method).

    The error left is predicted for the slower contraction of the chord method. For systems whose
    elimination costs several times a residual.
    """
    limits = tolerance, max_iterations, PATIENCE
    return _until_done(lambda loop: _corrected(equations, loop, limits, _HELD), x, limits)


def iterate_dual(
    equations, x, tolerance, max_iterations, held: bool = False
) -> tuple[Any, NewtonInfo]:
    """As `iterate`, by a derivative that has duals of its own: estimates that follow the iteration.

    Besides the methods above the equations have
        first_duals(x) -> duals, with_duals(duals) -> equations, next_duals(new x) -> duals.
    The derivative of the solution is the exact one, without duals. If `held`, the derivative is
    kept as by `iterate_held`, and so are its duals.
    """
    limits = tolerance, max_iterations, PATIENCE_WITH_DUALS

    def body(carry):
        loop, duals = carry
        whole = equations.with_duals(duals)
        if held:
            new = _corrected(whole, loop, limits, _HELD_WITH_DUALS)
        else:
            new = _corrected_once(whole, loop, limits)
        return new, whole.next_duals(new.x)

    going = lambda carry: _unfinished(carry[0], limits)
    begun = _beginning(x), equations.first_duals(x)
    return _outcome(lax.while_loop(going, body, begun)[0])


def _until_done(correct, x, limits) -> tuple[Any, NewtonInfo]:
    going = lambda loop: _unfinished(loop, limits)
    return _outcome(lax.while_loop(going, correct, _beginning(x)))


def _corrected_once(equations, loop: _Loop, limits) -> _Loop:
    """After an increment by a derivative of its own."""
    fresh = loop._replace(turned=jnp.zeros_like(loop.turned))
    return _updated(equations, fresh, equations.newton_increment(loop.x), limits[0])


def _corrected(equations, loop: _Loop, limits, shrinks: float) -> _Loop:
    """After increments by one derivative, as many as shrink by this factor."""
    system, residual = equations.linearize_with_residual(loop.x)
    system = system.eliminate()

    # not the method itself, which has no hash where it holds arrays that are traced
    def elsewhere(x):
        return equations.residual(x)

    def again(state):
        first, inner = state
        # how fast the first shrinks is not known: a small one is taken to shrink fast
        small = (inner.iterations == 1) & (inner.size < _SMALL)
        shrinking = (inner.contraction < shrinks) | (inner.close > 0) | small
        return _unfinished(inner, limits) & (first | shrinking)

    def correct(state):
        first, inner = state
        # by a condition, not before the loop by a solve of its own: the solve is compiled once
        here = lax.cond(first, lambda _: residual, elsewhere, inner.x)
        dx = system.solve(-here)
        # the first correction by a derivative is quadratic, s_1 = c s_0^2, and those that
        # follow shrink by 2 c s_0 each
        return jnp.asarray(False), _updated(equations, inner, dx, limits[0], growth=2.0)

    fresh = loop._replace(turned=jnp.zeros_like(loop.turned))
    return lax.while_loop(again, correct, (jnp.asarray(True), fresh))[1]


def _beginning(x) -> _Loop:
    no, zero = jnp.asarray(False), jnp.asarray(0, jnp.int32)
    one = jnp.ones((), x.dtype)
    return _Loop(x, zero, one * jnp.inf, one, 0 * one, zero, zero, no, ~no)


def _updated(equations, loop: _Loop, dx, tolerance, growth=1.0) -> _Loop:
    """The iteration after an increment, the next contraction being `growth` times the last."""
    scale = equations.limit(loop.x, dx)
    full = equations.size(dx)
    contraction = jnp.where(loop.iterations > 0, full / loop.size, 1.0)
    ahead = growth * contraction
    left = full * jnp.minimum(ahead / jnp.maximum(1 - ahead, 0.5), 1.0)
    turn = equations.rotation(dx)
    curved = turn * (0.5 * turn + loop.turned)
    close = (left <= tolerance) & (scale >= 1.0)
    slow = (contraction > 0.7) & (loop.iterations > 0) & (scale >= 1.0)
    return _Loop(
        equations.retract(loop.x, scale * dx),
        loop.iterations + 1,
        full,
        contraction,
        loop.turned + turn,
        loop.slow + slow.astype(jnp.int32),
        jnp.where(close, loop.close + 1, 0),
        curved <= max(_LEFT_OF_CONSTRAINT, _ROUNDING * jnp.finfo(curved.dtype).eps),
        jnp.isfinite(full),
    )


def _unfinished(loop: _Loop, limits):
    _, max_iterations, patience = limits
    done = (loop.close > 0) & (loop.exact | (loop.close > _FINER))
    going = ~done & loop.finite & (loop.iterations < max_iterations)
    return going & (loop.slow < patience)


def _outcome(end: _Loop) -> tuple[Any, NewtonInfo]:
    result = jnp.where(end.close > 0, Result.SUCCESS, Result.NEWTON_FAILED)
    result = jnp.where(end.finite, result, Result.NON_FINITE)
    return end.x, NewtonInfo(result.astype(jnp.int32), end.iterations)


@eqx.filter_custom_jvp
def solve(equations, x, tolerance, max_iterations) -> tuple[Any, NewtonInfo]:
    """Root of the equations from the guess x, differentiable as `root` is.

    The guess, the tolerance and the iterations taken have no influence on the derivative.
    """
    return equations.iterate(x, tolerance, max_iterations)


@solve.def_jvp
def _solve_jvp(primals, tangents):
    # named with its derivatives: named before them, second derivatives under a policy would miss
    # how the solution moves
    x, info = checkpoint_name(solve(*primals), SOLUTION)
    nothing = jax.tree.map(lambda _: None, info)
    return (x, info), (_tangent(primals[0], x, tangents[0]), nothing)


@eqx.filter_custom_jvp
def solve_linear(equations):
    """Root of equations residual(x) = A x - `right`, differentiable as `root` is."""
    return equations.linearize(None).solve(equations.right)


@solve_linear.def_jvp
def _solve_linear_jvp(primals, tangents):
    x = checkpoint_name(solve_linear(*primals), SOLUTION)
    return x, _tangent(primals[0], x, tangents[0])


@eqx.filter_custom_jvp
def root(equations, x):
    """The root x of the equations, with its derivative by the implicit function theorem.

    dx = -(dr/dx)^-1 (dr/d equations), in forward and reverse mode and nested.
    """
    return x


@root.def_jvp
def _root_jvp(primals, tangents):
    x = root(*primals)
    return x, _tangent(primals[0], x, tangents[0])


def _tangent(equations, x, change):
    """How the root x moves with a change of the equations."""
    if not any(leaf is not None for leaf in jax.tree.leaves(change)):
        return jnp.zeros_like(x)
    _, dr = eqx.filter_jvp(lambda e: e.residual(x), (equations,), (change,))
    if dr is None:  # what changes has no influence here
        return jnp.zeros_like(x)
    system = equations.linearize(x)
    dx = lax.custom_linear_solve(
        system.multiply,
        -dr,
        lambda _, b: system.solve(b),
        lambda _, b: system.solve_transpose(b),
    )
    return equations.lift(x, dx)


def constant(tree: Any) -> Any:
    """The tree without derivatives."""
    arrays, rest = eqx.partition(tree, eqx.is_array)
    return eqx.combine(lax.stop_gradient(arrays), rest)
