"""Self-contact: the search, pair forces, and the coupled Newton system."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import DIAMETER, LAWS, PAIR, hairpin, order_of

from rodjax import contact as contact_of
from rodjax import contact_forces as forces_of
from rodjax import contact_laws as laws
from rodjax import measures, newton, screening
from rodjax.consistency import start
from rodjax.contact import Contact
from rodjax.coupled import find_nearby
from rodjax.ends import Clamped
from rodjax.loads import MorisonDrag
from rodjax.results import Result
from rodjax.rod import circular_section, straight_rod
from rodjax.run import Run
from rodjax.scene import Scene
from rodjax.step_equations import StepEquations
from rodjax.stepping import no_info, step


@pytest.fixture(scope="module")
def bent(request):
    """Hairpin scene, a moving state of it, and the points near each other."""
    contact = Contact(LAWS["damped"], segments=20, cutoff=0.1, points_per_segment=2)
    scene = Scene(hairpin(getattr(request, "param", 24)), Clamped(), Clamped(), (), contact)
    state = start(scene)
    velocity = 0.1 * np.random.default_rng(0).normal(size=state.position.shape)
    state = dataclasses.replace(state, rate=state.rate.at[:, :3].set(velocity))
    return scene, state, find_nearby(scene, state.position, 1e-3 * state.velocity)


# grids finer and coarser than the contact's 20 segments
finer_and_coarser = pytest.mark.parametrize("bent", [24, 14], indirect=True)


def test_points_find_their_partners(bent):
    scene, _, near = bent
    where, found = near
    count = int(found.count)
    assert 10 < count < 60 and not found.overflow
    first, second = found.first[:count], found.second[:count]
    assert np.all(np.asarray(first) < np.asarray(second))
    # the two legs face each other
    s = np.asarray(where.arc_length).mean(1)
    assert np.all(np.abs(s[first] + s[second] - 1) < 0.25)
    assert {2, 17} <= {int(j) for j in first} | {int(j) for j in second}
    np.testing.assert_array_equal(found.rank[found.order], np.arange(21))


def test_search_misses_no_pair_that_acts(bent):
    """Every pair of points with a force, found by brute force, is in the list."""
    scene, state, near = bent
    where, found = near
    joints = np.asarray(contact_of.interpolate(where, state.position))
    part = (np.arange(2) + 0.5) / 2
    points = joints[:-1, None] + part[:, None] * (joints[1:, None] - joints[:-1, None])
    chord = joints[1:] - joints[:-1]
    chord /= np.linalg.norm(chord, axis=1, keepdims=True)
    listed = set(zip(*(np.asarray(x)[: int(found.count)].tolist() for x in found[:2]), strict=True))
    acting = set()
    for a in range(20):
        for b in range(a + 1, 20):
            r = points[b][None] - points[a][:, None]
            d = np.linalg.norm(r, axis=-1)
            cosines = [np.sum(r * chord[segment], -1) / d for segment in (a, b)]
            apart = np.abs(where.arc_length[b][None] - where.arc_length[a][:, None])
            gate = forces_of.window(scene.contact, d, PAIR, cosines)
            gate = gate * (apart >= scene.contact.excluded)
            if np.any(gate > 0):
                acting.add((a, b))
    assert len(acting) > 5 and acting <= listed


def test_straight_rod_has_no_contact_and_its_step_is_that_without():
    section = circular_section(DIAMETER, 1e6, 5e5, 1500.0)
    rod = straight_rod(1.0, 10, section, natural_curvature=(0.3, 0.0, 0.0))
    contact = Contact(LAWS["damped"], segments=20, cutoff=0.1, points_per_segment=2)
    runs = [
        step(scene, start(scene), jnp.asarray(1e-2))[0]
        for scene in (Scene(rod, Clamped()), Scene(rod, Clamped(), contact=contact))
    ]
    for plain, touching in zip(*(jax.tree.leaves(run) for run in runs), strict=True):
        np.testing.assert_allclose(touching, plain, rtol=1e-9, atol=1e-12)


def test_forces_are_equal_and_opposite(bent):
    scene, state, near = bent
    force = forces_of.forces(scene.contact, scene.rod, *near, state.position, state.velocity)
    scale = float(jnp.max(jnp.abs(force)))
    assert scale > 0
    np.testing.assert_allclose(jnp.sum(force, 0), 0.0, atol=1e-12 * scale)


def test_central_forces_make_no_torque():
    scene = Scene(
        hairpin(),
        Clamped(),
        Clamped(),
        contact=Contact(LAWS["damped"], segments=20, cutoff=0.1, points_per_segment=2),
    )
    state = start(scene)
    push = forces_of.report(scene.contact, scene.rod, state.position, state.velocity).force
    torque = jnp.sum(jnp.cross(state.position, push), 0)
    np.testing.assert_allclose(torque, 0.0, atol=1e-12 * float(jnp.max(jnp.abs(push))))


@finer_and_coarser
def test_newton_system_is_the_exact_derivative(bent):
    scene, state, near = bent
    equations = StepEquations(scene, state, jnp.asarray(1e-3), jnp.asarray(0.8), near)
    x = equations.guess()
    system = equations.linearize(x)
    matrix = jax.jacfwd(equations.residual)(x).reshape(x.size, x.size)
    b = jnp.asarray(np.random.default_rng(1).normal(size=x.shape))
    dx = system.solve(b)
    np.testing.assert_allclose(
        matrix @ equations.lift(x, dx).reshape(-1), b.reshape(-1), atol=1e-11
    )
    np.testing.assert_allclose(system.multiply(dx), b, atol=1e-11)
    y = system.solve_transpose(b)
    np.testing.assert_allclose(jnp.vdot(y, system.multiply(b)), jnp.vdot(b, b), rtol=1e-11)
    np.testing.assert_allclose(
        equations.newton_increment(x), system.solve(-equations.residual(x)), atol=1e-13
    )


@finer_and_coarser
def test_batches_of_right_sides_and_of_systems(bent):
    """Lanes in contact and out of it, by the solver of their own."""
    scene, state, _ = bent
    apart = dataclasses.replace(
        state, position=state.position.at[len(state.position) // 2 + 1 :, 0].add(0.3)
    )
    both = jax.tree.map(lambda *leaves: jnp.stack(leaves), state, apart)
    right = jnp.asarray(np.random.default_rng(1).normal(size=(2, state.position.shape[0], 9)))

    @jax.jit
    def equations(state):
        nearby = find_nearby(scene, state.position)
        return StepEquations(scene, state, jnp.asarray(1e-3), jnp.asarray(0.5), nearby)

    system = lambda state: equations(state).linearize(equations(state).guess())

    def root(state):
        tried = equations(state)
        return tried.iterate(tried.guess(), jnp.asarray(1e-11), jnp.asarray(2))

    def close(found, expected):
        # the rod apart is torn in two: its nodes move by many elements to be one again
        largest = max(1.0, float(jnp.max(jnp.abs(expected))))
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12 * largest)

    one = system(state)
    assert int(one.coupling.near.level) > 0 and int(system(apart).coupling.near.level) == 0
    alone = [one.solve(b) for b in right]
    close(jax.vmap(one.solve)(right), jnp.stack(alone))
    # several right sides of several systems
    grid = jax.jit(jax.vmap(lambda s: jax.vmap(system(s).solve)(right)))(both)
    close(grid[0], jnp.stack(alone))
    close(grid[1], jnp.stack([system(apart).solve(b) for b in right]))
    # two of Newton's iterations, of each lane for itself or, if none is in contact, together
    expected = [jax.jit(root)(s) for s in (state, apart)]
    found, infos = jax.jit(jax.vmap(root))(both)
    for lane, (x, info) in enumerate(expected):
        close(found[lane], x)
        assert int(infos.iterations[lane]) == int(info.iterations)
    easy = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), apart)
    close(jax.jit(jax.vmap(root))(easy)[0], jnp.stack([expected[1][0]] * 2))


@finer_and_coarser
def test_a_held_derivative_leads_to_the_same_motion(bent):
    scene, state, _ = bent
    nearby = find_nearby(scene, state.position)
    equations = StepEquations(scene, state, jnp.asarray(1e-3), jnp.asarray(0.5), nearby)
    assert int(nearby.near.count) > 0
    rest = (equations.guess(), jnp.asarray(1e-11), jnp.asarray(20))
    whole, each = jax.jit(lambda: newton.iterate(equations, *rest))()
    held, once = jax.jit(lambda: newton.iterate_held(equations, *rest))()
    assert int(each.result) == int(once.result) == 0
    np.testing.assert_allclose(held, whole, rtol=1e-8, atol=1e-10)
    assert int(each.iterations) <= int(once.iterations) <= 2 * int(each.iterations)


def test_joints_lie_on_the_curve_through_the_nodes():
    """Fourth order on a helix, where chords would be off by kappa l^2/8."""

    def helix(s):
        return np.stack([0.1 * np.cos(8 * s), 0.1 * np.sin(8 * s), 0.6 * s], -1)

    section = circular_section(DIAMETER, 1e6, 5e5, 1500.0)
    errors, counts = [], (12, 24, 48)
    for elements in counts:
        rod = straight_rod(1.0, elements, section)
        contact = Contact(LAWS["damped"], segments=50, cutoff=0.1, points_per_segment=2)
        where = contact_of.sites(contact, rod)
        joints = contact_of.interpolate(where, jnp.asarray(helix(np.asarray(rod.arc_length))))
        exact = helix(np.linspace(0, 1, 51))
        errors.append(np.max(np.linalg.norm(np.asarray(joints) - exact, axis=1)))
        np.testing.assert_allclose(jnp.sum(where.weight, 1), 1.0, atol=1e-13)
        # forces are spread with the same total and moment
        force = jnp.asarray(np.random.default_rng(0).normal(size=joints.shape))
        nodes = helix(np.asarray(rod.arc_length))
        nodal = np.asarray(contact_of.spread(where, force, elements + 1))
        np.testing.assert_allclose(nodal.sum(0), force.sum(0), atol=1e-12)
        moment = np.cross(joints, force).sum(0)
        np.testing.assert_allclose(np.cross(nodes, nodal).sum(0), moment, atol=1e-12)
    assert order_of(1 / np.asarray(counts), errors) > 3.5


# where strands settle under each law
SETTLED = {
    "damped": 0.58 * DIAMETER,
    "inverse_power": DIAMETER,
    "lennard_jones": 0.026,
    "debye_hueckel": DIAMETER,
    "barrier": 1.05 * DIAMETER,
    "penalty": 0.99 * DIAMETER,
    "damped_penalty": 0.99 * DIAMETER,
}


@pytest.mark.parametrize("name", LAWS)
def test_ripple_of_the_force_is_under_two_percent(name):
    """Sliding one strand along the other by one spacing barely changes the force.

    Two parallel strands at a distance d feel sum_j psi(d_j) window n_j per point; its ripple with
    the phase between the points is that of the documented spacing h = min(sqrt(2 d w)/2, d/3).
    """
    law = LAWS[name]
    d = SETTLED[name]
    psi = lambda r: laws.continued(law, r, jnp.asarray(0.0), PAIR)
    width = float(psi(jnp.asarray(d)) / abs(jax.grad(psi)(jnp.asarray(d))))
    spacing = min(0.5 * np.sqrt(2 * d * width), d / 3)
    contact = Contact(law, 2, cutoff=6 * DIAMETER)
    phase = spacing * np.linspace(0, 1, 17)[:, None] + spacing * np.arange(-40, 41)
    r = jnp.asarray(np.sqrt(d**2 + phase**2))
    cosine = jnp.asarray(phase) / r
    density = jax.vmap(jax.vmap(psi))(r) * forces_of.window(contact, r, PAIR, (cosine, cosine))
    force = np.sum(density * d / r, 1) * spacing
    assert np.ptp(force) < 0.02 * np.mean(force)


def test_contacts_over_a_run_are_those_of_its_states(bent):
    scene, state, _ = bent
    states = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), state)
    apart = states.position.at[1, 13:, 0].add(1.0)  # one strand moved out of reach
    states = eqx.tree_at(lambda s: s.position, states, apart)
    zero = jnp.asarray(0, jnp.int32)
    run = Run(states, no_info(apart.dtype), zero, zero, zero)
    found = measures.contacts(scene, run)
    alone = forces_of.report(scene.contact, scene.rod, state.position, state.velocity)
    np.testing.assert_allclose(found.force[0], alone.force, rtol=1e-12, atol=1e-15)
    assert float(found.total[0]) == pytest.approx(float(alone.total)) and alone.total > 0
    assert float(found.total[1]) == 0 and float(found.smallest[1]) == np.inf
    with pytest.raises(ValueError, match="scene: it has no contact"):
        measures.contacts(dataclasses.replace(scene, contact=None), run)


def test_force_does_not_depend_on_the_division():
    totals = []
    for segments, points in ((48, 4), (96, 2), (96, 6)):
        contact = Contact(
            LAWS["damped"], segments, 0.1, points_per_segment=points, pairs_per_segment=12
        )
        scene = Scene(hairpin(96), contact=contact)
        state = start(scene)
        found = forces_of.report(scene.contact, scene.rod, state.position, state.velocity)
        totals.append(float(found.total))
    assert totals[0] > 0
    np.testing.assert_allclose(totals, totals[0], rtol=0.01)


def test_capacity_overflow_is_reported(bent):
    scene, state, _ = bent
    small = eqx.tree_at(
        lambda s: s.contact, scene, Contact(LAWS["damped"], 20, 0.1, capacities=(4,))
    )
    _, info = step(small, state, jnp.asarray(1e-3))
    assert int(info.result) == Result.CAPACITY_OVERFLOW


@finer_and_coarser
def test_every_size_of_solver_gives_the_same_increment(bent):
    scene, state, near = bent
    found = []
    apart = dataclasses.replace(scene.contact, exclusion=jnp.asarray(0.45))
    for sizes in ((21,), (4, 18, 21)):
        contact = dataclasses.replace(apart, capacities=sizes)
        same = eqx.tree_at(lambda s: s.contact, scene, contact)
        near = find_nearby(same, state.position, 1e-3 * state.velocity)
        assert int(near.near.level) == len(sizes) - (len(sizes) > 1)
        equations = StepEquations(same, state, jnp.asarray(1e-3), jnp.asarray(0.8), near)
        found.append(equations.newton_increment(equations.guess()))
    np.testing.assert_allclose(found[1], found[0], atol=1e-12)


def test_limit_keeps_strands_apart(bent):
    scene, state, near = bent
    # one leg moved right through the other
    change = jnp.zeros_like(state.position).at[:10, 0].set(0.2)
    limit = screening.approach_limit(scene.contact, *near, state.position, change)
    assert 0 < limit < 0.5
    assert screening.approach_limit(scene.contact, *near, state.position, -change) == 1


@pytest.mark.parametrize("pieces", [1, 40])
def test_passage_is_seen_fast_or_slow(pieces):
    """One leg tilted and moved through the other, in one step or in many; not beside it."""
    contact = Contact(LAWS["damped"], segments=20, cutoff=0.1)
    scene = Scene(hairpin(), contact=contact)
    place = scene.rod.position
    place = place.at[14:, 2].add(0.3 * (jnp.arange(11) - 6) / 11)  # the legs cross when projected

    @eqx.filter_jit
    def seen(before, after):
        nearby = find_nearby(scene, before, after - before)
        return screening.passage_suspected(*nearby, before, after)

    def passed(shift):
        way = [place.at[14:].add(part * shift) for part in jnp.linspace(0, 1, pieces + 1)]
        return any(bool(seen(a, b)) for a, b in zip(way, way[1:], strict=False))

    assert passed(jnp.asarray([-0.16, 0.0, 0.0]))
    assert not passed(jnp.asarray([-0.06, 0.0, 0.0]))
    assert not passed(jnp.asarray([0.16, 0.0, 0.0]))
    assert not passed(jnp.asarray([-0.16, 0.0, 0.6]))


@pytest.mark.parametrize("bend", [0.0, 1e-9, 0.3])
def test_no_passage_is_seen_along_one_strand(bend):
    """Segments as long as the cut-off: neighbours are listed, and cross by rounding if at all."""
    section = circular_section(DIAMETER, 1e6, 5e5, 1500.0)
    rod = straight_rod(1.0, 40, section, direction=(0.3, 1.0, 0.7))
    scene = Scene(rod, contact=Contact(LAWS["damped"], 20, cutoff=0.06, points_per_segment=10))
    s = np.asarray(rod.arc_length)
    random = np.random.default_rng(0)

    @eqx.filter_jit
    def seen(before, after):
        nearby = find_nearby(scene, before, after - before)
        return nearby.near.count, screening.passage_suspected(*nearby, before, after)

    def shape():
        wave = np.outer(np.sin(3 * s + random.uniform(0, 6)), random.normal(size=3))
        noise = random.normal(size=rod.position.shape)
        return rod.position + jnp.asarray(bend * wave + 1e-12 * noise)

    for _ in range(20):
        count, passage = seen(shape(), shape())
        assert count > 15 and not passage


def test_gradient_through_a_step_in_contact(bent):
    scene, state, _ = bent

    def end(k1):
        law = eqx.tree_at(lambda c: c.law.k1, scene.contact, k1)
        touching = eqx.tree_at(lambda s: s.contact, scene, law)
        return jnp.sum(step(touching, state, jnp.asarray(1e-3))[0].velocity[:8, 0])

    k1 = jnp.asarray(1e-4)
    reverse, forward = jax.grad(end)(k1), jax.jvp(end, (k1,), (jnp.ones(()),))[1]
    h = 1e-6
    difference = (end(k1 + h) - end(k1 - h)) / (2 * h)
    assert abs(difference) > 0
    np.testing.assert_allclose(reverse, forward, rtol=1e-9)
    np.testing.assert_allclose(reverse, difference, rtol=1e-5)


@pytest.mark.parametrize(
    ("arguments", "name"),
    [
        ({"cutoff": -1.0}, "cutoff"),
        ({"cutoff": 0.1, "aperture": 4.0}, "aperture"),
        ({"cutoff": 0.1, "exclusion": 0.05}, "cutoff"),
        ({"cutoff": 0.1, "segments": 1}, "segments"),
        ({"cutoff": 0.1, "points_per_segment": 0}, "points_per_segment"),
        ({"cutoff": 0.1, "edge": 0.0}, "edge"),
        ({"cutoff": 0.1, "capacities": (8, 4)}, "capacities"),
    ],
)
def test_bad_input_names_the_argument(arguments, name):
    with pytest.raises(ValueError, match=f"^{name}"):
        Contact(LAWS["damped"], **({"segments": 20} | arguments))


def test_scenes_are_built_in_traced_code_from_known_and_traced_values():
    """There even known arrays become traced by an operation, so no check may use one."""
    scene = Scene(hairpin(), loads=(MorisonDrag(1.0, 1.0, 1.0),))

    @jax.jit
    def build(factor):
        rod = dataclasses.replace(scene.rod, mass=factor * scene.rod.mass)
        drag = dataclasses.replace(scene.loads[0], normal_coefficient=factor)
        law = dataclasses.replace(LAWS["damped"], k1=factor)
        new = Scene(rod, Clamped(), loads=(drag,), contact=Contact(law, 20, cutoff=0.1))
        return new.contact.law.k1

    assert float(build(2.0)) == 2.0


def test_contact_needs_a_diameter_and_room():
    rod = hairpin()
    bare = dataclasses.replace(rod, diameter=None)
    with pytest.raises(ValueError, match="^diameter"):
        Scene(bare, contact=Contact(LAWS["damped"], segments=20, cutoff=0.1, points_per_segment=2))
    with pytest.raises(ValueError, match="^cutoff"):
        Scene(rod, contact=Contact(LAWS["damped"], 20, cutoff=0.9))
    with pytest.raises(ValueError, match="^k1"):
        laws.DampedInversePower(k1=-1.0, k3=0.0, reference_spacing=1.0)
