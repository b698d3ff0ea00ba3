"""Contact and its laws take nothing that is none of theirs, and allocate nothing for it."""

import jaxtyping
import numpy as np
import pytest
from helpers import LAWS, hairpin

import rodjax as rx


@pytest.fixture(autouse=True)
def unchecked():
    """As a user's program runs, without the checker of types that tests have."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


GIVEN = {"segments": 20, "cutoff": 0.1}


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"segments": 10**9}, "^segments"),
        ({"segments": 2.5}, "^segments"),
        ({"segments": True}, "^segments"),
        ({"segments": "many"}, "^segments"),
        ({"points_per_segment": 10**6}, "^points_per_segment"),
        ({"pairs_per_segment": 10**9}, "^pairs_per_segment"),
        ({"segments": 9_000, "pairs_per_segment": 9_000}, "^pairs_per_segment: lists"),
        ({"pairs_per_segment": 0}, "^pairs_per_segment"),
        ({"capacities": ()}, "^capacities"),
        ({"capacities": 64}, "^capacities"),
        ({"capacities": (8, "all")}, r"^capacities\[1\]"),
        ({"capacities": (8, 8)}, "^capacities"),
        ({"cutoff": "near"}, "^cutoff"),
        ({"cutoff": None}, "^cutoff"),
        ({"cutoff": np.nan}, "^cutoff"),
        ({"cutoff": np.inf}, "^cutoff"),
        ({"cutoff": 0.1 + 0.1j}, "^cutoff"),
        ({"cutoff": True}, "^cutoff"),
        ({"cutoff": [0.1, 0.2]}, "^cutoff"),
        ({"edge": {}}, "^edge"),
        ({"aperture": np.nan}, "^aperture"),
        ({"aperture": 120.0}, "^aperture: must be in .* radians"),
        ({"exclusion": "far"}, "^exclusion"),
        ({"exclusion": np.nan}, "^exclusion"),
    ],
)
def test_contact_names_the_argument(changed, message):
    with pytest.raises(ValueError, match=message):
        rx.Contact(LAWS["penalty"], **(GIVEN | changed))


@pytest.mark.parametrize("law", [rx.Penalty, None, 3.0, "penalty", rx.Clamped(), dict])
def test_a_law_is_an_instance(law):
    with pytest.raises(ValueError, match="^law: "):
        rx.Contact(law, **GIVEN)


@pytest.mark.parametrize("contact", [LAWS["penalty"], rx.Contact, 1.0])
def test_a_scene_takes_a_contact(contact):
    with pytest.raises(ValueError, match="^contact: "):
        rx.Scene(hairpin(), rx.Clamped(), contact=contact)


LEAST = {
    rx.Penalty: {"stiffness": 1.0},
    rx.Barrier: {"stiffness": 1.0},
    rx.InversePower: {"strength": 1.0, "exponent": 3.0},
    rx.LennardJones: {"energy": 1.0, "range": 1.0},
    rx.DebyeHueckel: {"strength": 1.0, "screening": 1.0},
    rx.DampedInversePower: {"k1": 1.0, "k3": 1.0, "reference_spacing": 1.0},
}


@pytest.mark.parametrize("kind", LEAST, ids=lambda kind: kind.__name__)
@pytest.mark.parametrize("value", ["1", None, {}, np.nan, np.inf, 1j, True, [1.0, 2.0], rx.Free])
def test_laws_take_one_real_number(kind, value):
    for name in LEAST[kind]:
        with pytest.raises(ValueError, match=f"^{name}: "):
            kind(**(LEAST[kind] | {name: value}))
