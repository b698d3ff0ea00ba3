"""Sweeps: shares, resumption, failures, and several processes."""

import os
import socket
import subprocess
import sys
import textwrap
from pathlib import Path

import h5py
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rodjax
from rodjax.files.fingerprint import fingerprint
from rodjax.files.sealed_files import StorageError
from rodjax.files.sweep import read, sweep
from rodjax.numerics.batching import largest

PLACES = [str(Path(file).parents[i]) for file, i in ((__file__, 0), (rodjax.__file__, 1))]
PARAMETERS = {"a": np.arange(7.0), "b": np.linspace(-1.0, 1.0, 7)[:, None] * np.ones(2)}


def function(p):
    root = jnp.sqrt(p["a"] - 1.0)  # not a number for the first set
    return {"root": root, "sum": jnp.sum(p["b"]) + p["a"], "failed": jnp.isnan(root)}


def check(found):
    np.testing.assert_allclose(found["sum"], PARAMETERS["a"] + PARAMETERS["b"].sum(1))
    np.testing.assert_allclose(found["root"][1:], np.sqrt(PARAMETERS["a"][1:] - 1))
    np.testing.assert_array_equal(found["failed"], [True] + 6 * [False])


def test_all_sets_are_evaluated_and_a_failure_spoils_no_other(tmp_path):
    rounds = []
    path = tmp_path / "sweep.h5"
    report = lambda done, total: rounds.append((done, total))
    check(sweep(function, PARAMETERS, path, per_device=3, progress=report))
    assert rounds == [(3, 7), (6, 7), (7, 7)]
    with h5py.File(path) as file:
        np.testing.assert_array_equal(file["parameters/b"], PARAMETERS["b"])
        assert np.all(file["done"])


def test_an_interrupted_sweep_continues_where_it_stopped(tmp_path):
    path, evaluated = tmp_path / "sweep.h5", []

    def stop(done, _):
        if done == 4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        sweep(function, PARAMETERS, path, per_device=2, progress=stop)

    def watched(p):
        jax.debug.callback(lambda a: evaluated.append(float(a)), p["a"])
        return function(p)

    check(sweep(watched, PARAMETERS, path, per_device=2))
    jax.effects_barrier()
    assert set(evaluated) == {4.0, 5.0, 6.0}
    evaluated.clear()
    check(sweep(watched, PARAMETERS, path))
    jax.effects_barrier()
    assert not evaluated


def test_bad_input_is_named(tmp_path):
    path = tmp_path / "sweep.h5"
    sweep(function, PARAMETERS, path)
    with pytest.raises(StorageError, match="values of the parameter a are other ones"):
        sweep(function, PARAMETERS | {"a": np.arange(7.0) + 1}, path)
    other = tmp_path / "other.h5"
    for wrong, message in {
        "parameters: every array.*a \\(3,\\), b \\(4,\\)": {
            "a": np.arange(3.0),
            "b": np.arange(4.0),
        },
        "parameters: every array.*no array": {},
        "parameters: 'a' must be numbers": {"a": np.array(["x", "y"])},
        "parameters: for the keys 'k'": {"k": jax.random.split(jax.random.key(0), 3)},
        "parameters: 'a.0' cannot be the name": {"a.0": np.ones(2), "a": [np.ones(2)]},
    }.items():
        with pytest.raises(ValueError, match=wrong):
            sweep(function, message, other)
    one = {"a": np.arange(3.0)}
    for wrong, message in {
        "function: must return a dictionary": lambda p: p["a"],
        "function: its result 'y' must be an array": lambda p: {"y": {"z": p["a"]}},
        "function: 'y/z' cannot be the name": lambda p: {"y/z": p["a"]},
    }.items():
        with pytest.raises(ValueError, match=wrong):
            sweep(message, one, other)
    for name, wrong in {"per_device": 0, "units": {"c": "m"}, "dimensions": {"y": ["s"]}}.items():
        with pytest.raises(ValueError, match=f"{name}: "):
            sweep(lambda p: {"y": p["a"]}, one, other, **{name: wrong})
    with pytest.raises(StorageError, match="path: only HDF5 is written"):
        sweep(function, PARAMETERS, tmp_path / "sweep.csv")
    assert [entry.name for entry in tmp_path.iterdir()] == ["sweep.h5"]


def scaled(factor, name="y"):
    """A function that closes over a constant."""
    return lambda p: {name: factor * p["a"] + p["b"][0] - p["b"][0]}


def called_back(factor):
    """The same, its constant behind a callback that JAX does not look into."""
    shape = jax.ShapeDtypeStruct((), jnp.result_type(float))
    call = lambda a: np.asarray(factor * a)
    return lambda p: {"y": jax.pure_callback(call, shape, p["a"], vmap_method="sequential")}


SWAPPED = {"a": PARAMETERS["b"], "b": PARAMETERS["a"]}
OTHERS = {
    "another constant": (scaled(2.0), PARAMETERS, "computes something else"),
    "another array of constants": (scaled(np.full(2, 1.0)), PARAMETERS, "result y has shape"),
    "other operations": (lambda p: {"y": p["a"] ** 2}, PARAMETERS, "computes something else"),
    "a result more": (
        lambda p: scaled(1.0)(p) | {"z": p["a"]},
        PARAMETERS,
        "results are named y, not y, z",
    ),
    "another name of the result": (scaled(1.0, "z"), PARAMETERS, "results are named y, not z"),
    "another type of the result": (
        lambda p: {"y": p["a"].astype(jnp.float32)},
        PARAMETERS,
        "precision float64, not float32",
    ),
    "parameters under each other's name": (
        lambda p: {"y": p["b"]},
        SWAPPED,
        "values of the parameter a are other ones",
    ),
    "another name of a parameter": (
        lambda p: {"y": p["c"]},
        {"c": PARAMETERS["a"], "b": PARAMETERS["b"]},
        "parameters are named a, b, not b, c",
    ),
    "parameters rounded": (
        scaled(1.0),
        {k: v.astype(np.float32) for k, v in PARAMETERS.items()},
        "values of the parameter a",
    ),
    "a set less": (scaled(1.0), {k: v[:6] for k, v in PARAMETERS.items()}, "values of the param"),
}


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """The file of a finished sweep."""
    path = tmp_path_factory.mktemp("sweep") / "sweep.h5"
    sweep(scaled(1.0), PARAMETERS, path, units={"y": "N", "a": "m"})
    return path


@pytest.mark.parametrize("other", OTHERS)
def test_results_of_another_sweep_are_refused(finished, other):
    function, parameters, message = OTHERS[other]
    before = finished.read_bytes()
    with pytest.raises(StorageError, match=message):
        sweep(function, parameters, finished)
    assert finished.read_bytes() == before


def test_the_same_sweep_is_recognised_whatever_its_batches_and_names(finished):
    again = lambda given: {"y": 1.0 * given["a"] + given["b"][0] - given["b"][0]}
    found = sweep(again, PARAMETERS, finished, per_device=1, units={"y": "N"})
    np.testing.assert_array_equal(found["y"], PARAMETERS["a"])


def test_precision_versions_and_units_are_compared(finished, monkeypatch):
    with jax.enable_x64(False), pytest.raises(StorageError, match="traced as float64, not float32"):
        sweep(scaled(1.0), PARAMETERS, finished)
    with pytest.raises(StorageError, match="units of y are N, not kN"):
        sweep(scaled(1.0), PARAMETERS, finished, units={"y": "kN"})
    monkeypatch.setattr(jax, "__version__", "9.9")
    with pytest.raises(StorageError, match="made by jax .*, not 9.9"):
        sweep(scaled(1.0), PARAMETERS, finished)


def test_constants_of_callbacks_count(tmp_path):
    path, parameters = tmp_path / "sweep.h5", {"a": np.arange(3.0)}
    np.testing.assert_array_equal(sweep(called_back(2.0), parameters, path)["y"], [0, 2, 4])
    np.testing.assert_array_equal(sweep(called_back(2.0), parameters, path)["y"], [0, 2, 4])
    with pytest.raises(StorageError, match="computes something else"):
        sweep(called_back(3.0), parameters, path)


def test_fingerprints_are_the_same_in_another_process():
    """Whatever the addresses, and the order in which strings hash."""
    code = """
        import jax, os, sys
        jax.config.update("jax_enable_x64", True)
        sys.path[:0] = sys.argv[1:]
        from test_sweep import called_back, function, PARAMETERS
        from rodjax.files.fingerprint import fingerprint
        one = {name: value[0] for name, value in PARAMETERS.items()}
        for f in (function, called_back(2.0)):
            print(fingerprint(jax.make_jaxpr(f)(one)))
    """
    command = [sys.executable, "-c", textwrap.dedent(code), *PLACES]
    said = subprocess.run(command, capture_output=True, text=True, env=os.environ, check=True)
    one = {name: value[0] for name, value in PARAMETERS.items()}
    expected = [fingerprint(jax.make_jaxpr(f)(one)) for f in (function, called_back(2.0))]
    assert said.stdout.split() == expected
    assert expected[0] != expected[1]


def test_results_are_read_with_names_units_and_dimensions(tmp_path):
    path = tmp_path / "sweep.h5"
    function = lambda p: {"shape": p["rod"]["length"] * jnp.ones((2, 3)), "last": p["k"][1]}
    parameters = {"rod": {"length": np.array([1.0, 2.0])}, "k": np.ones((2, 2))}
    units, dimensions = {"rod.length": "m", "shape": "m"}, {"shape": ("node", "axis")}
    sweep(function, parameters, path, units=units, dimensions=dimensions)
    # what a later call leaves out is kept
    sweep(function, parameters, path)
    stored = read(path)
    assert stored.units == units
    assert stored.dimensions == dimensions
    np.testing.assert_array_equal(stored.parameters["rod.length"], [1.0, 2.0])
    np.testing.assert_array_equal(stored.results["shape"], np.ones((2, 2, 3)) * [[[1.0]], [[2.0]]])
    assert np.all(stored.done)
    assert stored.made_by["jax"] == jax.__version__
    with h5py.File(path) as file:
        labels = [axis.label for axis in file["results/shape"].dims]
        assert labels == ["set", "node", "axis"]
        assert file["results/shape"].fletcher32


def test_a_damaged_file_is_refused_and_kept(finished, tmp_path):
    path = tmp_path / "sweep.h5"
    whole = bytearray(finished.read_bytes())
    for place in (3, 100, 700, len(whole) // 2, len(whole) - 1):
        damaged = whole.copy()
        damaged[place] ^= 1
        path.write_bytes(damaged)
        with pytest.raises(StorageError, match="damaged"):
            sweep(scaled(1.0), PARAMETERS, path)
        assert path.read_bytes() == damaged
    path.write_bytes(whole[:-10])
    with pytest.raises(StorageError, match="cut off"):
        sweep(scaled(1.0), PARAMETERS, path)


def test_what_another_process_adds_is_kept_and_not_done_again(tmp_path):
    """Two processes on one file: the second finishes while the first does its second round."""
    path, rounds = tmp_path / "sweep.h5", []

    def meanwhile(done, _):
        rounds.append(done)
        if done == 2:
            sweep(function, PARAMETERS, path)

    check(sweep(function, PARAMETERS, path, per_device=2, progress=meanwhile))
    assert rounds == [2, 7]
    assert np.all(read(path).done)


def test_another_sweep_that_appears_meanwhile_is_not_overwritten(tmp_path):
    path = tmp_path / "sweep.h5"

    def meanwhile(done, _):
        if done == 2:
            path.unlink()
            sweep(scaled(1.0), PARAMETERS, path)

    with pytest.raises(StorageError, match="results are named y"):
        sweep(function, PARAMETERS, path, per_device=2, progress=meanwhile)
    np.testing.assert_array_equal(read(path).results["y"], PARAMETERS["a"])


def test_lanes_share_the_largest_count():
    assert int(largest(jnp.asarray(3))) == 3
    counts = jnp.asarray([2, 5, 1])
    np.testing.assert_array_equal(jax.vmap(largest)(counts), [5, 5, 5])
    slope = jax.grad(lambda x: x * largest(jnp.asarray(2)))
    assert float(slope(1.5)) == 2.0


PROCESS = """
    import sys
    import jax
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_num_cpu_devices", 2)
    jax.config.update("jax_cpu_collectives_implementation", "gloo")
    jax.distributed.initialize(sys.argv[1], 2, int(sys.argv[2]))
    sys.path[:0] = sys.argv[4:]
    from test_sweep import PARAMETERS, check, function, sweep
    check(sweep(function, PARAMETERS, sys.argv[3], per_device=2))
"""


def test_two_processes_of_two_devices_each(tmp_path):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    script, path = tmp_path / "process.py", tmp_path / "sweep.h5"
    script.write_text(textwrap.dedent(PROCESS))
    command = lambda i: [sys.executable, str(script), address, str(i), str(path), *PLACES]
    both = [
        subprocess.Popen(command(i), stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        for i in range(2)
    ]
    said = [process.communicate(timeout=180)[0] for process in both]
    assert [process.returncode for process in both] == [0, 0], said
    # the file of the two is that of one
    check(sweep(function, PARAMETERS, path))
