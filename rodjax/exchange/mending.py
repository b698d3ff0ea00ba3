"""Points of a measured curve looked through row by row: what is missing, twice or out of order."""

from typing import NamedTuple

import numpy as np

_SAME = 1e-9  # of the whole length, nearer than which two points are one
_GAP = 10.0  # median spacings, beyond which something is missing
_BACK = -0.5  # cosine of a turn between two edges, below which points are out of order


class Rows(NamedTuple):
    """Points on the way through the checks."""

    points: np.ndarray
    order: np.ndarray  # the parameter, or the number of the row
    labels: np.ndarray
    name: str  # of the parameter

    def taken(self, keep: np.ndarray) -> "Rows":
        """Some of the rows, in this order."""
        return self._replace(
            points=self.points[keep], order=self.order[keep], labels=self.labels[keep]
        )


def _listed(labels: np.ndarray) -> str:
    """Names of rows, the first few."""
    many = len(labels) > 5
    kind = "lines" if str(labels[0]).startswith("line ") and len(labels) > 1 else ""
    names = [str(label).removeprefix("line ") if kind else str(label) for label in labels[:5]]
    return f"{kind} {', '.join(names)}".strip() + (f" and {len(labels) - 5} more" if many else "")


def without_missing(rows: Rows, drop: bool, report: list[str]) -> Rows:
    """The rows that have all their numbers; others are refused, or dropped."""
    whole = np.all(np.isfinite(rows.points), 1) & np.isfinite(rows.order)
    if not np.all(whole):
        where = _listed(rows.labels[~whole])
        if not drop:
            raise ValueError(
                f"source: {where}: numbers are missing; fill them in, or leave these points out by"
                " drop_missing=True"
            )
        report.append(f"left out, for want of numbers: {where}")
        rows = rows.taken(whole)
    if len(rows.points) < 2:
        raise ValueError(f"source: a line needs at least 2 points, got {len(rows.points)}")
    return rows


def in_order(rows: Rows, sort: bool, report: list[str]) -> Rows:
    """The rows in the order of the parameter, from where it is least."""
    if np.all(np.diff(rows.order) <= 0) and rows.order[-1] < rows.order[0]:
        report.append(f"reversed: {rows.name} falls from first to last")
        rows = rows.taken(np.arange(len(rows.points))[::-1])
    falls = np.flatnonzero(np.diff(rows.order) < 0) + 1
    if len(falls) and not sort:
        k = falls[0]
        raise ValueError(
            f"source: {_listed(rows.labels[falls])}: out of order, as of {rows.labels[k]}"
            f" {rows.name} = {rows.order[k]:g} after {rows.order[k - 1]:g}; sort=True puts them in"
            " order, another parameter= may be meant, or only= one of several curves"
        )
    if len(falls):
        order = np.argsort(rows.order, kind="stable")
        report.append(f"sorted by {rows.name}: out of order were {_listed(rows.labels[falls])}")
        rows = rows.taken(order)
    return rows


def _spacing(points: np.ndarray) -> np.ndarray:
    return np.linalg.norm(np.diff(points, axis=0), axis=1)


def without_repeated(rows: Rows, report: list[str]) -> Rows:
    """The rows that do not lie on the one before."""
    size = np.max(np.ptp(rows.points, 0))
    repeated = np.concatenate([[False], _spacing(rows.points) <= _SAME * size])
    if np.any(repeated):
        report.append(f"left out, on the point before: {_listed(rows.labels[repeated])}")
        rows = rows.taken(~repeated)
    if len(rows.points) < 2:
        raise ValueError("source: all points lie in one place")
    twice = np.flatnonzero(np.diff(rows.order) == 0) + 1
    if len(twice):
        k = twice[0]
        raise ValueError(
            f"source: {_listed(rows.labels[twice])}: apart from the point before, but of the same"
            f" {rows.name} = {rows.order[k]:g}; mend them, or choose another parameter="
        )
    return rows


def check_gaps(rows: Rows, largest_gap: float | None) -> None:
    """Raise ValueError where successive points are too far apart."""
    spacing = _spacing(rows.points)
    median = float(np.median(spacing))
    limit = _GAP * median if largest_gap is None else largest_gap
    far = np.flatnonzero(spacing > limit) + 1
    if len(far):
        most = float(np.max(spacing))
        raise ValueError(
            f"source: {_listed(rows.labels[far])}: as far as {most:.4g} from the point before, the"
            f" median is {median:.4g}: points are missing, or out of order (parameter= with"
            f" sort=True); if it is right, give largest_gap={1.01 * most:.3g}"
        )


def check_turns(rows: Rows) -> None:
    """Raise ValueError where the line turns back on itself."""
    edges = np.diff(rows.points, axis=0)
    edges = edges / np.linalg.norm(edges, axis=1)[:, None]
    back = np.flatnonzero(np.sum(edges[1:] * edges[:-1], 1) < _BACK) + 1
    if len(back):
        raise ValueError(
            f"source: {_listed(rows.labels[back])}: there the line turns back by more than 120"
            " degrees: points are out of order (parameter= with sort=True), or noisy (noise=, their"
            " standard deviation, lays a smooth curve)"
        )
