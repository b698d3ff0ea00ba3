"""What constructors share: conversion of numbers, and checks of what was given.

A converter never raises: what is no number it leaves as it is, so that the check after it, which
knows the argument's name, can say so. Every check raises ValueError with "name: the mend, got ...".

Tracers and `jax.ShapeDtypeStruct` have a shape and a kind, which are checked, and no values. A
check of values must not use an operation of jax: in traced code even known arrays become traced by
one. What may be left out is passed through `given`; None is an error elsewhere. (What
transformations put in place of arrays never comes here: they unflatten without a constructor.)
"""

import numbers
from typing import Any

import jax
import jax.core
import jax.numpy as jnp
import numpy as np

LARGEST = 1_000_000
"""Of elements, segments and the like: more is a slip, and would be allocated without a word."""


# Conversion


def as_float(value) -> Any:
    """The value as an array of floating point numbers; what holds no real numbers is left.

    Single precision is kept, all else taken in the default precision.
    """
    array = _array(value)
    if array is None or isinstance(array, jax.ShapeDtypeStruct):
        return value
    single = array.dtype == jnp.float32
    return jnp.asarray(array, jnp.float32 if single else jnp.result_type(float))


def as_float_or_none(value) -> Any:
    """`as_float` of what may be left out."""
    return None if value is None else as_float(value)


def as_traced(tree):
    """The pytree with its numbers as arrays of full type, which are traced, not compiled in.

    Truth values, texts and functions stay what they are.
    """

    def convert(leaf):
        number = isinstance(leaf, int | float | complex | np.number) and not isinstance(leaf, bool)
        if not (number or isinstance(leaf, np.ndarray) or getattr(leaf, "weak_type", False)):
            return leaf
        if isinstance(leaf, int) and abs(leaf) > jnp.iinfo(jnp.result_type(int)).max:
            leaf = float(leaf) if abs(leaf) < 2**1000 else np.inf  # no integers of any size
        try:
            return jnp.asarray(leaf, jnp.asarray(leaf).dtype)
        except TypeError:  # an array of texts or objects
            return leaf

    return jax.tree.map(convert, tree)


def as_integer(value):
    """The value as an int; what is no whole number is left."""
    if isinstance(value, bool | np.bool_ | jax.core.Tracer):
        return value
    if isinstance(value, numbers.Integral):
        return int(value)
    array = _array(value)
    if array is None or array.shape != () or isinstance(array, jax.ShapeDtypeStruct):
        return value
    number = float(array)
    return int(number) if number.is_integer() else value


def _array(value) -> Any:
    """The value as something with shape and dtype of real numbers, or None."""
    if not isinstance(value, jax.Array | np.ndarray | np.generic | jax.ShapeDtypeStruct):
        value = made_array(value)
        if value is None:
            return None
    real = jnp.issubdtype(value.dtype, jnp.floating) or jnp.issubdtype(value.dtype, jnp.integer)
    return value if real else None


def made_array(value) -> Any:
    """An array of a number or of nested sequences, whatever they hold, or None."""
    if isinstance(value, int) and not isinstance(value, bool):
        # there are no integer arrays of any size, and a whole number may be large
        value = float(value) if abs(value) < 2**1000 else None
    try:
        return np.asarray(value)
    except jax.errors.TracerArrayConversionError:
        pass
    except Exception:  # whatever another library's object raises
        return None
    if any(isinstance(leaf, str | bytes) for leaf in jax.tree.leaves(value)):
        return None  # which jax would take for names of types
    try:
        return jnp.asarray(value)  # of tracers, so it is traced anyway
    except (TypeError, ValueError):  # and of something else besides
        return None


def array_of(value) -> Any:
    """Real numbers as numpy's array (in double precision) where known, else as they are traced."""
    array = _array(value)
    return np.asarray(array, float) if isinstance(array, np.ndarray) or known(array) else array


def given(**values) -> dict[str, Any]:
    """Those of the arguments that are not None."""
    return {name: value for name, value in values.items() if value is not None}


def broadcasts(shape: tuple[int, ...], to: tuple[int, ...]) -> bool:
    """Whether an array of one shape broadcasts to another."""
    try:
        return np.broadcast_shapes(shape, to) == tuple(to)
    except ValueError:
        return False


def known(value) -> bool:
    """Whether a field holds numbers (not a tracer, nor what only has a shape)."""
    held = isinstance(value, jax.Array | np.ndarray | np.generic)
    return held and not isinstance(value, jax.core.Tracer)


def all_known(*trees) -> bool:
    """Whether no leaf of the pytrees is traced, nor has a shape only."""
    without = jax.core.Tracer | jax.ShapeDtypeStruct
    return not any(isinstance(leaf, without) for leaf in jax.tree.leaves(trees))


def shown(value) -> str:
    """The value in a message: short, and of arrays the shape."""
    shape = getattr(value, "shape", None)
    if isinstance(value, type):
        return f"the class {value.__name__}"
    if isinstance(shape, tuple) and shape != ():
        return f"an array of shape {shape} ({value.dtype})"
    if isinstance(value, jax.core.Tracer):
        return f"a traced {value.dtype}"
    text = str(value) if known(value) else " ".join(repr(value).split())
    return text if len(text) <= 60 else f"{text[:57]}..."


# Checks of numbers


def check_numbers(**values) -> None:
    """Raise ValueError unless each is a real number or an array of them."""
    for name, value in values.items():
        if _array(value) is None:
            raise ValueError(
                f"{name}: must be a real number or an array of them, got {_what(value)}"
            )


def check_shape(shape: tuple[int, ...], **values) -> None:
    """Raise ValueError unless each is an array of real numbers of this shape, () for a number."""
    for name, value in values.items():
        array = _array(value)
        if array is None or tuple(array.shape) != shape:
            raise ValueError(f"{name}: must be {_described(shape)}, got {_what(value)}")


def check_scalar(**values) -> None:
    """Raise ValueError unless each is one real number."""
    check_shape((), **values)


def check_finite(**values) -> None:
    """Raise ValueError unless the values are real numbers, the known ones finite."""
    check_numbers(**values)
    for name, value in _known(values):
        if not np.all(np.isfinite(value)):
            raise ValueError(f"{name}: must be finite, got {_worst(value, ~np.isfinite(value))}")


def check_positive(**values) -> None:
    """Raise ValueError unless the values are real numbers, the known ones positive and finite."""
    check_numbers(**values)
    for name, value in _known(values):
        bad = ~(np.isfinite(value) & (value > 0))
        if np.any(bad):
            raise ValueError(f"{name}: must be positive and finite, got {_worst(value, bad)}")


def check_not_negative(**values) -> None:
    """Raise ValueError unless the values are real numbers, the known ones finite and >= 0."""
    check_numbers(**values)
    for name, value in _known(values):
        bad = ~(np.isfinite(value) & (value >= 0))
        if np.any(bad):
            raise ValueError(f"{name}: must be finite and not negative, got {_worst(value, bad)}")


def check_integer(low: int, high: int = LARGEST, **values) -> None:
    """Raise ValueError unless each is an int between the two (see `as_integer`)."""
    for name, value in values.items():
        whole = isinstance(value, int) and not isinstance(value, bool)
        if not whole or not low <= value <= high:
            raise ValueError(
                f"{name}: must be a whole number of at least {low} and at most {high},"
                f" got {shown(value)}"
            )


def check_arrays_of_numbers(**trees) -> None:
    """Raise ValueError if a pytree holds an array of texts, dates or objects."""
    for name, tree in trees.items():
        for leaf in jax.tree.leaves(tree):
            if isinstance(leaf, np.ndarray) and leaf.dtype.kind not in "biufc":
                raise ValueError(f"{name}: give arrays of numbers; got {shown(leaf)}")


def check_flag(**values) -> None:
    """Raise ValueError unless each is True or False."""
    for name, value in values.items():
        if not isinstance(value, bool | np.bool_):
            raise ValueError(f"{name}: must be True or False, got {shown(value)}")


def _known(values):
    """Names and numbers of the values that are known, as arrays of numpy."""
    for name, value in values.items():
        if known(value) or isinstance(value, int | float | list | tuple):
            if isinstance(value, list | tuple) and not known(_array(value)):
                continue  # of tracers
            large = isinstance(value, int) and abs(value) >= 2**63  # no integer of an array's
            yield name, np.asarray(made_array(value) if large else value)


def _described(shape: tuple[int, ...]) -> str:
    if shape == ():
        return "one real number"
    if shape == (3,):
        return "three real numbers"
    return f"an array of shape {shape} of real numbers"


def _what(value) -> str:
    """What was given instead of a number or array."""
    array = _array(value)
    return shown(value) if array is None or array.shape == () else f"shape {tuple(array.shape)}"


def _worst(value, bad) -> str:
    """The first of the numbers that are wrong."""
    if value.shape == ():
        return str(value)
    where = [int(i) for i in np.argwhere(bad)[0]]
    return f"{value[tuple(where)]} at index {tuple(where) if len(where) > 1 else where[0]}"


# Checks of objects


def check_instance(kind: type | tuple[type, ...], mend: str, **values) -> None:
    """Raise ValueError unless each is an instance of a class; `mend` says what to give."""
    for name, value in values.items():
        if isinstance(value, kind):
            continue
        if isinstance(value, type) and issubclass(value, kind):
            raise ValueError(
                f"{name}: {value.__name__} is a class; give one of its kind, {value.__name__}(...)"
            )
        raise ValueError(f"{name}: {mend}; got {shown(value)}")


def as_node(node) -> Any:
    """The number as an array, which does not make the program; what is no integer is left."""
    if isinstance(node, int) and not isinstance(node, bool) and abs(node) < 2**31:
        return jnp.asarray(node, jnp.int32)
    whole = jnp.issubdtype(getattr(node, "dtype", float), jnp.integer)
    return jnp.asarray(node, jnp.int32) if whole else node


def check_node(node) -> None:
    """Raise ValueError unless it is the number of one node, as `as_node` gives it."""
    kind = getattr(node, "dtype", None)
    if kind is None or jnp.shape(node) != () or not jnp.issubdtype(kind, jnp.integer):
        raise ValueError(f"node: give the number of one node, an integer; got {shown(node)}")
