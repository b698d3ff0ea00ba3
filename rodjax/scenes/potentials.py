"""What a user's load must keep to that says it stores energy: its wrench is that energy's slope.

A load without a potential, or with one that changes in time, would leave the ledger of a run with
an error that looks like one of the time integration.
"""

import jax
import jax.numpy as jnp
import numpy as np

from rodjax.inputs.validation import all_known
from rodjax.interactions.load import AbstractLoad
from rodjax.interactions.roles import Role
from rodjax.rods.rod import Rod
from rodjax.rods.state import NodeMotion, at_rest, moved

_WITH_ENERGY = Role.STORED, Role.CONTACT

_MEND = "; give its potential energy in `energy(rod, motion)`, or another role"


def check_potential(load: AbstractLoad, rod: Rod, name: str) -> None:
    """Raise ValueError unless the role of a load is one, and its energy fits its wrench.

    Seen for displacements and turns of all nodes from near where the rod is placed. Skipped where
    load or rod is traced, and where energy or wrench is not finite.
    """
    title = f"{name} ({type(load).__name__})"
    if not isinstance(load.role, Role):
        raise ValueError(f"{title}: its role must be a rodjax.Role, got {load.role!r}")
    if load.role not in _WITH_ENERGY or type(load).__module__.startswith("rodjax."):
        return
    if not all_known((load, rod)):
        return
    generator = np.random.default_rng(0)
    with jax.ensure_compile_time_eval():
        for _ in range(3):
            _check_once(load, rod, title, generator)


def _check_once(load: AbstractLoad, rod: Rod, title: str, generator) -> None:
    dtype = rod.position.dtype
    unit = np.repeat([0.1 * float(jnp.sum(rod.length)), 0.5], 3)
    draw = lambda: jnp.asarray(generator.normal(size=(rod.elements + 1, 6)) * unit, dtype)
    start = at_rest(jnp.asarray(0.3, dtype), rod.position, rod.quaternion)
    motion, direction = moved(start, draw()), draw()

    def energy(motion: NodeMotion):
        found = load.energy(rod, motion)
        if jnp.shape(found) != ():
            raise ValueError(f"{title}: its energy must be one number, got {found!r}{_MEND}")
        return found

    value, gain = jax.jvp(
        lambda z: energy(moved(motion, z)), (jnp.zeros_like(direction),), (direction,)
    )
    works = load.wrench(rod, motion) * direction
    size = float(jnp.sum(jnp.abs(works)) + jnp.abs(gain))
    rounding = float(jnp.finfo(dtype).eps) ** 0.5
    if not np.isfinite(size + float(value)):
        return
    if abs(float(gain + jnp.sum(works))) > rounding * size:
        raise ValueError(
            f"{title}: it is said to store energy, but in a small motion its energy grows by"
            f" {float(gain):.6g} while its wrench does the work {float(jnp.sum(works)):.6g}, which"
            " should be the opposite (moments and spins in body axes)" + _MEND
        )
    if any(_hangs_on(energy, motion, time) for time in (*generator.uniform(0, 100, 20), np.nan)):
        raise ValueError(
            f"{title}: its energy changes in time while the rod rests, which is work put in from"
            " outside: its role is Role.DRIVEN"
        )


def _hangs_on(energy, motion: NodeMotion, time: float) -> bool:
    """Whether the energy changes in time then, or is not a number where the time is none."""
    then = jnp.asarray(time, motion.position.dtype)
    at = lambda t: energy(motion._replace(time=t))
    value, rate = jax.jvp(at, (then,), (jnp.ones_like(then),))
    return not (float(rate) == 0 and np.isfinite(float(value)))
