"""`help` of every public name tells what each of its fields and parameters means."""

import dataclasses
import enum
import inspect
import re

import pytest

import rodjax as rx
from rodjax.numerics.results import MESSAGES

MODULES = [name for name in rx.__all__ if inspect.ismodule(getattr(rx, name))]


def _of_module(name: str) -> dict[str, object]:
    """Public functions and classes that a public module defines itself."""
    module = getattr(rx, name)
    return {
        f"{name}.{key}": value
        for key, value in vars(module).items()
        if not key.startswith("_")
        and (inspect.isclass(value) or inspect.isfunction(value))
        and value.__module__ == module.__name__
    }


def _public() -> dict[str, object]:
    found = {name: getattr(rx, name) for name in rx.__all__ if name not in MODULES}
    for name in MODULES:
        found |= _of_module(name)
    # what public functions return
    for module, names in {
        "measuring.energy": ["Ledger", "Reactions"],
        "measuring.event_times": ["first_crossing", "slopes", "time_of_maximum"],
        "rods.winding": ["twist", "writhe", "writhe_of"],
        "dynamics.stepping": ["StepInfo"],
        "interactions.contact_report": ["ContactReport"],
        "equilibria.load_path": ["EquilibriumInfo"],
        "equilibria.linear_stability": ["Stability"],
        "equilibria.small_vibration": ["Vibration"],
        "fitting.descent": ["Minimum"],
        "dynamics.step_control": ["Control"],
        "viewing.tubes": ["View", "facing"],
    }.items():
        of = __import__(f"rodjax.{module}", fromlist=names)
        found |= {f"{module.split('.')[1]}.{key}": getattr(of, key) for key in names}
    return found


PUBLIC = _public()


def _parts(thing) -> list[str]:
    """Names of the fields of a class, of the parameters of a function."""
    if inspect.isclass(thing):
        if issubclass(thing, enum.Enum | BaseException):
            return []
        if dataclasses.is_dataclass(thing):
            return [field.name for field in dataclasses.fields(thing)]
        return list(getattr(thing, "_fields", []))
    return [name for name in inspect.signature(thing).parameters if not name.startswith("_")]


def _unsaid(thing) -> list[str]:
    doc = inspect.getdoc(thing) or ""
    return [name for name in _parts(thing) if not re.search(rf"\b{name}\b", doc)]


@pytest.mark.parametrize("name", sorted(PUBLIC))
def test_every_field_and_parameter_is_told(name):
    assert inspect.getdoc(PUBLIC[name])
    assert [part for part in _unsaid(PUBLIC[name]) if f"{name}: {part}" not in MISSING] == []


@pytest.mark.parametrize("name", sorted(PUBLIC))
def test_public_methods_are_told(name):
    thing = PUBLIC[name]
    if not inspect.isclass(thing) or issubclass(thing, enum.Enum | BaseException):
        return
    own = [key for key in vars(thing) if not key.startswith("_") and key not in _parts(thing)]
    bare = [key for key in own if not inspect.getdoc(getattr(thing, key))]
    assert [key for key in bare if f"{name}: {key}" not in MISSING] == []


def test_every_result_has_its_meaning_and_mend():
    assert set(MESSAGES) == set(rx.Result)
    assert all(len(MESSAGES[result]) > 20 for result in rx.Result)


def test_a_field_that_is_not_told_is_found():
    class Told(rx.State):
        """Has `time` and position alone."""

    assert _unsaid(Told) == [name for name in _parts(rx.State) if name not in ("time", "position")]
    assert _unsaid(lambda scene, k: None) == ["scene", "k"]


# what is still to be told; it only shrinks
MISSING: set[str] = {
    "energy.contact_energy: scene",
    "energy.contact_energy: state",
}
