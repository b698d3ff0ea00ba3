"""Masses and rigid bodies that are fixed to nodes: against theory and independent integrations."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import random_arrays
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

import rodjax as rx
from rodjax import energy, rotations
from rodjax.equations.equations import step_equations
from rodjax.measuring.numerical_damping import estimate
from rodjax.rods.lumped import matrix_diagonal

GRAVITY = rx.Gravity((0.0, 0.0, -9.81))
PLAIN = rx.Section(stiffness=(1.0, 1.0, 1.0), mass=1.0)
TURNING = rx.Section(stiffness=(1.0, 1.3, 0.7), mass=1.0, rotary_inertia=(1e-3, 1e-3, 2e-3))
INERTIA = np.array([[0.03, 0.004, -0.002], [0.004, 0.05, 0.003], [-0.002, 0.003, 0.06]])
BODY = rx.Lump(-1, 0.8, inertia=INERTIA, offset=(0.1, -0.05, 0.2))


def characteristic(mass, inertia, offset):
    """Lowest frequency of a cantilever of unit numbers with a body ahead of its tip."""

    def determinant(b):
        s, c, sh, ch = np.sin(b), np.cos(b), np.sinh(b), np.cosh(b)
        # cosh - cos and sinh - sin of b x, with their derivatives at x = 1
        shapes = np.array([[ch - c, sh - s], [sh + s, ch - c], [ch + c, sh + s], [sh - s, ch + c]])
        w, slope, bend, shear = shapes * (b ** np.arange(4))[:, None]
        centre = w + offset * slope
        turning = inertia * slope + mass * offset * centre
        rows = shear + mass * b**4 * centre, bend - b**4 * turning
        return np.linalg.det(np.stack(rows))

    return brentq(determinant, 0.3, 1.8) ** 2


def test_cantilever_with_a_tip_mass_has_the_frequency_of_theory():
    """1 + cos cosh + M b (cos sinh - sin cosh) = 0, and with a body ahead of the tip."""
    rod = rx.straight_rod(1.0, 12, PLAIN)
    mass = 0.5
    known = brentq(
        lambda b: (
            1
            + np.cos(b) * np.cosh(b)
            + mass * b * (np.cos(b) * np.sinh(b) - np.sin(b) * np.cosh(b))
        ),
        1.0,
        1.8,
    )
    np.testing.assert_allclose(characteristic(mass, 0.0, 0.0), known**2, rtol=1e-10)
    found = []
    for lump in (
        rx.Lump(-1, mass, (1e-12, 1e-12, 1e-12), offset=(0.0, 0.0, 0.0)),  # in one program
        rx.Lump(-1, mass, (0.05, 0.05, 0.02), offset=(0.0, 0.0, 0.3)),
    ):
        scene = rx.Scene(rod, rx.Clamped(), lumps=(lump,))
        found.append(float(rx.vibration(scene, rx.placing(scene), 1).frequency[0]))
    expected = characteristic(mass, 0.0, 0.0), characteristic(mass, 0.05, 0.3)
    np.testing.assert_allclose(found, expected, rtol=5e-4)


def test_the_newton_system_is_the_derivative():
    """Couplings of the offset and centrifugal terms among it."""
    scene = rx.Scene(
        rx.straight_rod(1.0, 2, TURNING), loads=(GRAVITY,), lumps=(BODY, rx.Lump(1, 0.3))
    )
    rod, nodes = scene.rod, 3
    shift, turn, rates, force, b = random_arrays(
        3, (nodes, 3), (nodes, 3), (nodes, 6), (rod.elements, 3), (nodes, 9)
    )
    state = dataclasses.replace(
        rx.placing(scene),
        position=rod.position + 0.05 * shift,
        quaternion=rotations.multiply(rod.quaternion, rotations.exponential(0.3 * turn)),
        rate=3.0 * rates,
        force=force,
    )

    @jax.jit
    def systems(scene, state, b):
        equations = step_equations(scene, state, jnp.asarray(0.05), jnp.asarray(0.8))
        x = equations.guess(state.force) + 0.01 * b
        lifted = lambda dx: equations.residual(x + equations.lift(x, dx))
        exact = jax.jacfwd(lifted)(jnp.zeros_like(x)).reshape(x.size, x.size)
        columns = jnp.eye(x.size).reshape(x.size, *x.shape)
        return exact, jax.vmap(equations.linearize(x).multiply)(columns).reshape(x.size, -1).T

    exact, matrix = systems(scene, state, b)
    np.testing.assert_allclose(matrix, exact, atol=1e-11 * np.max(np.abs(exact)))


def spinning(times):
    """Spin and place of the node that carries a body in free flight, from its centre of mass."""
    offset, mass = np.asarray(BODY.offset), INERTIA

    def slope(_, y):
        spin, frame = y[:3], y[3:].reshape(3, 3)
        gain = np.linalg.solve(mass, -np.cross(spin, mass @ spin))
        return np.concatenate([gain, (frame @ np.cross(np.eye(3), spin)).ravel()])

    start = np.concatenate([SPIN, np.eye(3).ravel()])
    found = solve_ivp(slope, (0, times[-1]), start, t_eval=times, rtol=1e-11, atol=1e-12).y.T
    frames = found[:, 3:].reshape(-1, 3, 3)
    return found[:, :3], -frames @ offset


SPIN = np.array([0.5, 3.0, -0.3])


@pytest.mark.slow
def test_a_spinning_body_off_its_node_follows_eulers_equations():
    """Carried by a rod that weighs nothing; with second order of the step."""
    light = rx.Section((1e2, 1e2, 1e2), mass=1e-7, rotary_inertia=(1e-9, 1e-9, 1e-9))
    rod = rx.straight_rod(0.2, 2, light, origin=(0.0, 0.0, -0.2))
    scene = rx.Scene(rod, lumps=(BODY,))
    # its centre of mass, which rests, is a and b from node and rod
    arm = np.asarray(rod.position) - np.asarray(BODY.offset)
    state = rx.start(
        scene, velocity=np.cross(SPIN, arm), angular_velocity=np.tile(SPIN, (len(arm), 1))
    )
    steps = 40

    @jax.vmap
    def last(duration):
        times = duration * jnp.linspace(0.0, 1.0, steps + 1)[1:]
        final = rx.rollout(scene, state, times, throw=False).final
        return final.angular_velocity[-1], final.position[-1]

    durations = np.array([1.0, 0.5])
    spins, places = spinning(np.sort(durations))
    spin, place = last(jnp.asarray(durations))
    errors = [np.max(np.abs(spin[i] - spins[1 - i])) for i in range(2)]
    assert errors[0] < 2e-2 and errors[1] < 1e-3
    moved = np.asarray(place) - np.asarray(BODY.offset)
    np.testing.assert_allclose(moved[::-1] - places, 0, atol=3e-3)


@pytest.mark.slow
def test_a_pendulum_with_a_bob_swings_as_a_rigid_body():
    """On a stiff rod, released at rest from above the horizontal."""
    section = rx.Section((1e3, 1e3, 1e3), mass=0.4, rotary_inertia=(1e-5, 1e-5, 1e-5))
    rod = rx.straight_rod(0.5, 2, section, direction=(np.sin(2.0), 0.0, -np.cos(2.0)))
    bob = rx.Lump(-1, 0.8, (0.02, 0.02, 0.01), offset=(0.0, 0.0, 0.1))
    scene = rx.Scene(rod, rx.Pinned(), loads=(GRAVITY,), lumps=(bob,))
    times = np.linspace(0.0, 1.0, 401)[1:]
    run = rx.rollout(scene, rx.start(scene), times)
    places = np.array([0.0, 0.25, 0.5, 0.6])
    masses = np.array([0.05, 0.1, 0.05, 0.8])
    inertia = masses @ places**2 + 0.02 + 1e-5 * 0.5
    torque = 9.81 * (masses @ places)
    slope = lambda _, y: [y[1], -torque / inertia * np.sin(y[0])]
    angle = solve_ivp(slope, (0, 1), [2.0, 0.0], t_eval=times, rtol=1e-10, atol=1e-12).y[0]
    tip = 0.5 * np.stack([np.sin(angle), 0 * angle, -np.cos(angle)], 1)
    np.testing.assert_allclose(run.states.position[1:, -1], tip, atol=1.2e-4)
    assert np.ptp(angle) > 3.0


SWING = rx.Scene(
    rx.straight_rod(0.5, 3, dataclasses.replace(TURNING, stiffness=(30.0, 30.0, 30.0))),
    rx.Pinned(),
    loads=(GRAVITY,),
    lumps=(BODY,),
)
TIMES = np.linspace(0.0, 0.4, 81)[1:]


@pytest.fixture(scope="module")
def swing():
    state = rx.start(SWING, angular_velocity=np.tile([0.0, 2.0, 0.0], (4, 1)))
    return rx.rollout(SWING, state, TIMES, method=rx.GeneralizedAlpha(spectral_radius=0.98))


def test_energy_of_a_swinging_body_is_booked(swing):
    """Kinetic by its own formula, weight at its centre of mass, and all of it in the ledger."""
    book = energy.ledger(SWING, swing)
    turned = np.max(np.abs(book.gravity - book.gravity[0]))
    assert turned > 1.0
    assert np.max(np.abs(book.residual)) < 1e-3 * turned
    state = swing.final
    frame = np.asarray(rotations.matrix(state.quaternion))[-1]
    spin, offset = np.asarray(state.angular_velocity)[-1], np.asarray(BODY.offset)
    centre = np.asarray(state.position)[-1] + frame @ offset
    velocity = np.asarray(state.velocity)[-1] + frame @ np.cross(spin, offset)
    own = 0.5 * 0.8 * velocity @ velocity + 0.5 * spin @ INERTIA @ spin
    bare = dataclasses.replace(SWING, rod=dataclasses.replace(SWING.rod, lumps=()))
    added = energy.kinetic_energy(SWING, state) - energy.kinetic_energy(bare, state)
    np.testing.assert_allclose(added, own, rtol=1e-12)
    added = energy.gravity_energy(SWING, state) - energy.gravity_energy(bare, state)
    np.testing.assert_allclose(added, 0.8 * 9.81 * centre[2], rtol=1e-12)


def test_a_scene_with_a_body_comes_back_from_its_file(swing, tmp_path):
    rx.storage.save(tmp_path / "swing.h5", SWING, swing)
    again = rx.storage.load(tmp_path / "swing.h5").scene
    assert jax.tree.structure(again) == jax.tree.structure(SWING)
    pairs = zip(jax.tree.leaves(again), jax.tree.leaves(SWING), strict=True)
    assert all(np.array_equal(one, other) for one, other in pairs)


def test_numerical_damping_weighs_the_body(swing):
    """The frequency of the estimate falls with the mass at the tip."""
    matrix = np.asarray(matrix_diagonal(SWING.rod))
    apart = np.asarray(BODY.offset)
    expected = np.diag(INERTIA) + 0.8 * (apart @ apart - apart**2)
    np.testing.assert_allclose(matrix[-1], [0.8, 0.8, 0.8, *expected], rtol=1e-12)
    lost, steps = estimate(SWING, swing, 0.8)
    assert 0 < lost < 0.1 and steps > 5


@pytest.mark.slow
def test_reactions_of_a_body_at_rest():
    """At the root of a cantilever the weights and their moments about it, in the bent shape."""
    lump = rx.Lump(-1, 0.2, offset=(0.05, -0.1, 0.2), volume=1e-4, inertia=(0.1, 0.1, 0.1))
    water = rx.Gravity((0.0, 0.0, -1.0), fluid_density=500.0)
    section = rx.Section((1.0, 1.0, 1.0), mass=0.3, area=1e-4)
    rod = rx.straight_rod(1.0, 6, section, direction=(1, 0, 0))
    scene = rx.Scene(rod, rx.Clamped(), loads=(water,), lumps=(lump,))
    state, _ = rx.equilibrium(scene, rx.placing(scene))
    held = energy.reactions(scene, state)
    weight = np.asarray(rod.node_length) * (0.3 - 500 * 1e-4)
    position = np.asarray(state.position)
    centre = position[-1] + np.asarray(rotations.rotate(state.quaternion[-1], lump.offset))
    weights, places = [*weight, 0.2 - 500 * 1e-4], np.concatenate([position, centre[None]])
    forces = np.outer(weights, [0, 0, -1.0])
    moment = -np.sum(np.cross(places - position[0], forces), 0)
    np.testing.assert_allclose(held.force[0], -forces.sum(0), atol=1e-9)
    np.testing.assert_allclose(held.torque[0], moment, atol=1e-9)
    assert state.position[-1, 2] < -0.05


def fall(mass):
    """Where a cantilever's tip with this mass is after a while."""
    inertia = mass * jnp.asarray([0.01, 0.02, 0.025])
    lump = rx.Lump(-1, mass, inertia=inertia, offset=(0.0, 0.02, 0.1))
    rod = rx.straight_rod(0.5, 2, TURNING, direction=(1, 0, 0))
    scene = rx.Scene(rod, rx.Clamped(), loads=(GRAVITY,), lumps=(lump,))
    run = rx.rollout(scene, rx.start(scene), np.linspace(0.0, 0.1, 5)[1:], throw=False)
    return run.final.position[-1, 2]


@pytest.mark.slow
def test_derivatives_by_the_mass():
    mass = jnp.asarray(0.5)
    reverse = jax.jit(jax.grad(fall))(mass)
    forward = jax.jit(jax.jacfwd(fall))(mass)
    step = 1e-4
    ahead, behind = jax.jit(jax.vmap(fall))(mass + jnp.asarray([step, -step]))
    np.testing.assert_allclose(reverse, forward, rtol=1e-9)
    np.testing.assert_allclose(reverse, (ahead - behind) / (2 * step), rtol=1e-5)


@pytest.mark.slow
def test_masses_in_a_batch_are_those_by_themselves():
    masses = jnp.asarray([0.2, 1.5])
    both = jax.jit(jax.vmap(fall))(masses)
    one = jax.jit(fall)(masses[1])
    np.testing.assert_allclose(both[1], one, rtol=1e-10)


def test_lumps_go_with_their_rods():
    """Into a chain and out of it."""
    rod = rx.straight_rod(1.0, 3, TURNING)
    carrying = rx.Scene(rod, lumps=(rx.Lump(1, 0.5),)).rod
    scene = rx.Scene(
        rods=(carrying, rod, carrying),
        lumps=(rx.Lump(-1, 0.7, rod=1, inertia=(1.0, 1.0, 1.5), volume=0.1),),
    )
    assert [(one.node, one.rod) for one in scene.rod.lumps] == [(1, 0), (1, 2), (-1, 1)]
    assert [[one.rod for one in rod.lumps] for rod in scene.rods] == [[0], [0], [0]]
    mass = np.asarray(matrix_diagonal(scene.rod))[:, 0]
    np.testing.assert_allclose(mass, [0, 0.5, 0, 0, 0, 0, 0, 0.7, 0, 0.5, 0, 0])
    assert "lumps" in repr(scene) and "lumps" not in repr(rx.Scene(rod))


ROD = rx.straight_rod(1.0, 3, PLAIN)
REFUSED = {
    "mass": ("mass: must be positive", lambda: rx.Lump(0, 0.0)),
    "masses": ("mass: must be one real", lambda: rx.Lump(0, (1.0, 2.0))),
    "node": ("node: must be a whole number", lambda: rx.Lump(0.5, 1.0)),
    "inertia shape": ("inertia: give three principal", lambda: rx.Lump(0, 1.0, 1.0)),
    "not symmetric": (
        "inertia: must be symmetric",
        lambda: rx.Lump(0, 1.0, np.eye(3) + np.eye(3, k=1)),
    ),
    "not definite": ("inertia: must be positive definite", lambda: rx.Lump(0, 1.0, (1, 1, 0))),
    "no triangle": ("inertia: no body has", lambda: rx.Lump(0, 1.0, (1.0, 1.0, 2.1))),
    "offset": ("offset: must be three", lambda: rx.Lump(0, 1.0, offset=0.1)),
    "volume": ("volume: must be finite and not negative", lambda: rx.Lump(0, 1.0, volume=-1.0)),
    "no tuple": ("lumps: give a tuple", lambda: rx.Scene(ROD, lumps=rx.Lump(0, 1.0))),
    "no lump": (r"lumps\[0\]: give a lump", lambda: rx.Scene(ROD, lumps=(1.0,))),
    "beyond": ("node: a rod of 3 elements", lambda: rx.Scene(ROD, lumps=(rx.Lump(4, 1.0),))),
    "rod": ("rod: the scene's rods", lambda: rx.Scene(ROD, lumps=(rx.Lump(0, 1.0, rod=1),))),
    "no inertia about its arm": (
        "inertia: about the line to its offset",
        lambda: rx.Scene(ROD, lumps=(rx.Lump(0, 1.0, offset=(0, 0, 1)),)),
    ),
    "no mass": (
        "mass=None has no inertia",
        lambda: rx.Scene(
            rx.straight_rod(1.0, 3, rx.Section((1.0, 1.0, 1.0))),
            loads=(rx.LinearDrag(1.0, 1.0, 1.0),),
            lumps=(rx.Lump(0, 1.0),),
        ),
    ),
}


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("case", REFUSED)
def test_bad_lumps_are_refused(case):
    message, make = REFUSED[case]
    with pytest.raises(ValueError, match=message):
        make()


def test_a_flat_body_is_one():
    rx.Lump(0, 1.0, (1.0, 1.0, 2.0))
