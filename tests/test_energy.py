"""Energies, reactions and the ledger against closed forms, theory and their own convergence."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import UNIT_SECTION, order_of, random_configuration

from rodjax import consistency, contact, contact_laws, energy, rod, rotations
from rodjax.ends import Clamped, Free, Pinned, Slider, Switched, Turn
from rodjax.loads import DistributedLoad, Gravity, LinearDrag, MorisonDrag, PointLoad
from rodjax.run import Run
from rodjax.scene import Scene
from rodjax.schedules import Constant, Function, Smooth
from rodjax.state import State
from rodjax.stepping import StepInfo, prepare, step

ELEMENTS = 8
AXIS = jnp.array([0.0, 0.0, 1.0])

start = eqx.filter_jit(consistency.start)
reactions = eqx.filter_jit(energy.reactions)
one_step = eqx.filter_jit(step)


def state_of(a_rod, position=None, quaternion=None, force=None):
    """A state at rest; the rod's own placing by default."""
    nodes = a_rod.elements + 1
    still = jnp.zeros((nodes, 6))
    return State(
        jnp.zeros(()),
        a_rod.position if position is None else position,
        a_rod.quaternion if quaternion is None else quaternion,
        still,
        still,
        still,
        jnp.zeros((nodes - 1, 3)) if force is None else force,
    )


def twisted(a_rod, turns):
    """A straight rod twisted uniformly, the end s = 0 by -turns."""
    angle = 2 * jnp.pi * turns * (a_rod.arc_length / a_rod.arc_length[-1] - 1)
    spin = rotations.exponential(angle[:, None] * AXIS[None])
    return state_of(a_rod, quaternion=rotations.multiply(a_rod.quaternion, spin))


def test_energy_of_pure_twist():
    """C (2 pi turns)^2 / 2 L, all of it torsion, spread evenly."""
    scene = Scene(rod.straight_rod(2.0, ELEMENTS, UNIT_SECTION))
    state = twisted(scene.rod, 1.5)
    expected = 0.8 * (3 * np.pi) ** 2 / (2 * 2.0)
    assert energy.torsion_energy(scene, state) == pytest.approx(expected, rel=1e-12)
    assert energy.bending_energy(scene, state) == pytest.approx(0, abs=1e-24)
    assert energy.axial_energy(scene, state) == 0
    density = energy.strain_energy_density(scene.rod, state)
    np.testing.assert_allclose(density, expected / 2.0, rtol=1e-12)


def test_energy_of_a_circle():
    """A straight rod bent to a circle: A (2 pi)^2 / 2 L exactly, also on the grid."""
    length, angle = 2.0, lambda s: 2 * np.pi * s / 2.0
    circle = lambda s: np.array([1 - np.cos(angle(s)), 0, np.sin(angle(s))]) * length / (2 * np.pi)
    bent = rod.curved_rod(
        circle, length, 20, UNIT_SECTION, first_director=(0, 1, 0), stress_free=False
    )
    scene, state = Scene(bent), state_of(bent)
    expected = 1.0 * (2 * np.pi) ** 2 / (2 * length)  # about a_1 = e_2
    assert energy.bending_energy(scene, state) == pytest.approx(expected, rel=1e-6)
    assert energy.torsion_energy(scene, state) == pytest.approx(0, abs=1e-9)
    at_rest = rod.curved_rod(circle, length, 20, UNIT_SECTION, stress_free=True)
    assert energy.bending_energy(Scene(at_rest), state_of(at_rest)) == pytest.approx(0, abs=1e-24)


def test_axial_energy_of_a_stretched_and_sheared_rod():
    """EA e^2 L/2 + GA g^2 L/2; a component without compliance stores nothing."""
    section = rod.Section(stiffness=(1.0, 1.0, 1.0), compliance=(0.5, 0.0, 0.01))
    drag = LinearDrag(1.0, 1.0, 1.0)
    scene = Scene(rod.straight_rod(2.0, ELEMENTS, section), loads=(drag,))
    strain = jnp.array([0.02, 0.03, 0.1])
    state = state_of(scene.rod, position=scene.rod.arc_length[:, None] * (AXIS + strain)[None])
    frame = rotations.matrix(scene.rod.quaternion[0])
    local = frame.T @ strain
    expected = 2.0 * 0.5 * (local[0] ** 2 / 0.5 + local[2] ** 2 / 0.01)
    assert energy.axial_energy(scene, state) == pytest.approx(float(expected), rel=1e-12)
    assert energy.kinetic_energy(scene, state) == 0


def test_kinetic_and_gravity_energy_of_rigid_motion():
    """m v^2 / 2 and m g h, the latter less buoyancy; added mass only across the tangent."""
    fluid = MorisonDrag(2.0, 0.0, 0.0, added_mass_coefficient=1.5)
    gravity = Gravity((0.0, 0.0, -9.0), fluid_density=10.0)
    scene = Scene(rod.straight_rod(2.0, ELEMENTS, UNIT_SECTION), loads=(gravity, fluid))
    state = state_of(scene.rod)
    velocity = jnp.array([0.3, 0.0, 0.4])
    moving = eqx.tree_at(lambda s: s.rate, state, state.rate.at[:, :3].set(velocity))
    expected = 0.5 * 2.0 * 0.25 + 0.5 * (2.0 * 1.5 * 8e-3 * 2.0) * 0.09
    assert energy.kinetic_energy(scene, moving) == pytest.approx(expected, rel=1e-12)
    raised = eqx.tree_at(lambda s: s.position, state, state.position + 0.7 * AXIS[None])
    gain = energy.gravity_energy(scene, raised) - energy.gravity_energy(scene, state)
    assert gain == pytest.approx(2.0 * (1 - 10.0 * 8e-3) * 9.0 * 0.7, rel=1e-12)


def test_gradient_of_the_strain_energy_is_the_internal_moment():
    """Derivative by stiffness and by configuration against central differences."""
    scene = Scene(rod.straight_rod(1.0, ELEMENTS, UNIT_SECTION, natural_curvature=(0.1, 0.2, 0.3)))
    position, frames, _ = random_configuration(scene.rod, 3)
    total = jax.jit(
        lambda frames, scale: (
            energy.bending_energy(scene, state_of(scene.rod, position, rotations.normalize(frames)))
            + scale * energy.torsion_energy(scene, state_of(scene.rod, position, frames))
        )
    )
    direction = jnp.asarray(np.random.default_rng(0).normal(size=frames.shape))
    direction = direction - jnp.sum(direction * frames, 1, keepdims=True) * frames
    step = 1e-6
    by_hand = (total(frames + step * direction, 2.0) - total(frames - step * direction, 2.0)) / (
        2 * step
    )
    found = jnp.sum(jax.grad(total)(frames, 2.0) * direction)
    assert found == pytest.approx(float(by_hand), rel=1e-7)


def test_energies_under_vmap_and_jit():
    """A batch of states gives the same as one by one."""
    scene = Scene(rod.straight_rod(1.0, ELEMENTS, UNIT_SECTION))
    batch = jax.vmap(lambda turns: twisted(scene.rod, turns))(jnp.array([0.5, 1.0, 2.0]))
    values = jax.jit(jax.vmap(lambda s: energy.torsion_energy(scene, s)))(batch)
    np.testing.assert_allclose(values / values[0], [1, 4, 16], rtol=1e-12)


def test_torque_of_a_twisted_rod_is_that_of_theory():
    """C 2 pi turns / L about the tangent: +, on the end s = 0 that was turned by -turns."""
    scene = Scene(rod.straight_rod(2.0, ELEMENTS, UNIT_SECTION), Clamped(), Slider((0, 0, 1)))
    found = energy.reactions(scene, twisted(scene.rod, 0.5))
    torque = 0.8 * 2 * np.pi * 0.5 / 2.0
    np.testing.assert_allclose(found.torque, [-torque * AXIS, torque * AXIS], atol=1e-11)
    np.testing.assert_allclose(found.force, 0, atol=1e-11)


def test_reaction_of_a_clamp_in_inertial_and_body_axes():
    """A bent rod with frames all turned: torques agree by the end's frame, and with theory.

    A quarter circle held by end couples alone: the couple of every section is A/R.
    """
    radius = 2 / np.pi
    circle = lambda s: radius * np.array([1 - np.cos(s / radius), np.sin(s / radius), 0.0])
    bent = rod.curved_rod(
        circle, 1.0, 40, UNIT_SECTION, first_director=(0, 0, 1), stress_free=False
    )
    scene = Scene(bent, Clamped(), Clamped())
    found = energy.reactions(scene, state_of(bent))
    couple = np.array([0.0, 0.0, 1 / radius])  # on s = 0, bending stiffness 1 about a_1 = e_3
    np.testing.assert_allclose(found.torque[0], couple, atol=1e-2)
    np.testing.assert_allclose(found.torque[1], -couple, atol=1e-2)
    assert np.abs(found.torque[0][2]) > 1
    frames = bent.quaternion[jnp.array([0, -1])]
    back = rotations.rotate_inverse(frames, found.torque)
    np.testing.assert_allclose(found.body_torque, back, atol=1e-12)


def test_reactions_only_where_an_end_constrains():
    """A pin gives no torque, a slider no force along its axis, a free end nothing."""
    a_rod = rod.straight_rod(1.0, ELEMENTS, UNIT_SECTION, natural_curvature=(0.5, 0.4, 0.3))
    state = state_of(a_rod, force=jnp.ones((ELEMENTS, 3)))
    found = energy.reactions(Scene(a_rod, Pinned(), Slider((0, 0, 1))), state)
    np.testing.assert_array_equal(found.torque[0], 0)
    assert found.force[1, 2] == 0
    assert np.all(np.abs(found.force[0]) > 0.1)
    assert np.all(np.abs(found.force[1, :2]) > 0.1)
    assert np.all(np.abs(found.torque[1]) > 0.1)
    loose = energy.reactions(Scene(a_rod, Free(), Clamped()), state)
    np.testing.assert_array_equal([loose.force[0], loose.torque[0]], 0)


def hanging(direction, end_force):
    """A heavy rod pinned at s = 0, its weight 1 x 9 along e3, with a dead load on its end."""
    loads = (Gravity((0.0, 0.0, 9.0)), PointLoad(-1, force=Constant(end_force)))
    a_rod = rod.straight_rod(1.0, 4, UNIT_SECTION, direction=direction)
    return Scene(a_rod, Pinned(), Free(), loads)


def test_weight_of_a_hanging_rod():
    """The pin carries the weight and the load on the end."""
    scene = hanging((0.0, 0.0, 1.0), [0.0, 0.0, 2.0])
    found = reactions(scene, start(scene))
    np.testing.assert_allclose(found.force[0], [0, 0, -9.0 - 2.0], atol=1e-9)
    np.testing.assert_array_equal(found.force[1], 0)


def run_of(states, infos=None):
    """A stored run; without `infos` one whose steps projected nothing."""
    stack = lambda items: jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves)), *items)
    if infos is None:
        infos = [StepInfo(*[jnp.zeros(())] * len(StepInfo._fields))] * (len(states) - 1)
    zero = jnp.asarray(0, jnp.int32)
    return Run(stack(states), stack(infos), zero, zero, zero)


def run_over(scene, state, end_time, steps, longest=None, every=1):
    """A run of equal steps, saved every so many.

    It is filled up to the `longest` of a series by states that rest at its end and add nothing,
    so that all of the series share what is compiled.
    """
    state = prepare(scene, state)
    states, infos = [state], []
    for k in range(steps):
        state, info = one_step(scene, state, jnp.asarray((k + 1) * end_time / steps))
        assert info.result == 0
        states.append(state)
        infos.append(info)
    fill = 0 if longest is None else longest - steps
    still = eqx.tree_at(lambda i: i.projection_loss, infos[-1], jnp.zeros(()))
    return run_of(states[::every] + fill * [state], infos + fill * [still])


def smooth_twist(turns, until=1.0):
    return Turn(AXIS, Smooth([0.0, until, 1e3], [0.0, -2 * np.pi * turns, -2 * np.pi * turns]))


def everything():
    """A driven rod with every kind of load, all frequencies of its grid low enough to resolve."""
    inertia = (0.05, 0.05, 0.1)
    section = eqx.tree_at(lambda s: s.rotary_inertia, UNIT_SECTION, inertia)
    push = lambda time: jnp.array([0.5, 0.2, -0.3]) * jnp.sin(2 * time) ** 2
    spread = lambda strength, s, motion: (
        strength
        * jnp.concatenate([jnp.sin(motion.time) * jnp.cos(motion.position), motion.position], 1)
    )
    loads = (
        Gravity((1.0, 0.0, -2.0), fluid_density=20.0),
        MorisonDrag(5.0, 2.0, 0.5, added_mass_coefficient=10.0),
        LinearDrag(0.5, 0.2, 0.1),
        PointLoad(-1, force=Function(push), moment=Function(push), follower=True),
        DistributedLoad(spread, jnp.asarray(0.5)),
    )
    shift = Smooth([0.0, 1.0, 9.0], [[0.0] * 3, [0.1, 0.0, 0.1], [0.1, 0.0, 0.1]])
    a_rod = rod.straight_rod(1.0, 3, section)
    return Scene(a_rod, Clamped(shift, smooth_twist(0.3)), Free(), loads)


@pytest.fixture(scope="module")
def refined():
    """Ledgers of the driven, loaded and damped rod with halved steps."""
    scene = everything()
    state = start(scene)
    steps = (40, 80, 160, 320)
    return [(n, energy.ledger(scene, run_over(scene, state, 0.8, n, steps[-1]))) for n in steps]


def test_ledger_balances_at_second_order(refined):
    """Every column is in use; the balance error falls as the square of the step."""
    last = refined[-1][1]
    for name in ("drive_work", "load_work", "bending", "torsion", "kinetic", "gravity"):
        assert np.max(np.abs(np.asarray(getattr(last, name)))) > 1e-3 * abs(last.work[-1]), name
    for name in ("drag_loss", "damping_loss"):
        assert np.all(np.diff(getattr(last, name)) > -1e-6) and getattr(last, name)[-1] > 1e-2
    for name in ("axial", "contact_work", "projection_loss"):
        np.testing.assert_array_equal(getattr(last, name), 0)
    errors = [float(book.balance_error) for _, book in refined]
    assert errors[-1] < 1e-5
    assert order_of([1 / n for n, _ in refined], errors) == pytest.approx(2.0, abs=0.1)


@pytest.mark.parametrize("name", ["drive_work", "load_work", "drag_loss", "damping_loss"])
def test_ledger_columns_converge_at_second_order(refined, name):
    """Differences of successive refinements at the end fall by four."""
    ends = np.array([float(getattr(book, name)[-1]) for _, book in refined])
    differences = np.abs(np.diff(ends))
    steps = [1 / n for n, _ in refined[:-1]]
    assert order_of(steps, differences) == pytest.approx(2.0, abs=0.1)


@pytest.fixture(scope="module")
def slow_twist():
    """A damped rod twisted smoothly and left alone until it rests: scene, run."""
    a_rod = rod.straight_rod(1.0, ELEMENTS, UNIT_SECTION)
    drive = Clamped(rotation=smooth_twist(0.4, 2.0))
    scene = Scene(a_rod, drive, Slider((0, 0, 1)), (LinearDrag(0.1, 0.1, 0.05),))
    return scene, run_over(scene, state_of(a_rod), 4.0, 200)


def test_work_of_a_slow_twist_is_the_torsional_energy(slow_twist):
    """W = C (2 pi turns)^2 / 2 L + losses, kinetic energy gone; the torque is C 2 pi turns / L."""
    scene, run = slow_twist
    book = energy.ledger(scene, run)
    stored = 0.8 * (2 * np.pi * 0.4) ** 2 / 2
    assert book.torsion[-1] == pytest.approx(stored, rel=1e-3)
    assert book.drive_work[-1] == pytest.approx(stored + float(book.damping_loss[-1]), rel=1e-3)
    assert 0.01 * stored < book.damping_loss[-1] < stored
    assert book.balance_error < 1e-3
    torque = jax.lax.map(lambda s: energy.reactions(scene, s).torque[0] @ AXIS, run.states)
    assert torque[-1] == pytest.approx(-0.8 * 2 * np.pi * 0.4, rel=1e-2)


def test_ledger_is_differentiable(slow_twist):
    """Derivative of a loss and of the work by parameters against central differences."""
    scene, run = slow_twist

    def columns(factor):
        scaled = eqx.tree_at(lambda s: s.loads[0].rotational, scene, 0.05 * factor)
        scaled = eqx.tree_at(lambda s: s.rod.stiffness, scaled, scene.rod.stiffness * factor)
        book = energy.ledger(scaled, run)
        return jnp.stack([book.drive_work[-1], book.damping_loss[-1], book.torsion[-1]])

    found = jax.jvp(columns, (jnp.asarray(1.0),), (jnp.asarray(1.0),))[1]
    high, low = columns(jnp.asarray(1.001)), columns(jnp.asarray(0.999))
    assert np.min(np.abs(found)) > 1e-3
    np.testing.assert_allclose(found, (high - low) / 2e-3, rtol=1e-6)


def test_gravity_pendulum_with_a_point_load():
    """A pinned rod falls, pulled at its end: no drive works, the load by force times way."""
    scene = hanging((1.0, 0.0, 0.0), [0.5, 0.0, 1.0])
    state = start(scene)
    errors = []
    for steps in (50, 100):
        run = run_over(scene, state, 0.3, steps, 100)
        book = energy.ledger(scene, run)
        np.testing.assert_allclose(book.drive_work, 0, atol=1e-12)
        way = run.states.position[-1, -1] - run.states.position[0, -1]
        work = way @ jnp.array([0.5, 0.0, 1.0])
        assert book.load_work[-1] == pytest.approx(float(work), rel=1e-12)
        assert book.kinetic[-1] > 1.0
        errors.append(float(jnp.max(jnp.abs(book.residual)) / book.kinetic[-1]))
    assert errors[1] < 1e-3
    assert 3.2 < errors[0] / errors[1] < 4.8


def test_projection_loss_is_booked_once():
    """A flying rod whose end is caught loses energy there; the ledger says how much.

    States saved every fourth step give the same losses as all of them.
    """
    a_rod = rod.straight_rod(1.0, 4, UNIT_SECTION)
    catch = Switched(Slider((1.0, 0.0, 0.0)), Clamped(), 0.1)
    scene = Scene(a_rod, Free(), catch, (LinearDrag(0.1, 0.1, 0.1),))
    state = start(scene, velocity=jnp.zeros((5, 3)).at[:, 0].set(0.2))
    books = [energy.ledger(scene, run_over(scene, state, 0.2, 40, every=every)) for every in (1, 4)]
    loss = np.asarray(books[0].projection_loss)
    assert loss[20] == 0 and loss[21] > 1e-3 and loss[-1] == loss[21]
    np.testing.assert_allclose(books[1].projection_loss, loss[::4], atol=1e-15)
    # until the blow nothing but drag acts; after it the scheme damps the fastest ringing
    assert np.max(np.abs(books[0].residual[:21])) < 1e-6 * books[0].kinetic[0]
    assert np.max(np.abs(books[0].residual)) < 0.1 * loss[-1]


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
    a_rod = rod.curved_rod(curve, length, 24, section)
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
