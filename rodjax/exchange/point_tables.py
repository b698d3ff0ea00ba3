"""Points out of tables of text: which columns they are, and which line each stands in."""

import csv
import itertools
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from rodjax.inputs.validation import shown

# what stands where a value is missing
_MISSING = {"", "nan", "na", "n/a", "null", "none", "-", "--"}
# columns that tell where along the curve a point is
_ALONG = ("s", "arc length", "arc_length", "arclength", "parameter")

Name = str | int


class Table(NamedTuple):
    """Rows of numbers, NaN where one is missing.

    Attributes:
        names: of the columns, without their units.
        units: of the columns, nothing where none is said.
        values: of the rows.
        labels: which line of the file each row is.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    values: Float[np.ndarray, "k columns"]
    labels: tuple[str, ...]

    def column(self, name: Name, argument: str) -> int:
        """The place of a column that is given by its name or number."""
        if isinstance(name, int) and not isinstance(name, bool) and 0 <= name < len(self.names):
            return name
        found = [i for i, own in enumerate(self.names) if own == _plain(name)]
        if len(found) != 1:
            raise ValueError(
                f"{argument}: there is no one column {name!r}; there are {self.listing}, or give"
                " its number from 0"
            )
        return found[0]

    @property
    def listing(self) -> str:
        """Names of the columns, for messages."""
        return ", ".join(map(repr, self.names))

    def only(self, wanted: Mapping[str, float]) -> "Table":
        """The rows where columns have these values."""
        keep = np.ones(len(self.values), bool)
        for name, value in wanted.items():
            column = self.values[:, self.column(name, "only")]
            keep &= np.isclose(column, value, rtol=1e-9, atol=0.0)
            if not np.any(keep):
                near = np.unique(column[np.isfinite(column)])[:8].tolist()
                raise ValueError(f"only: no row has {name} = {value!r}; there are {near}")
        labels = tuple(itertools.compress(self.labels, keep.tolist()))
        return self._replace(values=self.values[keep], labels=labels)

    def places(self, columns: Sequence[Name] | None) -> list[int]:
        """The columns of x, y and, where there is one, z."""
        if columns is not None:
            if isinstance(columns, str) or len(columns) not in (2, 3):
                raise ValueError(
                    f"columns: give those of x, y and z, as ('x', 'y', 'z'); got {shown(columns)}"
                )
            return [self.column(name, "columns") for name in columns]
        for names in ("xyz", "xy"):
            if all(self.names.count(name) == 1 for name in names):
                return [self.names.index(name) for name in names]
        if len(self.names) in (2, 3):
            return list(range(len(self.names)))
        raise ValueError(f"columns: say which are x, y and z; there are {self.listing}")

    def along(self) -> int | None:
        """The column that tells where along the curve a point is, if one is named so."""
        found = [i for i, name in enumerate(self.names) if name in _ALONG]
        return found[0] if len(found) == 1 else None


def read_table(path: str | os.PathLike) -> Table:
    """A table of numbers, with a heading or without.

    Raises:
        ValueError: it holds no numbers, a cell is no number, or a row has too many.
    """
    text = Path(path).read_text(encoding="utf-8-sig")
    lines = [(i, line) for i, line in enumerate(text.splitlines(), 1) if line.strip()]
    remarks = [line for _, line in lines if line.lstrip().startswith("#")]
    lines = [(i, line) for i, line in lines if not line.lstrip().startswith("#")]
    if not lines:
        raise ValueError(f"source: {path} holds no row of numbers")
    divider = _divider(lines[-1][1])
    rows = [(f"line {i}", _cells(line, divider)) for i, line in lines]
    heading = None
    if any(_number(cell, divider) is None for cell in rows[0][1]):
        heading, rows = rows[0][1], rows[1:]
    elif remarks:  # as numpy.savetxt writes it
        cells = _cells(remarks[-1].lstrip(" #"), divider)
        heading = cells if len(cells) == len(rows[0][1]) else None
    if not rows:
        raise ValueError(f"source: {path} holds a heading alone")
    width = len(heading) if heading else max(len(cells) for _, cells in rows)
    heading = heading or [str(i) for i in range(width)]
    values = np.full((len(rows), width), np.nan)
    for i, (label, cells) in enumerate(rows):
        if len(cells) > width:
            raise ValueError(f"source: {label} has {len(cells)} cells, the table {width} columns")
        for j, cell in enumerate(cells):
            number = _number(cell, divider)
            if number is None:
                raise ValueError(
                    f"source: {label}, column {heading[j]!r}: {cell!r} is no number; mend it, or"
                    " leave the cell empty and give drop_missing=True"
                )
            values[i, j] = number
    names, units = zip(*map(_named, heading), strict=True)
    return Table(names, units, values, tuple(label for label, _ in rows))


def _divider(line: str) -> str | None:
    """What stands between cells; None: blanks."""
    return next((mark for mark in (";", "\t", ",") if mark in line), None)


def _cells(line: str, divider: str | None) -> list[str]:
    if divider is None:
        return line.split()
    return [cell.strip() for cell in next(csv.reader([line], delimiter=divider))]


def _number(cell: str, divider: str | None) -> float | None:
    """The number of a cell, NaN where it is missing, None where it is no number."""
    if cell.lower() in _MISSING:
        return np.nan
    try:  # beside semicolons numbers may be written with commas
        return float(cell.replace(",", ".") if divider == ";" else cell)
    except ValueError:
        return None


def _named(heading: str) -> tuple[str, str]:
    """Name and unit of a column, as of 'x [mm]' or 'x (mm)'."""
    found = re.fullmatch(r"(.*?)\s*[\[(](.*)[\])]\s*", heading)
    name, unit = (found[1], found[2].strip()) if found else (heading, "")
    return _plain(name), unit


def _plain(name: Name) -> str:
    return str(name).strip().strip("\"'").lower()
