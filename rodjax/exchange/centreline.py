"""Measured centrelines: points out of files and arrays, looked through, mended, and made a rod."""

import os
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from rodjax.exchange import mending
from rodjax.exchange.point_tables import Name, Table, read_table
from rodjax.exchange.smooth_lines import lengths_along, resampled
from rodjax.inputs.argument_types import AnyArray
from rodjax.inputs.validation import (
    as_integer,
    check_flag,
    check_integer,
    check_positive,
    check_scalar,
    given,
    shown,
)
from rodjax.rods.builders import curved_rod
from rodjax.rods.curves import MOST_POINTS
from rodjax.rods.rod import Rod


class Centreline(NamedTuple):
    """Points along a curve in order, and what was done to what was given.

    Attributes:
        points: (k, 3) [m].
        arc_length: of the points along the smooth curve through them [m].
        report: what was found and changed, a line each; nothing where all was well.

    Example:
        >>> line = rx.centreline([(0, 0, 0), (0.5, 0, 0.1), (1, 0, 0)], points=20)
        >>> line.points.shape, line.report
        ((20, 3), ('3 points resampled to 20, equally spaced',))
    """

    points: Float[np.ndarray, "k 3"]
    arc_length: Float[np.ndarray, " k"]
    report: tuple[str, ...]

    @property
    def length(self) -> float:
        """Length of the smooth curve through the points [m]."""
        return float(self.arc_length[-1])

    def rod(self, elements: int, section: Any, **options: Any) -> Rod:
        """The rod along it, `curved_rod(points, None, elements, section, **options)`.

        Args:
            elements: n; the rod follows the curve to second order in their length.
            section: a `Section`, or a function of arc lengths such as `circular_section` returns.
            options: `first_director`, `stress_free`, `actuation` and `jumps` of `curved_rod`.
        """
        return curved_rod(self.points, None, elements, section, **options)

    def __str__(self) -> str:
        first = f"a centreline of {len(self.points)} points, {self.length:.6g} long"
        return "\n".join([first, *(f"  {line}" for line in self.report)])

    def __repr__(self) -> str:
        return f"Centreline({len(self.points)} points, length={self.length:.6g})"


def centreline(
    source: str | os.PathLike | Sequence | AnyArray,
    *,
    columns: Sequence[Name] | None = None,
    parameter: Name | Sequence[float] | AnyArray | None = None,
    only: Mapping[str, float] | None = None,
    factor: float = 1.0,
    reverse: bool = False,
    sort: bool = False,
    drop_missing: bool = False,
    largest_gap: float | None = None,
    noise: float | None = None,
    points: int | None = None,
) -> Centreline:
    """A measured curve, looked through: what is wrong is named by its line, with the mend.

    What is told without being asked, in `report`: points that lie on the one before them are left
    out, points whose parameter falls are reversed, more than 2000 are thinned to as many. What may
    be a fault of the data is refused until it is said to be right.

    Args:
        source: path of a table of text (commas, semicolons, tabs or blanks between columns, with
            a heading or without), or points (k, 3); (k, 2) lie in the plane z = 0.
        columns: of a table those of x, y and z, by name or by number from 0. Default: the ones
            named so, or all of a table of two or three.
        parameter: what grows along the curve: a column, or of an array of points k numbers.
            Default: a column named s, arc length or parameter, if there is one.
        only: rows where columns have these values, as {"time": 0.5} of a table of many times.
        factor: what turns the numbers into the scene's units, 1e-3 of millimetres for metres.
        reverse: begin from the other end.
        sort: put points in the order of the parameter where they are not.
        drop_missing: leave out points without all their numbers; a smooth curve bridges them.
        largest_gap: between successive points [m]. Default: 10 times the median.
        noise: standard deviation of each coordinate [m]: a smooth curve is laid not through the
            points but as near to them. Without it the noise of points is curvature of the rod.
        points: how many, equally spaced along the smooth curve. Default: those given.

    Raises:
        ValueError: numbers are missing, points are out of order, a gap is too large, the line turns
            back on itself; the message names the lines and the mend.
        FileNotFoundError: there is no such file.

    Example:
        >>> x = np.linspace(0.0, 1000.0, 21)  # millimetres
        >>> np.savetxt("cable.csv", np.stack([x, 0 * x, 40 * np.sin(x / 200)], -1), delimiter=",")
        >>> line = rx.centreline("cable.csv", factor=1e-3)
        >>> cable = line.rod(20, section)
    """
    check_flag(reverse=reverse, sort=sort, drop_missing=drop_missing)
    numbers = {"factor": factor, **given(largest_gap=largest_gap, noise=noise)}
    check_scalar(**numbers)
    check_positive(**numbers)
    points = as_integer(points)
    check_integer(2, MOST_POINTS, **given(points=points))
    report = []
    rows, ordered = _rows_of(source, parameter, only, columns, factor, report)
    if sort and not ordered:
        raise ValueError("sort: say by what, parameter=; nothing tells the points' order")
    rows = mending.without_missing(rows, drop_missing, report)
    rows = mending.without_repeated(mending.in_order(rows, sort, report), report)
    mending.check_gaps(rows, largest_gap)
    if noise is None:
        mending.check_turns(rows)
    if reverse:
        rows = rows.taken(np.arange(len(rows.points))[::-1])
        report.append("reversed, as asked")
    found = _resampled(rows.points, points, noise, report)
    return Centreline(found, lengths_along(found), tuple(report))


def _rows_of(
    source: Any, parameter: Any, only: Any, columns: Any, factor: float, report: list[str]
) -> tuple[mending.Rows, bool]:
    """The points as they are given, and whether something tells their order."""
    table, along = _table_of(source, parameter)
    if only is not None:
        table = table.only(only)
    places = table.places(columns)
    report += _about(table, places, factor)
    if along is None:
        along = table.along() if parameter is None else table.column(parameter, "parameter")
    points = np.zeros((len(table.values), 3))
    points[:, : len(places)] = factor * table.values[:, places]
    labels, numbers = np.asarray(table.labels), np.arange(float(len(points)))
    if along is None:
        return mending.Rows(points, numbers, labels, "row"), False
    return mending.Rows(points, table.values[:, along], labels, table.names[along]), True


def _resampled(
    given: np.ndarray, count: int | None, noise: float | None, report: list[str]
) -> np.ndarray:
    """The points, or as many as are asked for or allowed."""
    many = len(given) > MOST_POINTS
    if count is None and noise is None and not many:
        return given
    why = f", as a rod is laid through at most {MOST_POINTS}" if many and count is None else ""
    count = count or min(len(given), MOST_POINTS)
    found, moved = resampled(given, count, noise)
    report.append(f"{len(given)} points resampled to {count}, equally spaced{why}")
    if noise is not None:
        report.append(f"smoothed: the points moved by {moved:.3g} (root mean square)")
    return found


def _table_of(source: Any, parameter: Any) -> tuple[Table, int | None]:
    """Whatever was given as a table, and the column of an array's parameter."""
    if isinstance(source, str | os.PathLike):
        return read_table(source), None
    try:
        values = np.asarray(source, float)
    except (TypeError, ValueError):
        values = np.zeros(0)
    if values.ndim != 2 or values.shape[-1] not in (2, 3):
        raise ValueError(f"source: give the path of a table, or points (k, 3); got {shown(source)}")
    names = tuple("xyz"[: values.shape[-1]])
    labels = tuple(f"points[{i}]" for i in range(len(values)))
    if parameter is None:
        return Table(names, ("",) * len(names), values, labels), None
    along = np.asarray(parameter, float)
    if along.shape != (len(values),):
        raise ValueError(f"parameter: give a number a point, {len(values)}; got {shown(parameter)}")
    values = np.concatenate([values, along[:, None]], 1)
    names = (*names, "parameter")
    return Table(names, ("",) * len(names), values, labels), len(names) - 1


def _about(table: Table, places: list[int], factor: float) -> list[str]:
    """What is to be known of the columns."""
    units = sorted({table.units[i] for i in places} - {""})
    if len(units) > 1:
        raise ValueError(f"columns: they are in different units, {' and '.join(units)}")
    report = []
    if units and factor == 1 and units != ["m"]:
        report.append(f"in {units[0]}, as the table says; factor= turns them into another unit")
    elif factor != 1:
        of = f", of {units[0]}" if units else ""
        report.append(f"multiplied by {factor:g}{of}")
    if len(places) == 2:
        report.append("in the plane z = 0")
    return report
