"""A scene runs the same in any units."""

import jax.numpy as jnp
import numpy as np
import pytest
from helpers import PRECISE, UP, relative_difference, slow

from rodjax.constraints.ends import Clamped, Slider, Switched, Turn
from rodjax.dynamics.adaptive import adaptive_rollout
from rodjax.dynamics.consistency import start
from rodjax.dynamics.fixed_rollout import rollout
from rodjax.inputs.schedules import Constant, Smooth
from rodjax.interactions.loads import DistributedLoad, Gravity, LinearDrag, MorisonDrag, PointLoad
from rodjax.rods.builders import straight_rod
from rodjax.rods.section import circular_section
from rodjax.scenes.scene import Scene


def growing(parameters, s, motion):
    """A load per length that grows along the rod."""
    return parameters[None, :] * (s / jnp.max(s))[:, None]


def loaded_scene(length, force, duration):
    """One scene in units in which a metre, a newton and a second have these numbers."""
    mass = force * duration**2 / length  # of a kilogram
    pressure, density, speed = force / length**2, mass / length**3, length / duration
    section = circular_section(
        lambda s: length * 5e-3 * (1 + 0.2 * s / length),
        1.25e7 * pressure,
        5e6 * pressure,
        1500.0 * density,
        extensible=True,
    )
    rod = straight_rod(
        length, 6, section, natural_curvature=(0.3 / length, lambda s: 0.1 * s / length**2, 0.0)
    )
    ramp = [0.0, 0.5 * duration, 10 * duration]
    push = Smooth(ramp, length * np.array([[0.0] * 3, [0.05, 0.02, 0.1], [0.05, 0.02, 0.1]]))
    loads = (
        Gravity(9.81 * length / duration**2 * np.array([0.3, 0.0, -0.2]), 1000.0 * density),
        MorisonDrag(1000.0 * density, 1.0, 0.1, speed * np.array([0.1, 0.0, 0.05])),
        LinearDrag(
            1e-2 * force * duration / length**2,
            5e-3 * force * duration / length**2,
            1e-6 * force * duration,
        ),
        PointLoad(
            -1, Constant(1e-3 * force * np.ones(3)), Constant(1e-4 * force * length * np.ones(3))
        ),
        DistributedLoad(growing, jnp.asarray([1e-3 * force / length] * 3 + [1e-5 * force] * 3)),
    )
    switch = Switched(Slider(UP), Clamped(), 0.2 * duration)
    return Scene(rod, Clamped(push, Turn(UP, Smooth(ramp, [0.0, 3.0, 3.0]))), switch, loads)


# metre, newton, second; nanometre, piconewton, microsecond; ton and megametre like
UNITS = {"nm pN us": (1e9, 1e12, 1e6), "Mm GN ks": (1e-6, 1e-9, 1e-3)}


@pytest.fixture(scope="module")
def in_si():
    scene = loaded_scene(1.0, 1.0, 1.0)
    state = start(scene)
    times = jnp.asarray(np.linspace(0, 0.3, 31)[1:])
    return rollout(scene, state, times, PRECISE), adaptive_rollout(scene, state, 0.3, PRECISE)


@pytest.mark.slow
# the grid is coarse in any units, and the runs say so
@pytest.mark.filterwarnings("ignore::rodjax.numerics.results.ModelWarning")
@pytest.mark.parametrize("name", ["nm pN us", slow("Mm GN ks")])
def test_units_are_free(in_si, name):
    units = length, force, duration = UNITS[name]
    scene = loaded_scene(*units)
    state = start(scene)
    times = jnp.asarray(np.linspace(0, 0.3, 31)[1:]) * duration
    fixed = rollout(scene, state, times, PRECISE)
    chosen = adaptive_rollout(scene, state, 0.3 * duration, PRECISE)
    for found, expected in zip((fixed, chosen), in_si, strict=True):
        assert int(found.result) == 0
        assert len(found.times) == len(expected.times) > 20
        assert int(found.rejected) == int(expected.rejected)
        a, b = found.states, expected.states
        assert relative_difference(a.time / duration, b.time) < 1e-9
        assert relative_difference(a.position / length, b.position) < 1e-9
        assert relative_difference(a.quaternion, b.quaternion) < 1e-9
        assert relative_difference(a.velocity * (duration / length), b.velocity) < 1e-9
        spin = a.angular_velocity * duration
        assert relative_difference(spin, b.angular_velocity) < 1e-9
        assert relative_difference(a.force / force, b.force) < 1e-9
        loss = found.infos.projection_loss / (force * length)
        assert relative_difference(loss, expected.infos.projection_loss) < 1e-9
        errors = found.infos.error_position / length
        assert relative_difference(errors, expected.infos.error_position) < 1e-7
