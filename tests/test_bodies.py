"""Rigid bodies by themselves: joined to each other and to rods, held, driven, free."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import rodjax as rx
from rodjax import energy, rotations
from rodjax.equations.rigid_motions import Hold, check_held

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


SLENDER = rx.circular_section(0.02, 1e6, 0.4e6, 1500.0)
ARM = rx.straight_rod(1.0, 4, SLENDER, direction=(1, 0, 0))
END_ACROSS = rotations.rotate_inverse(ARM.quaternion[-1], jnp.asarray([0.0, 1.0, 0.0]))


def hung(place, joint=None, loads=(GRAVITY,), mass=0.5, **given):
    """A body at a place, its joint at the end of a cantilever."""
    body = rx.Body(mass, (1e-3, 1e-3, 1e-3), place)
    joints = ()
    if joint is not None:
        offset = tuple(np.array([1.0, 0.0, 0.0]) - np.array(place))
        joints = (joint(rx.Point(-1), rx.Point(body=0, offset=offset)),)
    return rx.Scene(ARM, rx.Clamped(), loads=loads, bodies=(body,), joints=joints, **given)


HINGED = lambda *points: rx.Hinge(*points, axis=END_ACROSS)
SLIDING = lambda *points: rx.Slide(*points, axis=END_ACROSS)
BELOW, BESIDE = (1.0, 0.0, -0.1), (1.1, 0.0, 0.0)
RESTS = {
    "hangs": (hung(BELOW, HINGED), Hold(loads=True)),
    "swings": (hung(BESIDE, HINGED), Hold(loads=True)),
    "wheel": (hung((1.0, 0.1, 0.0), HINGED), Hold(loads=True, bodies=True)),
    "ball": (hung(BESIDE, rx.Ball), Hold(loads=True, bodies=True)),
}


@pytest.mark.parametrize("case", RESTS)
def test_what_holds_a_body_at_rest(case):
    """Weight holds a swing, however the body is placed; what turns at no cost is to stay."""
    scene, expected = RESTS[case]
    assert check_held(scene, rx.placing(scene), spin_free=True) == expected


@pytest.mark.parametrize(
    ("scene", "count"),
    [(hung(BELOW), 6), (hung(BELOW, SLIDING), 1), (hung(BELOW, SLIDING, loads=()), 1)],
)
def test_a_body_that_nothing_holds_does_not_rest(scene, count):
    message = rf"bodies\[0\].end: they leave {count} rigid .*rod and bodies free.*Gravity"
    with pytest.raises(ValueError, match=message):
        rx.equilibrium(scene, rx.placing(scene))


@pytest.mark.slow
def test_a_body_hangs_from_the_end_of_a_rod():
    """By a ball joint, placed beside: reactions are those of all weights in the bent shape."""
    scene = hung(BESIDE, rx.Ball)
    state, info = rx.equilibrium(scene, rx.placing(scene))
    assert int(info.unstable) == 0
    position = np.asarray(state.position)
    np.testing.assert_allclose(position[5] - position[4], [0.0, 0.0, -0.1], atol=1e-9)
    np.testing.assert_allclose(state.joints[0], [0, 0, -0.5 * G, 0, 0, 0], atol=1e-9)
    held = energy.reactions(scene, state)
    weight = np.append(np.asarray(ARM.to_nodes(ARM.mass))[:5], 0.5) * G
    np.testing.assert_allclose(held.force[0], [0.0, 0.0, weight.sum()], atol=1e-9)
    moment = np.cross(position, np.outer(weight, [0.0, 0.0, 1.0])).sum(0)
    np.testing.assert_allclose(held.torque[0], moment, atol=1e-9)


@pytest.mark.slow
def test_derivatives_of_a_hanging_body_by_its_mass():
    """At rest, by the implicit function theorem; in both modes, beside differences."""

    def sag(mass):
        scene = hung(BELOW, HINGED, mass=mass)
        state, _ = rx.equilibrium(scene, rx.placing(hung(BELOW, HINGED)), throw=False)
        return state.position[5, 2]

    mass, step = jnp.asarray(0.02), 1e-5
    reverse, forward = jax.jit(jax.grad(sag))(mass), jax.jit(jax.jacfwd(sag))(mass)
    ahead, behind = jax.jit(sag)(mass + step), jax.jit(sag)(mass - step)
    np.testing.assert_allclose(reverse, forward, rtol=1e-9)
    np.testing.assert_allclose(reverse, (ahead - behind) / (2 * step), rtol=1e-5)


@pytest.mark.slow
def test_derivatives_of_a_moving_body_by_its_mass():
    def fall(mass):
        scene = hung(BESIDE, rx.Ball, mass=mass)
        run = rx.rollout(scene, rx.start(scene), np.linspace(0.0, 0.05, 4)[1:], throw=False)
        return run.final.position[5, 2]

    mass, step = jnp.asarray(0.5), 1e-4
    reverse, forward = jax.jit(jax.grad(fall))(mass), jax.jit(jax.jacfwd(fall))(mass)
    ahead, behind = jax.jit(jax.vmap(fall))(mass + jnp.asarray([step, -step]))
    np.testing.assert_allclose(reverse, forward, rtol=1e-9)
    np.testing.assert_allclose(reverse, (ahead - behind) / (2 * step), rtol=1e-5)


@pytest.mark.slow
def test_a_towed_body_in_a_current():
    """At rest: its joint carries its weight in water and its drag, the cable's top all of it."""
    cable = rx.straight_rod(1.0, 6, SLENDER, direction=(0, 0, -1))
    fish = rx.Body(0.8, (1e-3, 1e-3, 1e-3), (0.0, 0.0, -1.1), volume=2e-4)
    water = rx.Gravity((0.0, 0.0, -G), fluid_density=1000.0)
    drag = rx.PointDrag(body=0, linear=1.0, quadratic=2.0, current=(0.8, 0.0, 0.0))
    scene = rx.Scene(
        cable,
        rx.Clamped(),
        loads=(water, drag),
        bodies=(fish,),
        joints=(rx.Ball(rx.Point(-1), rx.Point(body=0, offset=(0.0, 0.0, 0.1))),),
    )
    state, _ = rx.equilibrium(scene, rx.placing(scene))
    pull = np.array([0.8 + 2 * 0.64, 0.0, -0.6 * G])
    np.testing.assert_allclose(state.joints[0, :3], pull, atol=1e-8)
    # no moment about its centre of mass: the joint stands in the line of the force
    arm = np.asarray(state.position)[6] - np.asarray(state.position)[7]
    np.testing.assert_allclose(np.cross(arm, pull), 0.0, atol=1e-8)
    own = (1500.0 - 1000.0) * np.pi * 0.01**2 * G
    np.testing.assert_allclose(
        energy.reactions(scene, state).force[0], [-pull[0], 0.0, own - pull[2]], atol=1e-8
    )


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


REFUSED = {
    "mass": ("mass: must be positive", lambda: rx.Body(-1.0, (1.0, 1.0, 1.0), (0, 0, 0))),
    "inertia": ("inertia: no body has", lambda: rx.Body(1.0, (1.0, 1.0, 3.0), (0, 0, 0))),
    "no inertia": ("inertia: give the moments", lambda: rx.Body(1.0, None, (0, 0, 0))),
    "position": ("position: must be three", lambda: rx.Body(1.0, (1, 1, 1), 0.0)),
    "quaternion": (
        "quaternion: must have unit",
        lambda: rx.Body(1.0, (1, 1, 1), (0, 0, 0), (1, 1, 0, 0)),
    ),
    "end": ("end: give an end", lambda: rx.Body(1.0, (1, 1, 1), (0, 0, 0), end="held")),
    "no tuple": ("bodies: give a tuple", lambda: rx.Scene(STAND, bodies=UPPER)),
    "no body": (r"bodies\[0\]: give a body", lambda: rx.Scene(STAND, bodies=(1.0,))),
    "no rod": ("rod: give one rod", lambda: rx.Scene(bodies=(UPPER,))),
    "twice": (
        "bodies: the rod is one of a scene that has bodies",
        lambda: rx.Scene(PENDULUM.rod, bodies=(UPPER,)),
    ),
    "in a chain": (
        r"rods\[1\]: it has bodies",
        lambda: rx.Scene(rods=(STAND, PENDULUM.rod)),
    ),
    "no mass": (
        "bodies: beside rods with mass=None",
        lambda: rx.Scene(
            rx.straight_rod(1.0, 3, rx.Section((1.0, 1.0, 1.0))),
            loads=(rx.LinearDrag(1.0, 1.0, 1.0),),
            bodies=(UPPER,),
        ),
    ),
    "point on no body": (
        r"joints\[0\].second: body: the scene's bodies are 0 to 0, got 1",
        lambda: rx.Scene(STAND, bodies=(UPPER,), joints=(rx.Ball(rx.Point(0), rx.Point(body=1)),)),
    ),
    "point on none": (
        "body: the scene's bodies are none",
        lambda: rx.Scene(STAND, joints=(rx.Ball(rx.Point(0), rx.Point(body=0)),)),
    ),
    "point on both": ("body: a point is on a body or", lambda: rx.Point(2, body=0)),
    "support of a body": (
        "rod: the scene's rods are 0 to 0",
        lambda: rx.Scene(STAND, bodies=(UPPER,), supports=(rx.Support(0, rx.Pinned(), rod=1),)),
    ),
    "apart": (
        "its points are 0.3 apart",
        lambda: rx.Scene(STAND, bodies=(UPPER,), joints=(rx.Ball(rx.Point(0), rx.Point(body=0)),)),
    ),
    "drag of no body": (
        "body: the scene has 0 bodies",
        lambda: rx.Scene(STAND, loads=(rx.PointDrag(body=0),)),
    ),
    "drag beyond": ("node: a rod of 2", lambda: rx.Scene(STAND, loads=(rx.PointDrag(3),))),
    "drag of both": ("body: the drag is of a body or", lambda: rx.PointDrag(2, body=0)),
    "negative drag": ("linear: must be finite and not", lambda: rx.PointDrag(linear=-1.0)),
}


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("case", REFUSED)
def test_bad_bodies_are_refused(case):
    message, make = REFUSED[case]
    with pytest.raises(ValueError, match=message):
        make()
