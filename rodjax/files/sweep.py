"""Sweeps: one function of many parameter sets, by `vmap` on every device, kept as they are done.

Each device maps its share in a program of its own (`shard_map`), so that the control flow of one
(iterations, contact) does not wait for another's. With `jax.distributed` initialised, each process
does its share of every round on its own devices, and the first process keeps the file.
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from jax.extend.core import jaxpr_as_fun
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import PyTree

from rodjax.files.fingerprint import fingerprint
from rodjax.files.sealed_files import hdf5_path
from rodjax.files.sweep_files import SweepFile, check_labels, read
from rodjax.files.versions import versions
from rodjax.inputs.validation import as_integer, check_integer
from rodjax.numerics.compilation import compiled

__all__ = ["read", "sweep"]


def sweep(
    function: Callable[[PyTree], dict[str, Any]],
    parameters: PyTree,
    path: str | Path,
    *,
    per_device: int = 16,
    progress: Callable[[int, int], None] | None = None,
    units: Mapping[str, str] | None = None,
    dimensions: Mapping[str, Sequence[str]] | None = None,
) -> dict[str, np.ndarray]:
    """Evaluate a function for every set of parameters, and keep the results in an HDF5 file.

    The file knows what made it: names and values of the parameters, names, shapes and types of the
    results, a fingerprint of the traced function with every constant it closes over, and the
    versions of rodjax and jax. If all of these agree the sweep continues where it stopped; if any
    differs it is refused and the file is left alone. How sets are batched may differ: it changes
    results by rounding only. What the function reads at run time without JAX seeing it (a file, a
    global variable inside `jax.pure_callback`) is not part of the fingerprint.

    Args:
        function: from one set of parameters to a dictionary of arrays; traced, under `vmap`. A set
            that fails should say so in its results (`rollout(..., throw=False)` and its `result`),
            and spoils no other.
        parameters: pytree of arrays with the sets along the leading axis.
        path: file of the results, written anew after each round; see `read`. Of several processes
            of `jax.distributed` only the first reads and writes it. What another sweep of the same
            function and parameters adds to the file meanwhile is kept, and not done again.
        per_device: sets mapped at once on a device: enough to fill it, few enough that an
            interruption loses little.
        progress: called with the number of sets done and that of all, after each round.
        units: units of parameters and results by name, kept in the file.
        dimensions: names of the axes of results (those of one set), by the result's name.

    Returns:
        The results of all sets along the leading axis.

    Raises:
        ValueError: the leading axes differ, or what the function returns cannot be kept.
        StorageError: the file holds another sweep; the message says what differs.
    """
    per_device = as_integer(per_device)
    check_integer(1, per_device=per_device)
    names, leaves, structure = _named(parameters)
    count = _count(names, leaves)
    program, results = _traced(function, [jnp.asarray(leaf[0]) for leaf in leaves], structure)
    check_labels(names, {k: leaf.ndim for k, leaf in results.items()}, units, dimensions)
    file = SweepFile(
        path=hdf5_path(path),
        made_by={**versions(), "function": fingerprint(program)},
        title=f"{getattr(function, '__module__', '?')}.{getattr(function, '__qualname__', '?')}",
        parameters=dict(zip(names, leaves, strict=True)),
        traced_as=tuple(str(aval.dtype) for aval in program.in_avals),
        results={
            name: np.zeros((count, *leaf.shape), leaf.dtype) for name, leaf in results.items()
        },
        done=np.zeros(count, bool),
        units=dict(units or {}),
        dimensions={name: tuple(axes) for name, axes in (dimensions or {}).items()},
    )
    _together(file.continue_from_disk, file.made_by["function"])
    share = per_device * jax.local_device_count()
    rank, processes = jax.process_index(), jax.process_count()
    # neighbouring sets, likely of like cost, are dealt out among the devices in turn
    dealt = np.arange(share * processes).reshape(per_device, -1).T.ravel()
    back = np.argsort(dealt)
    mapped = _on_all_devices(jaxpr_as_fun(program))
    done = _of_the_first(file.done)
    while not np.all(done):
        left = np.flatnonzero(~done)[: share * processes]
        # a short last round repeats its last set
        padded = np.resize(left, share * processes)
        padded[len(left) :] = left[-1]
        mine = padded[dealt].reshape(processes, share)[rank]
        values = mapped(*(jnp.asarray(leaf[mine]) for leaf in leaves))
        for name, value in zip(results, values, strict=True):
            file.results[name][left] = np.asarray(_gathered(value))[back][: len(left)]
        file.done[left] = True
        if rank == 0:
            file.write()
        done = _of_the_first(file.done)
        if progress is not None:
            progress(int(np.sum(done)), count)
    return file.results


def _named(parameters):
    """Names of the leaves by their place in the tree, the leaves, and the tree's structure."""
    found, structure = jax.tree_util.tree_flatten_with_path(parameters)
    names = [jax.tree_util.keystr(path, simple=True, separator=".") for path, _ in found]
    names = [name or "parameter" for name in names]
    for name in names:
        if "/" in name or names.count(name) > 1:
            raise ValueError(f"parameters: '{name}' cannot be the name of one array in a file")
    leaves = []
    for name, (_, leaf) in zip(names, found, strict=True):
        if isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            raise ValueError(f"parameters: for the keys '{name}' give jax.random.key_data of them")
        leaves.append(np.asarray(leaf))
        if leaves[-1].dtype.kind not in "biufc":
            raise ValueError(f"parameters: '{name}' must be numbers, got {leaves[-1].dtype}")
    return names, leaves, structure


def _count(names, leaves) -> int:
    counts = {np.shape(leaf)[:1] for leaf in leaves}
    if len(counts) != 1 or counts & {(), (0,)}:
        pairs = zip(names, leaves, strict=True)
        shapes = ", ".join(f"{name} {np.shape(leaf)}" for name, leaf in pairs)
        raise ValueError(
            "parameters: every array needs the same number of sets as leading axis, got"
            f" {shapes or 'no array'}"
        )
    return int(np.shape(leaves[0])[0])


def _traced(function, one, structure):
    """The function of one set as a program of arrays in and out, and its results by name."""
    flat = lambda *arrays: function(jax.tree.unflatten(structure, arrays))
    program, results = jax.make_jaxpr(flat, return_shape=True)(*one)
    if not isinstance(results, dict) or not all(isinstance(name, str) for name in results):
        raise ValueError(
            "function: must return a dictionary of arrays by name, {'force': force}; got"
            f" {type(results).__name__}"
        )
    for name, value in results.items():
        if not isinstance(value, jax.ShapeDtypeStruct) or value.dtype.kind not in "biufc":
            kind = getattr(value, "dtype", type(value).__name__)
            raise ValueError(f"function: its result '{name}' must be an array of numbers: {kind}")
        if not name or "/" in name:
            raise ValueError(f"function: '{name}' cannot be the name of a result in a file")
    # as pytrees do, whatever the order in which the function put them in
    return program, dict(sorted(results.items()))


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


def _of_the_first(done: np.ndarray) -> np.ndarray:
    """Which sets are done, as the first process knows (of earlier runs only it has results)."""
    if jax.process_count() == 1:
        return done.copy()
    return np.array(multihost_utils.broadcast_one_to_all(done))


def _together(continue_from_disk: Callable[[], None], digest: str) -> None:
    """Read the file in the first process; if that or the functions' agreement fails, all raise.

    A process that raised alone would leave the others waiting for it.
    """
    error = None
    if jax.process_index() == 0:
        try:
            continue_from_disk()
        except Exception as caught:
            error = caught
    if jax.process_count() > 1:
        mine = np.frombuffer(bytes.fromhex(digest) + bytes([error is not None]), np.uint8)
        all_of_them = np.asarray(multihost_utils.process_allgather(mine))
        if error is None and np.any(all_of_them[:, -1]):
            error = ValueError("path: refused by the first process, whose message says why")
        if error is None and np.any(all_of_them[:, :-1] != mine[:-1]):
            error = ValueError("function: differs from process to process, constants included")
    if error is not None:
        raise error
