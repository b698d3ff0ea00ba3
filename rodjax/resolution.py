"""Whether given steps resolve the motion that they took, judged when a rollout has ended."""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from rodjax.scene import Scene
from rodjax.state import State
from rodjax.stepping import StepInfo

COARSE = 0.5  # local errors over motion (rms of all steps) beyond which a run means nothing
VISIBLE = 1e-4  # displacement in a step, over the rod's length, that matters at all
NOISE = (0.05, 0.1)  # speeds of rounding over elastic and actual ones that drown the motion


def unresolved(
    scene: Scene, states: State, infos: StepInfo, steps: Float[Array, " k"]
) -> Bool[Array, ""]:
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
        return jnp.asarray(False)
    states, infos, steps = lax.stop_gradient((states, infos, steps))
    length = jnp.sum(rod.length)
    # the shock of a new constraint is damped, not resolved
    counted = jnp.where(infos.settling, 0.0, 1.0)
    squares = lambda values: jnp.sum(counted * values**2)
    visible = VISIBLE * length
    motion = squares(infos.growth_position) + squares(visible)
    too_long = squares(infos.error_position) > COARSE**2 * motion
    noise = jnp.finfo(length.dtype).eps * length / jnp.min(steps)
    elastic = jnp.sqrt(jnp.mean(rod.stiffness[:, :2]) / jnp.mean(rod.mass)) / length
    fastest = jnp.sqrt(jnp.max(jnp.sum(states.velocity**2, -1)))
    too_short = (noise > NOISE[0] * elastic) & (noise > NOISE[1] * fastest)
    return lax.stop_gradient(too_long | too_short)
