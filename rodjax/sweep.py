"""Sweeps: one function of many parameter sets, by `vmap` on every device, kept as they are done.

Each device maps its share in a program of its own (`shard_map`), so that the control flow of one
(iterations, contact) does not wait for another's. With `jax.distributed` initialised, each process
does its share of every round on its own devices, and the first process keeps the file.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import PyTree

from rodjax.compilation import compiled
from rodjax.storage import replacing


def sweep(
    function: Callable[[PyTree], dict[str, Any]],
    parameters: PyTree,
    path: str | Path,
    *,
    per_device: int = 16,
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, np.ndarray]:
    """Evaluate a function for every set of parameters, and keep the results in an HDF5 file.

    Args:
        function: from one set of parameters to a dictionary of arrays; traced, under `vmap`. A set
            that fails should say so in its results (`rollout(..., throw=False)` and its `result`),
            and spoils no other.
        parameters: pytree of arrays with the sets along the leading axis.
        path: file of the results, written anew after each round. If it holds results of the same
            parameters the sweep continues where it stopped; of several processes only the first
            reads and writes it.
        per_device: sets mapped at once on a device: enough to fill it, few enough that an
            interruption loses little.
        progress: called with the number of sets done and that of all, after each round.

    Returns:
        The results of all sets along the leading axis.

    Raises:
        ValueError: the leading axes differ, or the file holds another sweep.
    """
    leaves, structure = jax.tree.flatten(jax.tree.map(np.asarray, parameters))
    counts = {np.shape(leaf)[:1] for leaf in leaves}
    if len(counts) != 1 or counts & {(), (0,)}:
        raise ValueError("parameters: every array needs the same number of sets as leading axis")
    count = int(np.shape(leaves[0])[0])
    found, done = _read(Path(path), leaves, count)
    share = per_device * jax.local_device_count()
    rank, processes = jax.process_index(), jax.process_count()
    # neighbouring sets, likely of like cost, are dealt out among the devices in turn
    dealt = np.arange(share * processes).reshape(per_device, -1).T.ravel()
    back = np.argsort(dealt)
    mapped = _on_all_devices(function)
    while not np.all(done):
        left = np.flatnonzero(~done)[: share * processes]
        # a short last round repeats its last set
        padded = np.resize(left, share * processes)
        padded[len(left) :] = left[-1]
        mine = padded[dealt].reshape(processes, share)[rank]
        results = mapped(
            jax.tree.unflatten(structure, [jnp.asarray(leaf[mine]) for leaf in leaves])
        )
        results = {name: np.asarray(_gathered(value))[back] for name, value in results.items()}
        for name, value in results.items():
            if name not in found:
                found[name] = np.zeros((count, *value.shape[1:]), value.dtype)
            found[name][left] = value[: len(left)]
        done[left] = True
        if rank == 0:
            _write(Path(path), leaves, found, done)
        if progress is not None:
            progress(int(np.sum(done)), count)
    return found


def _on_all_devices(function):
    """The function mapped over sets, these shared among the local devices."""
    mesh = Mesh(np.asarray(jax.local_devices()), ("sets",))
    shares = PartitionSpec("sets")
    mapped = jax.shard_map(
        jax.vmap(function), mesh=mesh, in_specs=shares, out_specs=shares, check_vma=False
    )
    return compiled(mapped)


def _gathered(value):
    """The values of all processes, one after the other."""
    if jax.process_count() == 1:
        return value
    return multihost_utils.process_allgather(np.asarray(value), tiled=True)


def _read(path: Path, leaves, count: int) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Results so far and which sets are done, the same in every process."""
    found, done = {}, np.zeros(count, bool)
    if jax.process_index() == 0 and path.exists():
        with h5py.File(path, "r") as file:
            given, results = file["parameters"], file["results"]
            assert isinstance(given, h5py.Group) and isinstance(results, h5py.Group)
            stored = [np.asarray(given[str(i)]) for i in range(len(given))]
            same = len(stored) == len(leaves) and all(
                np.array_equal(a, b) for a, b in zip(stored, leaves, strict=True)
            )
            if not same:
                raise ValueError(f"path: {path} holds a sweep of other parameters; give another")
            done = np.array(file["done"])
            found = {name: np.asarray(value) for name, value in results.items()}
    if jax.process_count() > 1:
        # of the results only the first process needs those of earlier runs
        done = np.array(multihost_utils.broadcast_one_to_all(done))
    return found, done


def _write(path: Path, leaves, found, done) -> None:
    with replacing(path) as file:
        for i, leaf in enumerate(leaves):
            file[f"parameters/{i}"] = leaf
        for name, value in found.items():
            file[f"results/{name}"] = value
        file["done"] = done
