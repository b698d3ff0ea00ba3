"""Scenes of the paths of `bifurcations.py`: a clamped rod that is turned, or pressed."""

import dataclasses

import _settings  # noqa: F401 (first)
import jax
import jax.numpy as jnp
import numpy as np
from example import NECK

import rodjax as rx

COLUMN = 4 * np.pi**2  # P L^2/A of clamped ends
TWIST = 8.986819  # M L/A of clamped ends without tension, tan x = x with x = M L/2A
RATIO = 0.8  # torsional over bending stiffness
AXIS = (0.0, 0.0, 1.0)
DIAMETER = 0.02  # where contact counts


def rod_of(elements: int, necked: bool = False, length: float = 1.0) -> rx.Rod:
    """A rod of bending stiffness 1 (of its thick part) and torsional stiffness `RATIO`."""

    def section(s):
        inside = necked & (s > NECK[0] * length) & (s < NECK[1] * length)
        fourth = np.where(inside, 0.9, 1.0) ** 4
        return rx.Section((fourth, fourth, RATIO * fourth), diameter=DIAMETER, mass=1.0)

    return rx.straight_rod(length, elements, section)


def turned(rod: rx.Rod, loads=()) -> rx.Scene:
    """A clamped rod whose other end is turned by 2 pi p at time p, and may slide along the axis."""
    far = 20.0
    turn = rx.PiecewiseLinear([-far, far], [-2 * np.pi * far, 2 * np.pi * far])
    return rx.Scene(rod, rx.Clamped(), rx.Slider(AXIS, rotation=rx.Turn(AXIS, turn)), loads=loads)


def torque(scene, state):
    """The torque about the axis that the turned end feels."""
    return rx.energy.reactions(scene, state).torque[1, 2]


def shortening(scene, state):
    """How far the ends have come together."""
    return jnp.sum(scene.rod.length) - state.position[-1, 2] + state.position[0, 2]


MEASURES = {"torque": torque, "shortening": shortening}


def pressed(rod: rx.Rod, turns=0.0):
    """Scenes along the thrust of a clamped rod whose other end is turned so often."""
    # of one type whatever is given, so that all turns share their programs
    return jax.tree_util.Partial(_pressed, rod, jnp.asarray(turns, float))


def _pressed(rod, turns, thrust):
    load = rx.PointLoad(-1, force=rx.Constant(-thrust * jnp.asarray(AXIS)))
    return turned(rod, (load,)), turns


def first_branch(found: rx.EquilibriumPath) -> rx.CriticalPoint:
    """The first branch point of a path."""
    return next(one for one in found.critical if one.kind == "branch")


def finer(point: rx.CriticalPoint, state: rx.State) -> rx.CriticalPoint:
    """Where to look for a critical point on another grid of the same rod: at a state of that."""
    count = len(state.position)
    there, here = (np.linspace(0.0, 1.0, n) for n in (point.modes.shape[1], count))

    def on_grid(motions):
        both = np.asarray(motions)
        drawn = [[np.interp(here, there, lane) for lane in one.T] for one in both]
        return jnp.asarray(drawn).reshape(len(both), 6, count).swapaxes(1, 2)

    # joints pull as they did
    state = dataclasses.replace(state, joints=point.state.joints)
    return dataclasses.replace(
        point, state=state, origin=state, modes=on_grid(point.modes), free=on_grid(point.free)
    )


def drawn_on(coarse, fine, ratio: float):
    """What two grids, one so many times the other, say of no element length, in second order."""
    return (ratio**2 * fine - coarse) / (ratio**2 - 1)


def curves(found: rx.EquilibriumPath) -> dict:
    """What the summary keeps of a path."""
    kept = {
        "parameter": found.parameters.tolist(),
        "unstable": found.unstable.tolist(),
        "energy": found.energy.tolist(),
        "critical": [(one.kind, float(one.parameter)) for one in found.critical],
        "end": found.end.name,
    }
    return kept | {name: np.asarray(values).tolist() for name, values in found.measures.items()}
