"""Equilibria of strands that touch."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import DIAMETER, hairpin

from rodjax.constraints.ends import Clamped, Free
from rodjax.equations.imbalance import static_imbalance
from rodjax.equilibria.linear_stability import stability
from rodjax.equilibria.load_path import equilibrium
from rodjax.inputs.schedules import Constant
from rodjax.interactions.contact import Contact
from rodjax.interactions.contact_laws import InversePower
from rodjax.interactions.loads import PointLoad
from rodjax.rods.state import at_rest
from rodjax.scenes.placing import placing
from rodjax.scenes.scene import Scene


def squeezed(first, last, node):
    """A hairpin held at one end; its other leg, pulled towards the first, touches it."""
    contact = Contact(InversePower(1e-4, 3.0), 20, 0.08, points_per_segment=2, exclusion=0.3)
    pull = PointLoad(node, force=Constant(jnp.asarray([-0.04 if node else 0.04, 0.0, 0.0])))
    return Scene(hairpin(), first, last, (pull,), contact)


@pytest.fixture(scope="module")
def found():
    """The scene, its equilibrium, and that of strands that may pass."""
    scene = squeezed(Clamped(), Free(), -1)
    # unstable: strands would slip off each other
    state, info = equilibrium(scene, placing(scene), relax=False)
    apart = eqx.tree_at(lambda s: s.contact, scene, None)
    through, _ = equilibrium(apart, placing(apart))
    return scene, state, info, through


@pytest.mark.slow
def test_contact_carries_the_load(found):
    scene, state, _, through = found
    motion = at_rest(state.time, state.position, state.quaternion)
    wrench, constraint = eqx.filter_jit(static_imbalance)(scene, motion, state.force)
    # node 0 is held
    np.testing.assert_allclose(wrench[1:], 0.0, atol=1e-8 * 0.04)
    np.testing.assert_allclose(constraint, 0.0, atol=1e-10)
    gap = lambda s: float(s.position[-1, 0] - s.position[0, 0])
    assert gap(through) < 0 < 0.4 * DIAMETER < gap(state) < 0.08


@pytest.mark.slow
def test_strands_pressed_together_are_unstable_sideways(found):
    """Repulsion holds strands apart, and pressed together they would slip off each other."""
    scene, state, info, _ = found
    result = stability(scene, state, 4)
    assert not result.stable
    assert int(info.unstable) == np.sum(np.asarray(result.eigenvalues) < 0) > 0
    mode = np.abs(result.modes[0, :, :3]).max(0)
    assert mode[2] > 10 * mode[0] and mode[2] > 10 * mode[1]
    free = eqx.tree_at(lambda s: s.loads, scene, ())
    alone, _ = equilibrium(free, placing(free))
    assert stability(free, alone).stable


@pytest.mark.slow
def test_either_end_may_be_held(found):
    """The mirror image, whose system is solved through the cantilever of the other end."""
    _, state, _, _ = found
    mirrored = squeezed(Free(), Clamped(), 0)
    other, _ = equilibrium(mirrored, placing(mirrored), relax=False)
    gap = lambda s: jnp.linalg.norm(s.position[-1] - s.position[0])
    np.testing.assert_allclose(gap(other), gap(state), rtol=2e-3)


@pytest.mark.slow
def test_derivative_by_the_strength(found):
    scene, state, _, _ = found

    @jax.jit
    def gap(strength):
        stronger = eqx.tree_at(lambda s: s.contact.law.strength, scene, strength)
        return equilibrium(stronger, state, load_steps=1, throw=False)[0].position[-1, 0]

    one, h = jnp.asarray(1e-4), 1e-7
    reverse = jax.jit(jax.grad(gap))(one)
    forward = jax.jit(lambda x: jax.jvp(gap, (x,), (jnp.ones(()),))[1])(one)
    difference = (gap(one + h) - gap(one - h)) / (2 * h)
    assert difference > 0
    np.testing.assert_allclose(reverse, forward, rtol=1e-9)
    np.testing.assert_allclose(reverse, difference, rtol=1e-5)
