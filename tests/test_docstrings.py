"""What `help` says of rods, sections, ends, loads and schedules: every field, with its unit."""

import dataclasses
import re

import pytest

import rodjax as rx

CLASSES = [
    *(rx.Rod, rx.Section, rx.Scene, rx.Turn, rx.Free, rx.Clamped, rx.Pinned, rx.Slider),
    rx.Support,
    *(rx.Lump, rx.Body, rx.PointDrag),
    *(rx.Switched, rx.Constant, rx.PiecewiseLinear, rx.PiecewiseLinearRate, rx.Smooth),
    *(rx.Function, rx.Gravity, rx.MorisonDrag, rx.LinearDrag, rx.DistributedLoad, rx.PointLoad),
    *(rx.GeneralizedAlpha, rx.StepControl),
]
SAID = {
    rx.Section: ["(A1, A2, C)", "[N m^2]", "(1/GA1, 1/GA2, 1/EA)", "[1/N]", "[kg m]", "[kg/m]"],
    rx.Rod: ["A1, A2, C", "[N m^2]", "1/GA1, 1/GA2, 1/EA", "[1/N]", "[kg m]", "[1/m]", "real part"],
    rx.Clamped: ["displacement: schedule of three inertial components [m]", "Turn"],
    rx.Turn: ["[rad]", "2 pi"],
    rx.Gravity: ["[m/s^2]", "(0, 0, -9.81)", "[kg/m^3]"],
    rx.LinearDrag: ["[N s/m^2]", "[N s]"],
    rx.PointLoad: ["[N]", "[N m]"],
}


@pytest.mark.parametrize("kind", CLASSES, ids=lambda kind: kind.__name__)
def test_every_field_is_described(kind):
    text = kind.__doc__
    described = re.split(r"(?:Attributes|Args):\n", text, maxsplit=1)
    assert len(described) == 2, text
    for field in dataclasses.fields(kind):
        assert re.search(rf"^ +([a-z_]+, )*{field.name}(, [a-z_]+)*: ", described[1], re.MULTILINE)
    for words in SAID.get(kind, []):
        assert words in text


@pytest.mark.parametrize("builder", [rx.straight_rod, rx.curved_rod, rx.circular_section])
def test_every_argument_of_a_builder_is_described(builder):
    described = builder.__doc__.split("Args:\n")[1]
    arguments = builder.__annotations__.keys() - {"return"}
    for name in arguments:
        assert re.search(rf"^ +{name}: ", described, re.MULTILINE), name
