"""Files that are damaged, cut off, or come from a stranger: the same data or one StorageError."""

import os
import shutil
import struct
import types

import h5py
import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest
from helpers import assert_identical, standing_run

from rodjax import storage
from rodjax.constraints import ends
from rodjax.files.plain_trees import read_images
from rodjax.files.sealed_files import HEADER_SIZE, StorageError, replacing, seal
from rodjax.interactions.contact import Contact
from rodjax.interactions.contact_laws import Barrier
from rodjax.interactions.loads import Gravity, LinearDrag
from rodjax.numerics.results import ModelWarning
from rodjax.rods.builders import straight_rod
from rodjax.rods.section import Section
from rodjax.scenes.scene import Scene

SECTION = Section((1.0, 1.0, 0.8), mass=1.0, rotary_inertia=(1e-3, 1e-3, 2e-3), diameter=0.02)


@pytest.fixture(autouse=True)
def own_checks():
    """The package's own checks, not those that the tests put around its functions."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


@pytest.fixture(scope="module")
def base(tmp_path_factory):
    """A stored run that was never computed, and its file."""
    rod = straight_rod(1.0, 8, SECTION)
    contact = Contact(Barrier(1e6), segments=8, cutoff=0.05)
    held = ends.Switched(ends.Free(), ends.Clamped(), 0.4)
    loads = (LinearDrag(1.0, 1.0, 0.1), Gravity((0.0, 0.0, -1.0)))
    scene = Scene(rod, ends.Clamped(), held, loads, contact)
    path = tmp_path_factory.mktemp("files") / "base.h5"
    storage.save(path, scene, standing_run(scene, 4), measures={"gap": np.arange(5.0)})
    return path, storage.load(path)


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


def replace(file, name, data=None, kind="jax", **how):
    """Another dataset in the place of one."""
    del file[name]
    new = file.create_dataset(name, data=data, **how)
    new.attrs.update(KIND=kind, weak_type=False)
    return new


DIAMETER = "scene/rod/diameter"


def link_to_itself(file):
    del file["scene/loads"]
    file["scene"]["loads"] = h5py.SoftLink("/scene/loads")


def group_within_itself(file):
    group = file["scene/loads"]
    for name in list(group):
        del group[name]
    group.attrs["LENGTH"] = 1
    group["0"] = group


def whole_file_within_itself(file):
    del file["scene/loads/0"]
    file["scene/loads/0"] = file["/"]


def tuples_of_each_other(file):
    """Written out in full they would have 2^44 entries."""
    del file["scene/loads"]
    inner = file.create_group("x0")
    inner.attrs.update(KIND="tuple", LENGTH=0)
    for i in range(1, 45):
        outer = file.create_group(f"x{i}")
        outer.attrs.update(KIND="tuple", LENGTH=2)
        outer["0"] = outer["1"] = inner
        inner = outer
    file["scene/loads"] = inner


def deep_tuples(file):
    group = file["scene"]
    del group["loads"]
    name = "loads"
    for _ in range(100):
        group = group.create_group(name)
        group.attrs.update(KIND="tuple", LENGTH=1)
        name = "0"


def external_link(file):
    del file["run"]
    file["run"] = h5py.ExternalLink("base.h5", "/run")


def external_data(file):
    secret = ("secret.bin", 0, 64)
    replace(file, DIAMETER, shape=(8,), dtype="f8", external=[secret])


def virtual_data(file):
    layout = h5py.VirtualLayout(shape=(8,), dtype="f8")
    layout[:] = h5py.VirtualSource("base.h5", DIAMETER, shape=(8,))
    del file[DIAMETER]
    made = file.create_virtual_dataset(DIAMETER, layout)
    made.attrs.update(KIND="jax", weak_type=False)


def object_pointers(file):
    """An opaque type whose tag makes h5py read raw pointers to Python objects."""
    opaque = h5py.h5t.create(h5py.h5t.OPAQUE, 8)
    opaque.set_tag(b"NUMPY:|O")
    del file["measures/gap"]
    space = h5py.h5s.create_simple((4,))
    data = h5py.h5d.create(file["measures"].id, b"gap", opaque, space)
    h5py.Dataset(data).attrs.update(KIND="numpy", weak_type=False)


def unpacks_to_gigabytes(file):
    new = replace(
        file, DIAMETER, shape=(25 * 10**7,), dtype="f8", chunks=(1 << 20,), compression="gzip",
        fillvalue=1.0,
    )  # fmt: skip
    new[:1] = 1.0


def packed(file):
    """HDF5's inflate goes on to the end of the stream, whatever the size of the chunk."""
    replace(file, DIAMETER, np.ones(8), compression="gzip")


def a_chunk_beyond_the_memory(file):
    """One value, in a chunk of 128 MiB: reading a value reads its chunk."""
    replace(
        file, DIAMETER, shape=(1,), maxshape=(None,), dtype="f8", chunks=(1 << 24,), fletcher32=True
    )


def references(file):
    replace(file, DIAMETER, np.array([file["scene"].ref] * 8, dtype=h5py.ref_dtype))


def attributes(place, **values):
    """A case that changes attributes."""
    return lambda file: file[place].attrs.update(values)


def number(place, value):
    """A case that changes all numbers of a dataset."""

    def change(file):
        file[place][...] = value

    return change


def without(place):
    """A case that leaves something out."""

    def change(file):
        del file[place]

    return change


def other_array(value, place=DIAMETER, kind="jax"):
    """A case with another array."""
    return lambda file: replace(file, place, value, kind)


def cut_states(file):
    replace(file, "run/states/position", file["run/states/position"][:-2])


HOSTILE = {
    "class of another module": attributes("scene", MODULE="os", CLASS="system"),
    "module to import": attributes("scene", MODULE="evil_module", CLASS="Scene2"),
    "no class": attributes("scene", MODULE="rodjax.files.storage", CLASS="np"),
    "end as rod": attributes("scene/rod", MODULE="rodjax.ends", CLASS="Free"),
    "load as end": attributes("scene/first_end", MODULE="rodjax.loads", CLASS="Gravity"),
    "rod as run": attributes("run", MODULE="rodjax.rod", CLASS="Rod"),
    "control as method": attributes("method", KIND="record", MODULE="rodjax", CLASS="Control"),
    "law as contact": attributes("scene/contact", MODULE="rodjax.contact_laws", CLASS="Barrier"),
    "link to itself": link_to_itself,
    "group within itself": group_within_itself,
    "file within itself": whole_file_within_itself,
    "tuples of each other": tuples_of_each_other,
    "deep tuples": deep_tuples,
    "external link": external_link,
    "external data": external_data,
    "virtual data": virtual_data,
    "object pointers": object_pointers,
    "unpacks to gigabytes": unpacks_to_gigabytes,
    "packed": packed,
    "a chunk beyond the memory": a_chunk_beyond_the_memory,
    "16 GB never written": lambda file: replace(
        file, DIAMETER, shape=(2 * 10**9,), dtype="f8", chunks=(1 << 20,)
    ),
    "73 TiB": lambda file: replace(file, DIAMETER, shape=(10**13,), dtype="f8", chunks=(1024,)),
    "references": references,
    "pickle": other_array(np.void(b"\x80\x04N."), "measures/gap", "numpy"),
    "text for numbers": other_array(["a"] * 8, kind="numpy"),
    "wrong shape": other_array(np.ones(3)),
    "scalar for array": other_array(1.0),
    "complex": other_array(np.ones(8, complex)),
    "truth values": other_array(np.ones(8, bool)),
    "half precision": other_array(np.ones(8, np.float16)),
    "single precision": other_array(np.ones(8, np.float32)),
    "long double": other_array(np.ones(8, np.longdouble)),
    "integers": other_array(np.ones(8, int)),
    "negative": number("scene/rod/stiffness", -1.0),
    "not a number": number("scene/rod/stiffness", np.nan),
    "without length": number("scene/rod/length", 0.0),
    "frames of no length": number("scene/rod/quaternion", 0.0),
    "method out of range": number("scene/contact/cutoff", -1.0),
    "code that is none": number("run/result", 77),
    "many loads": attributes("scene/loads", LENGTH=10**15),
    "negative loads": attributes("scene/loads", LENGTH=-3),
    "no loads": attributes("scene/loads", LENGTH=0),
    "loads by text": attributes("scene/loads", LENGTH="two"),
    "a load less": without("scene/loads/1"),
    "no run": without("run"),
    "no rod": without("scene/rod"),
    "no contact": without("scene/contact"),
    "no velocity": without("run/states/velocity"),
    "no reports": without("run/infos/iterations"),
    "fewer positions": cut_states,
    "unknown kind": attributes(DIAMETER, KIND="pickle"),
    "keys of elsewhere": attributes("measures", KEYS='["/scene", "../run"]'),
    "keys that are none": attributes("measures", KEYS="["),
    "no version": lambda file: file.attrs.__delitem__("format_version"),
    "text as version": attributes("/", format_version="abc"),
    "version 0": attributes("/", format_version=0),
    "version of tomorrow": attributes("/", format_version=storage.FORMAT_VERSION + 1),
    "no units": lambda file: file.attrs.__delitem__("unit_of_length"),
    "numbers as units": attributes("/", unit_of_length=1.0),
    "another format": attributes("/", format="rodjax sweep"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_a_strangers_file_is_refused(base, tmp_path, name):
    """Though it was given a seal of its own; without one it counts as edited anyhow."""
    (tmp_path / "secret.bin").write_bytes(struct.pack("8d", *range(8)))
    shutil.copy(base[0], tmp_path / "base.h5")
    path = tmp_path / "hostile.h5"
    shutil.copy(base[0], path)
    with h5py.File(path, "r+") as file:
        HOSTILE[name](file)
    with pytest.raises(StorageError, match="damaged|cut off"):
        storage.load(path)
    seal(path)
    with pytest.raises(StorageError, match="^(?!.*its bytes are not)"):
        storage.load(path)


def test_other_byte_orders_are_the_same_numbers(base, tmp_path):
    path = tmp_path / "big.h5"
    shutil.copy(base[0], path)
    with h5py.File(path, "r+") as file:
        replace(file, DIAMETER, file[DIAMETER][...].astype(">f8"))
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
