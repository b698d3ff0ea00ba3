"""Bodies that hang from rods: what holds them at rest, the loads of their joints, derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rodjax as rx
from rodjax import energy, rotations
from rodjax.equations.rigid_motions import Hold, check_held

G = 9.81
GRAVITY = rx.Gravity((0.0, 0.0, -G))
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
