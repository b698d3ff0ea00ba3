"""Texts of several lines and tables for notebooks: numbers with units, shapes of what is traced."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import UNIT_SECTION, standing_run

import rodjax as rx
from rodjax.inputs.sheets import Sheet, quantity, told

PINNED = rx.Support(3, rx.Pinned())


@pytest.fixture(scope="module")
def scene():
    rod = rx.straight_rod(2.0, 8, UNIT_SECTION, natural_curvature=(0.3, 0.4, 0.0))
    turn = rx.Turn((0, 0, 1), rx.PiecewiseLinear([0.0, 1.0], [0.0, 2.5]))
    contact = rx.Contact(rx.Penalty(stiffness=1e6), segments=8, cutoff=0.2)
    ends = rx.Clamped(rotation=turn), rx.Free()
    return rx.Scene(rod, *ends, (rx.Gravity((0, 0, -9.81)),), contact, supports=(PINNED,))


def lines_of(thing):
    """Its text, the names in it taken for keys."""
    first, *others = str(thing).splitlines()
    return first, dict(tuple(line.strip().split("  ", 1)) for line in others)


def said(thing, name):
    return lines_of(thing)[1][name].strip()


def test_a_rod_says_its_numbers_with_units(scene):
    first, _ = lines_of(scene.rod)
    assert first == "a rod of 8 elements, 2 m long"
    assert said(scene.rod, "bending stiffness A2") == "1.3 N m^2"
    assert said(scene.rod, "mass") == "1 kg/m"
    assert said(scene.rod, "natural curvature") == "0.5 rad/m"
    assert "natural twist" not in str(scene.rod) and "1/EA" not in str(scene.rod)
    assert repr(scene.rod).startswith("Rod(elements=8, length=2,")
    tapered = rx.straight_rod(
        1.0, 4, rx.Section((1.0, 1.0, 1.0), diameter=lambda s: 0.02 - 0.01 * s)
    )
    assert said(tapered, "diameter") == "0.01125 to 0.01875 m"
    assert said(tapered, "mass") == "none: no inertia"


def test_a_scene_says_what_holds_and_loads_it(scene):
    first, _ = lines_of(scene)
    assert first == "Scene of a rod of 8 elements, 2 m long"
    assert said(scene, "loads[0]") == "Gravity(acceleration=(0, 0, -9.81) m/s^2)"
    end = said(scene, "first end")
    assert "times=(0, 1) s, values=(0, 2.5) rad" in end  # a schedule has the unit of what it drives
    assert said(scene, "last end") == "Free()"
    assert said(scene, "supports[0]") == "Pinned() at node 3"
    assert "Penalty(stiffness=1e+06 N/m^3" in said(scene, "contact")
    assert said(scene.contact, "cutoff") == "0.2 m"
    two = rx.Scene(rods=[scene.rod, rx.straight_rod(1.0, 4, UNIT_SECTION, origin=(1, 0, 0))])
    assert lines_of(two)[0] == "Scene of 2 rods of 8, 4 elements, 2 m, 1 m long"
    assert said(two, "diameter") == "0.1 m"


def test_a_run_says_how_it_went(scene):
    run = standing_run(scene, 5)
    assert lines_of(run)[0] == "Run over 0 to 0.5 s: SUCCESS"
    assert said(run, "saved states") == "6, of 9 nodes"
    assert said(run, "steps") == "5" and said(run, "step size") == "0.1 s"
    where = lambda r: (r.result, r.rejected, r.states.position)
    lost = run.states.position.at[4:].set(jnp.nan)
    failed = eqx.tree_at(where, run, (jnp.asarray(3, jnp.int32), jnp.asarray(2, jnp.int32), lost))
    assert lines_of(failed)[0].endswith("NEWTON_FAILED")
    assert said(failed, "steps") == "5, 2 more taken back"
    assert said(failed, "no numbers in") == "2 states"
    assert said(failed, "result").startswith("Newton's method did not converge; use")
    none = jax.tree.map(lambda leaf: leaf[:0], run.states)
    assert "Run without states" in str(eqx.tree_at(lambda r: r.states, run, none))


def test_a_ledger_says_what_stands_in_it():
    time = np.linspace(0.0, 2.0, 5)
    parts = {name: np.zeros(5) for name in rx.energy.Ledger._fields[1:12]}
    ledger = rx.energy.Ledger(jnp.asarray(time), **{k: jnp.asarray(v) for k, v in parts.items()})
    ledger = ledger._replace(load_work=jnp.asarray(time), bending=jnp.asarray(0.75 * time))
    assert repr(ledger) == "Ledger over 0 to 2 s, 5 times"
    assert str(ledger).splitlines()[1:] == [
        "  load work          2 J",
        "  bending            1.5 J",
        "  not accounted for  0.5 J at most",
    ]
    assert "<th" in ledger._repr_html_() and "1.5 J" in ledger._repr_html_()


def test_sections_say_what_they_were_made_of():
    section = rx.circular_section(0.01, 1.2e7, 4e6, density=1500.0)
    assert repr(section) == (
        "circular_section(youngs_modulus=1.2e+07 N/m^2, shear_modulus=4e+06 N/m^2, shear_factor=1,"
        " density=1500 kg/m^3, diameter=0.01 m)"
    )
    assert said(rx.Section((1.0, 2.0, 3.0), mass=0.2), "mass") == "0.2 kg/m"


def test_other_units_are_named_once_they_are_in_use(scene):
    before = rx.units.use(rx.units.Units("nm", "us", "ag", "pN"))
    try:
        assert lines_of(scene.rod)[0] == "a rod of 8 elements, 2 nm long"
        assert said(scene, "loads[0]").endswith("nm/us^2)")
        assert "nm" in str(
            rx.picture(scene).findobj(lambda x: "[nm]" in getattr(x, "_text", ""))[0]
        )
    finally:
        assert rx.units.use(before) == rx.units.Units("nm", "us", "ag", "pN")
    assert lines_of(scene.rod)[0].endswith("2 m long")


def test_notebooks_show_tables(scene):
    for thing in (scene, scene.rod, scene.contact, standing_run(scene, 2)):
        page = thing._repr_html_()
        assert page.startswith("<table>") and page.count("<tr>") == len(str(thing).splitlines()) - 1
    assert Sheet("a < b", (("c & d", "<e>"),)).html.count("&lt;") == 2
    fit = rx.least_squares(
        lambda p: p["a"] * jnp.arange(3.0), {"a": 1.0},
        rx.Observations(np.arange(3.0), 2.0 * np.arange(3.0), deviation=0.1),
    )  # fmt: skip
    assert "<th" in fit._repr_html_() and ">2 +- 0.045<" in fit._repr_html_()


def test_what_is_traced_says_its_shapes(scene):
    run, seen = standing_run(scene, 3), []

    @jax.jit
    def trace(scene, run):
        things = scene, scene.rod, scene.contact, run, rx.Section((scene.rod.mass, 1.0, 1.0))
        seen.extend([str(thing) + thing._repr_html_() for thing in things])
        ledger = rx.energy.Ledger(*[run.times] * 16)
        seen.append(str(ledger) + repr(ledger) + ledger._repr_html_())
        return run.result

    trace(scene, run)
    assert "float64[8,3]" in seen[0] and "float64[4]" in seen[3]
    for tree in (scene, scene.rod, run):
        batch = jax.tree.map(lambda x: jnp.stack([x, x]), tree)
        shapes = eqx.filter_eval_shape(lambda x: x, tree)
        without = eqx.filter(tree, eqx.is_array, inverse=True)
        assert str(batch) and str(shapes) and str(without) and batch._repr_html_()


def test_quantities():
    assert quantity(np.array([1.0, 1.0]), "m") == "1 m"
    assert quantity(np.array([1.0, np.nan, 2.0]), "") == "1 to 2, some no numbers"
    assert quantity(np.array([np.nan]), "m") == "no number"
    assert told((1.0, None, True), "m") == "(1 m, None, True)"
