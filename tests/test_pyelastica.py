"""Motions as PyElastica's callbacks collect them: what was told and what comes back of it."""

import os
import pickle
from collections import defaultdict

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import UNIT_SECTION, order_of, standing_run
from scipy.spatial.transform import Rotation

import rodjax as rx
from rodjax.exchange.node_frames import node_frames
from rodjax.rods.strains import curvature, element_quaternions


def rotations_of(quaternions):
    """All of them in one row."""
    return Rotation.from_quat(quaternions.reshape(-1, 4), scalar_first=True)


def bent_run(elements):
    """Four states of a rod that bends about both axes and twists more and more."""
    section = rx.Section((1.0, 1.3, 0.8), 1.0, diameter=0.1, compliance=(1e-3, 1e-3, 1e-4))
    scene = rx.Scene(rx.straight_rod(1.0, elements, section))
    made = standing_run(scene, 3)
    s, t = np.linspace(0, 1, elements + 1), np.asarray(made.times)[:, None]
    turns = [Rotation.from_rotvec(np.stack([3 * t * s**2, 4 * t * np.sin(3 * s), 0 * t * s], -1)[i])
             * Rotation.from_rotvec(np.outer(5 * np.sin(2 * s) * t[i], [0, 0, 1.0]))
             for i in range(4)]  # fmt: skip
    frames = jnp.asarray(np.stack([turn.as_quat(scalar_first=True) for turn in turns]))
    halfway = np.stack([np.asarray(element_quaternions(one)) for one in frames])
    tangent = rotations_of(halfway).as_matrix()[:, :, 2].reshape(4, elements, 3)
    steps = 1.01 * tangent * np.asarray(scene.rod.length)[:, None]  # stretched by a hundredth
    position = np.concatenate([np.zeros((4, 1, 3)), np.cumsum(steps, 1)], 1)
    where = lambda run: (run.states.position, run.states.quaternion, run.states.rate)
    rate = made.states.rate.at[..., :3].set(0.1 * jnp.asarray(position)).at[..., 3:].set(0.5)
    return scene, eqx.tree_at(where, made, (jnp.asarray(position), frames, rate)), section


def as_collected(scene, run):
    """The dictionary of lists that a callback would have filled of this run."""
    data = defaultdict(list)
    for i, time in enumerate(np.asarray(run.times)):
        state = run.state(i)
        frames = np.asarray(element_quaternions(state.quaternion))
        matrices = rotations_of(frames).as_matrix()
        data["time"].append(time)
        data["step"].append(i)
        data["position"].append(np.asarray(state.position).T)
        data["directors"].append(np.moveaxis(np.swapaxes(matrices, 1, 2), 0, -1))
        data["velocity"].append(np.asarray(state.velocity).T)
        data["omega"].append(np.asarray(state.angular_velocity)[:-1].T)
        edges = np.linalg.norm(np.diff(state.position, axis=0), axis=1)
        data["lengths"].append(edges)
        data["dilatation"].append(edges / np.asarray(scene.rod.length))
        data["radius"].append(0.5 * np.asarray(scene.rod.diameter))
    return data


@pytest.fixture(scope="module")
def told():
    return bent_run(48)


@pytest.fixture(scope="module")
def motion(told):
    scene, run, section = told
    return rx.from_pyelastica(as_collected(scene, run), section)


def test_a_motion_comes_back(told, motion):
    scene, run, _ = told
    back = motion.run.states
    for name in ("time", "position", "velocity"):
        np.testing.assert_allclose(getattr(back, name), getattr(run.states, name), atol=1e-14)
    np.testing.assert_allclose(back.angular_velocity, 0.5, rtol=1e-14)
    np.testing.assert_allclose(motion.scene.rod.length, scene.rod.length, rtol=1e-12)
    np.testing.assert_allclose(motion.scene.rod.diameter, 0.1)
    same = np.abs(np.sum(np.asarray(back.quaternion) * np.asarray(run.states.quaternion), -1))
    np.testing.assert_allclose(same, 1.0, atol=1e-9)
    for i in range(4):
        found = curvature(motion.scene.rod, back.quaternion[i])
        np.testing.assert_allclose(found, curvature(scene.rod, run.states.quaternion[i]), atol=4e-3)
    # stretched by 0.01 = f3/EA
    np.testing.assert_allclose(back.force[..., 2], 0.01 / 1e-4, rtol=1e-6)
    assert motion.report == () and repr(motion) == "Motion(4 states of 48 elements)"


def test_frames_come_back_to_fourth_order():
    errors = []
    for elements in (12, 24, 48):
        _, run, _ = bent_run(elements)
        quaternion = np.asarray(run.states.quaternion)
        halfway = np.stack([np.asarray(element_quaternions(jnp.asarray(q))) for q in quaternion])
        found = node_frames(halfway, np.full(elements, 1 / elements))
        off = rotations_of(found).inv() * rotations_of(quaternion)
        errors.append(np.max(off.magnitude()))
        assert np.all(np.sum(found[:, 1:] * found[:, :-1], -1) > 0)
    assert order_of([1 / 12, 1 / 24, 1 / 48], errors) > 3.5
    assert errors[-1] < 2e-5


def test_it_is_shown_measured_and_written(told, motion, tmp_path):
    _, run, _ = told
    page = rx.view(motion, colour="tension")
    assert page.frames == 4
    found = rx.measures.linking(motion.scene, motion.run)
    expected = rx.measures.linking(told[0], run)
    np.testing.assert_allclose(found.twist, expected.twist, atol=1e-4)
    np.testing.assert_allclose(found.writhe, expected.writhe, atol=1e-4)
    assert rx.to_csv(motion, None, tmp_path / "run.csv").exists()


def test_files_and_pieces_are_read(told, motion, tmp_path):
    scene, run, section = told
    data = as_collected(scene, run)
    arrays = {name: np.array(value) for name, value in data.items()}
    np.savez(tmp_path / "rod_00.npz", **{name: value[:2] for name, value in arrays.items()})
    (tmp_path / "rod_01.pkl").write_bytes(pickle.dumps({k: v[2:] for k, v in data.items()}))
    (tmp_path / "whole.pkl").write_bytes(pickle.dumps(data))
    for source in ([tmp_path / "rod_00.npz", tmp_path / "rod_01.pkl"], tmp_path / "whole.pkl"):
        back = rx.from_pyelastica(source, section).run
        np.testing.assert_array_equal(back.states.position, motion.run.states.position)
    (tmp_path / "bad.pkl").write_bytes(pickle.dumps({"time": os.system}))
    with pytest.raises(ValueError, match="holds a posix.system; only dictionaries of arrays"):
        rx.from_pyelastica(tmp_path / "bad.pkl")
    with pytest.raises(ValueError, match="ends in .npz or .pkl"):
        rx.from_pyelastica(tmp_path / "rod.h5")


def test_what_was_not_collected_is_told(told):
    scene, run, _ = told
    data = {name: as_collected(scene, run)[name] for name in ("time", "position", "directors")}
    with pytest.warns(rx.ModelWarning, match="section: what PyElastica's callbacks collect holds"):
        motion = rx.from_pyelastica(data, stress_free=True)
    assert [line.split(":")[0] for line in motion.report] == [
        "rest lengths", "stiffness and mass", "velocity and omega", "forces",
    ]  # fmt: skip
    assert str(motion).count("\n") == 4
    assert motion.scene.rod.diameter is None
    # of the first state, which is straight and stretched by a hundredth
    np.testing.assert_allclose(motion.scene.rod.length, 1.01 / 48)
    np.testing.assert_allclose(motion.scene.rod.natural_curvature, 0.0, atol=1e-9)
    assert np.all(np.isnan(motion.run.states.velocity))
    assert np.all(np.isfinite(rx.measures.linking(motion.scene, motion.run).writhe))
    with pytest.warns(rx.ModelWarning, match="section"):
        longer = rx.from_pyelastica(data, rest_lengths=np.full(48, 0.02))
    np.testing.assert_allclose(longer.scene.rod.length, 0.02)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: {"rod": d}, "lacks time and position and directors; give one of 'rod'"),
        (lambda d: {"time": d["time"]}, "lacks position and directors; it has 'time'"),
        (lambda d: d | {"directors": np.moveaxis(d["directors"], 0, -1)}, "directors must have"),
        (lambda d: d | {"position": d["position"][..., 1:]}, "closed rod"),
        (lambda d: d | {"velocity": d["velocity"][..., 2:]}, r"velocity must have shape \(4, 3"),
        (lambda d: d | {"directors": 2 * d["directors"]}, "no right-handed frames"),
        (lambda d: d | {"directors": np.roll(d["directors"], 1, 1)}, "third rows"),
        (lambda d: d | {"position": d["position"] * [[[1]], [[1]], [[np.nan]], [[1]]]}, "t = 0.2"),
        (lambda d: 3.0, "give the dictionary"),
    ],
)
def test_what_does_not_fit_is_refused(told, change, message, unchecked):
    scene, run, section = told
    arrays = {name: np.array(value) for name, value in as_collected(scene, run).items()}
    with pytest.raises(ValueError, match=message):
        rx.from_pyelastica(change(arrays), UNIT_SECTION)
