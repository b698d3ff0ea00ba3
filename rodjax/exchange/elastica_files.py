"""What PyElastica's callbacks save: dictionaries of lists, out of memory or files."""

import os
import pickle
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rodjax.inputs.validation import shown

_NEEDED = ("time", "position", "directors")
# modules and names that a dictionary of arrays is pickled by, under numpy 1 and 2
_HARMLESS = {
    ("collections", "defaultdict"),
    ("builtins", "list"),
    ("builtins", "dict"),
    ("numpy", "ndarray"),
    ("numpy", "dtype"),
    *(
        (f"numpy.{core}.{module}", name)
        for core in ("core", "_core")
        for module, name in (
            ("multiarray", "_reconstruct"),
            ("multiarray", "scalar"),
            ("numeric", "_frombuffer"),
        )
    ),
}


class _Arrays(pickle.Unpickler):
    """Reads arrays, lists and dictionaries, and nothing that could run."""

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in _HARMLESS:
            raise ValueError(
                f"source: the file holds a {module}.{name}; only dictionaries of arrays are read:"
                " save what the callback collected alone"
            )
        return super().find_class(module, name)


def collected(source: Any) -> dict[str, np.ndarray]:
    """The arrays of a dictionary, of a file, or of several of them one after the other.

    Raises:
        ValueError: time, position or directors are missing, or something else is in it.
    """
    several = isinstance(source, Sequence) and not isinstance(source, str)
    parts = [_one(part) for part in (source if several else [source])]
    if not parts:
        raise ValueError("source: give at least one dictionary or file")
    names = [name for name in parts[0] if all(name in part for part in parts)]
    return {name: np.concatenate([part[name] for part in parts]) for name in names}


def _one(source: Any) -> dict[str, np.ndarray]:
    if isinstance(source, str | os.PathLike):
        source = _read(Path(source))
    if not isinstance(source, Mapping):
        raise ValueError(
            "source: give the dictionary that a callback of PyElastica collected, or the path of a"
            f" file of it (.npz, .pkl); got {shown(source)}"
        )
    lacking = [name for name in _NEEDED if name not in source]
    if lacking:
        inner = [name for name, value in source.items() if isinstance(value, Mapping)]
        told = f"give one of {', '.join(map(repr, inner))} of it" if inner else (
            f"it has {', '.join(map(repr, source)) or 'nothing'}; let the callback collect them"
        )  # fmt: skip
        raise ValueError(f"source: it lacks {' and '.join(lacking)}; {told}")
    found = {}
    for name, value in source.items():
        try:
            found[str(name)] = np.asarray(value, float)
        except (TypeError, ValueError):  # what is no array of numbers is not asked for
            if name in _NEEDED:
                raise ValueError(f"source: {name} is no array of numbers") from None
    return {name: value for name, value in found.items() if value.ndim}


def _read(path: Path) -> Any:
    if path.suffix == ".npz":
        with np.load(path, allow_pickle=False) as file:
            return dict(file)
    if path.suffix not in (".pkl", ".pickle", ".dat"):
        raise ValueError(f"source: name a file that ends in .npz or .pkl, got {str(path)!r}")
    with path.open("rb") as file:
        try:
            return _Arrays(file).load()
        except (pickle.UnpicklingError, EOFError, AttributeError, IndexError) as error:
            raise ValueError(f"source: {path} is no whole pickle: {error}") from error
