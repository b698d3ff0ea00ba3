"""What the functions of a scene and a state are given: checked once, before anything is traced."""

import numpy as np

from rodjax.inputs.validation import check_instance, check_numbers, check_scalar, known, shown
from rodjax.rods.state import State
from rodjax.scenes.scene import Scene


def check_scene(scene: Scene) -> None:
    """Raise ValueError unless this is a scene."""
    check_instance(Scene, "give a Scene, Scene(rod, first_end, last_end)", scene=scene)


def check_motion(scene: Scene, state: State) -> None:
    """Raise ValueError unless this is a scene and a state of its rod."""
    check_scene(scene)
    mend = "give a State, of start(scene) or placing(scene), or of a run its `final`"
    check_instance(State, mend, state=state)
    shape, nodes = state.position.shape, scene.rod.elements + 1
    if len(shape) != 2:
        raise ValueError(f"state: holds many states, positions {shape}; pick one, or use jax.vmap")
    if shape[0] != nodes:
        raise ValueError(
            f"state: is one of {shape[0]} nodes, but the scene's rod has {nodes}; make it by"
            " start(scene), or carry it over to this rod by regrid(state, rod)"
        )
    if known(state.position) and not np.all(np.isfinite(np.asarray(state.position))):
        raise ValueError(
            "state: holds no numbers, as a run or equilibrium that failed leaves it; look at the"
            " `result` that came with it"
        )


def check_end_time(end_time) -> None:
    """Raise ValueError unless this is one time."""
    if end_time is None:
        raise ValueError("end_time: give the time until which to run, after the scene and state")
    check_scalar(end_time=end_time)


def check_step_times(times) -> None:
    """Raise ValueError unless these are the ends of steps."""
    mend = "give the ends of all steps, for 100 in a second numpy.linspace(0, 1, 101)[1:]"
    if times is None:
        raise ValueError(f"times: {mend}")
    check_numbers(times=times)
    shape = getattr(times, "shape", None)
    shape = (len(times),) if shape is None and isinstance(times, list | tuple) else shape
    if shape is None or len(shape) != 1 or shape[0] < 1:
        raise ValueError(f"times: {mend}; got {shown(times)}")
