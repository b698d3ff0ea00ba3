"""Derivatives of rods of other than a diagonal linear law, against the machine's."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import random_arrays, random_configuration, relative_difference, slow

from rodjax import rotations
from rodjax.equations.equations import step_equations
from rodjax.inputs.schedules import PiecewiseLinear
from rodjax.measuring.energies import strain_energy_density
from rodjax.rods import balance
from rodjax.rods.builders import straight_rod
from rodjax.rods.elastic_plastic import ElasticPlastic
from rodjax.rods.kelvin_voigt import KelvinVoigt
from rodjax.rods.material import AbstractMaterial
from rodjax.rods.section import Section
from rodjax.rods.state import NodeMotion, State
from rodjax.rods.strains import curvature, strains
from rodjax.scenes.scene import Scene

ELEMENTS = 4
MATRIX = np.array([[1.0, 0.1, 0.2], [0.1, 1.3, -0.3], [0.2, -0.3, 0.8]])
CURLING = PiecewiseLinear([0.0, 1.0], [[0.0, 0.0, 0.0], [0.3, -0.2, 0.4]])


class Softening(AbstractMaterial):
    """Moments that grow less than in proportion, and resist their rate."""

    limit: jax.Array

    def moment(self, at):
        return at.stiffness * self.limit * jnp.tanh(at.bent / self.limit) + 0.01 * at.rate**3

    def energy(self, at):
        return at.stiffness * self.limit**2 * jnp.log(jnp.cosh(at.bent / self.limit))


BASE = {"mass": 1.0, "rotary_inertia": (2e-3, 3e-3, 4e-3)}
SECTIONS = {
    "coupled": Section(MATRIX, **BASE),
    "cable": Section((1.0, 1.3, 0.8), torque_per_tension=0.2, **BASE),
    "compliant cable": Section(
        MATRIX, compliance=(0.0, 0.0, 0.05), torque_per_tension=lambda s: 0.2 + 0.1 * s, **BASE
    ),
    "damped": Section(
        (1.0, 1.3, 0.8),
        compliance=(0.02, 0.0, 0.05),
        torque_per_tension=0.2,
        material=KelvinVoigt(0.03, 0.05, 0.07),
        **BASE,
    ),
    "plastic": Section(
        (1.0, 1.3, 0.8),
        material=KelvinVoigt(0.03, elastic=ElasticPlastic(0.3, 0.4)),
        compliance=(0.0, 0.0, 0.05),
        **BASE,
    ),
    "own law": Section((1.0, 1.3, 0.8), material=Softening(jnp.asarray(2.0)), **BASE),
}


def rod_of(name):
    return straight_rod(1.0, ELEMENTS, SECTIONS[name], actuation=CURLING)


QUICK = ("coupled", "plastic")


@pytest.mark.parametrize("name", [name if name in QUICK else slow(name) for name in SECTIONS])
def test_a_step_has_the_derivative_of_its_residual(name):
    scene = Scene(rod_of(name))
    position, quaternion, force = random_configuration(scene.rod, 1, 0.4)
    shape = (ELEMENTS + 1, 6)
    rate, acceleration, x = random_arrays(2, shape, shape, (ELEMENTS + 1, 9))
    state = State(jnp.asarray(0.3), position, quaternion, rate, acceleration, acceleration, force)

    @jax.jit
    def both(scene, state):
        equations = step_equations(scene, state, jnp.asarray(0.4), jnp.asarray(0.8))
        at = 0.1 * x
        moved = lambda dx: equations.residual(at + equations.lift(at, dx))
        size = x.size
        expected = jax.jacfwd(moved)(jnp.zeros_like(x)).reshape(size, size)
        columns = jnp.eye(size).reshape(size, *x.shape)
        found = jax.vmap(equations.linearize(at).multiply)(columns).reshape(size, size).T
        return found, expected

    assert relative_difference(*both(scene, state)) < 1e-12


@pytest.mark.parametrize("name", [name for name in SECTIONS if name != "plastic"])
def test_wrenches_at_rest_are_the_slope_of_the_energy(name):
    """With the constraint's multiplier, and where the rod is compliant with its force's energy."""
    rod = rod_of(name)
    position, quaternion, force = random_configuration(rod, 3, 0.4)
    time = jnp.asarray(0.7)

    def placed(z):
        turned = rotations.multiply(quaternion, rotations.exponential(z[:, 3:]))
        zero = jnp.zeros_like(position)
        return NodeMotion(time, position + z[:, :3], turned, zero, zero)

    def energy(z, force):
        motion = placed(z)
        state = State(time, motion.position, motion.quaternion, z, z, z, force)
        strain = balance.force_strain(rod, strains(rod, *motion[1:3]), motion)
        rigid = 1.0 if rod.compliance is None else jnp.where(rod.compliance > 0, 0.0, 1.0)
        stored = jnp.sum(rod.length * strain_energy_density(rod, state))
        return stored + jnp.sum(rod.length[:, None] * rigid * force * strain)

    @jax.jit
    def both():
        nothing, given = jnp.zeros((ELEMENTS + 1, 6)), force
        motion = placed(nothing)
        if rod.compliance is not None:
            strain = balance.force_strain(rod, strains(rod, *motion[1:3]), motion)
            give = jnp.where(rod.compliance > 0, rod.compliance, 1.0)
            given = jnp.where(rod.compliance > 0, strain / give, force)
        inner = balance.internal(rod, motion, given)
        return jnp.concatenate([inner.force, inner.moment], 1), jax.grad(energy)(nothing, given)

    assert relative_difference(*both()) < 1e-12


def test_strain_rates_are_those_of_the_strains_and_none_of_a_rigid_motion():
    rod = rod_of("damped")
    position, quaternion, _ = random_configuration(rod, 5, 0.5)
    shift, spin, axis = random_arrays(6, (ELEMENTS + 1, 3), (ELEMENTS + 1, 3), (3,))
    material = rod.material
    assert material is not None

    @jax.jit
    def seen(rod, velocity, angular_velocity):
        motion = NodeMotion(jnp.asarray(0.3), position, quaternion, velocity, angular_velocity)
        kinematics = strains(rod, position, quaternion)
        at = balance.constitution.element_motion(rod, kinematics.rotation, motion)
        return at.rate, balance.force_strain_rate(rod, kinematics, motion)

    def there(t):
        frames = rotations.multiply(quaternion, rotations.exponential(t * spin))
        motion = NodeMotion(0.3 + t, position + t * shift, frames, shift, spin)
        kinematics = strains(rod, *motion[1:3])
        return curvature(rod, motion.quaternion), balance.force_strain(rod, kinematics, motion)

    rates = jax.jit(lambda t: jax.jvp(there, (t,), (jnp.ones(()),))[1])(jnp.zeros(()))
    for found, expected in zip(seen(rod, shift, spin), rates, strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-12)
    # the actuation's own rate is no motion of the rod
    rod = straight_rod(1.0, ELEMENTS, SECTIONS["damped"])
    turning = jnp.broadcast_to(axis, position.shape)
    rigid = seen(rod, jnp.cross(turning, position), rotations.rotate_inverse(quaternion, turning))
    for found in rigid:
        assert np.max(np.abs(found)) < 1e-13
