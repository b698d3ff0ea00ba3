"""The paper's own scheme against itself (orders, its two solvers) and against the default."""

import dataclasses
import json

import equinox as eqx
import example
import jax.numpy as jnp
import numpy as np
import paper_scheme
import pytest
from helpers import final_state, order_of, relative_difference
from jax import lax

from rodjax.constraints.ends import Clamped, Free, Slider, Turn
from rodjax.dynamics.consistency import start
from rodjax.dynamics.fixed_rollout import rollout
from rodjax.equations.generalized_alpha import GeneralizedAlpha
from rodjax.inputs.schedules import Function
from rodjax.interactions.loads import Gravity, MorisonDrag, PointLoad
from rodjax.measuring.measures import linking, stretch_error
from rodjax.numerics.results import Result, SimulationError
from rodjax.reference.paper_scheme import PaperScheme, fields_of, paper_rollout, paper_step
from rodjax.reference.paper_solvers import BlockSolve, Shooting
from rodjax.rods.builders import straight_rod
from rodjax.rods.section import Section, circular_section
from rodjax.scenes.placing import placing
from rodjax.scenes.scene import Scene

DRAG = MorisonDrag(1.0, 2.0, 0.5)


SLIDER = Slider((0.0, 0.0, 1.0))


def driven(elements, stiffness=(1.0, 1.3, 0.8), jumps=(), last_end=SLIDER):
    """A clamp that shifts and turns smoothly, gravity and drag: bent and twisted."""
    section = Section(stiffness, mass=1.0, rotary_inertia=(0.02, 0.02, 0.04), diameter=0.1)
    rod = straight_rod(1.0, elements, section, jumps=jumps)
    shift = Function(lambda t: jnp.sin(1.5 * t) ** 6 * jnp.asarray([0.4, -0.2, 0.8]))
    turn = Turn((0.0, 0.0, 1.0), Function(lambda t: 4 * jnp.sin(1.5 * t) ** 6))
    loads = (DRAG, Gravity((0.0, 0.0, 1.0)))
    return Scene(rod, Clamped(shift, turn), last_end, loads)


@eqx.filter_jit
def advance(scene, fields, end, count, method):
    """Fields after `count` equal steps, and the worst result; one compilation serves every step."""
    begin = fields.state.time

    def one(i, carry):
        now, worst = carry
        now, info = paper_step(scene, now, begin + (end - begin) * ((i + 1) / count), method)
        return now, jnp.maximum(worst, info.result)

    return lax.fori_loop(0, count, one, (fields, jnp.asarray(0, jnp.int32)))


def after(scene, end, count, method, fields=None):
    """Fields after `count` steps that must all succeed."""
    fields = fields_of(scene, start(scene)) if fields is None else fields
    fields, worst = advance(scene, fields, jnp.asarray(end), jnp.asarray(count), method)
    assert int(worst) == 0
    return fields


def at_nodes(state, every=1):
    """What is compared: at every so many nodes, forces as the mean of the elements beside."""
    force = np.asarray(0.5 * (state.force[1:] + state.force[:-1]))
    found = {
        name: np.asarray(getattr(state, name))[::every]
        for name in ("position", "quaternion", "rate", "acceleration")
    }
    return found | {"force": force[every - 1 :: every]}


def orders(states, sizes):
    """Observed order of every field from states at successively finer sizes."""
    found = {}
    for name in states[0]:
        pairs = zip(states, states[1:], strict=False)
        found[name] = order_of(sizes[:-1], [np.max(np.abs(a[name] - b[name])) for a, b in pairs])
    return found


def assert_second_order(found):
    assert found == {name: pytest.approx(2.0, abs=0.1) for name in found}, found


@pytest.mark.slow
def test_order_in_time():
    scene, counts = driven(6), 40 * 2 ** np.arange(4)
    for rho in (0.5, 0.9):
        method = PaperScheme(rho, tolerance=1e-11)
        states = [at_nodes(after(scene, 0.4, n, method).state) for n in counts]
        assert_second_order(orders(states, 1 / counts))


@pytest.mark.slow
@pytest.mark.parametrize("rho", [0.75, 1.0])
def test_order_in_space(rho):
    """Also where the stiffness jumps, and with slopes carried along (rho below 1)."""
    stiffness = tuple(
        lambda s, k=k: k * np.where(np.abs(s - 0.5) < 0.125, 0.7, 1.0) for k in (1.0, 1.3, 0.8)
    )
    sizes = 8 * 2 ** np.arange(4)
    states = []
    for n in sizes:
        scene = driven(int(n), stiffness, jumps=(0.375, 0.625))
        fields = after(scene, 0.4, 50, PaperScheme(0.5, rho, tolerance=1e-10))
        states.append(at_nodes(fields.state, n // 8))
    assert_second_order(orders(states, 1 / sizes))


@pytest.mark.slow
@pytest.mark.parametrize("last_end", [SLIDER, Free()], ids=["slider", "cantilever"])
def test_agrees_with_the_default_scheme(last_end):
    """Steps and elements refined together: the difference of the two schemes is second order."""
    sizes, differences = 8 * 2 ** np.arange(4), []
    for n in sizes:
        scene = driven(int(n), last_end=last_end)
        paper = at_nodes(after(scene, 0.4, 10 * n, PaperScheme()).state, n // 8)
        other = final_state(scene, start(scene), 0.4, 10 * n, GeneralizedAlpha())
        other = at_nodes(other, n // 8)
        differences.append({k: relative_difference(paper[k], other[k]) for k in paper})
    found = {k: order_of(1 / sizes, [d[k] for d in differences]) for k in differences[0]}
    assert_second_order(found)
    assert max(differences[-1].values()) < 1e-3


def thin(elements, diameter=2e-3):
    """A rod of the paper's materials, shaken and turned at one end, sliding at the other."""
    section = circular_section(diameter, 1.25e7, 5e6, 1500.0)
    rod = straight_rod(1.0, elements, section, direction=(0.0, 1.0, 0.0))
    pulse = lambda t: jnp.sin(0.5 * jnp.pi * t) ** 6
    shift = Function(lambda t: pulse(t) * jnp.asarray([0.05, -0.1, 0.03]))
    turn = Turn((0.0, 1.0, 0.0), Function(lambda t: 6 * pulse(t)))
    drag = MorisonDrag(1000.0, 0.1, 0.01)
    return Scene(rod, Clamped(shift, turn), Slider((0.0, 1.0, 0.0)), (drag,))


@pytest.mark.slow
def test_shooting_equals_the_block_solve_and_breaks_down_as_dt_is_refined():
    scene = thin(60)
    moving = after(scene, 0.5, 20, PaperScheme())
    gaps = {}
    for dt in (0.1, 0.01, 3e-3):
        block = after(scene, 0.5 + dt, 1, PaperScheme(), moving).value
        stop, one = jnp.asarray(0.5 + dt), jnp.asarray(1)
        shot, code = advance(scene, moving, stop, one, PaperScheme(solver=Shooting()))
        gaps[dt] = relative_difference(shot.value[:, 9:], block[:, 9:]) if code == 0 else code
    assert gaps[0.1] < 1e-12
    assert 100 * gaps[0.1] < gaps[0.01] < 1e-4  # the march grows by e^41 for e^15
    assert gaps[3e-3] in (Result.NEWTON_FAILED, Result.NON_FINITE)


@pytest.mark.slow
def test_example_is_twisted_as_by_the_default_scheme():
    """Straight and twisted, then bending; the left end slides and is held from 16 s on."""
    preset = dataclasses.replace(
        example.PRESETS["timeline"],
        diameter=3e-4,
        drive=((0.0, 0.0), (4.0, 3.0)),
        rate_after=0.02,
        seed_curvature=0.3,
        hold_at=16.0,
    )
    scene = example.scene(preset, 40, contact=False)
    times, state = 0.1 * jnp.arange(1.0, 201.0), start(scene)
    run, other = paper_rollout(scene, state, times), rollout(scene, state, times)
    # the end s = L has drifted by 14 mm on this grid, which bends by 44 mm
    assert float(jnp.max(jnp.abs(other.final.position[:, 0]))) > 0.04
    assert float(jnp.max(jnp.abs(run.states.position - other.states.position))) < 0.02
    found, expected = linking(scene, run), linking(scene, other)
    np.testing.assert_allclose(found.twist, expected.twist, atol=0.02)
    assert expected.twist[-1] < 3.25  # of 3.32 turns
    assert max(float(stretch_error(scene.rod, run.state(k))) for k in (40, 160, 200)) < 1e-12
    sliding = np.abs(np.asarray(run.states.velocity[:, -1, 1]))
    assert np.max(sliding[:161]) > 5e-3
    assert np.max(sliding[161:]) < 1e-12


@pytest.mark.slow
def test_failed_step_is_reported():
    scene = thin(8)
    method = PaperScheme(max_iterations=1, tolerance=1e-15)
    with pytest.raises(SimulationError, match="Newton"):
        paper_rollout(scene, start(scene), jnp.asarray([0.1, 0.2]), method)
    run = paper_rollout(scene, start(scene), jnp.asarray([0.1, 0.2]), method, throw=False)
    assert Result(int(run.result)) is Result.NEWTON_FAILED
    np.testing.assert_array_equal(run.states.position[0], scene.rod.position)
    assert np.all(np.isnan(run.states.position[1:])) and np.all(np.isnan(run.final.velocity))


def replaced(**changes):
    scene = driven(4)
    return dataclasses.replace(scene, rod=dataclasses.replace(scene.rod, **changes))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: replaced(compliance=jnp.full((4, 3), 0.1)), "compliance: the paper's scheme"),
        (lambda: replaced(rotary_inertia=None), "rotary_inertia"),
        (
            lambda: dataclasses.replace(
                driven(4), loads=(PointLoad(-1, force=Function(lambda t: t * jnp.ones(3))),)
            ),
            "not this PointLoad",
        ),
        (
            lambda: dataclasses.replace(
                replaced(area=jnp.full((4,), 0.1)),
                loads=(MorisonDrag(1.0, 2.0, 0.5, added_mass_coefficient=1.0),),
            ),
            "added mass",
        ),
    ],
)
def test_what_is_not_supported_is_refused(make, message):
    scene = make()
    with pytest.raises(ValueError, match=message):
        paper_rollout(scene, placing(scene), jnp.asarray([0.1]))


def test_settings_are_checked():
    for name in ("rho_time", "rho_space"):
        with pytest.raises(ValueError, match=f"{name}: must be in"):
            PaperScheme(**{name: 1.1})
    with pytest.raises(ValueError, match="tolerance: must be positive"):
        PaperScheme(tolerance=0.0)
    assert isinstance(PaperScheme().solver, BlockSolve)


@pytest.mark.slow
def test_experiment_shows_orders_and_where_shooting_ends(tmp_path):
    assert paper_scheme.main(["--quick", "--out", str(tmp_path)]) == 0
    names = {"summary.json", "orders.png", "shooting.png"}
    assert {path.name for path in tmp_path.iterdir()} == names
    summary = json.loads((tmp_path / "summary.json").read_text())
    for table in summary["convergence"].values():
        for order in table["orders"].values():
            assert order == pytest.approx(2.0, abs=0.1)
    rows = {row["dt"]: row for row in summary["shooting"]["rows"]}
    assert all(row["block"] == "SUCCESS" for row in rows.values())
    assert rows[0.1]["difference"] < 1e-12
    assert rows[0.003]["shooting"] != "SUCCESS"
    steps = {(row["dt"], row["rho_space"]): row["steps"] for row in summary["damping"]}
    assert steps[0.001, 1.0] == 200 > steps[0.001, 0.25]
