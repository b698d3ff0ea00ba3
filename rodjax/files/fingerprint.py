"""Fingerprints of traced functions: equal for equal computations, in every process.

A function of Python has no identity that outlives its process. What JAX traces of it has: the
operations, what they are given, their shapes and types, and the constants closed over. The digest
holds these and nothing of where they came from: no addresses, no names of functions or variables.
"""

import dataclasses
import enum
import functools
import hashlib
import re
import types
from collections.abc import Callable, Mapping

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal

# only names, of functions in Python
_DECORATION = {"name"}


def fingerprint(program: ClosedJaxpr) -> str:
    """Digest of a traced function: SHA-256 over its operations and constants, in hexadecimal.

    Of a Python function that is called from within (`jax.pure_callback`) the byte code counts, and
    what it closes over; not what it reads of its module or of the disk.
    """
    return _Fingerprint()(program)


class _Fingerprint:
    """Digests of the parts of one program; a part that occurs often is looked through once."""

    def __init__(self):
        self.seen: dict[int, tuple[object, str]] = {}

    def __call__(self, value) -> str:
        """Digest of a value of any kind that a program holds."""
        if isinstance(value, ClosedJaxpr):
            return _digest("program", self(value.jaxpr), *map(self, value.consts))
        if isinstance(value, Jaxpr):
            return self._once(value, self._jaxpr)
        if value is None or isinstance(value, bool | int | float | complex | str | bytes):
            return _digest(type(value).__name__, repr(value))
        if isinstance(value, jax.Array | np.ndarray | np.generic):
            return self._once(value, _array)
        if isinstance(value, enum.Enum):
            return _digest(type(value).__name__, value.name)
        if isinstance(value, Mapping):
            return _digest("mapping", *sorted(self(pair) for pair in value.items()))
        if isinstance(value, set | frozenset):
            return _digest("set", *sorted(map(self, value)))
        if isinstance(value, tuple | list):
            return _digest(type(value).__name__, *map(self, value))
        if isinstance(value, np.dtype | type):
            return _digest("type", _scrubbed(value))
        return _digest(type(value).__name__, _scrubbed(value))

    def _once(self, value, digest: Callable[..., str]) -> str:
        if id(value) not in self.seen:
            # kept with its value, so that no other object gets its id meanwhile
            self.seen[id(value)] = value, digest(value)
        return self.seen[id(value)][1]

    def _jaxpr(self, jaxpr) -> str:
        numbers: dict = {}

        def define(variable):
            numbers[variable] = len(numbers)
            return f"{numbers[variable]}:{_scrubbed(variable.aval)}"

        def use(atom):
            if isinstance(atom, Literal):
                return f"literal {_scrubbed(atom.aval)} {self(atom.val)}"
            return str(numbers[atom])

        lines = [*map(define, jaxpr.constvars), "in", *map(define, jaxpr.invars)]
        for equation in jaxpr.eqns:
            name = equation.primitive.name
            if "debug" in name:  # a print changes no result
                continue
            lines += [name, *map(use, equation.invars), "to", *map(define, equation.outvars)]
            for key in sorted(equation.params.keys() - _DECORATION):
                part = equation.params[key]
                lines += [key, self._callback(part) if "callback" in name else self(part)]
        return _digest("operations", *lines, "out", *map(use, jaxpr.outvars))

    def _callback(self, value) -> str:
        """Digest of what calls back into Python: code, defaults and what is closed over."""
        if isinstance(value, types.FunctionType):
            return self._once(value, self._function)
        if isinstance(value, types.MethodType):
            return _digest("method", self._callback(value.__func__), self._callback(value.__self__))
        if isinstance(value, functools.partial):
            parts = (value.func, *value.args, *sorted(value.keywords.items()))
            return _digest("partial", *map(self._callback, parts))
        if isinstance(value, types.CodeType):
            parts = (value.co_code, value.co_names, value.co_consts)
            return _digest("code", *map(self._callback, parts))
        if isinstance(value, tuple | list):
            return _digest(type(value).__name__, *map(self._callback, value))
        if dataclasses.is_dataclass(value) and not isinstance(value, type):
            parts = (getattr(value, field.name) for field in dataclasses.fields(value))
            return _digest(type(value).__name__, *map(self._callback, parts))
        return self(value)

    def _function(self, function) -> str:
        # a function may close over itself
        self.seen[id(function)] = function, _digest("this function")
        cells = [_content(cell) for cell in function.__closure__ or ()]
        parts = (function.__code__, function.__defaults__, cells)
        return _digest("function", *map(self._callback, parts))


def _array(value) -> str:
    if jnp.issubdtype(value.dtype, jax.dtypes.prng_key):
        return _digest("key", value.dtype, _array(jax.random.key_data(value)))
    array = np.asarray(value)
    return _digest(array.dtype, array.shape, np.ascontiguousarray(array).tobytes())


def _content(cell):
    try:
        return cell.cell_contents
    except ValueError:  # not assigned yet
        return None


def _scrubbed(value) -> str:
    """The object's own description without addresses."""
    return re.sub(r"0x[0-9a-fA-F]+", "", repr(value))


def _digest(*parts) -> str:
    """Digest of strings and bytes; where one ends and the next begins counts."""
    total = hashlib.sha256()
    for part in parts:
        data = part if isinstance(part, bytes) else str(part).encode()
        total.update(b"%d " % len(data))
        total.update(data)
    return total.hexdigest()
