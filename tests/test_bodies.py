"""Rigid bodies by themselves: joined to each other and to rods, held, driven, free."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import rodjax as rx
from rodjax import energy, rotations

G = 9.81
GRAVITY = rx.Gravity((0.0, 0.0, -G))
SECTION = rx.Section((1.0, 1.0, 1.0), mass=1.0, rotary_inertia=(1e-3,) * 3, diameter=0.02)
STAND = rx.straight_rod(0.5, 2, SECTION, direction=(1, 0, 0))
ACROSS = rotations.rotate_inverse(STAND.quaternion[0], jnp.asarray([0.0, 1.0, 0.0]))
INCLINED = rotations.rotate_inverse(STAND.quaternion[0], jnp.asarray([0.6, 0.0, -0.8]))

# from the pivot to the first centre of mass, from there to the hinge, from that to the second
M1, M2, I1, I2, A1, B1, A2 = 1.0, 0.6, 0.02, 0.015, 0.3, 0.25, 0.2
UPPER = rx.Body(M1, (0.02, I1, 0.01), (0.0, 0.0, -A1))
LOWER = rx.Body(M2, (0.01, I2, 0.01), (0.0, 0.0, -A1 - B1 - A2))
HINGES = (
    rx.Hinge(rx.Point(0), rx.Point(body=0, offset=(0, 0, A1)), axis=ACROSS),
    rx.Hinge(
        rx.Point(body=0, offset=(0, 0, -B1)), rx.Point(body=1, offset=(0, 0, A2)), axis=(0, 1, 0)
    ),
)
PENDULUM = rx.Scene(STAND, rx.Clamped(), loads=(GRAVITY,), bodies=(UPPER, LOWER), joints=HINGES)
SPINS = {3: (0.0, -3.0, 0.0), 4: (0.0, 2.0, 0.0)}


def rates(nodes, spins, velocities):
    """Of all nodes, zero but where they are given."""
    spin, velocity = np.zeros((nodes, 3)), np.zeros((nodes, 3))
    for node, value in spins.items():
        spin[node] = value
    for node, value in velocities.items():
        velocity[node] = value
    return {"angular_velocity": spin, "velocity": velocity}


@pytest.fixture(scope="module")
def tumbling():
    """Beside a rod: a body in free flight, spun about its middle axis, one that is driven, and one
    that falls through a fluid.
    """
    lift = rx.Smooth([0.0, 2.0], [(0.0, 0.0, 0.0), (0.0, 0.0, 1.0)])
    tennis = rx.Body(1.0, (1.0, 2.0, 2.5), (0.0, 2.0, 0.0))
    driven = rx.Body(3.0, (1.0, 1.0, 1.0), (0.0, 1.0, 0.0), end=rx.Clamped(displacement=lift))
    sphere = rx.Body(0.5, (0.1, 0.1, 0.1), (0.0, 3.0, 0.0))
    drag = rx.PointDrag(body=2, quadratic=0.4, rotational=0.2)
    bodies = (tennis, driven, sphere)
    scene = rx.Scene(STAND, rx.Clamped(), loads=(GRAVITY, drag), bodies=bodies)
    given = rates(6, {3: (0.3, 6.0, -0.3), 5: (1.0, 0.0, 0.0)}, {3: (1.0, 2.0, 3.0)})
    return scene, rx.rollout(scene, rx.start(scene, **given), np.linspace(0.0, 1.0, 201)[1:])


def test_a_free_body_tumbles_as_eulers_equations_say(tumbling):
    """After Dzhanibekov; with its energy and its angular momentum."""
    _, run = tumbling
    inertia = np.array([1.0, 2.0, 2.5])
    spin = np.asarray(run.states.angular_velocity[:, 3])
    turned = rotations.rotate(run.states.quaternion[:, 3], jnp.asarray(inertia * spin))
    stored = 0.5 * np.sum(inertia * spin**2, 1)

    def slope(_, w):
        return -np.cross(w, inertia * w) / inertia

    times = np.asarray(run.times)
    exact = solve_ivp(slope, (0, 1), spin[0], t_eval=times, rtol=1e-10, atol=1e-12).y.T
    assert np.ptp(exact[:, 1]) > 2.0
    np.testing.assert_allclose(spin, exact, atol=2e-2)
    np.testing.assert_allclose(stored, stored[0], rtol=1e-3)
    np.testing.assert_allclose(turned, turned[:1] + np.zeros((len(times), 3)), atol=2e-2)
    at = np.asarray(run.states.position[:, 3])
    path = np.outer(times, [1.0, 2.0, 3.0]) - np.outer(times**2, [0.0, 0.0, 0.5 * G])
    np.testing.assert_allclose(at, path + [0.0, 2.0, 0.0], atol=1e-9)


@pytest.mark.slow
def test_energy_and_momentum_of_a_free_body_are_kept_to_second_order(tumbling):
    scene, run = tumbling
    inertia = jnp.asarray([1.0, 2.0, 2.5])

    def error(state):
        spin = state.angular_velocity[3]
        turned = rotations.rotate(state.quaternion[3], inertia * spin)
        start = run.states.angular_velocity[0, 3]
        gained = 0.5 * inertia @ (spin**2 - start**2)
        return jnp.append(turned - inertia * start, gained)

    errors = []
    for steps in (50, 100):
        times = np.linspace(0.0, 1.0, steps + 1)[1:]
        final = rx.rollout(scene, run.state(0), times).final
        errors.append(np.linalg.norm(error(final)))
    assert 3.3 < errors[0] / errors[1] < 4.7


def test_a_driven_body_is_pushed_by_what_holds_it(tumbling):
    scene, run = tumbling
    place, force = jax.lax.map(
        lambda state: (state.position[4], energy.reactions(scene, state).force[3]), run.states
    )
    times = np.asarray(run.times)
    assert scene.holds[3].name == "bodies[1].end" and scene.holds[3].node == 4
    lift = jax.vmap(rx.Smooth([0.0, 2.0], [0.0, 1.0]))(jnp.asarray(times))
    np.testing.assert_allclose(place[:, 2], lift, atol=1e-10)
    curvature = np.gradient(np.gradient(np.asarray(lift), times), times)[10:-10]
    np.testing.assert_allclose(force[10:-10, 2], 3.0 * (G + curvature), rtol=2e-3)


def test_a_sphere_falls_against_its_drag(tumbling):
    """z = -(m/c) log cosh(sqrt(g c/m) t), and its spin dies out with c/I."""
    _, run = tumbling
    times, mass, drag = np.asarray(run.times), 0.5, 0.4
    fall = -mass / drag * np.log(np.cosh(np.sqrt(G * drag / mass) * times))
    np.testing.assert_allclose(run.states.position[:, 5, 2], fall, atol=2e-4)
    spin = np.exp(-2.0 * times)
    np.testing.assert_allclose(run.states.angular_velocity[:, 5, 0], spin, atol=1e-4)


def test_energy_of_bodies_is_booked(tumbling):
    scene, run = tumbling
    book = energy.ledger(scene, run)
    assert np.max(np.abs(book.drive_work)) > 1.0 and book.drag_loss[-1] > 1.0
    assert np.max(np.abs(book.residual)) < 1e-3 * np.ptp(book.kinetic)


def test_states_of_rods_and_bodies(tumbling, tmp_path):
    scene, run = tumbling
    rod, *bodies = rx.states_of(run.states)
    assert rod.position.shape == (201, 3, 3) and len(bodies) == 3
    assert bodies[1].position.shape == (201, 1, 3) and bodies[1].force.shape == (201, 0, 3)
    np.testing.assert_array_equal(bodies[1].position[:, 0], run.states.position[:, 4])
    assert [one.elements for one in scene.rods] == [2]
    with pytest.raises(ValueError, match=r"4 rods or bodies, and .* is of one rod"):
        rx.regrid(run.final, STAND)
    rx.storage.save(tmp_path / "bodies.h5", scene, run)
    again = rx.storage.load(tmp_path / "bodies.h5").scene
    assert jax.tree.structure(again) == jax.tree.structure(scene)
    assert "bodies=3" in repr(scene)


def test_a_figure_marks_bodies(tumbling):
    scene, run = tumbling
    states = [run.state(0), run.final]
    densities = [energy.strain_energy_density(scene.rod, state) for state in states]
    figure = rx.plot.snapshots(scene.rod, states, densities)
    marked = [line for line in figure.axes[0].lines if line.get_marker() == "s"]
    assert len(marked) == 1 and len(marked[0].get_xdata()) == 3


@pytest.mark.slow
def test_rods_move_as_they_do_without_bodies():
    """Viscous ones, actuated ones, supported ones."""
    numbers = dict(mass=0.5, rotary_inertia=(1e-4, 1e-4, 1e-4))
    viscous = rx.Section((1.0, 1.0, 1.0), material=rx.KelvinVoigt(1e-3), **numbers)
    plain = rx.Section((1.0, 1.0, 1.0), **numbers)
    one = rx.straight_rod(0.5, 4, viscous, direction=(1, 0, 0))
    other = rx.straight_rod(0.5, 3, plain, direction=(1, 0, 0), origin=(0, 1, 0))
    other = dataclasses.replace(other, actuation=rx.Constant((0.1, 0.0, 0.0)))
    ends, found = (rx.Clamped(), rx.Free()), []
    for bodies in ((), (UPPER, LOWER)):
        support = rx.Support(2, rx.Pinned(), rod=1)
        scene = rx.Scene(
            rods=(one, other), first_end=ends, loads=(GRAVITY,), bodies=bodies, supports=(support,)
        )
        final = rx.rollout(scene, rx.start(scene), np.linspace(0.0, 0.05, 6)[1:]).final
        reactions = energy.reactions(scene, final).force
        found.append((final.position[:9], reactions[:4], reactions[-1]))
        assert scene.holds[-1].name == "supports[0]"
    for without, beside in zip(*found, strict=True):
        np.testing.assert_allclose(beside, without, atol=1e-9)


@pytest.fixture(scope="module")
def everything():
    """Of one program: the double pendulum, and a bead on an incline that knows not of it."""
    bead = rx.Body(0.2, (1e-3, 1e-3, 1e-3), (0.0, 0.5, 0.0))
    slide = rx.Slide(rx.Point(0, offset=ACROSS * 0.5), rx.Point(body=2), axis=INCLINED)
    scene = rx.Scene(
        STAND,
        rx.Clamped(),
        loads=(GRAVITY,),
        bodies=(UPPER, LOWER, bead),
        joints=(*HINGES, slide),
    )
    velocities = {3: (0.9, 0.0, 0.0), 4: (3 * (A1 + B1) - 2 * A2, 0.0, 0.0)}
    given = rates(6, SPINS, velocities)
    state = rx.start(scene, **given)
    np.testing.assert_allclose(state.velocity[3:5], given["velocity"][3:5], atol=1e-12)
    return rx.rollout(scene, state, np.linspace(0.0, 1.0, 201)[1:])


@pytest.mark.slow
def test_two_bodies_on_hinges_swing_as_a_double_pendulum(everything):
    length = A1 + B1

    def slope(_, y):
        p, q, dp, dq = y
        c, s = np.cos(p - q), np.sin(p - q)
        mass = [[I1 + M1 * A1**2 + M2 * length**2, M2 * length * A2 * c], [M2 * length * A2 * c, 0]]
        mass[1][1] = I2 + M2 * A2**2
        right = [
            -M2 * length * A2 * s * dq**2 - G * (M1 * A1 + M2 * length) * np.sin(p),
            M2 * length * A2 * s * dp**2 - G * M2 * A2 * np.sin(q),
        ]
        return [dp, dq, *np.linalg.solve(mass, right)]

    run = everything
    times = np.asarray(run.times)
    p, q, *_ = solve_ivp(slope, (0, 1), [0, 0, 3.0, -2.0], t_eval=times, rtol=1e-10, atol=1e-12).y
    places = np.asarray(run.states.position)
    np.testing.assert_allclose(places[:, 3, 0], A1 * np.sin(p), atol=3e-4)
    np.testing.assert_allclose(places[:, 4, 0], length * np.sin(p) + A2 * np.sin(q), atol=3e-4)
    np.testing.assert_allclose(places[:, 4, 2], -length * np.cos(p) - A2 * np.cos(q), atol=3e-4)
    assert np.ptp(q) > 0.5


@pytest.mark.slow
def test_a_bead_slides_down_an_incline(everything):
    run = everything
    fall = 0.5 * 0.8 * G * np.asarray(run.times) ** 2
    moved = np.asarray(run.states.position[:, 5]) - [0.0, 0.5, 0.0]
    np.testing.assert_allclose(moved, np.outer(fall, [0.6, 0.0, -0.8]), atol=1e-9)


@pytest.mark.slow
def test_frequencies_of_a_double_pendulum():
    """Hanging at rest: of the linear equations, exactly."""
    state, info = rx.equilibrium(PENDULUM, rx.placing(PENDULUM))
    assert int(info.unstable) == 0
    np.testing.assert_allclose(state.joints[:, 2], [-(M1 + M2) * G, -M2 * G], rtol=1e-9)
    found = rx.vibration(PENDULUM, state, 2).frequency
    length = A1 + B1
    mass = [
        [I1 + M1 * A1**2 + M2 * length**2, M2 * length * A2],
        [M2 * length * A2, I2 + M2 * A2**2],
    ]
    spring = G * np.diag([M1 * A1 + M2 * length, M2 * A2])
    exact = np.sqrt(np.sort(np.linalg.eigvals(np.linalg.solve(mass, spring))))
    np.testing.assert_allclose(found, exact, rtol=1e-8)
    assert bool(rx.stability(PENDULUM, state).stable)


@pytest.mark.slow
def test_rods_touch_as_they_do_without_bodies():
    """One another and an obstacle, in which a body may be."""
    section = rx.circular_section(0.02, 1e6, 0.4e6, 1500.0)
    post = rx.straight_rod(0.5, 6, section)
    bar = rx.straight_rod(0.4, 4, section, direction=(1, 0, 0), origin=(-0.2, 0.03, 0.25))
    contact = rx.Contact.solid(post, 20.0)
    loads = (rx.Obstacle(rx.Plane((0.0, -0.03, 0.0), (0.0, 1.0, 0.0)), stiffness=1e4),)
    runs = []
    for bodies in ((), (rx.Body(1.0, (0.1, 0.1, 0.1), (0.0, -0.5, 0.25)),)):
        scene = rx.Scene(
            rods=(post, bar),
            first_end=(rx.Clamped(), rx.Free()),
            loads=loads,
            contact=contact,
            bodies=bodies,
        )
        velocity = np.zeros((12 + len(bodies), 3))
        velocity[7:12, 1] = -1.0
        velocity[12:, 1] = 2.0  # through everything
        state = rx.start(scene, velocity=velocity)
        runs.append(rx.rollout(scene, state, np.linspace(0, 0.03, 16)[1:]))
    alone, beside = (np.asarray(run.states.position)[:, :12] for run in runs)
    np.testing.assert_allclose(beside, alone, atol=1e-9)
    assert np.max(np.abs(alone[-1, :7, 1])) > 1e-4
    np.testing.assert_allclose(runs[1].final.position[12, 1], -0.5 + 2.0 * 0.03, atol=1e-12)
