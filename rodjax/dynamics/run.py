"""A stored motion."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from rodjax.dynamics.run_sheet import sheet_of_run
from rodjax.dynamics.step_control import Control
from rodjax.dynamics.stepping import StepInfo, no_info
from rodjax.inputs.argument_types import AnyArray
from rodjax.inputs.brief import brief
from rodjax.inputs.validation import all_known
from rodjax.numerics.results import Result, as_code
from rodjax.rods.state import State


class Run(eqx.Module):
    """A stored motion: the states saved, the first being the start, and what every step told.

    `states` has a leading axis over the saved states, `infos` over the accepted steps. `control`
    is the step control's memory of an adaptive run (None otherwise): with it, resuming from
    `resume_state` continues bit for bit.

    Attributes:
        states: the `State`s saved, stacked; `run.state(i)`, `run.final`, `run.times` pick of them.
        infos: a `StepInfo` of stacked numbers, one an accepted step.
        result: worst `Result` of the run, as a number; 0 is success.
        rejected: steps that an adaptive run took back.
        wasted_iterations: Newton iterations of those.
        control: memory of the step control.
        steps_before: accepted steps before each saved state, where they were thinned by time; None
            where every one is saved, or every so many.

    Example:
        >>> run.final.position.shape, rx.Result(int(run.result)).name
        ((21, 3), 'SUCCESS')
        >>> float(run.nearest(0.21).time)
        0.2
    """

    states: State
    infos: StepInfo
    result: Int[Array, ""]
    rejected: Int[Array, ""]
    wasted_iterations: Int[Array, ""]
    control: Control | None = None
    steps_before: Int[AnyArray, " k"] | None = None

    def __repr__(self) -> str:
        known = isinstance(self.result, jax.Array | np.ndarray) and np.ndim(self.result) == 0
        if not known or not all_known(self.result):
            return f"Run(states={brief(self.states.time)}, result={brief(self.result)})"
        times = np.asarray(self.times)
        span = f"{times[0]:g} to {times[-1]:g}" if len(times) else "none"
        parts = f"steps={len(self.infos.result)}, states={len(times)}, times={span}"
        return (
            f"Run({parts}, rejected={int(self.rejected)}, result={Result(int(self.result)).name})"
        )

    def __str__(self) -> str:
        return sheet_of_run(self).text

    def _repr_html_(self) -> str:
        return sheet_of_run(self).html

    @property
    def times(self) -> Float[Array, " k"]:
        """Times of the saved states."""
        return self.states.time

    @property
    def step_counts(self) -> Int[AnyArray, " k"]:
        """Accepted steps before each saved state."""
        if self.steps_before is not None:
            return self.steps_before
        steps, intervals = self.infos.result.shape[0], self.states.time.shape[0] - 1
        return np.arange(intervals + 1) * (steps // max(intervals, 1))

    @property
    def final(self) -> State:
        """The last state."""
        return self.state(-1)

    @property
    def resume_state(self) -> State:
        """The last state that the end of the run had no part in.

        An adaptive run shortens its last steps to end on its end time; a longer run would not
        have. Resumed from here it takes the steps of the longer run.
        """
        landing = 0 if self.control is None else max(int(self.control.landing), 0)
        return self.state(-1 - landing)

    def state(self, index: int) -> State:
        """One saved state."""
        return jax.tree.map(lambda leaf: _picked(leaf, index), self.states)

    def nearest(self, time: float) -> State:
        """The saved state nearest to a time."""
        return self.state(int(np.argmin(np.abs(np.asarray(self.times) - time))))


def _picked(leaf, index: int):
    """One entry of an array along its first axis."""
    if isinstance(leaf, jax.Array) and all_known(leaf) and jax.default_backend() == "cpu":
        # a slice by jax is a program of its own for every length of a run
        return jax.device_put(np.asarray(leaf)[index])
    return leaf[index]


def of_no_steps(state: State) -> Run:
    """The run of no steps from a state, interrupted there."""
    one = lambda leaf: jax.device_put(np.asarray(leaf)[None])
    none = lambda leaf: jax.device_put(np.zeros((0, *leaf.shape), leaf.dtype))
    info, zero = no_info(state.position.dtype), jnp.asarray(0, jnp.int32)
    code = as_code(Result.INTERRUPTED)
    return Run(jax.tree.map(one, state), jax.tree.map(none, info), code, zero, zero)


def of_states(states: State, code: Result = Result.SUCCESS) -> Run:
    """Stacked states as a run that took no steps between them, of this result."""
    begun = of_no_steps(jax.tree.map(lambda leaf: leaf[0], states))
    return dataclasses.replace(begun, states=states, result=as_code(code))


def join_runs(start: State, parts: list[Run]) -> Run:
    """The run from `start` through the parts given to `on_chunk`, up to the last of them.

    Raises:
        ValueError: there is no part, or a part does not begin after the one before.
    """
    if not parts:
        raise ValueError("parts: there is none")
    times = [np.asarray(start.time)[None], *(np.asarray(part.states.time) for part in parts)]
    with_start = any(len(part.states.time) > len(part.infos.result) for part in parts)
    # equal after a failure, where the last good state may be repeated
    if with_start or np.any(np.diff(np.concatenate(times)) < 0):
        raise ValueError(
            "parts: each must begin after the end of the one before, without the state it began"
            " from, as those given to on_chunk do; for a run and what resumed it, use"
            " rodjax.run.continued(run, rest)"
        )
    last = parts[-1]
    if start.settling is None and last.states.settling is not None:  # as the rollout did
        start = dataclasses.replace(start, settling=jnp.asarray(0, jnp.int32))
    if start.memory is None and last.states.memory is not None:  # which began with the run
        unknown = lambda leaf: np.full_like(leaf[0], np.nan)
        memory = jax.tree.map(unknown, last.states.memory)
        start = dataclasses.replace(start, memory=memory)
    join = lambda *leaves: np.concatenate(leaves)
    states, infos = jax.tree.map(join, *[(part.states, part.infos) for part in parts])
    # put, not converted: that would compile a program for every length
    infos = jax.tree.map(jax.device_put, infos)
    first = lambda a, b: jax.device_put(np.concatenate([np.asarray(a)[None], b]))
    states = jax.tree.map(first, start, states)
    return Run(states, infos, last.result, last.rejected, last.wasted_iterations, last.control)


def continued(run: Run, rest: Run) -> Run:
    """A run and the one that resumed it as one.

    What lies after the start of `rest` is left out of `run`: its steps to its end time, which the
    resumed run makes anew. Counts of rejected steps are those of both.

    Raises:
        ValueError: `rest` does not begin from a state of `run`.
    """
    first = jax.tree.map(lambda leaf: leaf[0], rest.states)
    at = np.flatnonzero(np.asarray(run.times) == np.asarray(first.time))
    if not at.size or not _equal(run.state(int(at[-1])), first):
        raise ValueError("rest: it does not begin from a state of run, as `resume` begins")
    count = int(at[-1])
    if run.times.shape[0] < 2:
        return rest
    before, after = np.asarray(run.step_counts), np.asarray(rest.step_counts)
    steps = int(before[count])
    counts = np.concatenate([before[:count], steps + after]).astype(np.int32)
    cut = lambda tree, size: jax.tree.map(lambda leaf: leaf[:size], tree)
    join = lambda a, b: jnp.concatenate([a, b])
    infos = jax.tree.map(join, cut(run.infos, steps), rest.infos)
    return Run(
        jax.tree.map(join, cut(run.states, count), rest.states),
        infos,
        rest.result,
        run.rejected + rest.rejected,
        run.wasted_iterations + rest.wasted_iterations,
        rest.control,
        None if np.array_equal(counts, np.arange(len(counts))) else counts,
    )


def thinned(run: Run, times: Float[np.ndarray, " t"]) -> Run:
    """The run with the states of these times alone, the first and the last; all steps are told.

    One that is resumed goes on from its last state: that before its last steps were shortened may
    not be there.
    """
    saved, counts = np.asarray(run.times), np.asarray(run.step_counts, np.int32)
    keep = np.isin(saved, np.asarray(times, saved.dtype))
    keep[[0, -1]] = True
    control = run.control
    if control is not None:
        control = control._replace(landing=jnp.minimum(control.landing, 0))
    states = jax.tree.map(lambda leaf: jax.device_put(np.asarray(leaf)[keep]), run.states)
    return dataclasses.replace(run, states=states, control=control, steps_before=counts[keep])


def _equal(a: State, b: State) -> bool:
    """Whether states are the same bit for bit."""
    same = lambda x, y: np.asarray(x).tobytes() == np.asarray(y).tobytes()
    return jax.tree.structure(a) == jax.tree.structure(b) and all(
        same(x, y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    )
