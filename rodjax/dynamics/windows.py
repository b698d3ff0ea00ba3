"""A motion in windows, each begun anew: multiple shooting.

Through a fork (which side a rod buckles to, which strand goes in front) or a chaotic stretch a long
rollout has derivatives that lead nowhere. Over short windows that begin from states near the
observed motion they stay useful: fit to all windows at once, and let the defects, by which each
window's end misses the next one's start, go to zero.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from rodjax.dynamics.fixed_rollout import rollout
from rodjax.dynamics.run import Run
from rodjax.equations.generalized_alpha import GeneralizedAlpha
from rodjax.inputs.validation import as_integer, check_instance, check_integer, known
from rodjax.numerics import rotations
from rodjax.rods.state import State
from rodjax.scenes.scene import Scene


class Windows(eqx.Module):
    """Where windows begin, and the ends of their steps.

    Attributes:
        starts: a `State` of each, stacked along the leading axis.
        times: ends of the steps of each [s].
    """

    starts: State  # stacked along the leading axis
    times: Float[Array, "windows k"]


def cut(run: Run, count: int) -> Windows:
    """A run with every step saved as `count` windows of equally many steps.

    Args:
        run: motion near the observed one: of a guess, or of the fit so far.

    Raises:
        ValueError: the steps cannot be shared out equally, are not all saved, or failed.
    """
    check_instance(Run, "give a run, with every step saved", run=run)
    count = as_integer(count)
    check_integer(1, count=count)
    steps = run.times.shape[0] - 1
    if run.infos.iterations.shape[0] != steps:
        raise ValueError("run: every step must be saved; roll it out with save_every=1")
    if known(run.times) and not np.all(np.diff(run.times) > 0):
        raise ValueError("run: its states repeat after a failure; cut a run of the steps before")
    if steps % count:
        raise ValueError(f"count: the {steps} steps of the run do not make {count} equal windows")
    length = steps // count
    starts = jax.tree.map(lambda leaf: leaf[:-1:length], run.states)
    return Windows(starts, run.times[1:].reshape(count, length))


def roll(scene: Scene, windows: Windows, method: GeneralizedAlpha | None = None) -> Run:
    """All windows of a scene by one method, one after the other.

    Every leaf of the run has them along its leading axis.

    Differentiable as `rollout` is, in the starts too. A window that fails is not a number from then
    on and says so in `result`; the others go on.
    """
    check_instance(Scene, "give a scene", scene=scene)
    check_instance(Windows, "give windows, as `cut` makes them", windows=windows)
    one = lambda window: rollout(scene, window.starts, window.times, method, throw=False)
    return lax.map(one, windows)


def defects(windows: Windows, run: Run) -> Float[Array, "gaps nodes 12"]:
    """By how much the end of each of the windows in a run misses the next one's start.

    Columns: position [m], rotation vector in the body frame [rad], velocity [m/s] and angular
    velocity [rad/s]; weigh them by what they are allowed to be off.
    """
    end = jax.tree.map(lambda leaf: leaf[:-1, -1], run.states)
    begin = jax.tree.map(lambda leaf: leaf[1:], windows.starts)
    turn = rotations.multiply(rotations.conjugate(begin.quaternion), end.quaternion)
    return jnp.concatenate(
        [end.position - begin.position, rotations.logarithm(turn), end.rate - begin.rate], -1
    )
