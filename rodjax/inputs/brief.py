"""Short texts of what is given and what came out: a few lines, numbers instead of arrays."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.core
import numpy as np


def brief(value: Any) -> str:
    """A value in a few words: numbers where they are known, an array's shape where there are many.

    An array whose rows are all equal is shown by one of them, fields that are None are left out.
    """
    if isinstance(value, eqx.Module):
        names = [f.name for f in dataclasses.fields(value)]
        return named(type(value).__name__, {name: getattr(value, name) for name in names})
    if isinstance(value, tuple):
        return f"({', '.join(map(brief, value))}{',' if len(value) == 1 else ''})"
    if isinstance(value, jax.Array | np.ndarray):
        return _array(value)
    if isinstance(value, float):
        return f"{value:g}"
    if callable(value):
        return getattr(value, "__name__", type(value).__name__)
    return repr(value)


def named(name: str, parts: dict[str, Any]) -> str:
    """`name(part=..., ...)` of the parts that are not None."""
    given = {key: part for key, part in parts.items() if part is not None}
    return f"{name}({', '.join(f'{key}={brief(part)}' for key, part in given.items())})"


def _array(value) -> str:
    shape = f"{value.dtype}[{','.join(map(str, value.shape))}]"
    if isinstance(value, jax.core.Tracer) or value.dtype == object:
        return shape
    numbers = np.asarray(value)
    if numbers.ndim and numbers.size and np.all(numbers == numbers[:1]) and len(numbers) > 3:
        numbers = numbers[0]
    if numbers.ndim == 0:
        return f"{numbers:g}" if numbers.dtype.kind in "fc" else str(numbers)
    if numbers.ndim > 1 or numbers.size > 4:
        return shape
    return f"({', '.join(_array(number) for number in numbers)})"
