"""DNA at room temperature: the theory that experiments compare with, and that they run."""

import json

import _wormlike
import minicircle
import numpy as np
import pytest
import thermal_oracles
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
    stiffness = (50 * KT, 100 * KT)
    off = [_wormlike.elements_under(1.0, stiffness, ds, KT) - exact for ds in (8.0, 4.0)]
    np.testing.assert_allclose(off[0] / off[1], 2.0, rtol=0.15)
    # for strong pulls by the spectrum of the discrete chain
    force, ds = 4.0, 5.0
    by_modes = 1 - KT / (2 * np.sqrt(stiffness[0] * force) + force * ds)
    found = _wormlike.elements_under(force, stiffness, ds, KT)
    np.testing.assert_allclose(found, by_modes, atol=1e-3)
    # ends are not felt far from them, and weaken the pull near by
    finite = [_wormlike.elements_under(force, stiffness, ds, KT, count) for count in (6, 30)]
    assert finite[0] < found - 1e-3 and abs(finite[1] - found) < 1e-6


def test_a_crumpled_start_is_a_chain_without_a_pull():
    """Ends of the distance that the distribution of the elements says, in the mean of 400."""
    stiffness, drawn = (50 * KT, 100 * KT), []
    for seed in range(10_000, 10_400):
        position, frames = _wormlike.crumpled(8, stiffness, 5.0, KT, seed)
        drawn.append(np.sum((position[-1] - position[0]) ** 2))
    right = thermal_oracles.end_to_end(8, (stiffness[0], *stiffness), 0.0, 5.0, KT)
    error = np.std(drawn) / np.sqrt(len(drawn))
    assert abs(np.mean(drawn) - right) < 3 * error
    assert frames.shape == (9, 4)


@pytest.mark.slow
def test_they_run_in_short_mode(tmp_path):
    assert tweezers.main(["--quick", "--out", str(tmp_path / "tweezers")]) == 0
    found = json.loads((tmp_path / "tweezers" / "summary.json").read_text())
    (turned,) = found["turned"]
    for pulled in found["pulled"]:
        assert pulled["result"] == turned["result"] == "SUCCESS"
        assert abs(pulled["tangent"] - pulled["theory"]) < 4 * pulled["error"]
    assert turned["linking_error"] < 1e-6
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
