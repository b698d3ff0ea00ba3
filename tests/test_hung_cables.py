"""Cables hung from a pin or between two: loads hold what the ends leave free; the spin is kept."""

import numpy as np

from rodjax.ends import Free, Pinned
from rodjax.energy import reactions
from rodjax.load_path import equilibrium, placing
from rodjax.loads import Gravity, PointLoad
from rodjax.rod import Section, straight_rod
from rodjax.scene import Scene
from rodjax.schedules import Constant

WEIGHT = 9.81
ELEMENTS = 20


def hung(direction=(0, 0, -1), stiffness=(1e-3, 1e-3, 0.7e-3), pull=(1.0, 0.0, 0.0), torque=0.0):
    """A cable of unit length and mass on a pin; force and axial torque on its free end."""
    rod = straight_rod(1.0, ELEMENTS, Section(stiffness, mass=1.0), direction=direction)
    loads = (
        Gravity((0.0, 0.0, -WEIGHT)),
        PointLoad(-1, Constant(pull)),
        PointLoad(-1, None, Constant((0.0, 0.0, torque)), follower=True),
    )
    return Scene(rod, Pinned(), Free(), loads)


def catenary(pull):
    """Tip of a chain hung from one end and pulled sideways at the other."""
    vertical = np.hypot(pull, WEIGHT) - pull
    return np.array([pull / WEIGHT * np.arcsinh(WEIGHT / pull), 0.0, -vertical / WEIGHT])


def test_a_chain_pulled_sideways():
    scene = hung()
    state, info = equilibrium(scene, placing(scene))
    assert int(info.unstable) == 0
    np.testing.assert_allclose(state.position[-1], catenary(1.0), atol=6e-3)
    held = reactions(scene, state)
    np.testing.assert_allclose(np.abs(held.force[0]), [1.0, 0.0, WEIGHT], atol=1e-7)
    np.testing.assert_allclose(held.torque[0], 0.0, atol=1e-9)
