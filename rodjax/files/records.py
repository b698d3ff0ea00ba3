"""Classes with named fields, as files hold them: which there are, and what may stand in a field."""

import collections.abc
import dataclasses
import functools
import importlib
import pkgutil
import types
import typing
from collections.abc import Callable, Iterable
from typing import Any

import equinox as eqx
import jax
import jaxtyping
import numpy as np

import rodjax
from rodjax.files.sealed_files import StorageError


def is_record(kind: type) -> bool:
    """A class with named fields: an equinox module or a named tuple."""
    return issubclass(kind, eqx.Module) or (issubclass(kind, tuple) and hasattr(kind, "_fields"))


def field_names(kind: type) -> list[str]:
    """Names of the fields of such a class."""
    if issubclass(kind, eqx.Module):
        return [field.name for field in dataclasses.fields(kind)]
    return list(kind._fields)  # pyright: ignore[reportAttributeAccessIssue]


def home(module: str) -> str:
    """Where files say that a class comes from: its module, whatever the folder of that."""
    return f"rodjax.{module.rpartition('.')[2]}" if module.startswith("rodjax.") else module


def registry(classes: Iterable[type]) -> dict[str, type]:
    """Storable classes by full name, and by plain name where that is unique.

    Raises:
        StorageError: one of the user's is no such class.
    """
    found: list[type] = list(classes)
    for kind in found:
        if not isinstance(kind, type) or not is_record(kind):
            raise StorageError(f"classes: give classes of equinox modules, not {kind!r}")
    for entry in pkgutil.walk_packages(rodjax.__path__, "rodjax."):
        module = importlib.import_module(entry.name)
        own = (c for c in vars(module).values() if getattr(c, "__module__", "") == entry.name)
        found += [c for c in own if isinstance(c, type) and is_record(c)]
    by_name: dict[str, type] = {}
    names = [c.__name__ for c in found]
    for c in found:
        by_name[f"{home(c.__module__)}.{c.__qualname__}"] = c
        if names.count(c.__name__) == 1:
            by_name[c.__name__] = c
    return by_name


def default(kind: type, field: str, place: str):
    """Default of a field that a file written by an earlier version does not have.

    Raises:
        StorageError: it has none.
    """
    if issubclass(kind, eqx.Module):
        for entry in dataclasses.fields(kind):
            if entry.name == field and entry.default is not dataclasses.MISSING:
                return entry.default
    elif field in kind._field_defaults:  # pyright: ignore[reportAttributeAccessIssue]
        return kind._field_defaults[field]  # pyright: ignore[reportAttributeAccessIssue]
    raise StorageError(f"{place}: the file has no {field} of {kind.__name__}; write it again")


def make(kind: type, values: dict[str, Any], place: str):
    """An object of these fields, without the conversions of its constructor but with its checks.

    Raises:
        StorageError: a value is not of its field's type, or the object's own check refuses.
    """
    if kind.__module__.startswith("rodjax."):
        hints = _hints(kind)
        for field, value in values.items():
            if not fits(value, hints.get(field, Any)):
                raise StorageError(
                    f"{place}.{field}: {_described(value)} cannot stand here in a"
                    f" {kind.__name__}; the file is damaged or was put together wrongly"
                )
    if not issubclass(kind, eqx.Module):
        return kind(**values)
    # not by __init__: its converters may change the last bit
    made = object.__new__(kind)
    for field, value in values.items():
        object.__setattr__(made, field, value)
    for base in reversed(kind.__mro__):
        check = vars(base).get("__check_init__")
        try:
            if check is not None:
                check(made)
        except Exception as error:  # also of a user's class
            raise StorageError(f"{place}: is no valid {kind.__name__}: {error}") from error
    return made


@functools.cache
def _hints(kind: type) -> dict[str, Any]:
    return typing.get_type_hints(kind)


def fits(value, hint) -> bool:
    """Whether a value may stand where a type is asked for.

    Arrays are compared in kind and in their last axes; more leading ones may be stacked states or
    the sets of a batch. Where the type says nothing that is known here, anything may stand.
    """
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        return any(fits(value, part) for part in arguments)
    if origin is tuple:
        if not isinstance(value, tuple):
            return False
        if arguments[1:] == (...,):
            return all(fits(item, arguments[0]) for item in value)
        return len(value) == len(arguments) and all(map(fits, value, arguments))
    if origin in (list, dict):
        return isinstance(value, origin)
    if hint is collections.abc.Callable or origin is collections.abc.Callable or hint is Callable:
        return callable(value)
    if not isinstance(hint, type):
        return True
    if hint is Any:
        return True
    if hint is type(None):
        return value is None
    if issubclass(hint, jaxtyping.AbstractArray):
        return _array_fits(value, hint)
    if hint in (bool, int, float):
        kinds = {bool: "b", int: "iu", float: "iuf"}[hint]
        number = isinstance(value, bool | int | float | jax.Array | np.ndarray | np.generic)
        return number and np.ndim(value) == 0 and np.asarray(value).dtype.kind in kinds
    if issubclass(hint, jax.Array | np.ndarray):
        return isinstance(value, jax.Array | np.ndarray | np.generic)
    return isinstance(value, hint)


def _array_fits(value, hint) -> bool:
    if not isinstance(value, jax.Array | np.ndarray | np.generic | int | float):
        return False
    axes = [_axis(word) for word in hint.dim_str.split()]
    leading = [] if "..." in axes else ["..."]
    # pyright does not know what jaxtyping makes
    wanted = hint.dtype[np.ndarray, " ".join(leading + axes)]  # pyright: ignore
    return isinstance(np.asarray(value), wanted)


def _axis(word: str) -> str:
    if word.isdigit():
        return word
    return "..." if word.startswith("*") or word == "..." else "_"


def _described(value) -> str:
    shape = getattr(value, "shape", None)
    if shape is None:
        return "nothing" if value is None else f"a {type(value).__name__}"
    return f"an array of {value.dtype} and shape {shape}"
