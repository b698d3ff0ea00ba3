"""The rod as it was built, at rest: where statics and dynamics may start."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.inputs.argument_types import Number
from rodjax.inputs.validation import check_finite, check_scalar
from rodjax.rods.state import State, at_rest
from rodjax.scenes.arguments import check_scene
from rodjax.scenes.memory import first_memory
from rodjax.scenes.scene import Scene


def placing(scene: Scene, time: Number | Float[Array, ""] = 0.0) -> State:
    """The rod at rest as it was built, without internal force: where a load path may start.

    Args:
        scene: whose rod it is.
        time: of the state [s].

    Example:
        >>> rx.placing(scene).position[-1]
        Array([1., 0., 0.], dtype=float64)
    """
    check_scene(scene)
    check_scalar(time=time)
    check_finite(time=time)
    rod = scene.rod
    dtype = rod.position.dtype
    rate = jnp.zeros((rod.elements + 1, 6), dtype)
    force = jnp.zeros((rod.elements, 3), dtype)
    now = jnp.asarray(time, dtype)
    memory = first_memory(scene, at_rest(now, rod.position, rod.quaternion))
    still = rate, rate, rate, force
    return State(now, rod.position, rod.quaternion, *still, memory=memory, breaks=rod.breaks)
