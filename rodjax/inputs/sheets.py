"""Texts of a few lines, and small tables of HTML: names and numbers with their units."""

import dataclasses
import html
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np

from rodjax.inputs.brief import brief
from rodjax.inputs.units import Units, unit_of, used
from rodjax.inputs.validation import known


class Sheet(NamedTuple):
    """What something is, and what there is to say of it.

    Attributes:
        title: in a line.
        rows: names and what stands beside them.
    """

    title: str
    rows: tuple[tuple[str, str], ...] = ()

    @property
    def text(self) -> str:
        """Lines for a terminal."""
        width = max((len(name) for name, _ in self.rows), default=0)
        rows = (f"  {name:<{width}}  {value}" for name, value in self.rows)
        return "\n".join([self.title, *rows])

    @property
    def html(self) -> str:
        """A table for a notebook."""
        left = 'style="text-align: left"'
        rows = (
            f"<tr><th {left}>{html.escape(name)}</th><td {left}>{html.escape(value)}</td></tr>"
            for name, value in self.rows
        )
        return (
            f"<table><caption {left}>{html.escape(self.title)}</caption><tbody>{''.join(rows)}"
            "</tbody></table>"
        )


def quantity(value: Any, unit: str | None) -> str:
    """A number with its unit, or from which to which many go; of what is traced the shape."""
    if not known(value) and not isinstance(value, float | int):
        return _with_unit(brief(value), unit)
    numbers = np.asarray(value, float)
    finite = numbers[np.isfinite(numbers)]
    if not finite.size:
        return "no number"
    low, high = float(np.min(finite)), float(np.max(finite))
    same = high - low <= 1e-9 * max(abs(low), abs(high))
    said = f"{low:.4g}" if same else f"{low:.4g} to {high:.4g}"
    return _with_unit(said, unit) + ("" if finite.size == numbers.size else ", some no numbers")


def told(value: Any, unit: str | None = None, units: Units | None = None) -> str:
    """A value in a few words, every number in it with its unit.

    Args:
        unit: of the value itself, and so of what a schedule gives.
        units: names of the base units; default: those in use.
    """
    if isinstance(value, eqx.Module):
        names = units or used()
        rows = (f"{name}={said}" for name, said in _fields(value, unit, names))
        return f"{type(value).__name__}({', '.join(rows)})"
    if isinstance(value, tuple):
        return f"({', '.join(told(part, unit, units) for part in value)})"
    if isinstance(value, float | int | np.ndarray | jax.Array) and not isinstance(value, bool):
        return _with_unit(brief(value), unit)
    return brief(value)


def sheet_of(module: eqx.Module) -> Sheet:
    """The fields of one of the library's objects, without those that are None."""
    rows = ((name.replace("_", " "), said) for name, said in _fields(module, None, used()))
    return Sheet(type(module).__name__, tuple(rows))


def _fields(module: eqx.Module, of: str | None, units: Units) -> list[tuple[str, str]]:
    found, name = [], type(module).__name__
    for field in dataclasses.fields(module):
        value = getattr(module, field.name)
        if value is not None:
            unit = unit_of(name, field.name, units, of)
            found.append((field.name, told(value, unit, units)))
    return found


def _with_unit(text: str, unit: str | None) -> str:
    return text if unit in (None, "", "1") else f"{text} {unit}"
