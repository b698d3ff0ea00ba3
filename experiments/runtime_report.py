"""Tables and figures of `error_vs_runtime.py`, from its rows alone."""

from pathlib import Path
from typing import Any

import _settings  # noqa: F401 (first)
import matplotlib.pyplot as plt
import numpy as np

Row = dict[str, Any]
LEVELS = (1e-2, 1e-3, 1e-4)


def setting(row: Row) -> str:
    """Steps asked for or the tolerance, in words."""
    if row["steps_asked"] is not None:
        return f"{row['steps_asked']} steps"
    return "" if row["tolerance"] is None else f"tol {row['tolerance']:.3g}"


def line(row: Row) -> str:
    """A row of the table."""
    head = f"{row['scene'][:24]:24} {row['label'][:30]:30} {row['elements']:5d} {setting(row):>12}"
    if row["result"] != "SUCCESS":
        return f"{head}   {row['result']}"
    number = lambda value, form: "-".rjust(8) if value is None else format(value, form)
    writhe = row["errors"].get("writhe")
    return (
        f"{head} {row['errors']['positions']:9.2e} {number(writhe, '8.1e')}"
        f" {row['cpu_seconds']:8.3f} {row['wall_seconds']:8.3f}"
        f" {number(row['compile_seconds'], '8.2f')} {row['steps']:7d}"
        f" {number(row['iterations'], '8d')}"
    )


HEADER = (
    f"{'scene':24} {'method':30} {'elem.':>5} {'setting':>12} {'error':>9} {'of Wr':>8}"
    f" {'CPU [s]':>8} {'wall [s]':>8} {'compile':>8} {'steps':>7} {'Newton':>8}"
)


def good(rows: list[Row], scene: str, methods=None) -> list[Row]:
    """Rows of a scene that succeeded, of the given methods."""
    chosen = [r for r in rows if r["scene"] == scene and r["result"] == "SUCCESS"]
    return [r for r in chosen if methods is None or r["method"] in methods]


def seconds_at(rows: list[Row], error: float) -> float | None:
    """CPU seconds at which an error is reached: log-log between the best rows, None if never.

    Where even the cheapest row is more exact, its seconds (a bound from above).
    """
    best: list[tuple[float, float]] = []
    for row in sorted(rows, key=lambda r: r["cpu_seconds"]):
        found = row["errors"]["positions"]
        if found > 0 and (not best or found < best[-1][1]):
            best.append((row["cpu_seconds"], found))
    if not best or best[-1][1] > error:
        return None
    seconds, errors = np.log(np.array(best)).T
    return float(np.exp(np.interp(-np.log(error), -errors, seconds)))


def levels(rows: list[Row], scene: str) -> dict[str, dict[str, float | None]]:
    """CPU seconds of every method at the levels of error."""
    found = good(rows, scene)
    names = dict.fromkeys(row["method"] for row in found)
    return {
        name: {f"{level:g}": seconds_at(good(found, scene, (name,)), level) for level in LEVELS}
        for name in names
    }


def extrapolation_gain(rows: list[Row], scene: str, method: str) -> list[Row]:
    """Of every extrapolated row: seconds of the plain method at its error over its own.

    Where the plain method was never so exact: None.
    """
    plain, result = good(rows, scene, (method,)), []
    for row in good(rows, scene, (f"{method}_extrapolated",)):
        error = row["errors"]["positions"]
        alone = seconds_at(plain, error)
        result.append(
            {
                "error": error,
                "cpu_seconds": row["cpu_seconds"],
                "plain_over_extrapolated": None if alone is None else alone / row["cpu_seconds"],
            }
        )
    return result


def draw(rows: list[Row], scene: str, title: str, reference_error: dict, out: Path) -> None:
    """Error of positions (and of Wr) against CPU seconds and against steps."""
    found = good(rows, scene)
    if not found:
        return
    quantities = [q for q in ("positions", "writhe") if any(q in r["errors"] for r in found)]
    columns = [("cpu_seconds", "warm CPU time [s]")]
    timeless = all(row["steps_asked"] is None and row["tolerance"] is None for row in found)
    columns.append(("elements", "elements") if timeless else ("steps", "steps"))
    figure, grid = plt.subplots(
        len(quantities),
        len(columns),
        figsize=(5.5 * len(columns) + 2.5, 4 * len(quantities)),
        squeeze=False,
        sharey="row",
        layout="constrained",
    )
    names = dict.fromkeys((row["method"], row["label"]) for row in found)
    handles = {}
    for i, (method, label) in enumerate(names):
        colour, marker = plt.get_cmap("tab20")(i % 20), "os^Dv<>pP*X"[i % 11]
        for k, quantity in enumerate(quantities):
            own = [r for r in good(found, scene, (method,)) if quantity in r["errors"]]
            for j, (key, _) in enumerate(columns):
                x, y = [r[key] for r in own], [r["errors"][quantity] for r in own]
                # one line a family of refinement: those of which grid and step go together
                style = {"color": colour, "marker": marker, "ms": 5, "lw": 0}
                (handles[label],) = grid[k, j].loglog(x, y, **style)
                for family in {r["family"] for r in own}:
                    part = sorted((r for r in own if r["family"] == family), key=lambda r: r[key])
                    grid[k, j].loglog(
                        [r[key] for r in part],
                        [r["errors"][quantity] for r in part],
                        color=colour,
                        lw=1.2,
                    )
    for k, quantity in enumerate(quantities):
        for j, (_, name) in enumerate(columns):
            axes = grid[k, j]
            if quantity in reference_error:
                axes.axhline(reference_error[quantity], color="0.4", ls=":", lw=1)
            axes.grid(which="both", alpha=0.25)
            if k == len(quantities) - 1:
                axes.set_xlabel(name)
        word = {"positions": "relative error of positions", "writhe": "relative error of Wr(t)"}
        grid[k, 0].set_ylabel(word[quantity])
    figure.suptitle(f"{title} (dotted: the reference's own error)")
    figure.legend(handles.values(), handles.keys(), loc="outside right center", fontsize=8)
    figure.savefig(out / f"{scene}.png", dpi=130)
    plt.close(figure)
