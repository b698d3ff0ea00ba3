"""Descent along the gradient of a loss in reverse mode: for many parameters, or any loss."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, PyTree

from rodjax.fitting.bounds import unknowns_of
from rodjax.fitting.fit_results import (
    FitError,
    FitResult,
    Progress,
    check_settings,
    reporting,
    short,
)
from rodjax.numerics.compilation import compiled
from rodjax.numerics.results import STEP_FAILED

_ADAM = optax.adam(0.05)  # one for all calls, which then share a compiled program


class Minimum(NamedTuple):
    """The smallest loss found, and its parameters.

    Attributes:
        parameters: a pytree like the guess.
        loss: the smallest.
        steps: those taken.
        evaluations: of the loss and its gradient, without those of line searches.
        history: losses at the guess and after each step.
        result: why the descent ended.
    """

    parameters: PyTree
    loss: float
    steps: int
    evaluations: int
    history: tuple[float, ...]
    result: FitResult

    def __repr__(self) -> str:
        return (
            f"Minimum({self.result.name}: loss {self.loss:.6g} after {self.steps} steps,"
            f" {self.evaluations} evaluations; {short(self.parameters)})"
        )


def minimize(
    loss: Callable[[PyTree], Array],
    guess: PyTree,
    *,
    bounds: PyTree = None,
    optimizer: optax.GradientTransformation | None = None,
    max_steps: int = 200,
    tolerance: float = 1e-6,
    progress: Progress = None,
) -> Minimum:
    """Minimize a loss along its gradient, in reverse mode.

    Args:
        loss: from the parameters to a number, differentiable in reverse mode. A step to where it
            or its gradient is not finite, or a step of a rollout fails, is halved, up to eight
            times; other errors are raised. Compiled once, as in `least_squares`.
        optimizer: of optax, for the vector of unknowns; None means `optax.adam(0.05)`, whose
            first step changes every unknown by 0.05. `optax.lbfgs()`, which uses the curvature,
            takes fewer steps where the loss is smooth; each holds a line search, whose evaluations
            are not counted. Pass the same object to repeated calls, or all is compiled anew.
        tolerance: converged when the next step changes no unknown by more.
        guess, bounds, max_steps, progress: as in `least_squares`.

    Raises:
        FitError: the loss or its gradient is not finite at the guess.
        ValueError: guess and bounds do not fit.

    Example:
        >>> found = rx.minimize(lambda x: jnp.sum((x - 2.0) ** 2), np.zeros(3))
        >>> bool(jnp.allclose(found.parameters, 2.0, atol=1e-3))
        True
    """
    check_settings(max_steps, tolerance, None, progress)
    if not callable(loss):
        raise ValueError(f"loss: give a function of the parameters, got {loss!r}")
    if optimizer is not None and not isinstance(optimizer, optax.GradientTransformation):
        raise ValueError(f"optimizer: give one of optax, such as optax.lbfgs(), got {optimizer!r}")
    unknowns = unknowns_of(guess, bounds)
    optimizer = _ADAM if optimizer is None else optimizer
    best = held = trial = unknowns.vector(unknowns.like)
    memory, shift, history, halvings, evaluations = optimizer.init(trial), 0 * trial, [], 0, 0
    result = FitResult.MAX_STEPS
    with reporting(progress, unknowns, max_steps) as report:
        try:
            while len(history) <= max_steps:
                evaluations += 1
                try:
                    found = _descend(loss, unknowns, optimizer, trial, memory)
                except STEP_FAILED:
                    if not history:
                        raise
                    found = np.nan, np.nan * trial, shift, memory
                value, gradient, step, after = found
                bad = ~np.isfinite(np.asarray(gradient))
                if np.any(bad) or not np.isfinite(value):
                    if not history:
                        names = ", ".join(np.array(unknowns.names)[bad]) or "no parameter"
                        raise FitError(
                            f"guess: the loss is {float(value):g}, and its derivative not finite"
                            f" with respect to {names}"
                        )
                    if halvings == 8:
                        result = FitResult.NON_FINITE
                        break
                    halvings, shift = halvings + 1, 0.5 * shift
                    trial = held + shift
                    continue
                history.append(float(value))
                best = trial if history[-1] <= min(history) else best
                report(len(history) - 1, min(history), best)
                if np.max(np.abs(step)) <= tolerance:
                    result = FitResult.CONVERGED
                    break
                held, memory, shift, halvings = trial, after, step, 0
                trial = held + shift
        except KeyboardInterrupt:
            if not history:
                raise
            result = FitResult.INTERRUPTED
    best = unknowns.parameters(best)
    return Minimum(best, min(history), len(history) - 1, evaluations, tuple(history), result)


@compiled
def _descend(loss, unknowns, optimizer, vector, memory) -> tuple[Array, Array, Any, Any]:
    def objective(u):
        value = jnp.asarray(loss(unknowns.parameters(u)))
        if value.shape != ():
            raise ValueError(f"loss: must give one number, got shape {value.shape}")
        return value

    value, gradient = jax.value_and_grad(objective)(vector)
    # what a line search needs; other optimizers do without
    more = {"value": value, "grad": gradient, "value_fn": objective}
    update = optax.with_extra_args_support(optimizer).update
    # optax mixes whole numbers and others: not to be refused where users have strict promotions
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        step, memory = update(gradient, memory, vector, **more)
    return value, gradient, step, memory
