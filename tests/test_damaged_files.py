"""Files that are damaged or cut off, and what is not written: the same data or one StorageError."""

import os
import shutil
import types

import h5py
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_identical
from stored_runs import SECTION, stored_run

from rodjax import storage
from rodjax.files.plain_trees import read_images
from rodjax.files.sealed_files import HEADER_SIZE, StorageError, replacing, seal
from rodjax.numerics.results import ModelWarning
from rodjax.rods.builders import straight_rod
from rodjax.scenes.scene import Scene

pytestmark = pytest.mark.usefixtures("unchecked")


@pytest.fixture(scope="module")
def base(tmp_path_factory):
    return stored_run(tmp_path_factory.mktemp("files") / "base.h5")


def test_no_changed_byte_goes_unseen(base, tmp_path):
    """Every place in the header, and places all over the rest."""
    whole = base[0].read_bytes()
    path = tmp_path / "changed.h5"
    rng = np.random.default_rng(1)
    places = [*range(120), HEADER_SIZE - 1, *rng.integers(HEADER_SIZE, len(whole), 150)]
    for place in places:
        changed = bytearray(whole)
        changed[place] ^= 1 << int(rng.integers(8))
        path.write_bytes(changed)
        with pytest.raises(StorageError, match="damaged|cut off"):
            storage.load(path)


def test_truncated_files_are_told_from_damaged_ones(base, tmp_path):
    whole = base[0].read_bytes()
    path = tmp_path / "cut.h5"
    for size in (1, 7, 8, 100, HEADER_SIZE, HEADER_SIZE + 8, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:size])
        with pytest.raises(StorageError, match="cut off|not an HDF5 file"):
            storage.load(path)
    path.write_bytes(b"")
    with pytest.raises(StorageError, match="0 bytes"):
        storage.load(path)


def test_what_stands_behind_the_end_is_not_ignored(base, tmp_path):
    path = tmp_path / "longer.h5"
    path.write_bytes(base[0].read_bytes() + bytes(1000))
    with pytest.raises(StorageError, match="damaged"):
        storage.load(path)


def test_chunks_carry_the_checksum_of_hdf5(base):
    def check(_, item):
        if isinstance(item, h5py.Dataset) and item.ndim:
            assert item.fletcher32

    with h5py.File(base[0]) as file:
        file.visititems(check)
        assert file["run/states/position"].shape == (5, 9, 3)


def _without_seal(path):
    """The file as rodjax wrote it before format 2: HDF5 alone."""
    data = path.read_bytes()[HEADER_SIZE:]
    path.write_bytes(data)
    # addresses of HDF5 count from the end of the user block
    with h5py.File(path, "r+") as file:
        file.attrs["format_version"] = 1

        def older(_, item):
            for name in ("FIELDS", "KEYS"):
                if name in item.attrs:
                    del item.attrs[name]

        file.visititems(older)
        file["measures"].attrs["KEYS"] = ["gap"]


def test_files_of_format_1_are_read_with_a_word(base, tmp_path):
    path = tmp_path / "old.h5"
    shutil.copy(base[0], path)
    _without_seal(path)
    with pytest.warns(ModelWarning, match="no checksums"):
        stored = storage.load(path)
    assert_identical(
        (stored.scene, stored.run, stored.measures),
        (base[1].scene, base[1].run, base[1].measures),
    )


def test_other_things_in_a_file_do_not_matter(base, tmp_path):
    """Notes, links and pictures that somebody added, and that nobody asks for."""
    path = tmp_path / "notes.h5"
    shutil.copy(base[0], path)
    with h5py.File(path, "r+") as file:
        file["notes"] = ["of the experimenter"]
        file["elsewhere"] = h5py.ExternalLink("other.h5", "/")
        file.attrs["authors"] = ["one", "two"]
    seal(path)
    assert_identical(storage.load(path).scene, base[1].scene)


def test_places_that_cannot_be_written_or_read_are_named(base, tmp_path):
    _, stored = base
    run, scene = stored.run, stored.scene
    for wrong, message in {
        tmp_path: "is a folder",
        tmp_path / "run.csv": "only HDF5 .* not .csv",
        tmp_path / "run.npz": "only HDF5 .* not .npz",
        str(tmp_path / "run.json"): "only HDF5 .* not .json",
        base[0] / "below.h5": "cannot be written",
        "/proc/run.h5": "cannot be written",
    }.items():
        with pytest.raises(StorageError, match=f"path: .*{message}"):
            storage.save(wrong, scene, run)
    with pytest.raises(StorageError, match="path: .* a Scene"):
        storage.save(scene, run, tmp_path / "run.h5")
    with pytest.raises(StorageError, match="run: .* not a PosixPath"):
        storage.save(tmp_path / "run.h5", scene, tmp_path)
    with pytest.raises(StorageError, match="scene: .* not a Run"):
        storage.save(tmp_path / "run.h5", run, scene)
    with pytest.raises(StorageError, match="measure_units: 'gap'"):
        storage.save(tmp_path / "run.h5", scene, run, measure_units={"gap": "1"})
    with pytest.raises(StorageError, match="is a folder"):
        storage.load(tmp_path)
    with pytest.raises(StorageError, match="classes: "):
        storage.load(base[0], classes=[int])
    assert list(tmp_path.iterdir()) == []


def test_what_a_link_points_to_is_replaced(base, tmp_path):
    stored = base[1]
    target, link = tmp_path / "there" / "run.h5", tmp_path / "run.h5"
    target.parent.mkdir()
    target.write_bytes(b"earlier")
    link.symlink_to(target)
    storage.save(link, stored.scene, stored.run)
    assert link.is_symlink()
    assert_identical(storage.load(target).scene, stored.scene)


def test_two_threads_may_save_to_one_path(tmp_path):
    path = tmp_path / "run.h5"
    with replacing(path) as first, replacing(path) as second:
        first["one"], second["two"] = 1, 2
    # the last to end is the one that stays
    assert list(read_images(path)[0][0].children) == ["one"]
    assert list(tmp_path.iterdir()) == [path]


def test_systems_that_sync_no_folder_and_only_what_is_written(tmp_path, monkeypatch):
    """As Windows does."""

    fcntl = pytest.importorskip("fcntl")

    def fsync(descriptor):
        if fcntl.fcntl(descriptor, fcntl.F_GETFL) & os.O_ACCMODE == os.O_RDONLY:
            raise OSError(9, "Bad file descriptor")

    def refuse(*_):
        raise PermissionError(13, "Permission denied")

    system = {**vars(os), "name": "nt", "fsync": fsync, "open": refuse}
    monkeypatch.setattr("rodjax.files.sealed_files.os", types.SimpleNamespace(**system))
    with replacing(tmp_path / "run.h5") as file:
        file["one"] = 1
    assert list(read_images(tmp_path / "run.h5")[0][0].children) == ["one"]


UNSTORABLE = {
    "set": ({1, 2}, "a set cannot"),
    "huge integer": (2**70, "too large an integer"),
    "zero byte": ("a\0b", "this text cannot"),
    "lone surrogate": ("\ud800", "this text cannot"),
    "objects": (np.array([None]), "an array of object"),
    "text array": (np.array(["x"]), "an array of <U1"),
    "long double": (np.ones(2, np.longdouble), "an array of float128"),
    "bfloat16": (jnp.ones(2, jnp.bfloat16), "an array of bfloat16"),
    "dates": (np.array(["2020"], "M8[Y]"), "an array of datetime64"),
    "complex number": (1j, "a complex cannot"),
    "reserved name": ({"KIND": 1}, "cannot be a name"),
    "path as name": ({"a/b": 1}, "cannot be a name"),
}


@pytest.mark.parametrize("name", UNSTORABLE)
def test_what_would_not_come_back_is_not_written(base, tmp_path, name):
    value, message = UNSTORABLE[name]
    with pytest.raises(StorageError, match=f"measures.x.*{message}"):
        storage.save(tmp_path / "r.h5", base[1].scene, base[1].run, measures={"x": value})
    assert list(tmp_path.iterdir()) == []


def test_runs_that_are_not_of_the_scene_are_not_written(base, tmp_path):
    _, stored = base
    other = Scene(straight_rod(1.0, 6, SECTION))
    with pytest.raises(StorageError, match="of 6 elements"):
        storage.save(tmp_path / "r.h5", other, stored.run)
