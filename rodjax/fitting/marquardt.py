"""Levenberg and Marquardt's method of optimistix, told residuals and Jacobian trial by trial.

It never evaluates the prediction itself: a rejected trial costs no further simulation, and the
loop around it can report, stop and keep what it has. It works in the unknowns' precision, the
default, whatever that of the prediction.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array

from rodjax.numerics.compilation import compiled

# Its own tolerances do not matter: the loops above end it. The damping falls after fair steps, not
# only after nearly perfect ones, without which a parameter creeps towards its bound.
_SOLVER = eqx.tree_at(
    lambda solver: solver.search,
    optx.LevenbergMarquardt(1e-8, 1e-8),
    optx.ClassicalTrustRegion(high_cutoff=0.75),
)
_OPTIONS = {"jac": "fwd"}


class Marquardt(NamedTuple):
    """Where the solver is, in y = scale * unknowns."""

    size: Array  # of the residual at the start
    scale: Array
    y: Array  # the point held
    state: Any  # arrays of the solver's state; its `y_eval` is the trial


def _model(residual, jacobian, about):
    """What the solver sees: residuals linear about the trial.

    A Jacobian that is not finite makes them not finite too, and the solver takes any such trial
    back and damps more.
    """
    return lambda y, _: (residual + jacobian @ (y - about), None)


def _state(residual, jacobian, y):
    out = jax.eval_shape(lambda: residual)
    model = _model(residual, jacobian, y)
    return _SOLVER.init(model, y, None, _OPTIONS, out, None, frozenset())


def _begin(residual, jacobian, vector):
    """The solver at the start, of residual 1 and columns 10 in its Jacobian.

    So the damping, which is 1 to begin with, is a hundredth of the diagonal of J^T J.
    """
    norm = lambda x: jnp.linalg.norm(x, axis=0)
    safe = lambda x: jnp.where(x > 0, x, 1.0)
    residual, jacobian = (x.astype(vector.dtype) for x in (residual, jacobian))
    size = safe(norm(residual))
    scale = safe(norm(jacobian)) / (10 * size)
    y = scale * vector
    return Marquardt(size, scale, y, eqx.filter(_state(residual, jacobian, y), eqx.is_array))


def _advance(residual, jacobian, solver):
    """Tell the solver residual and Jacobian at its trial; the next trial, and how far it is."""
    size, scale, y, state = solver
    residual, jacobian = (x.astype(y.dtype) for x in (residual, jacobian))
    residual, jacobian = residual / size, jacobian / (size * scale)[None]
    # the rest of the state are programs, made again here: they do not pass through jit
    programs = eqx.filter(_state(residual, jacobian, y), eqx.is_array, inverse=True)
    model, state = _model(residual, jacobian, state.y_eval), eqx.combine(state, programs)
    y, state, _ = _SOLVER.step(model, y, None, _OPTIONS, state, frozenset())
    solver = Marquardt(size, scale, y, eqx.filter(state, eqx.is_array))
    return solver, state.y_eval / scale, jnp.max(jnp.abs(state.y_eval - y) / scale)


begin_one, begin_all = compiled(_begin), compiled(jax.vmap(_begin))
advance_one, advance_all = compiled(_advance), compiled(jax.vmap(_advance))
