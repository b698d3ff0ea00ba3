"""Whether given steps resolve the motion that they took, judged when a rollout has ended."""

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from rodjax.dynamics.stepping import StepInfo
from rodjax.rods.state import State
from rodjax.scenes.scene import Scene

COARSE = 0.5  # local errors over motion (rms of all steps) beyond which a run means nothing
VISIBLE = 1e-4  # displacement in a step, over the rod's length, that matters at all
NOISE = (0.05, 0.1)  # speeds of rounding over elastic and actual ones that drown the motion


def unresolved(
    scene: Scene, states: State, infos: StepInfo, steps: Float[Array | np.ndarray, " k"]
) -> Bool[Array | np.ndarray, ""] | np.bool_:
    """Whether the steps of a run were too long for its motion, or too short for its precision.

    Too long: the local errors of displacements exceed half of the displacements, in the rms over
    all steps (and `VISIBLE` besides). A rod of fast modes that is damped numerically to its
    equilibrium counts as well: what it did on the way is not its motion.

    Too short: positions are rounded by eps L, hence velocities by eps L/dt; where that exceeds both
    a tenth of the largest speed and a twentieth of the elastic one, sqrt(A/m)/L, with which a rod
    bent by a radian springs back, velocities are noise.

    A rod without inertia has no such errors.
    """
    rod = scene.rod
    if rod.mass is None:
        return np.asarray(False) if isinstance(steps, np.ndarray) else jnp.asarray(False)
    if isinstance(steps, np.ndarray):  # outside traced code, where each length would be compiled
        rod = jax.tree.map(np.asarray, rod)
        return _unresolved(np, rod, states, infos, steps)
    return lax.stop_gradient(_unresolved(jnp, *lax.stop_gradient((rod, states, infos, steps))))


def _unresolved(xp, rod, states, infos, steps):
    length = xp.sum(rod.length)
    # the shock of a new constraint is damped, not resolved
    counted = xp.where(infos.settling, 0.0, 1.0)
    squares = lambda values: xp.sum(counted * values**2)
    visible = VISIBLE * length
    motion = squares(infos.growth_position) + squares(visible)
    too_long = squares(infos.error_position) > COARSE**2 * motion
    noise = xp.finfo(length.dtype).eps * length / xp.min(steps)
    elastic = (
        xp.sqrt(xp.mean(rod.solid(rod.stiffness)[:, :2]) / xp.mean(rod.solid(rod.mass))) / length
    )
    fastest = xp.sqrt(xp.max(xp.sum(states.rate[..., :3] ** 2, -1)))
    too_short = (noise > NOISE[0] * elastic) & (noise > NOISE[1] * fastest)
    return too_long | too_short
