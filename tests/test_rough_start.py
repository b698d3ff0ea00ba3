"""A rod without inertia that is let go from a rough shape settles by the default steps."""

import jax.numpy as jnp
import numpy as np
import pytest

from rodjax import energy, rotations
from rodjax.constraints.ends import Clamped
from rodjax.dynamics.adaptive import adaptive_rollout
from rodjax.dynamics.consistency import start
from rodjax.interactions.loads import LinearDrag
from rodjax.numerics.results import Result
from rodjax.rods.builders import straight_rod
from rodjax.rods.section import Section
from rodjax.rods.strains import element_quaternions
from rodjax.scenes.scene import Scene


@pytest.mark.slow
def test_a_massless_rod_settles_from_a_rough_start():
    elements = 12
    section = Section(stiffness=(1.0, 1.0, 0.7), mass=None)
    rod = straight_rod(1.0, elements, section, direction=(1.0, 0.0, 0.0))
    scene = Scene(rod, Clamped(), loads=(LinearDrag(60.0, 60.0, 1.0),))
    turn = 0.3 * np.random.default_rng(0).normal(size=(elements, 3)) * [1, 1, 0.1]
    frames = [rod.quaternion[0]]
    for vector in turn:
        frames.append(rotations.multiply(frames[-1], rotations.exponential(jnp.asarray(vector))))
    frames = jnp.stack(frames)
    edges = rotations.tangent_director(element_quaternions(frames)) / elements
    position = jnp.concatenate([jnp.zeros((1, 3)), jnp.cumsum(edges, 0)])
    first = start(scene, position=position, quaternion=frames)
    run = adaptive_rollout(scene, first, 2e7, max_steps=1500)
    assert int(run.result) == Result.SUCCESS
    # dissipation only: the strain energy falls, at the end to that of the straight rod
    strain = [float(energy.bending_energy(scene, run.state(i))) for i in (0, 5, -1)]
    assert strain[0] > strain[1] > strain[2] and strain[2] < 1e-12 * strain[0]
    # its fastest modes take steps a thousand millionth of the longest, and less
    assert float(np.min(np.diff(run.times))) < 1e-9 * 2e5
