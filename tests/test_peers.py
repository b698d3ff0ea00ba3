"""The other codes: the same problems as rodjax's scenes, and the comparison on the stout rod."""

import dataclasses
import importlib.util
import json

import jax.numpy as jnp
import numpy as np
import peer_dismech
import peer_problems
import peer_pyelastica
import peers
import pytest

import rodjax as rx

CANTILEVER = peer_problems.PROBLEMS["cantilever"]


def shorter(problem: peer_problems.Problem, count: int) -> peer_problems.Problem:
    """The first few recorded times."""
    return dataclasses.replace(problem, times=problem.times[:count])


def swing(elements: int) -> np.ndarray:
    """rodjax's cantilever at the recorded times and points up to 0.25 s."""
    scene = peer_problems.rodjax_scene(CANTILEVER, elements)
    run = rx.rollout(scene, rx.start(scene), jnp.linspace(0, 0.25, 101)[1:])
    seen = rx.positions_at(run, jnp.asarray(CANTILEVER.times[:5]))
    return np.asarray(seen[:, :: elements // (peer_problems.POINTS - 1)])


@pytest.fixture(scope="module")
def swung():
    return swing(40)


def test_scene_and_problem_agree():
    """Section, neck, seed, drive and drag of a problem arrive in the scene."""
    problem = peer_problems.Problem(
        (0.0, 1.0, 0.0),
        (1.0,),
        neck=(0.375, 0.625, 0.9),
        seed_curvature=0.02,
        turns=((0.0, 0.0), (1.0, 2.0)),
        slides=True,
        drag=peer_problems.Drag(1000.0, 0.1, 0.01),
    )
    scene = peer_problems.rodjax_scene(problem, 20)
    rod = scene.rod
    area = np.pi * 0.01**2 / 4
    np.testing.assert_allclose(rod.stiffness[0, 0], 1.25e7 * area * 0.01**2 / 16)
    np.testing.assert_allclose(rod.stiffness[10, 2] / rod.stiffness[0, 2], 0.9**4)
    np.testing.assert_allclose(rod.compliance[0], [28 / 27 / 5e6 / area] * 2 + [1 / 1.25e7 / area])
    np.testing.assert_allclose(rod.natural_curvature[3], [0.02, 0.0, 0.0])
    np.testing.assert_allclose(scene.first_end.rotation(0.5), [0, -2 * np.pi, 0])
    assert isinstance(scene.last_end, rx.Slider) and len(scene.loads) == 1


@pytest.mark.parametrize("slides", [False, True])
def test_held_ends_lie_in_the_middle_of_their_elements(slides):
    neck = (0.375, 0.625, 0.9)
    problem = peer_problems.Problem((0.0, 1.0, 0.0), (1.0,), neck=neck, slides=slides)
    nodes = peer_problems.held_grid(problem, 30)
    assert len(nodes) == 31 and np.all(np.diff(nodes) > 0)
    middles = 0.5 * (nodes[1:] + nodes[:-1])
    assert abs(middles[0]) < 1e-15
    assert abs((middles if slides else nodes)[-1] - 1) < 1e-15
    for jump in neck[:2]:
        assert np.min(np.abs(nodes - jump)) < 1e-15
    assert np.ptp(np.diff(nodes)) < 0.15 / 30


@pytest.mark.slow
def test_pyelastica_swings_the_same_cantilever(swung):
    """Undamped, to the difference of the two grids; a shear factor or mass amiss shows."""
    pytest.importorskip("elastica")
    found = [
        peer_pyelastica.run_pyelastica(shorter(CANTILEVER, 5), elements, 5e-5).positions
        for elements in (20, 40)
    ]
    moved = np.max(np.abs(swung - swung[0, :1]))
    coarse, fine = (np.max(np.abs(x - swung)) / moved for x in found)
    assert fine < 2e-3
    # twice the elements: a quarter of the error
    assert np.max(np.abs(found[1] - found[0])) < 1e-2 * moved and fine < 0.5 * coarse


def test_pyelastica_says_what_it_cannot():
    pytest.importorskip("elastica")
    assert "static" in peers.run("pyelastica", "bend", 20, 1e-4).reason
    reason = peer_pyelastica.run_pyelastica(shorter(CANTILEVER, 1), 20, 2e-3).reason
    assert "diverged" in reason


def test_list_of_near_pairs_gives_pyelasticas_own_contact_forces():
    pytest.importorskip("elastica")
    from elastica._contact_functions import _calculate_contact_forces_self_rod

    problem = peer_problems.Problem((0.0, 1.0, 0.0), (0.1,), neck=(0.375, 0.625, 0.9), slides=True)
    law = peer_pyelastica.near_self_contact(0.01, 20)
    rod = peer_pyelastica.pyelastica_system(problem, 60, (1e4, 10.0), law).rod
    u = np.linspace(0, 6 * np.pi, 61)  # a coil of touching turns
    rod.position_collection[:] = [0.02 * np.cos(u), 1.6e-3 * u, 0.02 * np.sin(u)]
    rod.velocity_collection[:] = np.random.default_rng(0).normal(size=(3, 61))
    rod.compute_internal_forces_and_torques(0.0)
    expected = np.zeros((3, 61))
    _calculate_contact_forces_self_rod(
        rod.position_collection[:, :-1], rod.radius, rod.lengths, rod.tangents,
        rod.velocity_collection, expected, 1e4, 10.0,
    )  # fmt: skip
    rod.external_forces[:] = 0
    law(1e4, 10.0).apply_contact(rod, rod)
    assert np.count_nonzero(expected) > 60
    np.testing.assert_allclose(rod.external_forces, expected, atol=1e-12 * np.abs(expected).max())


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # of newton and warp
def test_dismech_newton_finds_the_bend_and_the_cantilever(swung):
    if importlib.util.find_spec("dismech_newton") is None:
        pytest.skip("dismech-newton is not installed")
    bend = peers.run("dismech-newton", "bend", 40, 0.0)
    if isinstance(bend, peer_problems.CannotRun):
        pytest.skip(bend.reason)
    # of an inextensible rod, from the continuous equations
    np.testing.assert_allclose(bend.positions[-1, -1], [47.151, 15.685, 53.469], atol=0.06)
    found = peer_dismech.run_dismech(shorter(CANTILEVER, 5), 40, 2.5e-3).positions
    moved = np.max(np.abs(swung - swung[0, :1]))
    assert np.max(np.abs(found - swung)) < 1e-2 * moved


@pytest.mark.slow
def test_short_comparison_on_the_stout_rod(tmp_path):
    """The whole path; before contact both codes hold the same twisted rod."""
    pytest.importorskip("elastica")
    import stout_against_pyelastica as stout

    assert stout.main(["--quick", "--out", str(tmp_path)]) == 0
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["finished"] and summary["cpu_ratio"] > 0
    assert set(summary["deviations"]["rodjax"]) == set(stout.COMPARED)
    between = summary["deviations"]["refined runs, of each other"]
    # the torsional waves that the drive starts are in PyElastica's energies only
    assert between["torsion"]["largest"] < 0.02
    assert (tmp_path / "comparison.png").read_bytes()[:4] == b"\x89PNG"
    # a second call finds the runs stored
    before = (tmp_path / "pyelastica_30.npz").stat().st_mtime_ns
    assert stout.main(["--quick", "--out", str(tmp_path)]) == 0
    assert (tmp_path / "pyelastica_30.npz").stat().st_mtime_ns == before


def test_window_means_of_a_series_of_unequal_steps():
    import stout_against_pyelastica as stout

    time = np.sort(np.append(np.random.default_rng(0).uniform(0, 8, 300), [0.0, 8.0]))
    linear = stout.Series(time, *[2 * time] * 7)
    np.testing.assert_allclose(stout.window_means(linear, "writhe", 8.0), [2, 6, 10, 14])
    other = stout.Series(time, *[2 * time + 0.5] * 7)
    found = stout.deviation(other, linear, 8.0)
    assert found["writhe"]["rms"] == pytest.approx(0.5)
    assert found["torsion"]["largest"] == pytest.approx(0.5 / 14)
    stopped = stout.Series(time[:100], *[2 * time[:100]] * 7)
    assert np.isnan(stout.deviation(stopped, linear, 8.0)["writhe"]["rms"])
