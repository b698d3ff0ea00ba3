"""Sweeps: shares, resumption, failures, and several processes."""

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
from rodjax.batching import largest
from rodjax.sweep import sweep

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
        np.testing.assert_array_equal(file["parameters/1"], PARAMETERS["b"])
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
    with pytest.raises(ValueError, match="path: .* other parameters"):
        sweep(function, PARAMETERS | {"a": np.arange(7.0) + 1}, path)
    with pytest.raises(ValueError, match="parameters: every array"):
        sweep(function, {"a": np.arange(3.0), "b": np.arange(4.0)}, tmp_path / "other.h5")


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
    places = [str(Path(file).parents[i]) for file, i in ((__file__, 0), (rodjax.__file__, 1))]
    command = lambda i: [sys.executable, str(script), address, str(i), str(path), *places]
    both = [
        subprocess.Popen(command(i), stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        for i in range(2)
    ]
    said = [process.communicate(timeout=180)[0] for process in both]
    assert [process.returncode for process in both] == [0, 0], said
    # the file of the two is that of one
    check(sweep(function, PARAMETERS, path))
