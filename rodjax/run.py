"""A stored motion."""

import dataclasses

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from rodjax.brief import brief
from rodjax.results import Result
from rodjax.state import State
from rodjax.step_control import Control
from rodjax.stepping import StepInfo


class Run(eqx.Module):
    """A stored motion: the states saved, the first being the start, and what every step told.

    `states` has a leading axis over the saved states, `infos` over the accepted steps. `control`
    is the step control's memory of an adaptive run (None otherwise): with it, resuming continues
    bit for bit.

    Attributes:
        states: the `State`s saved, stacked; `run.state(i)`, `run.final`, `run.times` pick of them.
        infos: a `StepInfo` of stacked numbers, one an accepted step.
        result: worst `Result` of the run, as a number; 0 is success.
        rejected: steps that an adaptive run took back.
        wasted_iterations: Newton iterations of those.
        control: memory of the step control.
    """

    states: State
    infos: StepInfo
    result: Int[Array, ""]
    rejected: Int[Array, ""]
    wasted_iterations: Int[Array, ""]
    control: Control | None = None

    def __repr__(self) -> str:
        known = isinstance(self.result, jax.Array | np.ndarray) and np.ndim(self.result) == 0
        if not known or isinstance(self.result, jax.core.Tracer):
            return f"Run(states={brief(self.states.time)}, result={brief(self.result)})"
        times = np.asarray(self.times)
        span = f"{times[0]:g} to {times[-1]:g}" if len(times) else "none"
        parts = f"steps={len(self.infos.result)}, states={len(times)}, times={span}"
        return (
            f"Run({parts}, rejected={int(self.rejected)}, result={Result(int(self.result)).name})"
        )

    @property
    def times(self) -> Float[Array, " k"]:
        """Times of the saved states."""
        return self.states.time

    @property
    def final(self) -> State:
        """The last state."""
        return jax.tree.map(lambda leaf: leaf[-1], self.states)

    def state(self, index: int) -> State:
        """One saved state."""
        return jax.tree.map(lambda leaf: leaf[index], self.states)

    def nearest(self, time: float) -> State:
        """The saved state nearest to a time."""
        return self.state(int(np.argmin(np.abs(np.asarray(self.times) - time))))


def join_runs(start: State, parts: list[Run]) -> Run:
    """The run from `start` through the parts given to `on_chunk`, up to the last of them."""
    last = parts[-1]
    if start.settling is None and last.states.settling is not None:  # as the rollout did
        start = dataclasses.replace(start, settling=jnp.asarray(0, jnp.int32))
    join = lambda *leaves: jnp.asarray(np.concatenate(leaves))
    states, infos = jax.tree.map(join, *[(part.states, part.infos) for part in parts])
    states = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), start, states)
    return Run(states, infos, last.result, last.rejected, last.wasted_iterations, last.control)
