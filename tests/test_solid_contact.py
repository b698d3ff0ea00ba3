"""Solids: set up from the load, refused where nothing would hold them, and said to be overcome."""

import dataclasses
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_contact_potential import meeting, report

import rodjax as rx
from rodjax.equations import overlap
from rodjax.interactions.contact_law import PairProperties
from rodjax.scenes.placing import placing

D = 0.1  # of the strands of `meeting`
FORCE = 7.0


def pushed(contact, **shape):
    """Force on the second strand."""
    rod, position = meeting(**shape)
    found = report(contact.fitted(rod), rod, position, jnp.zeros_like(position))
    assert not found.overflow
    return np.asarray(found.force)[-21:].sum(0)


@pytest.fixture(scope="module")
def solid():
    return rx.Contact.solid(meeting(end=0.0)[0], FORCE)


@pytest.mark.parametrize("end", [-0.5, -0.497, -0.494])
def test_solid_carries_the_load_at_the_indentation_asked_for(solid, end):
    """At right angles, wherever the points lie."""
    force = pushed(solid, end=end, beside=0.95 * D)
    assert force[1] == pytest.approx(FORCE, rel=0.02)


@pytest.mark.parametrize("degrees", [60, 30, 15])
def test_other_angles_give_way_less(solid, degrees):
    force = pushed(solid, end=-0.5, angle=np.radians(degrees), beside=0.95 * D)
    assert force[1] == pytest.approx(FORCE / np.sin(np.radians(degrees)), rel=0.02)


def test_solid_holds_with_a_margin(solid):
    """Crossing, as a tip, and side by side, the strands are overcome by many times the load."""
    assert pushed(solid, end=-0.5, beside=D / 3)[1] > 150 * FORCE
    assert pushed(solid, end=0.0)[0] > 100 * FORCE
    assert 0.1 * FORCE < pushed(solid, end=0.9 * D)[0] < FORCE < pushed(solid, end=0.85 * D)[0]
    rod, position = meeting(end=0.0, angle=0.0)
    position = position.at[-21:].add(jnp.asarray([0.95 * D, 0.0, -0.5]))
    found = report(solid.fitted(rod), rod, position, jnp.zeros_like(position))
    side_by_side = -np.asarray(found.force)[9:12, 0].sum() / 0.15
    assert side_by_side == pytest.approx(3 * FORCE / D, rel=0.15)


@pytest.mark.parametrize("elements", [6, 200])
@pytest.mark.parametrize("indentation", [0.02, 0.05, 0.2])
def test_solid_does_not_depend_on_the_grid(elements, indentation):
    section = rx.circular_section(0.01, 1e7, 4e6, 1000.0)
    contact = rx.Contact.solid(
        rx.straight_rod(1.0, elements, section), FORCE, indentation=indentation, relaxation=1e-3
    )
    spacing = 1.0 / (contact.segments * contact.points_per_segment)
    assert spacing <= 0.5 * np.sqrt(indentation * (1 - indentation)) * 0.01
    pair = PairProperties(jnp.asarray(0.01), None)
    at = jnp.asarray((1 - indentation) * 0.01)
    force = 2 * np.pi * at * contact.law.potential(at, pair)
    assert float(force) == pytest.approx(FORCE, rel=1e-9)
    assert 0.01 < float(contact.cutoff) < 0.012 and contact.acting_aperture is None
    assert float(contact.law.relaxation) == 1e-3


def test_thin_part_of_a_taper_counts():
    rod, _ = meeting(end=0.0)
    taper = dataclasses.replace(rod, diameter=jnp.linspace(0.1, 0.05, 60))
    thin = dataclasses.replace(rod, diameter=jnp.full(60, 0.05))
    one, other = (rx.Contact.solid(r, FORCE) for r in (taper, thin))
    assert one.law == other.law and one.segments == other.segments
    assert float(one.cutoff) == pytest.approx(0.11)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"force": 0.0}, "^force"),
        ({"force": -1.0}, "^force"),
        ({"force": np.nan}, "^force"),
        ({"force": 1.0, "indentation": 0.0}, "^indentation"),
        ({"force": 1.0, "indentation": 0.5}, "^indentation"),
        ({"force": 1.0, "relaxation": -1.0}, "^relaxation"),
        ({"force": 1.0, "segments": 1}, "^segments"),
        ({"force": 1.0, "capacities": (64, 8)}, "^capacities"),
    ],
)
def test_solid_names_the_argument(arguments, message):
    with pytest.raises(ValueError, match=message):
        rx.Contact.solid(meeting(end=0.0)[0], **arguments)


def test_more_segments_keep_the_law_and_its_points():
    rod, _ = meeting(end=0.0)
    chosen = rx.Contact.solid(rod, FORCE)
    more = rx.Contact.solid(rod, FORCE, segments=3 * chosen.segments, capacities=(16,))
    assert (more.segments, more.capacities) == (3 * chosen.segments, (16,))
    spacing = lambda contact: 1 / (contact.segments * contact.points_per_segment)
    assert spacing(more) <= spacing(chosen) * (1 + 1e-12)
    assert float(more.law.stiffness) == float(chosen.law.stiffness)


def test_solid_needs_to_know_the_rod():
    rod, _ = meeting(end=0.0)
    with pytest.raises(ValueError, match="^diameter"):
        rx.Contact.solid(dataclasses.replace(rod, diameter=None), 1.0)
    with pytest.raises(ValueError, match="^rod: its 3e\\+06 diameters"):
        thread = dataclasses.replace(rod, diameter=jnp.full(60, 1e-6))
        rx.Contact.solid(thread, 1.0)
    with pytest.raises(ValueError, match="^rod: .* outside jit"):
        jax.jit(lambda rod: rx.Contact.solid(rod, 1.0).cutoff)(rod)
    stiffness = jax.grad(lambda force: rx.Contact.solid(rod, force).law.stiffness)(2.0)
    assert float(stiffness) > 0


class Nothing(rx.AbstractLaw):
    """A user's law whose force may be anything."""

    force: float = 0.0

    def repulsion(self, distance, approach, pair):
        return self.force * jnp.ones_like(distance)

    def smallest(self, pair):
        return 0.1 * pair.diameter


class Sum(Nothing):
    """A law that adds up what it should give point by point."""

    def repulsion(self, distance, approach, pair):
        return jnp.sum(distance)


def over_the_last_axis(distance):
    """Of some shapes only."""
    return jnp.sum(distance, axis=-1, keepdims=True)


class SharedDamping(Nothing):
    """A law whose damping goes by the mean speed of all pairs."""

    def repulsion(self, distance, approach, pair):
        return self.force * (1 + jnp.mean(approach)) * jnp.ones_like(distance)


class Shared(Nothing):
    """A law whose pairs share a force, or know the nearest of them."""

    of: Callable = eqx.field(static=True, default=jnp.sum)

    def repulsion(self, distance, approach, pair):
        return self.force * distance / self.of(distance)


@pytest.mark.parametrize(
    ("law", "cutoff", "message"),
    [
        (rx.Penalty(1e8), 0.5 * D, "^cutoff: 0.05 is not beyond 0.1, .* give at least 0.11"),
        (rx.Penalty(1e8), D, "^cutoff"),
        (rx.Barrier(1e8), 1.1 * D, "^cutoff: 0.11 is not beyond 0.12"),
        (rx.InversePower(1.0, 3.0, floor=1.0), 0.9 * D, "^cutoff: .* smallest distance"),
        (rx.DampedInversePower(1e-7, 1e-6, 1e-3), 0.4 * D, "^cutoff: .* smallest distance"),
        (Nothing(), 2 * D, "^law: Nothing gives no force"),
        (Nothing(np.nan), 2 * D, "^law: Nothing gives nan"),
        (Nothing(np.inf), 2 * D, "^law: Nothing gives inf"),
        (Sum(1.0), 2 * D, "^law: `Sum.repulsion` must give one number"),
        (Shared(1.0), 2 * D, "^law: `Shared.repulsion` gives .* alone .* depend on other pairs"),
        (Shared(1.0, jnp.max), 2 * D, "^law: `Shared.repulsion` gives .* alone"),
        (Shared(1.0, jnp.min), 2 * D, "^law: `Shared.repulsion` gives .* alone"),
        (Shared(1.0, jnp.median), 2 * D, "^law: `Shared.repulsion` gives .* alone"),
        (Shared(1.0, over_the_last_axis), 2 * D, "^law: `Shared.repulsion` gives .* alone"),
        (SharedDamping(1.0), 2 * D, "^law: `SharedDamping.repulsion` gives .* alone"),
        (rx.DebyeHueckel(1.0, 1e-5), 2 * D, "^law: DebyeHueckel gives no force"),
    ],
)
def test_contact_that_would_do_nothing_is_refused(law, cutoff, message):
    rod, _ = meeting(end=0.0)
    with pytest.raises(ValueError, match=message):
        rx.Scene(rod, rx.Clamped(), contact=rx.Contact(law, 60, cutoff))


@pytest.mark.parametrize("law", [rx.Penalty(1e8), Nothing(3.0)], ids=["penalty", "user"])
def test_contact_that_acts_is_taken(law):
    rod, _ = meeting(end=0.0)
    assert rx.Scene(rod, rx.Clamped(), contact=rx.Contact(law, 60, 1.05 * D)).contact is not None


def test_strands_are_held_best_at_a_third_of_the_diameter():
    """Of a penalty without soft beginning 2 pi d k (D - d)^2/2 is largest there: 4 pi k D^3/27."""
    pair = PairProperties(jnp.asarray([D]), None)
    contact = rx.Contact(rx.Penalty(1e3, softness=1e-4), 60, 1.2 * D)
    held = overlap.least_held(contact, pair)
    assert float(held[0]) == pytest.approx(D / 3, rel=0.02)
    force = float(overlap.crossing_force(contact, held, pair)[0])
    assert force == pytest.approx(4 * np.pi / 27 * 1e3 * D**3, rel=1e-3)


def deepest(contact, **shape):
    """Where strands are too near, which what a step looks at must say as well."""
    rod, _ = meeting(end=0.0)
    scene, position = rx.Scene(rod, rx.Clamped(), contact=contact), meeting(**shape)[1]
    found = overlap.deepest(scene, position)
    assert bool(in_a_step(scene, position)) == (found is not None)
    return found


@jax.jit
def in_a_step(scene, position):
    held = overlap.distances_held(scene)
    return overlap.too_near(scene.contact, scene.find_contact(position), held, position)


def test_overlap_is_found_where_it_is(solid):
    deep = {"end": -0.5, "beside": 0.2 * D}
    assert deepest(solid, end=-0.5, beside=0.4 * D) is None
    assert deepest(solid, end=0.06) is None
    where = deepest(solid, **deep)
    assert where.first == pytest.approx(0.5, abs=0.01)
    assert where.second == pytest.approx(3.0 - 0.5, abs=0.01)
    assert where.distance == pytest.approx(0.2 * D, rel=1e-6)
    assert where.held == pytest.approx(D / 3, rel=0.1)
    # a tip that went in, and one that went through
    for end in (0.02, -0.2):
        assert deepest(solid, end=end) is not None
    for degrees in (60, 30):
        where = deepest(solid, **deep, angle=np.radians(degrees))
        assert where.distance == pytest.approx(0.2 * D, rel=1e-3)


def test_a_ring_is_no_overlap():
    radius = 0.1
    circle = lambda s: jnp.stack(
        [radius * jnp.sin(s / radius), 0 * s, radius - radius * jnp.cos(s / radius)]
    )
    section = rx.Section((1.0, 1.0, 0.8), mass=1.0, diameter=0.01)
    rod = rx.curved_rod(circle, 2 * np.pi * radius, 32, section)
    contact = rx.Contact.solid(rod, 1.0)
    ring = rx.Scene(rod, rx.Clamped(), rx.Clamped(), contact=contact)
    assert overlap.deepest(ring, rod.position) is None
    loose = rx.Scene(rod, rx.Clamped(), rx.Free(), contact=contact)
    with pytest.raises(ValueError, match="^position: the strands at s = .* apart"):
        rx.start(loose)


def loop(height, contact_of, drive=None, elements=24):
    """Three quarters of a loop whose ends cross at a height, driven through each other."""
    radius, leg = 0.08, 0.2
    around = 1.5 * np.pi * radius

    def curve(s):
        s = float(s)
        slope = height / around
        flat = np.sqrt(1 - slope**2)
        angle = np.clip(s - leg, 0, around) * flat / radius
        arc = np.array([radius * np.sin(angle), radius * (1 - np.cos(angle)), 0.0])
        rest = max(s - leg - around, 0.0) * np.array([np.cos(angle), np.sin(angle), 0.0])
        rise = np.array([0.0, 0.0, slope * np.clip(s - leg, 0, around)])
        return np.array([min(s - leg, 0.0), 0.0, 0.0]) + arc + rest + rise

    section = rx.circular_section(0.01, 1.2e7, 4e6, 1500.0)
    rod = rx.curved_rod(curve, 2 * leg + around + radius, elements, section)
    ends = [rx.Clamped(), rx.Clamped()]
    if drive is not None:
        way = np.array([0.0, 0.0, drive])
        move = lambda sign: rx.Smooth([0.0, 1.0, 100.0], np.outer([0, sign, sign], way))
        ends = [rx.Clamped(displacement=move(1)), rx.Clamped(displacement=move(-1))]
    drag = rx.MorisonDrag(1000.0, 1.0, 0.01)
    return rx.Scene(rod, *ends, loads=(drag,), contact=contact_of(rod))


@pytest.mark.parametrize(
    "law",
    [
        rx.Penalty(1e7),
        rx.Barrier(1e6),
        rx.InversePower(1e-4, 3.0),
        rx.DampedInversePower(k1=1e-7, k3=1e-6, reference_spacing=1e-3),
    ],
    ids=lambda law: type(law).__name__,
)
@pytest.mark.parametrize("part", [1e-3, 1e-7, 0.0])
def test_a_start_inside_each_other_is_refused(law, part):
    scene = loop(part * 0.01, lambda rod: rx.Contact(law, 48, 0.03))
    with pytest.raises(ValueError, match=r"^position: the strands at s = .* and .* apart"):
        rx.start(scene)
    with pytest.raises(ValueError, match="^position"):
        rx.rollout(scene, placing(scene), jnp.asarray([0.1]))


@pytest.fixture(scope="module")
def overcome():
    """A scene whose strands are driven through each other, its start, and times."""
    contact = rx.Contact(rx.Penalty(1e5), 32, 0.03, capacities=(33,))
    scene = loop(0.02, lambda rod: contact, drive=0.06, elements=10)
    return scene, rx.start(scene), jnp.linspace(0, 1.0, 81)[1:]


@pytest.mark.slow
def test_a_penalty_too_weak_is_said_to_be_overcome(overcome):
    """In the step in which it is, outside traced code and in it."""
    scene, state, times = overcome
    run = rx.rollout(scene, state, times, save_every=10, throw=False)
    assert int(run.result) == rx.Result.CONTACT_OVERCOME
    told = np.asarray(run.infos.result)
    last = int(np.argmax(told != 0))
    assert 10 < last < 70 and np.all(told[last:] == rx.Result.CONTACT_OVERCOME)
    assert np.all(np.asarray(run.infos.iterations)[last + 1 :] == 0)
    traced = jax.jit(lambda *given: rx.rollout(*given, save_every=10, throw=False))(*overcome)
    np.testing.assert_array_equal(traced.infos.result, told)
    assert int(traced.result) == rx.Result.CONTACT_OVERCOME


@pytest.mark.slow
def test_adaptive_steps_end_before_strands_overlap_too_far(overcome):
    scene, state, _ = overcome
    with pytest.raises(rx.SimulationError) as failure:
        rx.adaptive_rollout(scene, state, 1.0)
    assert failure.value.result is rx.Result.CONTACT_OVERCOME
    kept = failure.value.partial.final
    assert 0.2 < float(kept.time) < 0.9
    assert overlap.deepest(scene, kept.position) is None


def test_a_scene_of_more_rods_has_more_segments_of_the_same_length():
    section = rx.circular_section(0.02, 1e6, 0.4e6, density=1500.0)
    rods = [
        rx.straight_rod(length, 10, section, origin=(0.1 * i, 0, 0))
        for i, length in enumerate((1.0, 0.6, 1.0))
    ]
    contact = rx.Contact.solid(rods[0], 20.0)
    assert rx.Scene(rods[0], contact=contact).contact.segments == contact.segments
    several = rx.Scene(rods=tuple(rods), contact=contact)
    assert several.contact.shares == tuple(
        round(contact.segments * length) for length in (1.0, 0.6, 1.0)
    )
    # laid out once: a scene made of it has no more
    again = dataclasses.replace(several, loads=(rx.Gravity((0, 0, -9.81)),))
    assert again.contact.segments == several.contact.segments
    # numbers of your own are for the rod that they were chosen on
    own = dataclasses.replace(contact, segments=20, points_per_segment=24)
    assert rx.Scene(rods=tuple(rods), contact=own).contact.shares == (20, 12, 20)
    # what is thinner needs points as much closer
    thin = dataclasses.replace(rods[1], diameter=0.5 * rods[1].diameter)
    assert sum(rx.Scene(rods=(rods[0], thin), contact=contact).contact.shares) == round(
        2 * 1.6 * contact.segments
    )
    fixed = dataclasses.replace(contact, laid_on=None)
    assert sum(rx.Scene(rods=tuple(rods), contact=fixed).contact.shares) in (57, 58, 59)
