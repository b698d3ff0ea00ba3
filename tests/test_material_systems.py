"""Materials in all that is done with scenes: several rods, files, batches, single precision."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rodjax as rx
from rodjax import storage
from rodjax.measuring.energy import ledger

N = 3
STEPS = np.linspace(0.02, 0.4, 20)
WAVING = rx.Smooth([0.0, 0.2, 1.0], [[0.0, 0.0, 0.0], [0.0, 3.0, 0.5], [0.0, 3.0, 0.5]])
YIELDING = rx.KelvinVoigt(0.01, elastic=rx.ElasticPlastic(0.3, 0.4))


def section(**changes):
    return rx.Section((1.0, 1.0, 0.8), mass=1.0, rotary_inertia=(1e-2, 1e-2, 2e-2), **changes)


def driven(n=N, material=YIELDING, **changes):
    return rx.straight_rod(1.0, n, section(material=material, **changes), actuation=WAVING)


@pytest.fixture(scope="module")
def run():
    """A scene that yields as it is driven, and its run."""
    scene = rx.Scene(driven(), rx.Clamped())
    return scene, rx.rollout(scene, rx.start(scene), STEPS)


@pytest.mark.slow
def test_what_is_driven_against_its_clamp_yields_and_is_booked(run):
    scene, whole = run
    assert np.max(np.abs(whole.final.memory.material)) > 0.01
    booked = ledger(scene, whole)
    assert booked.material_loss is not None and booked.material_loss[-1] > 1e-3
    assert booked.balance_error < 2e-2  # of twenty steps


@pytest.mark.slow
def test_a_file_keeps_scene_and_memory_to_the_last_bit(run, tmp_path):
    scene, whole = run
    half = rx.rollout(scene, whole.state(0), STEPS[:10])
    storage.save(tmp_path / "half.h5", scene, half, schedule=jnp.asarray(STEPS))
    stored = storage.load(tmp_path / "half.h5")
    assert eqx.tree_equal(stored.scene, scene, typematch=True)
    rest = stored.resume()
    for one, other in zip(jax.tree.leaves(rest.final), jax.tree.leaves(whole.final), strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.slow
def test_a_batch_of_laws_moves_as_each_by_itself(run):
    scene, whole = run

    def final(limit):
        material = rx.KelvinVoigt(0.01, elastic=rx.ElasticPlastic(limit, 0.4))
        moved = dataclasses.replace(scene, rod=driven(material=material))
        return rx.rollout(moved, whole.state(0), STEPS, throw=False).final.position

    found = jax.jit(jax.vmap(final))(jnp.asarray([0.3, 0.5]))
    np.testing.assert_allclose(found[0], whole.final.position, atol=1e-11)
    assert np.max(np.abs(found[1] - found[0])) > 1e-3


@pytest.mark.slow
def test_rods_of_other_materials_in_one_scene_move_as_by_themselves(run):
    scene, whole = run
    cable = rx.straight_rod(
        1.0, 2, section(torque_per_tension=0.1, coupling=(0.0, 0.0, 0.2)), origin=(3.0, 0.0, 0.0)
    )
    plain = dataclasses.replace(scene, rod=cable)
    velocity = 0.1 * np.arange(3.0)[:, None] * np.array([[1.0, 0.0, 0.0]])
    spin = np.arange(3.0)[:, None] * np.array([[0.0, 0.0, 0.4]])
    begun = rx.start(plain, velocity=velocity, angular_velocity=spin)
    alone = rx.rollout(plain, begun, STEPS)
    both = rx.Scene(rods=(driven(), cable), first_end=(rx.Clamped(), rx.Clamped()))
    join = lambda value: np.concatenate([np.zeros((N + 1, 3)), value])
    begun = rx.start(both, velocity=join(velocity), angular_velocity=join(spin))
    together = rx.rollout(both, begun, STEPS)
    first, second = rx.states_of(together.final)
    np.testing.assert_allclose(first.position, whole.final.position, atol=1e-9)
    np.testing.assert_allclose(second.position, alone.final.position, atol=1e-9)
    lost = ledger(both, together).material_loss
    np.testing.assert_allclose(lost, ledger(scene, whole).material_loss, atol=1e-9)


@pytest.mark.slow
def test_single_precision_takes_all_of_it():
    rod = driven(material=rx.KelvinVoigt(0.01, stretch=0.01), compliance=(0.0, 0.0, 1e-2))
    rod = dataclasses.replace(rod, torque_per_tension=jnp.full((N,), 0.1))
    single = lambda leaf: leaf.astype(jnp.float32) if eqx.is_inexact_array(leaf) else leaf
    scene = rx.Scene(jax.tree.map(single, rod), rx.Clamped())
    final, info = rx.step(scene, rx.placing(scene), jnp.asarray(0.02, jnp.float32))
    assert int(info.result) == 0
    assert {leaf.dtype for leaf in jax.tree.leaves(final)} == {jnp.dtype(jnp.float32)}
