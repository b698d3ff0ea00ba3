"""Storage: what comes back is equal bit for bit, and is never half written."""

import dataclasses

import equinox as eqx
import h5py
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_identical, standing_run, switched_scene

from rodjax import storage
from rodjax.constraints import ends
from rodjax.dynamics.run import continued, join_runs
from rodjax.dynamics.step_control import Control, StepControl
from rodjax.equations.generalized_alpha import GeneralizedAlpha
from rodjax.files import run_files, sealed_files
from rodjax.inputs import schedules
from rodjax.inputs.units import Units
from rodjax.interactions import loads
from rodjax.interactions.contact import Contact
from rodjax.interactions.contact_laws import (
    Barrier,
    DampedInversePower,
    DebyeHueckel,
    InversePower,
    LennardJones,
    Penalty,
)
from rodjax.numerics.results import ModelWarning
from rodjax.rods.builders import straight_rod
from rodjax.rods.section import Section
from rodjax.scenes.scene import Scene

METHOD = GeneralizedAlpha(0.7)
CONTROL = StepControl(absolute=1e-4)


@pytest.fixture(scope="module")
def example():
    """A scene, and a run that nobody computed, with the memory of an adaptive one."""
    scene = switched_scene()
    run = standing_run(scene, 12)
    rng = np.random.default_rng(0)
    scattered = {
        name: value + 0.01 * jnp.asarray(rng.normal(size=value.shape))
        for name in ("position", "quaternion", "rate", "acceleration", "auxiliary", "force")
        for value in [getattr(run.states, name)]
    }
    scattered["quaternion"] /= jnp.linalg.norm(scattered["quaternion"], axis=-1, keepdims=True)
    steps = [jnp.asarray(value) for value in (0.1, 1.5, 0.2, 1e-6)]
    memory = Control(*steps, jnp.asarray(2, jnp.int32), *steps[:2])
    values = lambda run: [getattr(run.states, name) for name in scattered]
    run = eqx.tree_at(values, run, list(scattered.values()))
    return scene, dataclasses.replace(run, control=memory)


def test_everything_comes_back(example, tmp_path):
    scene, run = example
    odd = np.array([np.nan, np.inf, -0.0])
    measures = {"writhe": odd, "nested": {"a": (1, 2.5, "x", None)}}
    path = tmp_path / "deeper" / "run.h5"
    storage.save(path, scene, run, method=METHOD, control=CONTROL, measures=measures)
    stored = storage.load(path)
    assert_identical(stored.scene, scene)
    assert_identical(stored.run, run)
    assert_identical(stored.method, METHOD)
    assert_identical(stored.control, CONTROL)
    assert_identical(stored.measures, measures)
    assert stored.schedule is None
    assert stored.steps_done == len(run.times) - 1
    assert stored.units == Units()


RAMP = schedules.PiecewiseLinear([0.0, 3.0], [[0.0, 0.0, 0.0], [0.1, 0.2, -0.0]])
OBJECTS = [
    ends.Free(),
    ends.Pinned(RAMP),
    ends.Clamped(RAMP, ends.Turn((1.0, 1.0, 1.0), schedules.Smooth([0.0, 1.0], [0.0, 1 / 3]))),
    ends.Switched(
        ends.Free(), ends.Switched(ends.Slider((0.1, 0.2, 0.3)), ends.Pinned(), 2.0), 1.0
    ),
    schedules.Constant(jnp.array([1.0, -0.0, 5e-324])),
    schedules.PiecewiseLinearRate([0.0, 0.1], [0.0, 0.7]),
    loads.Gravity((0.0, 0.0, -9.81), fluid_density=1000.0),
    loads.MorisonDrag(1000.0, 0.1, 0.01, current=(0.1, 0.0, 0.0), added_mass_coefficient=1.0),
    loads.LinearDrag(1.0, 2.0),
    loads.PointLoad(-1, force=RAMP, moment=schedules.Constant((0.0, 0.0, 1.0)), follower=True),
    straight_rod(1.0, 4, Section(stiffness=(1.0, 2.0, 3.0), compliance=(0.1, 0.1, 0.0))),
    StepControl(max_step=0.5, first_step=jnp.asarray(0.1)),
    GeneralizedAlpha(0.5, tolerance=1e-9, max_iterations=7),
    *(
        Contact(law, segments=49, cutoff=0.01, aperture=1.0, exclusion=0.05, capacities=(16, 50))
        for law in (
            DampedInversePower(k1=1e-7, k3=1e-6, reference_spacing=1e-3, offset=0.4),
            InversePower(1.0, 3.0),
            LennardJones(1.0, 0.01),
            DebyeHueckel(1.0, 0.01),
            Barrier(1e6),
            Penalty(1e6),
        )
    ),
]


@pytest.mark.parametrize("thing", OBJECTS, ids=lambda thing: type(thing).__name__)
def test_every_class_comes_back(example, tmp_path, thing):
    storage.save(tmp_path / "run.h5", *example, measures={"thing": thing})
    assert_identical(storage.load(tmp_path / "run.h5").measures, {"thing": thing})
    if not isinstance(thing, schedules.AbstractSchedule):  # its unit is that of what it drives
        with h5py.File(tmp_path / "run.h5") as file:
            _assert_units(file["measures"])


def test_single_precision_and_integers_keep_their_type(example, tmp_path):
    single = jax.tree.map(
        lambda x: x.astype(jnp.float32) if x.dtype == jnp.float64 else x, example[1]
    )
    storage.save(tmp_path / "run.h5", example[0], single)
    assert_identical(storage.load(tmp_path / "run.h5").run, single)


def test_double_precision_is_not_lost_silently(example, tmp_path):
    storage.save(tmp_path / "run.h5", *example)
    with jax.enable_x64(False), pytest.raises(storage.StorageError, match="jax_enable_x64"):
        storage.load(tmp_path / "run.h5")


def _assert_units(group):
    bare = []

    def check(name, item):
        full = isinstance(item, h5py.Dataset) and item.attrs["KIND"] != "none"
        if full and not item.attrs.get("units"):
            bare.append(name)

    group.visititems(check)
    assert not bare


def test_datasets_have_clear_names_and_units(example, tmp_path):
    scene, run = example
    units = Units("nm", "us", "fg", "pN")
    measures, measure_units = {"gap": np.ones(len(run.times))}, {"gap": "1"}
    storage.save(tmp_path / "run.h5", scene, run, units=units, measures=measures,
                 measure_units=measure_units)  # fmt: skip
    with h5py.File(tmp_path / "run.h5") as file:
        _assert_units(file)
        states = file["run/states"]
        expected = {
            "time": "us",
            "position": "nm",
            "quaternion": "1",
            "velocity": "nm/us",
            "angular_velocity": "rad/us",
            "curvature": "rad/nm",
            "force": "pN",
            "acceleration": "nm/us^2 and rad/us^2",
            "auxiliary": "nm/us^2 and rad/us^2",
        }
        assert {name: states[name].attrs["units"] for name in expected} == expected
        angle = file["scene/first_end/rotation/angle"]
        assert (angle["values"].attrs["units"], angle["times"].attrs["units"]) == ("rad", "us")
        assert file["scene/first_end/displacement/values"].attrs["units"] == "nm"
        assert file["scene/rod/stiffness"].attrs["units"] == "pN nm^2"
        assert file.attrs["format_version"] == storage.FORMAT_VERSION
        assert file.attrs["rodjax_version"]
        # kappa is not part of a state: it is written for those who read the file without rodjax
        frames = np.asarray(run.states.quaternion)
        relative = frames[-1, 0] @ frames[-1, 1]
        angle = np.linalg.norm(states["curvature"][-1, 0]) * scene.rod.length[0]
        assert np.cos(angle / 2) == pytest.approx(relative, abs=1e-12)
    assert storage.load(tmp_path / "run.h5").units == units


def _load_of(parameters, s, motion):
    return jnp.full((s.shape[0], 6), parameters)


def test_functions_are_asked_for(example, tmp_path):
    path = tmp_path / "run.h5"
    base, run = example
    load = loads.DistributedLoad(_load_of, parameters=jnp.asarray(0.5))
    scene = Scene(base.rod, loads=(*base.loads, load))
    storage.save(path, scene, run)
    with pytest.raises(storage.StorageError, match=r"scene\.loads\[1\]\.function.*_load_of"):
        storage.load(path)
    stored = storage.load(path, functions={"scene.loads[1].function": _load_of})
    assert_identical(stored.scene, scene)


class Wind(loads.AbstractLoad):
    """A user's load."""

    strength: jax.Array

    def wrench(self, rod, motion):
        return jnp.tile(self.strength[None], (rod.elements + 1, 1))


def test_own_classes_are_asked_for(example, tmp_path):
    path = tmp_path / "run.h5"
    scene = Scene(example[0].rod, loads=(Wind(jnp.ones(6)),))
    storage.save(path, scene, example[1])
    with pytest.raises(storage.StorageError, match=r"scene\.loads\[0\].*Wind.*classes="):
        storage.load(path)
    assert_identical(storage.load(path, classes=[Wind]).scene, scene)


def test_unstorable_objects_are_named_and_destroy_nothing(example, tmp_path):
    path = tmp_path / "run.h5"
    storage.save(path, *example)
    before = path.read_bytes()
    with pytest.raises(storage.StorageError, match=r"measures\.what: a set cannot be stored"):
        storage.save(path, *example, measures={"what": {1, 2}})
    assert path.read_bytes() == before
    assert [entry.name for entry in tmp_path.iterdir()] == ["run.h5"]


@pytest.mark.parametrize("where", ["write", "flush"])
def test_interrupted_write_keeps_the_earlier_file(example, tmp_path, monkeypatch, where):
    path = tmp_path / "run.h5"
    storage.save(path, *example, measures={"number": 1})
    before = path.read_bytes()

    def interrupt(*args, **kwargs):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        if where == "flush":
            patch.setattr(sealed_files.os, "fsync", interrupt)
        else:
            patch.setattr(
                run_files, "turns_of_elements", interrupt
            )  # when most of it has been written
        with pytest.raises(KeyboardInterrupt):
            storage.save(path, *example, measures={"number": 2})
    assert path.read_bytes() == before
    assert [entry.name for entry in tmp_path.iterdir()] == ["run.h5"]
    storage.save(path, *example, measures={"number": 2})
    assert storage.load(path).measures == {"number": 2}


def test_other_files_are_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match="nothing.h5"):
        storage.load(tmp_path / "nothing.h5")
    (tmp_path / "text.h5").write_text("not HDF5")
    with pytest.raises(storage.StorageError, match="cut off|not an HDF5 file"):
        storage.load(tmp_path / "text.h5")
    (tmp_path / "text.h5").write_text("not HDF5" * 100)
    with pytest.raises(storage.StorageError, match="not an HDF5 file"):
        storage.load(tmp_path / "text.h5")
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file.attrs["format"] = "something else"
    with (
        pytest.warns(ModelWarning, match="no checksums"),
        pytest.raises(storage.StorageError, match="not written by"),
    ):
        storage.load(tmp_path / "other.h5")


def test_newer_format_is_refused(example, tmp_path):
    storage.save(tmp_path / "run.h5", *example)
    with h5py.File(tmp_path / "run.h5", "r+") as file:
        file.attrs["format_version"] = storage.FORMAT_VERSION + 1
    sealed_files.seal(tmp_path / "run.h5")
    with pytest.raises(storage.StorageError, match="reads up to"):
        storage.load(tmp_path / "run.h5")


def test_runs_that_overlap_are_not_joined(example):
    scene, whole = example
    with pytest.raises(ValueError, match=r"parts: .*continued\(run, rest\)"):
        join_runs(whole.state(0), [whole, whole])
    with pytest.raises(ValueError, match="parts: there is none"):
        join_runs(whole.state(0), [])
    shifted = eqx.tree_at(lambda run: run.states.position, whole, whole.states.position + 1e-12)
    with pytest.raises(ValueError, match="rest: it does not begin from a state of run"):
        continued(whole, shifted)
