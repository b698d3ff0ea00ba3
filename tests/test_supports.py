"""Supports between the ends: beams on three supports, spans, halves of rods, drives, refusals."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rodjax as rx
from rodjax.constraints.supports import Support
from rodjax.measuring import energy

LENGTH, ELEMENTS = 1.0, 32
BENDING, TORSION, MASS = 2.0, 1.5, 0.8
LIGHT = jnp.asarray([0.0, 0.0, -1e-2])  # so that deflections are small: w L^3/EI = 4e-3


def beam(first, last, *supports, loads=(), elements=ELEMENTS, axial=1e-7, **fields):
    """A beam along x, axially compliant, so that supports may stand in one line."""
    section = rx.Section((BENDING, BENDING, TORSION), mass=MASS, compliance=(0.0, 0.0, axial))
    section = dataclasses.replace(section, **fields)
    rod = rx.straight_rod(LENGTH, elements, section, direction=(1.0, 0.0, 0.0))
    return rx.Scene(rod, first, last, loads=loads, supports=supports)


def at_rest(scene):
    state, info = rx.equilibrium(scene, rx.placing(scene))
    return state, info, energy.reactions(scene, state)


def middle(end=None):
    return Support(ELEMENTS // 2, rx.Pinned() if end is None else end)


@pytest.mark.slow
def test_two_spans_under_their_weight():
    """Three supports in a line carry 3/8, 10/8 and 3/8 of the weight of a span."""
    weight = 0.5 * LENGTH * MASS * 1e-2
    errors = []
    for elements in (16, 32):
        scene = beam(
            Torsionless(),
            rx.Pinned(),
            Support(elements // 2, rx.Pinned()),
            loads=(rx.Gravity(LIGHT),),
            elements=elements,
        )
        state, info, reactions = at_rest(scene)
        assert int(info.unstable) == 0
        carried = np.asarray(reactions.force[:, 2]) / weight
        np.testing.assert_allclose(carried.sum(), 2.0, rtol=1e-9)
        np.testing.assert_allclose(reactions.torque[1:], 0.0, atol=1e-12)
        errors.append(np.abs(carried - [0.375, 0.375, 1.25]).max())
        assert abs(float(state.position[elements // 2, 2])) < 1e-12
    assert errors[1] < 2e-3
    assert 3.5 < errors[0] / errors[1] < 4.5


class Torsionless(rx.Pinned):
    """A pin that holds the rotation about the beam's axis: body axis 3."""

    def projector(self, time):
        return jnp.diag(jnp.asarray([1.0, 1.0, 1.0, 0.0, 0.0, 1.0]))


@pytest.mark.slow
def test_a_beam_with_free_ends_on_two_supports():
    """At its quarter points: each carries half of the weight, and the middle does not bend.

    The moment there is w L/2 (L/4 - L/4) = 0.
    """
    quarter = ELEMENTS // 4
    supports = Support(quarter, Torsionless()), Support(-1 - quarter, rx.Pinned())
    scene = beam(rx.Free(), rx.Free(), *supports, loads=(rx.Gravity(LIGHT),))
    state, info, reactions = at_rest(scene)
    assert int(info.unstable) == 0
    half = 0.5 * MASS * LENGTH * 1e-2
    np.testing.assert_allclose(reactions.force[:2], 0.0, atol=1e-12)
    np.testing.assert_allclose(reactions.force[2:, 2], half, rtol=1e-6)
    kappa = rx.rotations.logarithm(
        rx.rotations.multiply(rx.rotations.conjugate(state.quaternion[:-1]), state.quaternion[1:])
    ) * (ELEMENTS / LENGTH)
    moment = BENDING * np.linalg.norm(np.asarray(kappa)[:, :2], axis=1)
    # in the middle of the element beside the support
    at_support = 0.5 * MASS * 1e-2 * (LENGTH / 4 - 0.5 * LENGTH / ELEMENTS) ** 2
    np.testing.assert_allclose(moment.max(), at_support, rtol=1e-2)
    assert moment[ELEMENTS // 2] < 0.02 * at_support


def test_frequencies_of_two_spans():
    """Those of a span between pins, and of one pinned at one end and clamped at the other."""
    scene = beam(Torsionless(), rx.Pinned(), middle(), axial=1e-9)
    state = rx.placing(scene)
    found = rx.vibration(scene, state, 4)
    unit = np.sqrt(BENDING / MASS) / (LENGTH / 2) ** 2
    expected = np.repeat([np.pi**2, 3.926602**2], 2)
    np.testing.assert_allclose(np.asarray(found.frequency) / unit, expected, rtol=6e-3)


@pytest.mark.parametrize(
    "factor, modes, contact",
    [
        pytest.param(1.05, 2, False, marks=pytest.mark.slow),
        pytest.param(0.95, 0, False, marks=pytest.mark.slow),
        pytest.param(0.95, 0, True, marks=pytest.mark.slow),
        pytest.param(1.05, 2, True, marks=pytest.mark.slow),
    ],
)
def test_a_column_held_at_half_its_height_carries_four_times_as_much(factor, modes, contact):
    """4 pi^2 EI/L^2 of a column whose last end slides down: of each of its two planes a mode."""

    class Guide(rx.Slider):
        """Slides along the column and turns, but not about it."""

        def projector(self, time):
            return jnp.diag(jnp.asarray([0.0, 1.0, 1.0, 0.0, 0.0, 0.0]))

    # parts of the rod that are near each other, and do not touch, have modes counted otherwise
    near = rx.Contact(rx.Penalty(1.0), segments=8, cutoff=0.3, exclusion=0.3) if contact else None
    thrust = factor * 4 * np.pi**2 * BENDING / LENGTH**2
    load = rx.PointLoad(-1, rx.Constant((-thrust, 0.0, 0.0)))
    across = Guide((1, 0, 0))
    scene = beam(Torsionless(), across, middle(across), loads=(load,), diameter=0.02)
    scene = dataclasses.replace(scene, contact=near)
    _, info = rx.equilibrium(scene, rx.placing(scene), relax=False)
    assert int(info.unstable) == modes


def bent(elements):
    """A stretch of a circle, which may be held anywhere without being held twice."""
    angle = lambda s: s / 0.4
    curve = lambda s: jnp.stack([0.4 * jnp.sin(angle(s)), 0.4 - 0.4 * jnp.cos(angle(s)), 0.0 * s])
    section = rx.Section(
        (BENDING, 1.2 * BENDING, TORSION), mass=MASS, rotary_inertia=(1e-3, 1e-3, 2e-3)
    )
    return rx.curved_rod(curve, LENGTH, elements, section)


def half_of(rod, last):
    """Its first or second half, as a rod."""
    n = rod.elements // 2

    def part(leaf):
        if not eqx.is_array(leaf) or leaf.ndim == 0:
            return leaf
        ends = leaf.shape[0] - rod.elements  # 1 for nodes
        return leaf[n:] if last else leaf[: n + ends]

    return jax.tree.map(part, rod)


LOADS = (rx.Gravity((0.3, -4.0, 6.0)), rx.LinearDrag(0.2, 0.1, 1e-3))


@pytest.mark.slow
def test_halves_of_a_rod_clamped_between_move_alone():
    rod = bent(16)
    scene = rx.Scene(rod, rx.Free(), rx.Free(), LOADS, supports=(Support(8, rx.Clamped()),))
    times = 0.01 * jnp.arange(1.0, 21.0)
    whole = rx.rollout(scene, rx.start(scene), times)
    carried = energy.reactions(scene, whole.final)
    ends = []
    for last in (False, True):
        held = (rx.Clamped(), rx.Free()) if last else (rx.Free(), rx.Clamped())
        part = rx.Scene(half_of(rod, last), *held, LOADS)
        alone = rx.rollout(part, rx.start(part), times)
        place = slice(8, None) if last else slice(0, 9)
        for name in ("position", "quaternion", "rate"):
            found = getattr(whole.states, name)[:, place]
            np.testing.assert_allclose(found, getattr(alone.states, name), atol=1e-9)
        ends.append(energy.reactions(part, alone.final).force[0 if last else 1])
    # inertia of the node is counted once in the whole, where it rests
    np.testing.assert_allclose(carried.force[2], ends[0] + ends[1], rtol=1e-7)


def driven(amount):
    """A bent rod, pinned at one end and moved in its middle, and its run."""
    moved = (0.0, 0.0, amount)
    shift = rx.Smooth([0.0, 0.2, 1.0], [(0.0, 0.0, 0.0), moved, moved])
    support = Support(8, rx.Pinned(displacement=shift))
    scene = rx.Scene(bent(16), rx.Pinned(), rx.Free(), LOADS, supports=(support,))
    return scene, rx.rollout(scene, rx.start(scene), 0.0025 * jnp.arange(1.0, 121.0))


@pytest.mark.slow
def test_a_driven_support_moves_the_rod_and_its_work_is_booked():
    scene, run = driven(0.05)
    shift = scene.supports[0].end.displacement
    expected = scene.rod.position[8][None] + jax.vmap(shift)(run.times)
    np.testing.assert_allclose(run.states.position[:, 8], expected, atol=1e-10)
    book = energy.ledger(scene, run)
    work = abs(float(book.drive_work[-1]))
    assert work > 0.1
    assert np.max(np.abs(book.residual)) < 0.01 * work


@pytest.mark.slow
def test_derivatives_through_a_driven_support():
    def moved(amount):
        return driven(amount)[1].states.position[-1, -1, 2]

    amount, h = jnp.asarray(0.05), 1e-5
    slope = rx.jit(jax.grad(moved))(amount)
    difference = (moved(amount + h) - moved(amount - h)) / (2 * h)
    np.testing.assert_allclose(slope, difference, rtol=1e-6)
    _, forward = rx.jit(lambda a: jax.jvp(moved, (a,), (jnp.ones_like(a),)))(amount)
    np.testing.assert_allclose(forward, slope, rtol=1e-9)


@pytest.mark.slow
def test_the_node_is_a_number():
    """Traced and mapped: lanes held at different nodes are those of scenes of their own."""
    rod = bent(16)
    times = 0.01 * jnp.arange(1.0, 6.0)

    def tip(node):
        support = Support(node, rx.Pinned())
        scene = rx.Scene(rod, rx.Clamped(), rx.Free(), LOADS, supports=(support,))
        return rx.rollout(scene, rx.start(scene), times, throw=False).states.position[-1, -1]

    nodes = jnp.asarray([4, 9, -2, 16, 40])
    found = np.asarray(jax.jit(jax.vmap(tip))(nodes))
    for lane, node in enumerate([4, 9, -2]):
        np.testing.assert_allclose(found[lane], tip(node), atol=1e-10)
    assert np.all(np.isnan(found[3:]))


@pytest.mark.slow
def test_a_support_that_begins():
    """From its time on the node rests; the energy that this takes is booked."""
    rod, begin = bent(16), 0.1
    support = Support(8, rx.Switched(rx.Free(), rx.Pinned(), begin))
    scene = rx.Scene(rod, rx.Clamped(), rx.Free(), LOADS, supports=(support,))
    run = rx.rollout(scene, rx.start(scene), 0.005 * jnp.arange(1.0, 61.0))
    after = np.asarray(run.times) >= begin - 1e-12
    still = np.asarray(run.states.position)[after][:, 8]
    np.testing.assert_allclose(still, still[:1] + 0 * still, atol=1e-10)
    assert float(energy.ledger(scene, run).projection_loss[-1]) > 0
    before = np.asarray(run.states.position)[~after][:, 8]
    assert np.linalg.norm(before[-1] - before[0]) > 1e-3


def test_held_twice():
    rod = rx.straight_rod(1.0, 8, rx.Section((1.0, 1.0, 1.0), mass=1.0))
    scene = rx.Scene(rod, rx.Clamped(), rx.Free(), supports=(Support(4, rx.Pinned()),))
    with pytest.raises(ValueError, match="hold the rod twice"):
        rx.start(scene)
    along = rx.Scene(rod, rx.Clamped(), rx.Free(), supports=(Support(4, rx.Slider((0, 0, 1))),))
    rx.start(along)


REFUSED = {
    "list": ([Support(3, rx.Free())], "give a tuple"),
    "an end": ((rx.Pinned(),), "give a support such as Support"),
    "first": ((Support(0, rx.Pinned()),), "node 0 is held by first_end already"),
    "last": ((Support(-1, rx.Pinned()),), "node 8 is held by last_end already"),
    "beyond": ((Support(9, rx.Pinned()),), "has the nodes 0 to 8"),
    "twice": ((Support(3, rx.Pinned()), Support(-6, rx.Free())), r"held by supports\[0\] already"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_supports_are_refused(case):
    supports, message = REFUSED[case]
    rod = rx.straight_rod(1.0, 8, rx.Section((1.0, 1.0, 1.0), mass=1.0))
    with pytest.raises(ValueError, match=message):
        rx.Scene(rod, supports=supports)


def test_wrong_parts_are_refused():
    with pytest.raises(ValueError, match="node"):
        Support(2.5, rx.Pinned())


def hung(middle):
    """Pins in a row, none of which holds the spin of a rod with two equal stiffnesses."""
    pins = rx.Pinned(), rx.Pinned()
    return beam(*pins, Support(middle, rx.Pinned()), loads=(rx.Gravity(LIGHT),), elements=16)


@pytest.mark.slow
def test_a_free_spin_stays_in_traced_code_too():
    """Of a traced scene the kinds of what holds it are known, though the node is not."""
    place = rx.jit(lambda scene: rx.equilibrium(scene, rx.placing(scene), throw=False))
    alone, info = rx.equilibrium(hung(8), rx.placing(hung(8)))
    traced, traced_info = place(hung(8))
    assert int(info.result) == int(traced_info.result) == 0
    np.testing.assert_allclose(traced.quaternion, alone.quaternion, atol=1e-9)
    moved = rx.jit(jax.vmap(lambda node: place(hung(node))[0].position[-3, 2]))
    found = moved(jnp.asarray([8, 5]))
    np.testing.assert_allclose(found[0], alone.position[-3, 2], atol=1e-12)
    assert abs(float(found[1] - found[0])) > 1e-6


@pytest.mark.slow
def test_equilibrium_in_single_precision():
    """Of 200 elements on five supports the reactions are those in double precision."""
    supports = [Support(node, rx.Pinned()) for node in (50, 100, 150)]
    gravity = rx.Gravity(jnp.asarray([0.0, 0.0, -1.0]))
    scene = beam(Torsionless(), rx.Pinned(), *supports, loads=(gravity,), elements=200, axial=1e-4)
    cast = lambda leaf: leaf.astype(jnp.float32) if eqx.is_inexact_array(leaf) else leaf
    carried = []
    for one in (scene, jax.tree.map(cast, scene)):
        state, _ = rx.equilibrium(one, rx.placing(one), relax=False)
        carried.append(np.asarray(energy.reactions(one, state).force[:, 2], float))
    np.testing.assert_allclose(carried[1], carried[0], atol=0.02 * carried[0].max())
