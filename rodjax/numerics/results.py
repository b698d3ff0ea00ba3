"""Result codes of traced code, and the errors they become outside it."""

import enum

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int


class Result(enum.IntEnum):
    """Why a computation ended; the larger code wins when several are joined.

    Example:
        >>> print(rx.Result(int(run.result)).name)
        SUCCESS
        >>> print(rx.Result.DRIVE_TOO_FAST)  # what it means and what to do  # doctest: +ELLIPSIS
        DRIVE_TOO_FAST (...): ...
    """

    SUCCESS = 0
    STEP_TOO_SMALL = 1
    MAX_STEPS = 2
    NEWTON_FAILED = 3
    STRAND_PASSAGE = 4
    CAPACITY_OVERFLOW = 5
    ROTATION_TOO_LARGE = 6
    SWITCH_MISSED = 7
    NON_FINITE = 8
    UNRESOLVED = 9  # only of runs in which nothing failed
    DRIVE_TOO_FAST = 10
    CONTACT_OVERCOME = 11
    INTERRUPTED = 12

    def __str__(self) -> str:
        """Name, number and what it means with its mend."""
        return f"{self.name} ({int(self)}): {MESSAGES[self]}"

    def __format__(self, spec: str) -> str:
        return format(int(self), spec) if spec else str(self)

    DRIVE_MISSED = 13  # only of runs in which nothing failed
    HELD_TWICE = 14
    OBSTACLE_PASSED = 15
    DIFFUSED_TOO_FAR = 16
    NO_BRANCH_POINT = 17


MESSAGES = {
    Result.SUCCESS: "the computation succeeded",
    Result.UNRESOLVED: (
        "the given steps do not resolve the motion: their local errors are of its own size (use"
        " smaller steps, or the adaptive rollout), or they are so small that velocities drown in"
        " rounding (use longer steps, or float64)"
    ),
    Result.DRIVE_TOO_FAST: (
        "an end is turned by half a turn or more in one step, which cannot be told from fewer"
        " turns; use smaller steps (the adaptive rollout takes them by itself)"
    ),
    Result.CONTACT_OVERCOME: (
        "strands were pressed closer to each other than the contact law can hold them apart; use a"
        " stronger law, for solids `Contact.solid` with the force expected"
    ),
    Result.HELD_TWICE: (
        "a constraint began that holds the rod twice in some direction, so that its force is not"
        " determined (a straight inextensible rod whose ends can no longer move along it): let one"
        " end slide on, give the rod axial compliance, or begin the hold when the rod is bent"
    ),
    Result.OBSTACLE_PASSED: (
        "a node went through an obstacle, or half a diameter into it in one step: use smaller steps"
        " (the adaptive rollout takes them by itself), or a stiffer obstacle; or an obstacle came"
        " between two nodes, which did not feel it: use more elements, or points between nodes"
        " (`points_per_element` of the obstacle)"
    ),
    Result.DIFFUSED_TOO_FAR: (
        "in one step of a thermal rod a node moved farther than half of the contact's cut-off, so"
        " that strands can cross unseen; use a smaller dt (the free motion of a node in a step is"
        " sqrt(2 kT dt / drag)), or a longer cut-off"
    ),
    Result.NO_BRANCH_POINT: (
        "at this point nothing branches, since something in the scene breaks the symmetry that a"
        " branch point needs; look for a fold along the path of this scene"
    ),
    Result.INTERRUPTED: "stopped by the user; what was computed until then is kept",
    Result.DRIVE_MISSED: (
        "an end or joint is not where its schedule puts it at the end, though no step failed; a"
        " schedule must be a function of time alone (and a `Function` must not read what changes"
        " after its first use), and a user's end must tell its `switch_times`"
    ),
    Result.STEP_TOO_SMALL: (
        "the step fell below min_step without an acceptable solution; the motion is too fast or the"
        " contact too stiff for the grid: use more elements, a softer law, or a smaller min_step"
    ),
    Result.MAX_STEPS: "max_steps was reached before the end time; raise max_steps or the tolerance",
    Result.NEWTON_FAILED: (
        "Newton's method did not converge; use a smaller step, or the adaptive rollout"
    ),
    Result.STRAND_PASSAGE: (
        "a strand seems to have passed through another (Tw + Wr jumped); use more contact segments"
        " and elements, a stiffer law or smaller steps"
    ),
    Result.CAPACITY_OVERFLOW: (
        "more pairs or vertices were in contact than the contact's `pairs_per_segment` and"
        " `capacities` hold; raise them"
    ),
    Result.ROTATION_TOO_LARGE: (
        "an element turned by more than 0.9 of a revolution, or a node by half of one in a step;"
        " use more elements or smaller steps; angles are in radians, and units must be consistent"
    ),
    Result.SWITCH_MISSED: (
        "a step strode over the time at which a constraint changes; end a step there"
    ),
    Result.NON_FINITE: (
        "a value became infinite or not a number; check the inputs, or use a smaller step"
    ),
}


class ModelWarning(UserWarning):
    """A result that solves the equations given, but perhaps not the problem that was meant.

    Example:
        >>> import warnings
        >>> warnings.simplefilter("error", rx.ModelWarning)  # doctest: +SKIP
    """


class SimulationError(RuntimeError):
    """A run that failed, with its `result` and, where there is one, what it had computed.

    Example:
        >>> try:
        ...     rx.adaptive_rollout(scene, rx.start(scene), 1.0, max_steps=3)
        ... except rx.SimulationError as error:
        ...     print(error.result.name, len(error.partial.times))
        MAX_STEPS 4
    """

    def __init__(self, result: Result, where: str = "", partial=None):
        self.result = Result(result)
        self.partial = partial
        super().__init__(f"{where + ': ' if where else ''}{MESSAGES[self.result]}")


class Interrupted(KeyboardInterrupt):
    """Ctrl-C during a run; `partial` is the run so far, `result` says INTERRUPTED.

    Still a KeyboardInterrupt, whatever `throw` says: scripts end by it, and no `except Exception`
    holds it.

    Example:
        >>> try:
        ...     run = rx.rollout(scene, rx.start(scene), np.linspace(0.02, 0.2, 10))
        ... except rx.Interrupted as stopped:
        ...     run = stopped.partial  # all steps up to Ctrl-C
    """

    def __init__(self, where: str = "", partial=None):
        self.result = Result.INTERRUPTED
        self.partial = partial
        super().__init__(f"{where + ': ' if where else ''}{MESSAGES[self.result]}")


# How a step says that it failed: outside traced code, or by a check in a compiled program. Faults
# of the machine or of a program (memory, a device, a callback) are RuntimeErrors, but not these.
STEP_FAILED = (SimulationError, eqx.EquinoxRuntimeError)


def as_code(result: Result) -> Int[Array, ""]:
    """A result as traced code holds it."""
    return jnp.asarray(int(result), jnp.int32)


def join(*codes: Int[Array, ""]) -> Int[Array, ""]:
    """The worst of several codes."""
    worst = jnp.asarray(codes[0], jnp.int32)
    for code in codes[1:]:
        worst = jnp.maximum(worst, jnp.asarray(code, jnp.int32))
    return worst


def raise_if_failed(code, where: str = "", partial=None) -> None:
    """Raise `SimulationError` outside traced code unless the worst of the codes is a success."""
    worst = Result(int(np.max(np.asarray(code))))
    if worst is not Result.SUCCESS:
        raise SimulationError(worst, where, partial)
