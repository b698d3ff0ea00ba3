"""Files that somebody made to do harm, or edited: one StorageError, before anything is done."""

import shutil
import struct

import h5py
import numpy as np
import pytest
from helpers import assert_identical
from stored_runs import stored_run

from rodjax import storage
from rodjax.files.sealed_files import StorageError, seal

pytestmark = pytest.mark.usefixtures("unchecked")


@pytest.fixture(scope="module")
def base(tmp_path_factory):
    return stored_run(tmp_path_factory.mktemp("files") / "base.h5")


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
