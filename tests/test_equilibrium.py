"""Equilibria against theory, published tables and an independent integration of the rod's ODE."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import order_of, slow
from scipy.integrate import solve_ivp
from scipy.optimize import root
from scipy.spatial.transform import Rotation

from rodjax import rotations
from rodjax.constraints.ends import Clamped, Free, Pinned, Slider, Switched, Turn
from rodjax.equilibria.load_path import equilibrium
from rodjax.inputs.schedules import Constant, PiecewiseLinear
from rodjax.interactions.loads import Gravity, PointLoad
from rodjax.numerics.results import Result, SimulationError
from rodjax.rods.builders import curved_rod, straight_rod
from rodjax.rods.section import Section
from rodjax.rods.strains import curvature, strains
from rodjax.scenes.placing import placing
from rodjax.scenes.scene import Scene

GRIDS = (36, 100)
RADIUS = 100.0
"""Radius of the 45-degree bend."""

# a = P L^2/A: deflection, shortening (over L), tip angle; Mattiasson 1981
ELASTICA = {
    0.2: (0.066364, 0.002647, 0.099636),
    0.5: (0.162144, 0.015919, 0.244534),
    1.0: (0.301721, 0.056433, 0.461352),
    2.0: (0.493457, 0.160642, 0.781750),
    3.0: (0.603253, 0.254420, 0.986017),
    5.0: (0.713792, 0.387628, 1.215368),
    10.0: (0.810609, 0.554996, 1.430286),
}
# tip of Bathe & Bolourchi's 45-degree bend, inextensible: along the clamped tangent, towards the
# centre, along the load
BEND = {300.0: (58.780, 22.245, 40.188), 600.0: (47.151, 15.685, 53.469)}


def loads(force=(0.0, 0.0, 0.0), moment=(0.0, 0.0, 0.0), follower=(0.0, 0.0, 0.0), gravity=0.0):
    """All loads of the cantilevers, so that a grid is compiled once for all of them."""
    return (
        Gravity(jnp.asarray([1.0, 0.0, 0.0]) * gravity),
        PointLoad(-1, Constant(np.array(force)), Constant(np.array(moment))),
        PointLoad(-1, Constant(np.array(follower)), follower=True),
    )


def cantilever(n, compliance=(0.0, 0.0, 0.0), ends=None, **load):
    """A straight rod along e3 of unit length and stiffness; zero compliance is Kirchhoff's rod."""
    section = Section((1.0, 1.0, 0.8), mass=1.0, compliance=compliance)
    rod = straight_rod(1.0, n, section, direction=(0, 0, 1), first_director=(1, 0, 0))
    return Scene(rod, *(ends or (Clamped(), Free())), loads(**load))


def bend(n, load):
    """45 degrees of a circle in the plane (1, 2), unit square section, E = 1e7, load along 3."""
    stiffness = 1e7 / 12
    section = Section((stiffness,) * 3, mass=1.0, compliance=(0.0, 0.0, 0.0))
    curve = lambda s: jnp.stack(
        [RADIUS * jnp.sin(s / RADIUS), RADIUS * (1 - jnp.cos(s / RADIUS)), 0 * s]
    )
    rod = curved_rod(curve, RADIUS * np.pi / 4, n, section, first_director=(0, 0, 1))
    return Scene(rod, Clamped(), Free(), loads(force=(0.0, 0.0, load)))


def solved(scene, **options):
    return equilibrium(scene, placing(scene), **options)[0]


def tip(state):
    """Position and tangent of the last node."""
    return np.asarray(state.position[-1]), np.asarray(
        rotations.tangent_director(state.quaternion[-1])
    )


def continuum(scene, dead, follower, guess):
    """Tip position and tangent of the continuous rod: Kirchhoff's ODE integrated from the tip.

    Unknown is the tip's frame, found by shooting for the clamp's frame from the frame `guess`;
    the rod is uniform.
    """
    rod = scene.rod
    length = float(jnp.sum(rod.length))
    stiffness = np.asarray(rod.stiffness[0])
    natural = np.asarray(rod.natural_curvature[0])
    if np.any(natural):  # the builder's kappa0 is that of the polygon's frames to second order
        natural = natural / np.linalg.norm(natural) / RADIUS
    clamp = Rotation.from_quat(np.asarray(rod.quaternion[0]), scalar_first=True)

    def shoot(vector):
        frame = (Rotation.from_rotvec(vector) * guess).as_matrix()
        force = np.asarray(dead) + frame @ np.asarray(follower)

        def slope(_, y):
            frame, moment = y[3:12].reshape(3, 3), y[12:]
            kappa = frame.T @ moment / stiffness + natural
            skew = np.cross(np.eye(3), kappa)
            tangent = frame[:, 2]
            return np.concatenate([tangent, (frame @ -skew.T).ravel(), np.cross(force, tangent)])

        start = np.concatenate([np.zeros(3), frame.ravel(), np.zeros(3)])
        end = solve_ivp(slope, (length, 0.0), start, rtol=1e-11, atol=1e-11, method="DOP853")
        end = end.y[:, -1]
        first = Rotation.from_matrix(end[3:12].reshape(3, 3))
        return (clamp.inv() * first).as_rotvec(), -end[:3], frame[:, 2]

    answer = root(lambda v: shoot(v)[0], np.zeros(3), options={"eps": 1e-14}).x
    gap, *end = shoot(answer)
    assert np.linalg.norm(gap) < 1e-9
    return end


def against_continuum(build, dead=(0.0, 0.0, 0.0), follower=(0.0, 0.0, 0.0)):
    """Tip on two grids, the continuous rod's, errors, and the order of convergence."""
    states = [solved(build(n)) for n in GRIDS]
    guess = Rotation.from_quat(np.asarray(states[-1].quaternion[-1]), scalar_first=True)
    position, tangent = continuum(build(GRIDS[0]), dead, follower, guess)
    size = np.linalg.norm(position)
    errors = [np.linalg.norm(tip(state)[0] - position) / size for state in states]
    assert errors[-1] < 1e-3
    assert abs(order_of(1 / np.array(GRIDS), errors) - 2) < 0.1
    return position, tangent, states


@pytest.mark.parametrize("load", ELASTICA)
def test_elastica(load):
    dead = (load, 0.0, 0.0)
    position, tangent, states = against_continuum(lambda n: cantilever(n, force=dead), dead)
    of = lambda p, t: np.array([p[0], 1 - p[2], np.arctan2(t[0], t[2])])
    np.testing.assert_allclose(of(position, tangent), ELASTICA[load], atol=6e-7)
    np.testing.assert_allclose(of(*tip(states[-1])), ELASTICA[load], rtol=1e-3)


@pytest.mark.parametrize("load", BEND)
def test_bend_of_45_degrees(load):
    position, _, states = against_continuum(lambda n: bend(n, load), (0.0, 0.0, load))
    np.testing.assert_allclose(position, BEND[load], atol=6e-4)
    np.testing.assert_allclose(tip(states[-1])[0], position, rtol=1e-3)


def test_follower_force():
    follower = (6.0, 0.0, 0.0)
    against_continuum(lambda n: cantilever(n, follower=follower), follower=follower)


def test_roll_up_closes_a_circle():
    errors = []
    for n in GRIDS:
        scene = cantilever(n, moment=(0.0, 2 * np.pi, 0.0))
        state = solved(scene)
        # a regular polygon closes on every grid, and its frame has turned once
        np.testing.assert_allclose(state.position[-1], 0.0, atol=1e-9)
        np.testing.assert_allclose(state.quaternion[-1], -state.quaternion[0], atol=1e-9)
        across = np.linalg.norm(state.position[n // 2] - state.position[0])
        errors.append(abs(across * np.pi - 1))
    assert errors[-1] < 1e-3
    assert abs(order_of(1 / np.array(GRIDS), errors) - 2) < 0.1


def linear_errors(expected, at, **load):
    """Relative errors of a node's deflection under a load small enough for linear theory."""
    states = [solved(cantilever(n, **load), load_steps=1, tolerance=1e-12) for n in GRIDS]
    return [
        abs(float(state.position[at(n), 0]) / expected - 1)
        for n, state in zip(GRIDS, states, strict=True)
    ]


def test_sag_under_gravity():
    weight = 1e-3
    # the tip's sag happens to be exact on every grid, up to the square of the slope
    assert max(linear_errors(weight / 8, lambda n: n, gravity=weight)) < 1e-7
    errors = linear_errors(1.0625 * weight / 24, lambda n: n // 2, gravity=weight)
    assert errors[-1] < 1e-3
    assert abs(order_of(1 / np.array(GRIDS), errors) - 2) < 0.1


def test_shear_compliance_is_timoshenkos():
    force, give = 3e-4, 0.5
    load = {"force": (force, 0.0, 0.0), "compliance": (give, give, 0.0)}
    errors = linear_errors(force / 3 + force * give, lambda n: n, **load)
    assert errors[-1] < 1e-3
    assert abs(order_of(1 / np.array(GRIDS), errors) - 2) < 0.1


@pytest.mark.slow
def test_axial_compliance_stretches_by_force_over_stiffness():
    scene = cantilever(32, compliance=(0.0, 0.0, 0.02), force=(0.0, 0.0, 3.0))
    state = solved(scene)
    np.testing.assert_allclose(state.position[-1], [0.0, 0.0, 1.06], atol=1e-12)
    np.testing.assert_allclose(state.force, np.broadcast_to([0.0, 0.0, 3.0], (32, 3)), atol=1e-9)


@pytest.mark.slow
def test_free_first_end_mirrors_free_last_end():
    held_first = solved(cantilever(32, force=(3.0, 1.0, 0.0)))
    scene = cantilever(32, ends=(Free(), Clamped()))
    pulled = PointLoad(0, Constant(np.array([3.0, 1.0, 0.0])), Constant(np.zeros(3)))
    held_last = solved(eqx.tree_at(lambda s: s.loads[1], scene, pulled))
    mirrored = np.asarray(held_last.position[::-1]) * [1, 1, -1] + [0, 0, 1]
    np.testing.assert_allclose(mirrored, held_first.position, atol=1e-9)


def twist_scene(turns, last=None):
    """A rod turned at its first end by a schedule that ends at time 1; the other end slides."""
    drive = Turn((0, 0, 1), PiecewiseLinear([0.0, 1.0], [0.0, 2 * np.pi * turns]))
    section = lambda s: Section((1.0, 1.0, 0.5 + s), mass=1.0)
    rod = straight_rod(1.0, 16, section)
    return Scene(rod, Clamped(rotation=drive), Slider((0, 0, 1)) if last is None else last)


@pytest.mark.slow
def test_driven_end_twists_a_straight_rod_by_its_torque():
    scene = twist_scene(-3.0)
    # three turns are beyond what the straight shaft can bear: it is taken knowingly
    state, info = equilibrium(scene, placing(scene), time=1.0, relax=False)
    assert info.result == Result.SUCCESS and info.unstable > 0
    rod = scene.rod
    torque = 6 * np.pi / jnp.sum(rod.length / rod.stiffness[:, 2])
    np.testing.assert_allclose(
        rod.stiffness[:, 2] * curvature(rod, state.quaternion)[:, 2], torque, rtol=1e-9
    )
    np.testing.assert_allclose(state.position, rod.position, atol=1e-9)
    assert float(state.time) == 1.0
    # half-way there and on from there: the same
    halfway, _ = equilibrium(scene, placing(scene), time=0.5)
    again, _ = equilibrium(scene, halfway, time=1.0, relax=False)
    np.testing.assert_allclose(again.quaternion, state.quaternion, atol=1e-9)


@pytest.mark.slow
def test_an_equilibrium_stays_where_it_is():
    scene = cantilever(32, force=(1.0, 2.0, -1.0), follower=(0.0, 1.0, 0.0), gravity=2.0)
    state, _ = equilibrium(scene, placing(scene))
    again, info = equilibrium(scene, state, load_steps=2)
    assert int(info.iterations) <= 4
    np.testing.assert_allclose(again.position, state.position, atol=1e-9)
    np.testing.assert_allclose(again.force, state.force, atol=1e-7)
    assert (
        np.max(np.abs(strains(scene.rod, state.position, state.quaternion).stretch[:, :2])) < 1e-12
    )


@pytest.mark.slow
def test_a_step_too_long_is_halved():
    scene = cantilever(32, moment=(0.0, 2 * np.pi, 0.0))
    state, info = equilibrium(scene, placing(scene), load_steps=1)
    assert int(info.rejected) > 0
    assert float(info.reached) == 1.0
    np.testing.assert_allclose(state.position[-1], 0.0, atol=1e-9)


def test_a_failure_is_reported():
    scene = cantilever(GRIDS[0], force=(10.0, 0.0, 0.0))
    with pytest.raises(SimulationError, match="load path") as caught:
        equilibrium(scene, placing(scene), max_iterations=1)
    assert caught.value.result == Result.NEWTON_FAILED
    last, info = caught.value.partial
    assert float(info.reached) < 1
    assert np.all(np.isfinite(last.position))
    state, info = equilibrium(scene, placing(scene), max_iterations=1, throw=False)
    assert info.result == Result.NEWTON_FAILED
    assert np.all(np.isnan(state.position)) and np.all(np.isnan(state.force))


@pytest.mark.slow
def test_derivatives_agree_with_differences():
    scene = cantilever(12)
    start = placing(scene)

    def deflection(stiffness, force):
        pulled = eqx.tree_at(
            lambda s: (s.rod.stiffness, s.loads[1].force.value), scene, (stiffness, force)
        )
        state, _ = equilibrium(pulled, start, throw=False)
        return state.position[-1] @ jnp.asarray([1.0, 0.3, -0.2]) + 0.1 * state.force[3, 0]

    generator = np.random.default_rng(0)
    stiffness = scene.rod.stiffness * generator.uniform(0.8, 1.2, (12, 3))
    point = (stiffness, jnp.asarray([2.0, 1.0, -0.5]))
    direction = tuple(jnp.asarray(generator.normal(size=p.shape)) for p in point)
    value = jax.jit(deflection)
    moved = lambda h: value(*(p + h * d for p, d in zip(point, direction, strict=True)))
    h = 1e-4
    slope = (8 * (moved(h) - moved(-h)) - (moved(2 * h) - moved(-2 * h))) / (12 * h)
    forward = jax.jit(lambda p, d: jax.jvp(deflection, p, d)[1])(point, direction)
    gradient = jax.jit(jax.grad(deflection, argnums=(0, 1)))(*point)
    reverse = sum(jnp.vdot(g, d) for g, d in zip(gradient, direction, strict=True))
    np.testing.assert_allclose(forward, slope, rtol=1e-7)
    np.testing.assert_allclose(reverse, forward, rtol=1e-9)


def test_bad_input_is_refused():
    scene = cantilever(GRIDS[0])
    start = placing(scene)
    swap = lambda first, last: eqx.tree_at(
        lambda s: (s.first_end, s.last_end), scene, (first, last)
    )
    driven, switched = (
        twist_scene(1.0, last) for last in (None, Switched(Slider((0, 0, 1)), Clamped(), 0.5))
    )
    broken = eqx.tree_at(lambda s: s.position, start, start.position.at[3, 1].set(jnp.nan))
    refused = [
        (swap(Free(), Free()), start, {}, "held at neither end"),
        (swap(Free(), Pinned()), start, {}, "2 rigid motion"),
        (swap(Free(), Slider((0, 0, 1))), start, {}, "1 rigid motion"),
        (scene, start, {"load_steps": 0}, "load_steps"),
        (scene, start, {"tolerance": 1e-18}, "tolerance"),
        (scene, start, {"max_rotation": -1.0}, "max_rotation"),
        (scene, start, {"time": np.inf}, "time"),
        (driven, placing(driven), {"time": 2.0}, "first_end.rotation"),
        (switched, placing(switched), {"time": 1.0}, "a constraint changes at 0.5"),
        (scene, broken, {}, "state: holds no numbers"),
    ]
    for given, state, options, message in refused:
        with pytest.raises(ValueError, match=message):
            equilibrium(given, state, **options)


@pytest.mark.slow
@pytest.mark.parametrize(
    "kind", ["jacfwd", *map(slow, ("vmap", "jacrev", "hessian", "vmap of grad"))]
)
def test_transformations_without_a_callers_jit(kind):
    """A small moment turns the tip by m L/A: derivatives and maps are known."""
    scene = cantilever(8)
    start = placing(scene)

    def slope(moment):
        value = jnp.stack([0.0 * moment, moment, 0.0 * moment])
        turned = eqx.tree_at(lambda s: s.loads[1].moment.value, scene, value)
        state, _ = equilibrium(turned, start, load_steps=2)
        return jnp.arctan2(state.position[-1, 0], state.position[-1, 2])

    # chord angle of an arc: half its turn
    moment, several = jnp.asarray(0.7), jnp.asarray([0.1, 0.7, 1.3])
    if kind == "vmap":
        np.testing.assert_allclose(jax.vmap(slope)(several), 0.5 * several, rtol=1e-6)
        return
    found = {
        "jacfwd": lambda: jax.jacfwd(slope)(moment),
        "jacrev": lambda: jax.jacrev(slope)(moment),
        "hessian": lambda: jax.hessian(lambda m: slope(m) ** 2)(moment),
        "vmap of grad": lambda: jax.vmap(jax.grad(slope))(several),
    }[kind]()
    np.testing.assert_allclose(found, 0.5, rtol=1e-6)
