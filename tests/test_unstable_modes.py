"""Number of unstable modes from the elimination, against theory and against eigenvalues."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rodjax.constraints.ends import Clamped, Free, Pinned, Slider
from rodjax.equations.equations import Equations
from rodjax.equations.schemes import AtRest
from rodjax.equilibria.motion_norms import moving_weight
from rodjax.equilibria.unstable_modes import count_below, neutral
from rodjax.inputs.schedules import Constant
from rodjax.interactions.contact import Contact
from rodjax.interactions.contact_laws import Penalty
from rodjax.interactions.loads import PointLoad
from rodjax.rods.balance import Internal
from rodjax.rods.builders import straight_rod
from rodjax.rods.section import Section
from rodjax.scenes.placing import placing
from rodjax.scenes.scene import Scene

ELEMENTS = 40


@jax.jit
def counted(scene, state, levels):
    """Modes of an equilibrium whose eigenvalues lie below minus the levels (0: unstable ones)."""
    zero = jnp.zeros_like(state.position)
    one = jnp.ones((), zero.dtype)
    nothing = Internal(zero, zero, jnp.zeros_like(state.force))
    rest = AtRest((state.position, state.quaternion), one, one, nothing)
    equations = Equations.of(scene, rest, state, one)
    levels = levels + neutral(scene, state.force)
    added = levels[:, None, None] * moving_weight(scene)[None]
    return count_below(equations, equations.guess(state.force), added, len(levels))


def pressed(first, last, thrust, compliance=None):
    """A straight column of unit length and stiffness under a thrust, and its state."""
    section = Section((1.0, 1.0, 0.8), mass=1.0, compliance=compliance)
    rod = straight_rod(1.0, ELEMENTS, section)
    along = jnp.asarray([0.0, 0.0, -1.0])
    node, sign = (0, -1.0) if isinstance(first, (Free, Slider)) else (-1, 1.0)
    load = PointLoad(node, Constant(sign * thrust * along))
    scene = Scene(rod, first, last, loads=(load,))
    state = placing(scene)
    return scene, eqx.tree_at(lambda s: s.force, state, state.force - jnp.asarray([[0, 0, thrust]]))


SLIDER = Slider((0, 0, 1))
# critical thrusts of each plane in units of pi^2; clamped and sliding: 4, 8.183 (tan x = x), 16
ENDS = {
    "clamped-free": (Clamped(), Free(), [0.25, 2.25, 6.25]),
    "free-clamped": (Free(), Clamped(), [0.25, 2.25, 6.25]),
    "clamped-slider": (Clamped(), SLIDER, [4.0, 8.1830, 16.0]),
    "slider-clamped": (SLIDER, Clamped(), [4.0, 8.1830, 16.0]),
    "slider-pinned": (SLIDER, Pinned(), [2.0457, 6.0468]),
    "pinned-slider": (Pinned(), SLIDER, [2.0457, 6.0468]),
}


COMPLIANT = (0.0, 1e-5, 1e-6)


@pytest.mark.parametrize(
    "ends, compliance",
    [
        ("clamped-free", None),
        ("clamped-slider", COMPLIANT),
        ("slider-clamped", None),
        ("slider-pinned", None),
        pytest.param("free-clamped", COMPLIANT, marks=pytest.mark.slow),
        pytest.param("pinned-slider", None, marks=pytest.mark.slow),
    ],
)
def test_columns_have_two_modes_more_beyond_each_critical_thrust(ends, compliance):
    first, last, critical = ENDS[ends]
    for number, thrust in enumerate(critical):
        for factor, modes in ((0.95, 2 * number), (1.05, 2 * number + 2)):
            scene, state = pressed(first, last, factor * thrust * np.pi**2, compliance)
            found = counted(scene, state, jnp.zeros(1))
            assert int(found[0]) == modes, (factor, thrust)


@pytest.mark.slow
@pytest.mark.parametrize("kind", [jnp.float32, pytest.param(jnp.float64, marks=pytest.mark.slow)])
def test_a_column_between_two_clamps_whose_parts_are_near(kind):
    """Near parts of a rod have modes counted otherwise; two clamps hold its length twice."""
    rod = straight_rod(1.0, 8, Section((1.0, 1.0, 0.8), mass=1.0, diameter=0.02))
    near = Contact(Penalty(1.0), segments=8, cutoff=0.3, exclusion=0.3)
    scene = Scene(rod, Clamped(), Clamped(), contact=near)
    cast = lambda leaf: leaf.astype(kind) if eqx.is_inexact_array(leaf) else leaf
    scene, state = jax.tree.map(cast, (scene, placing(scene)))
    assert int(scene.find_contact(state.position).pairs.capacity) > 0
    for factor, modes in ((0.85, 0), (1.15, 2)):
        thrust = jnp.asarray([[0.0, 0.0, factor * 4 * np.pi**2]], kind)
        pressed = eqx.tree_at(lambda s: s.force, state, state.force - thrust)
        assert int(counted(scene, pressed, jnp.zeros(1, kind))[0]) == modes
