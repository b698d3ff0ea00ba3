"""What a finished run could not resolve is said, and nothing is said of one that resolves all."""

import dataclasses
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import UNIT_SECTION, hairpin
from test_contact_potential import meeting

from rodjax import energy
from rodjax.constraints.ends import Clamped, Free, Slider, Turn
from rodjax.dynamics.adaptive import adaptive_rollout
from rodjax.dynamics.coarseness import largest_turns, warn_if_hopeless
from rodjax.dynamics.consistency import start
from rodjax.dynamics.fixed_rollout import rollout
from rodjax.dynamics.run import Run
from rodjax.dynamics.stepping import no_info
from rodjax.equilibria.linear_stability import stability
from rodjax.equilibria.load_path import equilibrium
from rodjax.inputs.schedules import Constant, PiecewiseLinear, Smooth
from rodjax.interactions import contact_laws
from rodjax.interactions.contact import Contact
from rodjax.interactions.loads import Gravity, LinearDrag, PointLoad
from rodjax.measuring.numerical_damping import amplification, estimate
from rodjax.measuring.run_check import Finding, Findings, _contact, _moved, _result, _stable, check
from rodjax.numerics.results import ModelWarning, Result, as_code
from rodjax.rods.builders import curved_rod, straight_rod
from rodjax.scenes.corners import corners_inside, warn_of_corners
from rodjax.scenes.placing import placing
from rodjax.scenes.scene import Scene

UP = (0.0, 0.0, 1.0)


def stored(*states, code=Result.SUCCESS):
    """Saved states as a run."""
    states = jax.tree.map(lambda *leaves: jnp.stack(leaves), *states)
    count = states.time.shape[0] - 1
    infos = jax.tree.map(lambda leaf: jnp.stack([leaf] * count), no_info(jnp.float64))
    return Run(states, infos, as_code(code), as_code(Result.SUCCESS), as_code(Result.SUCCESS))


def circle(elements, turns=1.0):
    """A rod bent into an arc, of 2 pi turns / elements rad an element."""
    radius = 1 / (2 * np.pi * turns)
    curve = lambda s: radius * np.array([np.sin(s / radius), 0.0, 1 - np.cos(s / radius)])
    return curved_rod(curve, 1.0, elements, UNIT_SECTION)


@pytest.mark.parametrize(("elements", "turns"), [(13, 1.0), (8, 1.0), (16, 0.5), (5, 1.0)])
def test_bend_of_an_element_is_that_of_the_arc(elements, turns):
    frames = np.asarray(circle(elements, turns).quaternion)
    bend, twist = largest_turns(np.stack([frames, frames]))
    assert bend == pytest.approx(2 * np.pi * turns / elements, rel=1e-3)
    assert twist < 1e-6


def test_twist_of_an_element_is_counted_apart():
    angle = 0.4 * np.arange(6)
    frames = np.stack([np.cos(angle / 2), 0 * angle, 0 * angle, np.sin(angle / 2)], 1)
    bend, twist = largest_turns(frames)
    assert bend < 1e-12 and twist == pytest.approx(0.4, rel=1e-12)


def test_a_run_says_by_itself_what_no_grid_of_its_size_resolves():
    coarse, fine = (placing(Scene(circle(n))) for n in (4, 8))
    with pytest.warns(ModelWarning, match="an element bends by 1.6 rad.* use 4 times"):
        warn_if_hopeless(stored(coarse, coarse))
    warn_if_hopeless(stored(fine, fine))


def ramp(value):
    """A load that ends at t = 0.25 within 1e-9."""
    return PiecewiseLinear([0, 0.25, 0.25 + 1e-9, 9], np.outer([1, 1, 0, 0], value))


CORNERED = {
    "loads[0].force": Scene(straight_rod(1.0, 4, UNIT_SECTION), loads=(PointLoad(-1, ramp(UP)),)),
    "loads[0].moment": Scene(
        straight_rod(1.0, 4, UNIT_SECTION), loads=(PointLoad(-1, None, ramp(UP)),)
    ),
    "first_end.rotation": Scene(
        straight_rod(1.0, 4, UNIT_SECTION),
        Clamped(rotation=Turn(UP, PiecewiseLinear([0, 0.25, 9], [0, 1, 1]))),
    ),
    "first_end.displacement": Scene(
        straight_rod(1.0, 4, UNIT_SECTION),
        Clamped(PiecewiseLinear([0, 0.25, 9], np.outer([0, 1, 1], UP))),
    ),
    "last_end.rotation": Scene(
        straight_rod(1.0, 4, UNIT_SECTION),
        last_end=Slider(UP, rotation=Turn(UP, PiecewiseLinear([0, 0.25, 9], [1, 1, 3]))),
    ),
}


@pytest.mark.parametrize("name", CORNERED)
def test_jumps_inside_steps_are_said_and_steps_that_end_there_not(name):
    scene = CORNERED[name]
    tenths = np.linspace(0, 1, 11)[1:]
    assert corners_inside(scene, 0.0, tenths) == {name: pytest.approx(0.25)}
    with pytest.warns(ModelWarning, match=rf"{name.replace('[', '.').replace(']', '.')}: the "):
        warn_of_corners(scene, 0.0, tenths)
    mended = np.union1d(tenths, np.asarray(scene.corners)[1:-1])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warn_of_corners(scene, 0.0, mended)
    # before the run begins, and after it has ended, nothing jumps
    assert not corners_inside(scene, 0.5, tenths[5:]) and not corners_inside(scene, 0.0, tenths[:1])


@pytest.mark.parametrize("precision", [np.float64, np.float32])
def test_a_corner_at_the_end_of_a_step_is_there_whatever_its_last_digit(precision):
    """At t = 100 with steps of 1 ms (of 10 ms in single precision) a digit is 1e-11 of a step."""
    jump = PiecewiseLinear([0, 100.0, 100.0 + 1e-9, 900], np.outer([1, 1, 0, 0], UP))
    scene = Scene(straight_rod(1.0, 4, UNIT_SECTION), loads=(PointLoad(-1, jump),))
    step = 1e-3 if precision is np.float64 else 1e-2
    ends = np.nextafter((100 + step * np.arange(-3, 4)).astype(precision), precision(1e9))
    ends = np.union1d(ends, np.nextafter(precision(100.0 + 1e-9), precision(1e9)))
    assert not corners_inside(scene, float(ends[0]), ends[1:])
    late = ends + precision(1e-2 * step)
    assert corners_inside(scene, float(late[0]), late[1:])


def test_kinks_of_loads_and_smooth_drives_are_no_jumps():
    kink = PointLoad(-1, PiecewiseLinear([0, 0.25, 9], np.outer([0, 1, 1], UP)))
    smooth = Clamped(rotation=Turn(UP, Smooth([0, 0.25, 9], [0, 1, 1])))
    scene = Scene(straight_rod(1.0, 4, UNIT_SECTION), smooth, loads=(kink,))
    assert not corners_inside(scene, 0.0, np.linspace(0, 1, 11)[1:])


@pytest.mark.parametrize("radius", [0.0, 0.5, 0.8])
def test_amplification_has_the_limits_of_theory(radius):
    """1 for small steps, the spectral radius for long ones; energy of a vibration stepped so."""
    small, large = amplification(radius, np.asarray([1e-3, 1e6]))
    assert small == pytest.approx(1.0, abs=1e-8) and large == pytest.approx(radius, abs=1e-3)
    damped = 1 - amplification(radius, np.asarray([0.1, 0.2, 0.4]))
    assert np.all(np.diff(damped) > 0)


@pytest.mark.slow
def test_numerical_damping_of_a_vibration_is_that_of_its_steps():
    """A cantilever that swings in its first mode: frequency 3.51602 sqrt(A/m)/L^2."""
    rod = straight_rod(1.0, 12, dataclasses.replace(UNIT_SECTION, rotary_inertia=(1e-6,) * 3))
    scene = Scene(rod, Clamped(), loads=(Gravity((1e-3, 0.0, 0.0)),))
    period = 2 * np.pi / 3.51602  # sqrt(A2/m) of bending about the first axis would be larger
    times = jnp.linspace(0.0, 5 * period, 61)[1:]
    run = rollout(scene, start(scene), times, throw=False)
    lost, steps = estimate(scene, run, 0.5)
    assert 8 < steps < 25
    assert 0 < lost < 1
    found = check(scene, run)
    assert "numerical damping" in found.looked_at and "energy ledger" in found.looked_at
    assert any(f.topic in ("numerical damping", "energy ledger") for f in found.found)
    text = str(found)
    assert "use more steps" in text or "use smaller" in text


def test_a_result_that_is_no_success_is_a_finding():
    state = placing(CORNERED["loads[0].force"])
    finding = _result(stored(state, state, code=Result.UNRESOLVED))
    assert finding is not None and "UNRESOLVED" in str(finding)
    assert _result(stored(state, state)) is None


def test_findings_are_true_if_any_and_print_in_words():
    none = Findings((), ("result",))
    some = Findings((Finding("result", 3.0, 0.0, "It failed."),), ("result",))
    assert not none and some
    assert str(none) == "resolved, as far as can be told (result)"
    assert str(some) == "result: 3 (at most 0). It failed.\n(looked at: result)"


def column(thrust):
    """A straight column between a clamp and a slider, whose Euler load is 4 pi^2 A."""
    rod = straight_rod(1.0, 20, dataclasses.replace(UNIT_SECTION, stiffness=(1.0, 1.0, 1.0)))
    push = PointLoad(-1, Constant((0.0, 0.0, -thrust)))
    scene = Scene(rod, Clamped(), Slider(UP), loads=(push,))
    state = start(scene)
    return scene, stored(state, state)


@pytest.mark.slow
def test_a_straight_column_beyond_eulers_load_is_unstable():
    """By 45 less A 4 pi^2 = 39.5, to second order; below that nothing is found."""
    (low, high) = (_stable(*column(thrust)) for thrust in (38.0, 45.0))
    assert list(low.values()) == [None]
    (finding,) = high.values()
    assert finding is not None
    # the mode is sin 2 pi s; differences of nodes bend, and means of two nodes tilt the elements
    tilt = np.pi / 20
    excess = 45.0 * np.cos(tilt) ** 2 - (40 * np.sin(tilt)) ** 2
    assert finding.value == pytest.approx(excess, rel=1e-6)
    assert "nothing has excited" in finding.meaning


@pytest.mark.slow
def test_spacing_and_tail_of_a_contact_law():
    """Parallel strands 0.08 apart under Debye-Hueckel, w = 1/(1/d + 1/l) about."""
    rod, screening = hairpin(), 0.02
    law = contact_laws.DebyeHueckel(strength=0.1, screening=screening)

    def found(cutoff, points, segments=24):
        contact = Contact(law, segments, cutoff, points, pairs_per_segment=16)
        scene = Scene(rod, Clamped(), Free(), contact=contact)
        state = start(scene)
        return _contact(scene, stored(state, state))

    coarse = found(0.12, 1)
    assert coarse["spacing of contact points"] is not None
    assert coarse["spacing of contact points"].value == pytest.approx(1 / 24)
    assert coarse["tail of the contact law"] is not None
    assert coarse["tail of the contact law"].value > 0.3
    fine = found(0.36, 6)
    assert fine["spacing of contact points"] is None
    assert fine["tail of the contact law"] is None


def test_contact_of_solids_has_no_tail_and_may_be_light():
    """A law that ends by itself is not cut off; strands that just touch need no finer points."""
    rod, _ = meeting(end=0.0)
    force = 10 * float(jnp.mean(rod.stiffness[:, :2])) / 3.0**2
    solid = Contact.solid(rod, force)
    state = placing(Scene(rod, Clamped(), contact=solid))

    def found(contact, depth):
        """Of strands that cross at right angles; the force for a depth of 0.05 is `force`."""
        position = meeting(end=-0.5, beside=(1 - depth) * 0.1)[1]
        near = dataclasses.replace(state, position=position)
        return _contact(Scene(rod, Clamped(), contact=contact), stored(state, near))

    coarse = dataclasses.replace(solid, points_per_segment=solid.points_per_segment // 2)
    topic = "spacing of contact points"
    assert found(solid, 0.05) == {topic: None}
    finding = found(coarse, 0.05)[topic]
    assert finding is not None
    assert finding.limit == pytest.approx(0.5 * 0.1 * np.sqrt(0.05 * 0.95), rel=0.02)
    assert found(coarse, 1e-3) == {}


@pytest.mark.slow
def test_a_mode_that_costs_nothing_is_not_unstable():
    """The plane of a buckled isotropic column between a clamp and a slider turns freely."""
    rod = straight_rod(1.0, 10, dataclasses.replace(UNIT_SECTION, stiffness=(1.0, 1.0, 1.0)))
    push = PointLoad(-1, Constant((0.0, 0.0, -45.0)))
    scene = Scene(rod, Clamped(), Slider(UP), loads=(push,))
    state, _ = equilibrium(scene, placing(scene), relax=True)
    assert float(jnp.max(jnp.abs(state.position[:, :2]))) > 0.05
    lowest = float(stability(scene, state).eigenvalues[0])
    assert abs(lowest) < 1e-5
    assert list(_stable(scene, stored(state, state)).values()) == [None]


def settling(scale):
    """A ledger of a cable that sinks slowly in drag, of its weight's work m g h = 1 J."""
    parts = {name: np.zeros(3) for name in energy.Ledger._fields}
    fall = scale * np.array([0.0, 0.5, 1.0])
    parts |= {"gravity": -fall, "drag_loss": 0.999 * fall, "kinetic": 1e-6 * fall}
    return energy.Ledger(**{name: jnp.asarray(value) for name, value in parts.items()})


def test_the_energy_that_moved_is_that_of_all_parts():
    """Of the weight and the drag as well, and never less than rounding of the rod's own."""
    scene = Scene(straight_rod(1.0, 4, UNIT_SECTION))
    sinking = settling(1.0)
    assert _moved(scene, sinking) == pytest.approx(1.0)
    assert float(jnp.max(jnp.abs(sinking.residual))) < 2e-3
    resting = settling(1e-17)
    assert _moved(scene, resting) == pytest.approx(1.15 * np.sqrt(np.finfo(float).eps))


@pytest.mark.slow
def test_a_run_that_resolves_all_has_no_findings():
    turn = Turn(UP, Smooth([0.0, 1.0, 9.0], [0.0, 1.0, 1.0]))
    rod = straight_rod(1.0, 12, UNIT_SECTION, natural_curvature=(0.1, 0.0, 0.0))
    scene = Scene(rod, Clamped(rotation=turn), Slider(UP), loads=(LinearDrag(1.0, 1.0, 0.1),))
    run = rollout(scene, start(scene), jnp.linspace(0.0, 1.0, 201)[1:])
    found = check(scene, run)
    assert not found, str(found)
    assert {"result", "ends", "corners", "energy ledger"} <= set(found.looked_at)


@pytest.mark.slow
def test_a_load_that_ends_inside_a_step_gives_its_impulse_by_the_mends_that_are_named():
    """A free rod pulled along itself by 1 N for 0.25 s has a momentum of 0.25 N s."""
    scene = CORNERED["loads[0].force"]
    state = start(scene)
    mass = scene.rod.to_nodes(scene.rod.mass)
    lacking = lambda run: abs(float(jnp.sum(mass * run.final.velocity[:, 2])) / 0.25 - 1)
    with pytest.warns(ModelWarning, match=r"loads.0..force: the load jumps at t = 0.25"):
        coarse = rollout(scene, state, np.array([0.2, 0.4]))
    assert lacking(coarse) > 0.1
    shorter = np.array([0.2, *np.asarray(scene.corners)[1:-1], 0.26, 0.27, 0.29, 0.33, 0.4])
    assert lacking(rollout(scene, state, shorter)) < 0.02
    adaptive = adaptive_rollout(scene, state, 0.4)
    # of the acceleration before the jump the auxiliary one keeps a third through the short step
    # over it, and the step after that one takes a sixth of it along: 2e-4 N s of steps of 4 ms
    assert lacking(rollout(scene, state, adaptive.times[1:])) < 1e-3
