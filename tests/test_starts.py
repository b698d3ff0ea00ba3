"""Starts that are refused, each for its own reason, and the neighbours that are not."""

import contextlib
import dataclasses
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rodjax.constraints.ends import AbstractEnd, Clamped, Free, Pinned, Slider, Switched, Turn
from rodjax.dynamics.adaptive import adaptive_rollout
from rodjax.dynamics.consistency import start
from rodjax.dynamics.fixed_rollout import rollout
from rodjax.equations.rigid_motions import check_held
from rodjax.equations.start_checks import (
    check_held_once,
    check_single_precision,
    check_spin,
    least_hold,
)
from rodjax.equilibria.load_path import equilibrium
from rodjax.equilibria.small_vibration import vibration
from rodjax.inputs.schedules import AbstractSchedule, Constant
from rodjax.interactions.loads import Gravity, LinearDrag, PointLoad
from rodjax.numerics.results import Result
from rodjax.rods.builders import curved_rod, straight_rod
from rodjax.rods.section import Section, circular_section
from rodjax.scenes.placing import placing
from rodjax.scenes.scene import Scene

N = 12
DRAG = (LinearDrag(1.0, 1.0, 0.1),)
GRAVITY = (Gravity((0.0, 0.0, -9.8)), LinearDrag(0.1, 0.1, 0.0))
TWICE, SPIN = "hold the rod twice", "can spin about its own axis"


class Held(AbstractEnd):
    """An end that holds any of the six directions; one structure for all."""

    held: jax.Array
    displacement: AbstractSchedule | None = None
    rotation: Turn | None = None

    def projector(self, time):
        return jnp.diag(self.held)


def held(*directions):
    """x y z and rotations about a_1 a_2 a_3."""
    return Held(jnp.asarray([float(d in directions) for d in ("x", "y", "z", "1", "2", "3")]))


PIN, BALL_AND_SPIN, CLAMP = held("x", "y", "z"), held("x", "y", "z", "3"), held(*"xyz123")


def straight(direction=(0, 0, 1), length=1.0, n=N, **section):
    """A straight rod."""
    section = {"mass": 1.0, "rotary_inertia": (1e-3, 1e-3, 2e-3)} | section
    return straight_rod(length, n, Section((1.0, 1.0, 0.8), **section), direction=direction)


def arc(angle, **given):
    """An arc that turns by `angle` on either side of its chord."""
    radius = 0.5 / angle
    # 1 - cos would round away the smallest of angles
    curve = lambda s: (radius * np.sin(s / radius), 0.0, 2 * radius * np.sin(s / radius / 2) ** 2)
    section = Section((1.0, 1.0, 0.8), mass=1.0, rotary_inertia=(1e-3, 1e-3, 2e-3))
    return curved_rod(curve, 1.0, N, section, **given)


@pytest.mark.parametrize("n", [N, 30])
def test_a_straight_inextensible_rod_held_at_both_ends(n):
    for length in (1.0, 2.0, 10.0, 10.5, 0.3, np.pi):
        for direction in ((1, 0, 0), (1, 1, 0), (1, 2, 3), (-1, 1e-3, 0)):
            rod = straight(direction, length, n)
            with pytest.raises(ValueError, match=TWICE + r".*Slider.*compliance.*curved"):
                start(Scene(rod, CLAMP, CLAMP, DRAG))


@pytest.mark.parametrize("ends", [(PIN, CLAMP), (BALL_AND_SPIN, PIN), (CLAMP, held("z"))])
def test_other_ends_that_hold_the_length_of_a_straight_rod(ends):
    with pytest.raises(ValueError, match=TWICE):
        start(Scene(straight(), *ends, DRAG))
    with pytest.raises(ValueError, match=TWICE):
        equilibrium(scene := Scene(straight(), CLAMP, ends[1], DRAG), placing(scene))


def test_a_bent_shape_at_rest_does_not_help_a_rod_that_is_placed_straight():
    rod = dataclasses.replace(straight(), natural_curvature=jnp.full((N, 3), 1e-2))
    with pytest.raises(ValueError, match=TWICE):
        start(Scene(rod, CLAMP, CLAMP, DRAG))
    # nor does shear, nor a stretch that is not along the rod
    for compliance in ((1e-3, 1e-3, 0.0), (0.0, 0.0, 0.0)):
        with pytest.raises(ValueError, match=TWICE):
            start(Scene(straight(compliance=compliance), CLAMP, CLAMP, DRAG))


def test_holds_that_determine_the_force_are_accepted():
    # one element that gives is enough
    partly = np.zeros(N)
    partly[5] = 1e-3
    oblique = Slider((1.0, 0.0, 1.0))
    for rod, ends in (
        (arc(0.3), (CLAMP, CLAMP)),
        (arc(1e-4), (CLAMP, CLAMP)),
        (straight(), (CLAMP, held("x", "y", "1", "2", "3"))),
        (straight(), (CLAMP, oblique)),
        (straight(compliance=(0.0, 0.0, 1e-3)), (CLAMP, CLAMP)),
        (straight(compliance=(0.0, 0.0, partly)), (CLAMP, CLAMP)),
    ):
        scene = Scene(rod, *ends, DRAG)
        check_held_once(scene, placing(scene))
    for angle in (0.3, 1e-4):
        state = start(Scene(arc(angle), CLAMP, CLAMP, GRAVITY))
        assert np.all(np.isfinite(state.acceleration))


def test_the_measure_is_the_angle_between_rod_and_chord():
    for angle in (1e-1, 1e-3, 1e-5):
        scene = Scene(arc(angle), PIN, PIN)
        # of an angle that falls from +a to -a the root mean square is a / sqrt(3); and the ends'
        # rows (1, 0), (1, e) of u_0 and that have the least singular value e / sqrt(2)
        np.testing.assert_allclose(least_hold(scene, placing(scene)), angle / 6**0.5, rtol=3e-2)
    scene = Scene(straight((1, 2, 3)), CLAMP, CLAMP)
    assert float(least_hold(scene, placing(scene))) < 1e-7


def test_traced_starts_are_no_numbers():
    rod = straight()
    scene = Scene(rod, CLAMP, CLAMP, DRAG)
    assert np.all(np.isnan(jax.jit(lambda scene: start(scene).rate)(scene)))


def held_later(after):
    """A straight rod whose end slides until 0.01 s."""
    rod = straight()
    return Scene(rod, Clamped(), Switched(Slider((0, 0, 1)), after, 0.01), DRAG)


@pytest.mark.slow
def test_a_hold_that_begins_later_on_a_straight_rod():
    scene = held_later(Clamped())
    run = rollout(scene, start(scene), jnp.asarray([0.005, 0.01, 0.015]), throw=False)
    assert Result(int(run.result)) is Result.HELD_TWICE


@pytest.mark.slow
def test_a_hold_that_begins_later_in_an_adaptive_run():
    scene = held_later(Pinned())
    run = adaptive_rollout(scene, start(scene), 0.02, throw=False)
    assert Result(int(run.result)) is Result.HELD_TWICE
    assert float(run.times[-1]) == pytest.approx(0.01)
    assert np.all(np.isfinite(run.states.position))


def single(rod):
    """The rod in single precision."""
    return jax.tree.map(lambda leaf: leaf.astype(jnp.float32), rod)


def test_single_precision_needs_more_of_a_curve():
    for rod, refused in ((straight((1, 1, 0)), True), (arc(1e-4), True), (arc(0.3), False)):
        scene = Scene(single(rod), CLAMP, CLAMP)
        if refused:
            with pytest.raises(ValueError, match=TWICE + ".*float32"):
                start(scene)
        else:
            check_held_once(scene, placing(scene))


@pytest.mark.parametrize("kind", [jnp.float32, jnp.float64])
def test_the_angle_that_is_asked_for_is_enough(kind):
    rod = lambda angle: jax.tree.map(lambda leaf: leaf.astype(kind), arc(angle))
    scene = Scene(rod(1e-9), PIN, PIN)
    with pytest.raises(ValueError, match="root mean square") as refused:
        check_held_once(scene, placing(scene))
    asked = float(re.search(r"more than (\S+) rad", str(refused.value))[1])
    # the angles of an arc are spread evenly from one side of the chord to the other
    for factor in (0.9, 1.1):
        scene = Scene(rod(factor * asked * 3**0.5), PIN, PIN)
        with pytest.raises(ValueError, match=TWICE) if factor < 1 else contextlib.nullcontext():
            check_held_once(scene, placing(scene))


@pytest.mark.parametrize("kind", [jnp.float32, jnp.float64])
def test_a_bent_pendulum_spins_about_the_vertical(kind):
    bent = jax.tree.map(lambda leaf: leaf.astype(kind), arc(0.4))
    # in no direction of the axes, so that single precision rounds
    weight = jnp.asarray([1.0, 2.0, -3.0], kind)
    for loads, message in (((Gravity(weight),), "1 rigid motion"), ((), "3 rigid motion")):
        scene = Scene(bent, PIN, Free(), loads)
        with pytest.raises(ValueError, match=message):
            check_held(scene, placing(scene))
    side = PointLoad(-1, Constant(jnp.asarray([0.0, 1e-3, 0.0], kind)), follower=True)
    scene = Scene(bent, PIN, Free(), (Gravity(weight), side))
    assert check_held(scene, placing(scene)).loads


def dna(rotary):
    """A cantilever of DNA in SI: A = 50 nm kT, C = 2 A, 340 nm."""
    bend, inertia = 50e-9 * 4.11e-21, 8e-34
    section = Section(
        (bend, bend, 2 * bend),
        mass=3.2e-15,
        rotary_inertia=(inertia, inertia, 2 * inertia) if rotary else None,
    )
    return straight_rod(340e-9, N, section), np.sqrt(3.2e-15 / bend) * 340e-9**2


def test_numbers_of_molecules_in_si_and_single_precision():
    for rotary in (True, False):
        rod, unit = dna(rotary)
        scene, small = Scene(rod, CLAMP), Scene(single(rod), CLAMP)
        check_single_precision(scene)
        with pytest.raises(ValueError, match="too small for float32.*nm, pN.*x64"):
            start(small)
        if rotary:
            with pytest.raises(ValueError, match="rotary_inertia.*too small for float32"):
                vibration(small, placing(small))
        else:
            found = vibration(small, placing(small))
            assert found.symmetric
            np.testing.assert_allclose(float(found.frequency[0]) * unit, 3.51602, rtol=1e-2)


def spinning(rod, first=PIN, last=None, loads=GRAVITY, rotary=None):
    """A rod without inertia against its spin."""
    rod = dataclasses.replace(rod, rotary_inertia=rotary)
    return Scene(rod, first, held() if last is None else last, loads)


def test_a_spin_without_inertia_is_named():
    oblique = straight((1, 0, -1))
    bent = arc(0.5, stress_free=False)
    unequal = dataclasses.replace(oblique, stiffness=oblique.stiffness * jnp.asarray([[1.0, 2, 1]]))
    flat = jnp.full((N, 3), 1e-3).at[:, 2].set(0.0)
    for scene in (
        spinning(oblique),
        spinning(oblique, held()),
        spinning(oblique, held("x", "y", "z", "1", "2")),
        spinning(oblique, rotary=flat),
        spinning(unequal),
        spinning(bent),
    ):
        with pytest.raises(
            ValueError, match=SPIN + ".*rotary_inertia=True.*hold the spin.*LinearDrag"
        ):
            start(scene)


def test_a_spin_that_something_resists_is_accepted():
    oblique = straight((1, 0, -1))
    drag = (GRAVITY[0], LinearDrag(0.1, 0.1, 1e-3))
    for scene in (
        spinning(oblique, BALL_AND_SPIN),
        spinning(oblique, PIN, held("3")),
        spinning(oblique, loads=drag),
        spinning(oblique, rotary=jnp.full((N, 3), 1e-3)),
        spinning(arc(0.5)),
    ):
        check_spin(scene, placing(scene))


def test_the_builder_of_circular_sections_is_no_exception():
    section = circular_section(0.01, 1e7, 4e6, 1000.0, rotary_inertia=False)
    rod = straight_rod(1.0, N, section, direction=(1, 0, -1))
    with pytest.raises(ValueError, match=SPIN):
        start(Scene(rod, Pinned(), Free(), (Gravity((0.0, 0.0, -9.81)),)))
