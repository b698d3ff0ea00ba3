"""Numbers of unstable modes by elimination, against the eigenvalues of random states and holds."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import hairpin

import rodjax as rx
from rodjax.constraints.supports import Support
from rodjax.equations import coupling
from rodjax.equations.equations import Equations
from rodjax.equations.imbalance import lacking
from rodjax.equations.schemes import AtRest
from rodjax.equilibria.admissible import admissible, mean_bending
from rodjax.equilibria.unstable_modes import count_below
from rodjax.interactions import contact_capacities, screening
from rodjax.interactions.contact_laws import InversePower
from rodjax.numerics import rotations
from rodjax.numerics.eigenvalues import far_above, split
from rodjax.numerics.front_order import FrontSize

ELEMENTS = 12


class Held(rx.AbstractEnd):
    """Takes away what a projector says."""

    directions: jax.Array
    displacement: None = None
    rotation: None = None

    def projector(self, time):
        return self.directions


def directions(generator, translations, rotations):
    """A projector on so many directions of either kind."""
    out = np.zeros((6, 6))
    for place, count in ((0, translations), (3, rotations)):
        axes = np.linalg.qr(generator.normal(size=(3, 3)))[0][:, :count]
        out[place : place + 3, place : place + 3] = axes @ axes.T
    return Held(jnp.asarray(out))


def random_cases(rod, count, force, contact=None):
    """Scenes held at random at both ends and two nodes between, and states out of balance.

    Every fourth without a potential: one axis of frames is held alone, against a moment.
    """
    for seed in range(count):
        generator = np.random.default_rng(seed)
        turns = [0, 1, 2, 3] if seed % 4 == 3 else [0, 2, 3]
        kind = lambda g=generator, t=turns: directions(g, g.integers(0, 4), g.choice(t))
        nodes = generator.permutation(np.arange(1, rod.elements))[:2]
        supports = tuple(Support(jnp.asarray(node), kind()) for node in nodes)
        first = directions(generator, 3, generator.choice(turns))
        scene = rx.Scene(rod, first, kind(), supports=supports, contact=contact)
        state = rx.placing(scene)
        size = force * 4.0 ** generator.integers(0, 4)
        inner = jnp.asarray(size * generator.normal(size=state.force.shape))
        yield scene, eqx.tree_at(lambda s: s.force, state, inner)


@jax.jit
def counted(scene, state):
    """By elimination."""
    one = jnp.ones_like(state.time)
    rest = AtRest((state.position, state.quaternion), one, one, lacking(scene, state, one))
    equations = Equations.of(scene, rest, state, one)
    nothing = jnp.zeros((1, *state.rate.shape), state.rate.dtype)
    return count_below(equations, equations.guess(state.force), nothing, 1)[0]


@jax.jit
def on_motions(scene, state):
    """The tangent on what the constraint and the holds allow, all of else far above."""
    motions = admissible(scene, state)
    # by spins of the body a moment that is not balanced leaves half of its product
    moment = lacking(scene, state).moment
    for held in scene.holds:
        own = moment[held.node]
        moment = moment.at[held.node].set(own - held.end.projector(state.time)[3:, 3:] @ own)
    unit = mean_bending(scene) / jnp.sum(scene.rod.length)
    odd = jnp.pad(0.5 * rotations.hat(moment) / unit, ((0, 0), (3, 0), (3, 0)))
    _, rows, free = split(motions.ends)
    matrix = free @ (motions.stiffness - motions.on_motions(odd)) @ free
    return matrix + far_above(matrix) * rows


def agree(cases):
    """The numbers of modes that both found, of cases without potential their parities."""
    numbers = []
    for i, (scene, state) in enumerate(cases):
        matrix, found = np.asarray(on_motions(scene, state)), int(counted(scene, state))
        if i % 4 == 3 and found < 2:
            assert found == (np.linalg.slogdet(matrix)[0] < 0)
            continue
        np.testing.assert_allclose(matrix, matrix.T, atol=1e-11 * np.max(np.abs(matrix)))
        values = np.linalg.eigvalsh(matrix)
        # what nothing resists, as the spin of a straight rod about itself, is neither
        assert np.min(np.abs(values)) > 1e-7
        numbers.append(np.sum(values < 0))
        assert found == numbers[-1]
    return numbers


@pytest.mark.slow
@pytest.mark.parametrize("compliance", [None, (2e-3, 1e-3, 1e-4)])
def test_rods_held_at_random(compliance):
    section = rx.Section((1.0, 1.3, 0.8), mass=1.0, compliance=compliance)
    curve = lambda s: jnp.stack([0.4 * jnp.sin(s / 0.4), 0.4 - 0.4 * jnp.cos(s / 0.4), 0.1 * s])
    rod = rx.curved_rod(curve, 1.0, ELEMENTS, section)
    numbers = agree(random_cases(rod, 40, 10.0))
    assert min(numbers) == 0 and max(numbers) > 4


@pytest.mark.slow
@pytest.mark.parametrize(
    "elements, segments, front", [(14, 20, None), (24, 12, None), (15, 20, FrontSize(24, 8))]
)
def test_strands_in_contact_held_at_random(elements, segments, front, monkeypatch):
    """By nodes, by joints, and along the strip that the strands form."""
    contact = rx.Contact(InversePower(1e-4, 3.0), segments, 0.12, exclusion=0.3)
    if front is not None:
        whole = contact_capacities.capacities(contact, elements)[-1]
        for module in (screening, coupling):
            fronts = whole._replace(front=front), whole
            monkeypatch.setattr(module, "capacities", lambda *given, fronts=fronts: fronts)
    rod = hairpin(elements)
    scene = rx.Scene(rod, contact=contact)
    assert int(scene.find_contact(rod.position).pairs.capacity) == 1
    numbers = agree(random_cases(rod, 30, 0.3, contact))
    assert min(numbers) == 0 and max(numbers) > 4


@pytest.mark.slow
def test_lanes_in_contact_and_out_of_it():
    rod = hairpin(12)
    contact = rx.Contact(InversePower(1e-4, 3.0), 16, 0.12, exclusion=0.3)
    cases = list(random_cases(rod, 3, 5.0, contact))
    parted = lambda state: dataclasses.replace(
        state, position=state.position.at[7:, 0].add(0.3), force=3.0 * state.force
    )
    cases += [(scene, parted(state)) for scene, state in cases]
    expected = [int(counted(*case)) for case in cases]
    batch = jax.tree.map(lambda *leaves: jnp.stack(leaves), *cases)
    np.testing.assert_array_equal(jax.jit(jax.vmap(counted))(*batch), expected)
    assert len(set(expected)) > 2


@pytest.mark.slow
@pytest.mark.parametrize("kind, elements", [(jnp.float32, 100), (jnp.float64, 400)])
def test_many_elements_in_either_precision(kind, elements):
    """Columns in a general direction, between two clamps that hold their length twice."""
    rod = rx.straight_rod(
        1.0, elements, rx.Section((1.0, 1.0, 0.8), mass=1.0), direction=(0.2, 0.9, 0.4)
    )
    scene = rx.Scene(rod, rx.Clamped(), rx.Clamped())
    cast = lambda leaf: leaf.astype(kind) if eqx.is_inexact_array(leaf) else leaf
    scene, state = jax.tree.map(cast, (scene, rx.placing(scene)))
    for factor, modes in ((0.85, 0), (1.15, 2)):
        thrust = jnp.asarray([[0.0, 0.0, factor * 4 * np.pi**2]], kind)
        pressed = eqx.tree_at(lambda s: s.force, state, state.force - thrust)
        assert int(counted(scene, pressed)) == modes
