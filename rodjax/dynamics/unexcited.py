"""Rods that stay straight because nothing excites the modes in which they would buckle.

A straight rod without imperfection stays straight whatever presses or twists it: the equations are
solved, and no rod would do so. The ends of runs are looked at for that; `check` looks at the
stability of any state of rest, `equilibrium` counts the modes itself.
"""

import warnings

import jax
import jax.numpy as jnp
import numpy as np

from rodjax.dynamics.coarseness import turns_of_elements
from rodjax.dynamics.run import Run
from rodjax.equations.equations import Equations
from rodjax.equations.imbalance import lacking
from rodjax.equations.rigid_motions import check_held
from rodjax.equations.schemes import AtRest
from rodjax.equilibria.motion_norms import moving_weight
from rodjax.equilibria.unstable_modes import count_below, neutral
from rodjax.numerics.compilation import compiled
from rodjax.numerics.results import ModelWarning, Result
from rodjax.rods.chain import states_of
from rodjax.rods.rod import Rod
from rodjax.rods.state import State
from rodjax.scenes.scene import Scene

# P L^2/A + (M L/2A)^2 of a thrust P and a torque M below which no straight rod buckles, whatever
# holds it: pi^2/4 is a cantilever's under thrust, pi^2 that of one between pins under both.
_SAFE = 2.0


def warn_if_unexcited(scene: Scene, run: Run) -> None:
    """ModelWarning where a run ends straight, with unstable modes (outside traced code)."""
    if int(run.result) != Result.SUCCESS:
        return
    # not `run.final`, whose slices compile one by one
    final = jax.tree.map(lambda leaf: np.asarray(leaf)[-1], run.states)
    # where a constraint changes at the end, the forces are of those before
    if any(float(t) == float(final.time) for t in scene.switch_times):
        return
    pressed = [
        found
        for rod, state in zip(scene.rods, states_of(final), strict=False)  # then the bodies'
        if (found := _pressed(rod, state)) is not None
    ]
    if not pressed:
        return
    thrust, torque = pressed[0]
    final = run.final
    try:
        check_held(scene, final, spin_free=True)
    except ValueError:  # it is free to move: at rest nowhere
        return
    modes = int(_unstable(scene, final))
    if modes > 0:
        warnings.warn(
            f"the rod ends straight, under a thrust of {thrust:.3g} N and a torque of"
            f" {torque:.3g} N m, with {modes} unstable mode(s) that nothing in the scene excites; a"
            " rod would leave this state at the least disturbance. Give it an imperfection,"
            " rodjax.imperfect(rod), or a small load",
            ModelWarning,
            stacklevel=3,
        )


def _pressed(rod: Rod, state: State) -> tuple[float, float] | None:
    """Thrust [N] and torque [N m] of a rod that is straight, if they might make it buckle."""
    position, force = np.asarray(state.position), np.asarray(state.force)
    chord = position[-1] - position[0]
    length = np.sum(np.asarray(rod.length))
    along = chord / np.maximum(np.linalg.norm(chord), np.finfo(chord.dtype).tiny)
    aside = position - position[0] - np.outer((position - position[0]) @ along, along)
    rounding = np.sqrt(np.finfo(position.dtype).eps)
    # a state that is not finite is not straight either
    if not np.max(np.abs(aside)) <= rounding * length:
        return None
    stiffness = np.asarray(rod.stiffness)
    thrust = max(float(np.max(-force[:, 2])), 0.0)  # along the tangents
    twist = turns_of_elements(np.asarray(state.quaternion))[:, 2] / np.asarray(rod.length)
    twist = twist - np.asarray(rod.natural_curvature)[:, 2]
    torque = float(np.max(np.abs(stiffness[:, 2] * twist)))
    soft = np.min(stiffness[:, :2])
    if thrust * length**2 / soft + (0.5 * torque * length / soft) ** 2 < _SAFE:
        return None
    return thrust, torque


@compiled
def _unstable(scene: Scene, state: State):
    # it moves, if slowly, so that its loads do not balance: what they lack is given
    one = jnp.ones_like(state.time)
    rest = AtRest((state.position, state.quaternion), one, one, lacking(scene, state, one))
    equations = Equations.of(scene, rest, state, state.time)
    level = neutral(scene, state.force) * moving_weight(scene)
    return count_below(equations, equations.guess(state.force), level[None], 1)[0]
