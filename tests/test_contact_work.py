"""What contact exerts on the ends, and its work in the ledger."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import UNIT_SECTION
from made_runs import reactions, run_of, run_over, start, state_of

from rodjax import energy
from rodjax.constraints.ends import Clamped
from rodjax.interactions import contact, contact_energy, contact_laws, contact_report, screening
from rodjax.interactions.loads import LinearDrag
from rodjax.rods import builders
from rodjax.scenes.scene import Scene


@pytest.fixture(scope="module")
def hairpin():
    """A rod at rest in the shape of a hairpin, whose strands repel each other."""
    radius, length = 0.05, 1.0
    straight = (length - np.pi * radius) / 2

    def curve(s):
        angle = (s - straight) / radius
        if angle < 0:
            return np.array([0.0, s, 0.0])
        if angle < np.pi:
            return np.array([radius * (1 - np.cos(angle)), straight + radius * np.sin(angle), 0.0])
        return np.array([2 * radius, straight - radius * (angle - np.pi), 0.0])

    section = eqx.tree_at(
        lambda s: (s.diameter, s.rotary_inertia), UNIT_SECTION, (0.02, (0.02, 0.02, 0.02))
    )
    law = contact_laws.InversePower(1e-2, 2.0)
    touching = contact.Contact(law, 24, 0.15, exclusion=0.3, capacities=(25,))
    a_rod = builders.curved_rod(curve, length, 24, section)
    return Scene(a_rod, Clamped(), Clamped(), (LinearDrag(20.0, 20.0, 0.1),), touching)


contact_wrench = eqx.filter_jit(energy.contact_wrench)


def test_contact_enters_the_reactions(hairpin):
    """Equal and opposite forces push the strands apart; the clamps take what acts on their nodes.

    The rod is at rest and unstressed, so the clamps have nothing else to carry.
    """
    state = state_of(hairpin.rod)
    wrench = contact_wrench(hairpin, state)
    force = np.asarray(wrench[:, :3])
    np.testing.assert_array_equal(wrench[:, 3:], 0)
    np.testing.assert_allclose(force.sum(0), 0, atol=1e-14)
    np.testing.assert_allclose(np.cross(hairpin.rod.position, force).sum(0), 0, atol=1e-14)
    assert force[3, 0] < -1e-4 and force[-4, 0] > 1e-4
    found = reactions(hairpin, state)
    np.testing.assert_allclose(found.force, -force[jnp.array([0, -1])], atol=1e-12)
    assert np.all(np.abs(found.force[:, 0]) > 1e-5)
    apart = eqx.tree_at(lambda s: s.contact, hairpin, None)
    np.testing.assert_array_equal(energy.contact_wrench(apart, state), 0)


def test_work_done_on_contact(hairpin):
    """Strands pressed together along a given path: the sum of force times way over the path."""

    def pressed(part):
        closer = hairpin.rod.position.at[:, 0].multiply(1 - 0.4 * part)
        return state_of(hairpin.rod, position=closer)

    path = [pressed(part) for part in np.linspace(0, 1, 9)]
    forces = np.stack([contact_wrench(hairpin, state)[:, :3] for state in path])
    places = np.stack([state.position for state in path])
    work = -0.5 * np.sum((forces[1:] + forces[:-1]) * np.diff(places, axis=0), (1, 2))
    book = energy.ledger(hairpin, run_of(path))
    assert np.all(work > 0)
    np.testing.assert_allclose(np.diff(book.contact_work), work, rtol=1e-10)


def test_the_ledger_searches_for_contact_once_a_state(hairpin, monkeypatch):
    """Forces, forces at rest and energies share what was found."""
    searches, search = [], screening.search
    counted = lambda *given: searches.append(None) or search(*given)
    monkeypatch.setattr(screening, "search", counted)
    for module in (contact_report, contact_energy):
        monkeypatch.delattr(module, "search")
    run = run_of([state_of(hairpin.rod)] * 5)
    # not traced before, as the scene of other tests is
    scene = dataclasses.replace(hairpin, contact=dataclasses.replace(hairpin.contact, segments=22))
    eqx.filter_eval_shape(energy.ledger, scene, run)
    assert len(searches) == 1  # for the shapes and the loop over the states


@pytest.mark.slow
def test_ledger_balances_while_strands_push_each_other_apart(hairpin):
    """Contact is where the motion's energy comes from."""
    state = start(hairpin)
    errors = []
    for steps in (200, 400):
        book = energy.ledger(hairpin, run_over(hairpin, state, 0.5, steps, 400))
        assert book.contact_work[-1] < 0
        errors.append(float(jnp.max(jnp.abs(book.residual))) / -float(book.contact_work[-1]))
    assert errors[1] < 1e-3
    assert errors[1] < errors[0] / 2.8
