"""For how much in contact solvers are compiled, and which is chosen."""

import numpy as np
import pytest

import rodjax as rx
from rodjax.interactions import contact_capacities, screening
from rodjax.interactions.contact_capacities import Capacity, capacities
from rodjax.numerics.front_order import FrontSize

SECTION = rx.circular_section(5e-3, 2e6, 1e6, density=1200.0)
FRICTION = rx.SlidingFriction(0.4, 1e-3)


def heap(rods, elements, friction=None):
    """Level rods above each other, turned by the golden angle, each touching the next."""
    placed = []
    for i in range(rods):
        along = np.array([np.cos(2.4 * i), np.sin(2.4 * i), 0.0])
        origin = np.array([0.0, 0.0, 4.9e-3 * i]) - 0.25 * along
        placed.append(rx.straight_rod(0.5, elements, SECTION, direction=along, origin=origin))
    contact = rx.Contact.solid(
        placed[0], 1.0, indentation=0.1, friction=friction, segments=elements
    )
    return rx.Scene(rods=tuple(placed), contact=contact)


def sizes_of(contact, elements):
    return [one.front or one.vertices for one in capacities(contact, elements)]


def test_few_are_tried_first_then_strips_then_many():
    law = rx.Penalty(stiffness=1e6)
    sizes = lambda segments, grid=200: sizes_of(rx.Contact(law, segments, 0.012), grid)
    narrow, wide = contact_capacities._FRONTS
    assert sizes(10) == [11]
    assert sizes(60) == [61]
    assert sizes(100) == [16, 101]  # 303 unknowns: no strip is cheaper
    assert sizes(200) == [16, 64, narrow, 201]
    assert sizes(800) == [16, 64, narrow, 256, 801]  # between 201 nodes
    assert sizes(800, 800) == [16, 64, narrow, wide, 256, 801]
    given = rx.Contact(law, 200, 0.012, capacities=(8, 40))
    assert sizes_of(given, 200) == [8, 40]


@pytest.mark.parametrize("friction", [None, FRICTION])
def test_no_dense_system_is_larger_than_can_be_solved(friction):
    scene = heap(20, 100, friction)
    found = capacities(scene.contact, scene.rod.elements)
    width = scene.contact.width
    assert all(width * one.vertices <= 3100 for one in found if one.front is None)
    last = found[-1]
    assert last.front is not None and last.vertices == 2020
    assert last.pairs >= max(one.pairs for one in found)


def test_the_first_that_holds_what_touches_is_chosen(monkeypatch):
    """Also before one that does not; none that holds it is an overflow."""
    scene = heap(2, 30)
    (*_, whole) = capacities(scene.contact, scene.rod.elements)
    few = Capacity(16, whole.pairs, None)
    narrow = whole._replace(front=FrontSize(1, 1))

    def found(*sizes):
        monkeypatch.setattr(screening, "capacities", lambda *given: sizes)
        pairs = scene.find_contact(scene.rod.position).pairs
        assert int(pairs.count) > 0
        return int(pairs.capacity), bool(pairs.overflow)

    assert found(few, whole) == (1, False)
    assert found(few._replace(vertices=2), whole) == (2, False)
    assert found(few, narrow) == (1, False)
    assert found(few._replace(vertices=2), narrow) == (2, True)
