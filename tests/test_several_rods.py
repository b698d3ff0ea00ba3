"""Several rods in one scene: each moves and rests as by itself, and they touch each other."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rodjax as rx
from rodjax.interactions.contact_law import PairProperties
from rodjax.rods.chain import chain
from rodjax.rods.strains import strains

THICK = rx.circular_section(0.03, 1e6, 0.4e6, density=1200.0)
THIN = rx.circular_section(0.02, 1e6, 0.4e6, density=1500.0)
GRAVITY = (rx.Gravity((0.0, -3.0, 0.3)),)
ENDS = ((rx.Clamped(), rx.Clamped()), (rx.Slider((0, 0, 1)), rx.Free()))


@pytest.fixture(scope="module")
def rods():
    return (
        rx.straight_rod(1.0, 6, THIN),
        rx.straight_rod(0.7, 4, THICK, origin=(0.0, 0.5, 0.0)),
    )


@pytest.fixture(scope="module")
def system(rods):
    return rx.Scene(rods=rods, first_end=ENDS[0], last_end=ENDS[1], loads=GRAVITY)


@pytest.fixture(scope="module")
def alone(rods):
    every = zip(rods, *ENDS, strict=True)
    return [rx.Scene(rod, first, last, GRAVITY) for rod, first, last in every]


@pytest.mark.slow
def test_each_moves_as_by_itself(system, alone):
    times = jnp.linspace(0.0, 0.1, 11)[1:]
    run = rx.rollout(system, rx.start(system), times)
    most = 0
    for scene, states in zip(alone, rx.states_of(run.states), strict=True):
        own = rx.rollout(scene, rx.start(scene), times)
        np.testing.assert_allclose(states.position, own.states.position, atol=1e-12)
        np.testing.assert_allclose(states.rate, own.states.rate, atol=1e-10)
        scale = np.max(np.abs(own.states.force))
        np.testing.assert_allclose(states.force, own.states.force, atol=1e-9 * scale)
        most = np.maximum(most, own.infos.iterations)
    np.testing.assert_array_equal(run.infos.iterations, most)


@pytest.mark.slow
def test_each_rests_as_by_itself(system, alone):
    state, info = rx.equilibrium(system, rx.start(system))
    unstable = 0
    for scene, part in zip(alone, rx.states_of(state), strict=True):
        own, about = rx.equilibrium(scene, rx.start(scene))
        np.testing.assert_allclose(part.position, own.position, atol=1e-12)
        unstable += about.unstable
    assert info.unstable == unstable


@pytest.mark.slow
def test_reactions_carry_the_weight_of_each(system, rods):
    """At rest: of the ends of a rod together, in the order of `Scene.holds`."""
    state, _ = rx.equilibrium(system, rx.start(system))
    names = [held.name for held in system.holds]
    assert names == ["first_end", "last_end", "last_end[0]", "first_end[1]"]
    force = rx.energy.reactions(system, state).force
    weight = lambda rod: -jnp.sum(rod.mass * rod.length) * GRAVITY[0].acceleration
    np.testing.assert_allclose(force[0] + force[2], weight(rods[0]), atol=1e-9)
    np.testing.assert_allclose(force[1] + force[3], weight(rods[1]), atol=1e-9)


@pytest.mark.slow
def test_gradients_are_those_of_each(system, alone):
    """Reverse and forward, by the stiffness of the second rod, of the tip of either."""
    times = jnp.linspace(0.0, 0.05, 6)[1:]
    start = rx.start(system)

    def tips(factor):
        stiffness = system.rod.stiffness.at[7:].multiply(factor)
        scene = dataclasses.replace(
            system, rod=dataclasses.replace(system.rod, stiffness=stiffness)
        )
        position = rx.rollout(scene, start, times).final.position
        return jnp.stack([position[6, 1], position[-1, 1]])

    def tip(factor):
        rod = alone[1].rod
        rod = dataclasses.replace(rod, stiffness=factor * rod.stiffness)
        scene = dataclasses.replace(alone[1], rod=rod)
        return rx.rollout(scene, rx.start(alone[1]), times).final.position[-1, 1]

    one = jnp.asarray(1.0)
    reverse, forward = jax.jacrev(tips)(one), jax.jacfwd(tips)(one)
    np.testing.assert_allclose(reverse, forward, rtol=1e-9, atol=1e-14)
    assert abs(reverse[0]) < 1e-14
    np.testing.assert_allclose(reverse[1], jax.grad(tip)(one), rtol=1e-8)


def test_nothing_stands_between_rods(system):
    """Whatever the nodes beside it do, it has the strain of an element at rest."""
    key = jax.random.key(0)
    position = system.rod.position + 0.1 * jax.random.normal(key, system.rod.position.shape)
    turned = system.rod.quaternion.at[7].set(jnp.asarray([0.0, 1.0, 0.0, 0.0]))
    found = strains(system.rod, position, turned)
    np.testing.assert_array_equal(found.rotation[6], 0.0)
    np.testing.assert_array_equal(found.stretch[6], [0.0, 0.0, 1.0])
    np.testing.assert_array_equal(found.frame[6], 0.0)
    np.testing.assert_allclose(jnp.sum(system.rod.node_length), 1.7, rtol=1e-14)


def test_rods_come_back(system, rods):
    for rod, same in zip(rods, system.rods, strict=True):
        np.testing.assert_array_equal(rod.position, same.position)
        np.testing.assert_array_equal(rod.stiffness, same.stiffness)
    assert chain(rods[:1]) is rods[0]
    three = rx.Scene(rods=(*rods, dataclasses.replace(rods[0])))
    assert [part for part in three.rod.parts] == [(0, 6), (7, 11), (12, 18)]


def test_what_is_asked_of_one_rod(system):
    state = rx.placing(system)
    for measure in (rx.measures.twist, rx.measures.writhe):
        with pytest.raises(ValueError, match=r"state: it is of 2 rods.*states_of"):
            measure(state)
        assert measure(rx.states_of(state)[1]) == 0


@pytest.mark.parametrize(
    "function",
    [
        lambda scene: rx.regrid(rx.placing(scene), scene.rods[0]),
        lambda scene: rx.imperfect(scene.rod),
        lambda scene: rx.measures.turns(scene, 1.0),
        lambda scene: rx.measures.apex(rx.placing(scene), jnp.asarray([0.0, 0.0, 1.0])),
    ],
    ids=["regrid", "imperfect", "turns", "apex"],
)
def test_what_is_of_one_rod_is_refused(system, function):
    with pytest.raises(ValueError, match=r"(state|rod): it is (of )?2 rods"):
        function(system)


def test_arc_length_counts_from_each_rods_first_node(system):
    expected = [*np.linspace(0.0, 1.0, 7), *np.linspace(0.0, 0.7, 5)]
    np.testing.assert_allclose(system.rod.arc_length, expected, atol=1e-14)


def test_a_run_of_several_is_kept_and_read(system, tmp_path):
    """Its scene, with inner ends, and its states, which are still of several rods."""
    state = rx.start(system)
    run = rx.rollout(system, state, jnp.linspace(0.0, 0.02, 3)[1:])
    rx.storage.save(tmp_path / "run.h5", system, run)
    kept = rx.storage.load(tmp_path / "run.h5")
    assert kept.run.states.breaks == system.rod.breaks == (6,)
    assert [held.name for held in kept.scene.holds] == [held.name for held in system.holds]
    np.testing.assert_array_equal(kept.run.states.position, run.states.position)
    again = rx.rollout(kept.scene, state, run.times[1:])
    np.testing.assert_array_equal(again.states.position, run.states.position)


# Contact between rods


@pytest.fixture(scope="module")
def crossing(rods):
    """A free rod thrown across a clamped one."""
    other = rx.straight_rod(0.6, 6, THIN, direction=(1.0, 0.0, 0.0), origin=(-0.3, 0.04, 0.5))
    scene = rx.Scene(
        rods=(rods[0], other),
        first_end=(rx.Clamped(), rx.Free()),
        last_end=(rx.Slider((0, 0, 1)), rx.Free()),
        contact=rx.Contact.solid(rods[0], 20.0),
    )
    velocity = jnp.zeros((14, 3)).at[7:, 1].set(-1.0)
    return scene, rx.start(scene, velocity=velocity)


@pytest.mark.slow
def test_rods_push_each_other(crossing):
    scene, state = crossing
    # segments of 4 sqrt(0.05 0.95) diameters, laid out on the first of 1 m and the other of 0.6 m
    assert scene.contact.shares == (58, 35)
    run = rx.adaptive_rollout(scene, state, 0.05)
    near = run.states.position[:, 10, 1] - run.states.position[:, 3, 1]
    assert 0.8 * 0.02 < np.min(near) < 0.02  # solid strands, that give way a little
    ledger = rx.energy.ledger(scene, run)
    assert np.max(ledger.contact_energy) > 0.02 * ledger.kinetic[0]
    np.testing.assert_allclose(ledger.residual, 0.0, atol=0.02 * ledger.kinetic[0])


@pytest.mark.slow
def test_contact_is_that_of_one_rod_with_both_as_stretches(rods):
    """Two strands of one rod, side by side, push each other as two rods in the same places do."""
    law = rx.Penalty(1e5, softness=0.2)
    origin = (0.018, 0.0, 0.1)
    both = (rods[0], rx.straight_rod(0.5, 5, THIN, origin=origin))
    contact = rx.Contact(law, 30, 0.025, points_per_segment=16)
    scene = rx.Scene(rods=both, contact=contact)
    state = rx.placing(scene)
    force = rx.energy.contact_wrench(scene, state)[:, :3]
    # per length of an infinitely long pair, by quadrature of the law's own points
    points = np.linspace(-0.05, 0.05, 20001)
    distance = np.sqrt(0.018**2 + points**2)
    pair = PairProperties(jnp.asarray(0.02), None)
    force_of = jax.vmap(lambda d: law.repulsion(d, jnp.zeros(()), pair))
    per_length = np.trapezoid(
        np.asarray(force_of(jnp.asarray(distance))) * 0.018 / distance, points
    )
    np.testing.assert_allclose(jnp.sum(force[:7, 0]), -0.5 * per_length, rtol=0.05)
    np.testing.assert_allclose(jnp.sum(force, 0), 0.0, atol=1e-12 * per_length)


# What is refused


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (dict(rods=()), "rods: give at least one"),
        (dict(first_end=(rx.Free(),)), "first_end: give one end for each of 2 rods, got 1"),
        (dict(supports=(rx.Support(1, rx.Pinned(), rod=2),)), "rod: the scene's rods are 0 to 1"),
        (dict(supports=(rx.Support(5, rx.Pinned(), rod=1),)), "a rod of 4 elements has the nodes"),
        (dict(supports=(rx.Support(0, rx.Pinned(), rod=1),)), r"held by first_end\[1\] already"),
        (dict(inner_ends=(rx.Free(),)), "inner_ends"),
    ],
)
def test_refusals(rods, change, message):
    given = dict(rods=rods) | change
    if "inner_ends" in change:
        given = dict(rod=chain(rods)) | change
    with pytest.raises(ValueError, match=message):
        rx.Scene(**given)


def test_rods_that_do_not_go_together(rods):
    without = dataclasses.replace(rods[1], mass=None, rotary_inertia=None)
    with pytest.raises(ValueError, match=r"rods\[1\]: mass: it is None"):
        rx.Scene(rods=(rods[0], without))
    with pytest.raises(ValueError, match="rods: give one rod as `rod` or several"):
        rx.Scene(rods[0], rods=rods)


def test_the_rod_that_is_held_twice_is_named():
    section = rx.circular_section(0.02, 1e6, 0.4e6, density=1500.0)
    bent = rx.curved_rod([(0, 0, 0), (0.1, 0.04, 0), (0.2, 0, 0)], None, 4, section)
    straight = rx.straight_rod(0.1, 4, section, direction=(0, 1, 0), origin=(1, 0, 0))
    held = (rx.Clamped(), rx.Clamped())
    scene = rx.Scene(rods=(bent, straight), first_end=held, last_end=held)
    with pytest.raises(ValueError, match=r"they hold rods\[1\] twice .* along \(0, 1, 0\)"):
        rx.start(scene)
