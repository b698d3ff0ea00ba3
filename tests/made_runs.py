"""States and runs put together by hand, shared by the tests of energies."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from helpers import UNIT_SECTION

from rodjax import energy
from rodjax.constraints.ends import Free, Pinned
from rodjax.dynamics import consistency
from rodjax.dynamics.run import Run
from rodjax.dynamics.stepping import StepInfo, prepare, step
from rodjax.inputs.schedules import Constant
from rodjax.interactions.loads import Gravity, PointLoad
from rodjax.rods import builders
from rodjax.rods.state import State
from rodjax.scenes.scene import Scene

ELEMENTS = 8
AXIS = jnp.array([0.0, 0.0, 1.0])
start = eqx.filter_jit(consistency.start)
reactions = eqx.filter_jit(energy.reactions)
one_step = eqx.filter_jit(step)


def state_of(a_rod, position=None, quaternion=None, force=None):
    """A state at rest; the rod's own placing by default."""
    nodes = a_rod.elements + 1
    still = jnp.zeros((nodes, 6))
    return State(
        jnp.zeros(()),
        a_rod.position if position is None else position,
        a_rod.quaternion if quaternion is None else quaternion,
        still,
        still,
        still,
        jnp.zeros((nodes - 1, 3)) if force is None else force,
    )


def hanging(direction, end_force):
    """A heavy rod pinned at s = 0, its weight 1 x 9 along e3, with a dead load on its end."""
    loads = (Gravity((0.0, 0.0, 9.0)), PointLoad(-1, force=Constant(end_force)))
    a_rod = builders.straight_rod(1.0, 4, UNIT_SECTION, direction=direction)
    return Scene(a_rod, Pinned(), Free(), loads)


def run_of(states, infos=None):
    """A stored run; without `infos` one whose steps projected nothing."""
    stack = lambda items: jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves)), *items)
    if infos is None:
        infos = [StepInfo(*[jnp.zeros(())] * len(StepInfo._fields))] * (len(states) - 1)
    zero = jnp.asarray(0, jnp.int32)
    return Run(stack(states), stack(infos), zero, zero, zero)


def run_over(scene, state, end_time, steps, longest=None, every=1):
    """A run of equal steps, saved every so many.

    It is filled up to the `longest` of a series by states that rest at its end and add nothing,
    so that all of the series share what is compiled.
    """
    state = prepare(scene, state)
    states, infos = [state], []
    for k in range(steps):
        state, info = one_step(scene, state, jnp.asarray((k + 1) * end_time / steps))
        assert info.result == 0
        states.append(state)
        infos.append(info)
    fill = 0 if longest is None else longest - steps
    still = eqx.tree_at(lambda i: i.projection_loss, infos[-1], jnp.zeros(()))
    return run_of(states[::every] + fill * [state], infos + fill * [still])
