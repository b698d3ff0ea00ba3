"""A scene traces nothing of what it does not have."""

import re

import equinox as eqx
import jax
import jax.numpy as jnp
import pytest

from rodjax.constraints.ends import Clamped, Slider, Switched
from rodjax.dynamics.fixed_rollout import rollout
from rodjax.dynamics.stepping import prepare, step
from rodjax.interactions.contact import Contact
from rodjax.interactions.contact_laws import InversePower
from rodjax.interactions.loads import Gravity, MorisonDrag
from rodjax.numerics import newton
from rodjax.rods.builders import straight_rod
from rodjax.rods.section import Section
from rodjax.scenes.placing import placing
from rodjax.scenes.scene import Scene

CONTACT = {"contact.py", "screening.py", "contact_forces.py", "pair_points.py"}
CONTACT |= {"contact_law.py", "contact_laws.py"}


def rod(**changes):
    """A rod of eight elements."""
    fields = {"mass": 1.0, "rotary_inertia": (1e-3, 1e-3, 2e-3), "diameter": 0.02} | changes
    return straight_rod(1.0, 8, Section((1.0, 1.0, 0.8), **fields))


SCENES = {
    "bare": Scene(rod(rotary_inertia=None), Clamped()),
    "rotary inertia": Scene(rod(), Clamped()),
    "compliance": Scene(rod(compliance=(1e-4, 1e-4, 1e-5)), Clamped()),
    "gravity": Scene(rod(), Clamped(), loads=(Gravity((0.0, 0.0, -9.81)),)),
    "drag": Scene(rod(), Clamped(), loads=(MorisonDrag(1000.0, 0.1, 0.01),)),
    "switch": Scene(rod(), Clamped(), Switched(Slider((0.0, 0.0, 1.0)), Clamped(), 1.0)),
    "contact": Scene(rod(), Clamped(), contact=Contact(InversePower(1.0, 3.0), 8, 0.1)),
}


@pytest.fixture(scope="module")
def programs():
    """The traced step of every scene, with the places in the source that made its operations."""
    texts = {}
    for name, scene in SCENES.items():
        state = prepare(scene, placing(scene))
        arrays, rest = eqx.partition((scene, state, jnp.asarray(1e-2)), eqx.is_array)
        # cached parts of programs traced before would name the places that made those
        jax.clear_caches()
        program = jax.jit(lambda arrays, rest=rest: step(*eqx.combine(arrays, rest)))
        texts[name] = program.lower(arrays).as_text(debug_info=True)
    return texts


def files(text):
    """Files of the library named in a program."""
    return set(re.findall(r"rodjax/\w+/(\w+\.py)", text))


def operations(text):
    """Number of operations of a program."""
    return len(re.findall(r"^\s*%\S+ = ", text, re.MULTILINE))


@pytest.mark.slow
def test_only_contact_traces_the_files_of_contact(programs):
    assert files(programs["contact"]) >= CONTACT
    for name in SCENES.keys() - {"contact"}:
        assert not files(programs[name]) & CONTACT, name


@pytest.mark.slow
def test_only_loads_trace_the_file_of_loads(programs):
    for name, text in programs.items():
        assert ("loads.py" in files(text)) == (name in ("gravity", "drag")), name


@pytest.mark.slow
def test_only_a_switch_traces_a_restart(programs):
    for name, text in programs.items():
        assert ("consistency.py" in files(text)) == (name == "switch"), name


@pytest.mark.slow
def test_every_part_adds_operations_of_its_own(programs):
    counts = {name: operations(text) for name, text in programs.items()}
    assert counts["bare"] > 100
    assert counts["bare"] < counts["rotary inertia"]
    for name in ("compliance", "gravity", "drag", "switch", "contact"):
        assert counts["rotary inertia"] < counts[name], name


def test_the_derivative_of_a_rollout_is_traced_once(monkeypatch):
    """That of one step, though the state has a tangent only after the first."""
    scene = SCENES["bare"]
    state, times = placing(scene), jnp.linspace(0.01, 0.04, 4)
    traced, tangent = [], newton._tangent
    monkeypatch.setattr(newton, "_tangent", lambda *given: traced.append(1) or tangent(*given))
    heavy = lambda factor: eqx.tree_at(lambda one: one.rod.mass, scene, factor * scene.rod.mass)

    def one(factor):
        return jnp.sum(step(heavy(factor), state, times[0])[0].position)

    def all_of_them(factor):
        return jnp.sum(rollout(heavy(factor), state, times, throw=False).final.position)

    def count(function):
        jax.clear_caches()
        traced.clear()
        jax.jit(function).trace(jnp.asarray(1.0))
        return len(traced)

    forward = lambda function: lambda x: jax.jvp(function, (x,), (jnp.ones_like(x),))
    for derivative in (jax.grad, forward):
        assert count(derivative(all_of_them)) == count(derivative(one)) > 0
