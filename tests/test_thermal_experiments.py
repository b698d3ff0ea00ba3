"""DNA at room temperature: the theory that experiments compare with, and that they run."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "experiments"))

import _wormlike
import minicircle
import thermal_rate
import tweezers

KT = 4.114


def test_the_wormlike_chain():
    # strong pulls: z = 1 - sqrt(kT/(P F))/2 and so on
    for force in (4.0, 16.0):
        z = 1 - 0.5 * np.sqrt(KT / (50 * force))
        np.testing.assert_allclose(_wormlike.exact(force, 50.0, KT), z, atol=2e-4)
    # weak ones: z = 2 F P/(3 kT)
    weak = 1e-4
    found = _wormlike.exact(weak, 50.0, KT), _wormlike.marko_siggia(weak, 50.0, KT)
    np.testing.assert_allclose(found, 2 * weak * 50 / (3 * KT), rtol=1e-3)
    # the interpolation is within 3 % of what it interpolates
    for force in (0.25, 1.0, 4.0):
        both = _wormlike.exact(force, 50.0, KT), _wormlike.marko_siggia(force, 50.0, KT)
        np.testing.assert_allclose(*both, rtol=0.03)


def test_elements_become_the_chain():
    exact = _wormlike.exact(1.0, 50.0, KT)
    off = [_wormlike.discrete(1.0, 50 * KT, ds, KT) - exact for ds in (8.0, 4.0)]
    np.testing.assert_allclose(off[0] / off[1], 2.0, rtol=0.15)
    # for strong pulls by the spectrum of the discrete chain
    a, force, ds = 50 * KT, 4.0, 5.0
    by_modes = 1 - KT / (2 * np.sqrt(a * force) + force * ds)
    np.testing.assert_allclose(_wormlike.discrete(force, a, ds, KT), by_modes, atol=1e-3)


@pytest.mark.slow
def test_they_run_in_short_mode(tmp_path):
    assert tweezers.main(["--quick", "--out", str(tmp_path / "tweezers")]) == 0
    found = json.loads((tmp_path / "tweezers" / "summary.json").read_text())
    (pulled,), (turned,) = found["pulled"], found["turned"]
    assert pulled["result"] == turned["result"] == "SUCCESS"
    assert pulled["extension_of_elements"] == pytest.approx(pulled["theory_of_elements"], rel=0.1)
    assert turned["rows"][-1]["turns"] > 0.5
    assert minicircle.main(["--quick", "--out", str(tmp_path / "ring")]) == 0
    (ring,) = json.loads((tmp_path / "ring" / "summary.json").read_text())
    assert ring["result"] == "SUCCESS" and ring["linking_error"] < 1e-3
    assert abs(ring["writhe"]) < 0.1  # of four rings for a short time
    assert 0.01 < ring["deviation"] < 1.0
    assert thermal_rate.main(["--quick", "--out", str(tmp_path / "rate")]) == 0
    assert {path.name for path in (tmp_path / "ring").iterdir()} == {
        "minicircle.png",
        "summary.json",
    }
