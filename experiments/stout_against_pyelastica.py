"""The stout rod intertwining by rodjax and by PyElastica: what either costs, and how far off it is.

    python experiments/stout_against_pyelastica.py [--elements N] [--tighter K] [--peer-elements M]
                                                   [--until T] [--peer-dt DT] [--quick] [--out DIR]

The rod of the preset `stout` (D = 10 mm, necked), turned 4.5 times in 32 s at one end, the other
sliding along its axis, in both codes with the same drag, shear and extension and with
PyElastica's penalty law of self-contact. Each code's error is its deviation from its own run on
twice the elements with half the tolerances or steps: of Wr(Lk) and of the energies, as means over
2 s. Every run is stored in DIR and used again if it is there; remove a file to repeat its run.
Writes comparison.png, table.txt and summary.json. Needs the extra `peers`.
`_stout_runs.py` tells how the two laws are made equal.
"""

import argparse
import importlib.util
import json
import sys
from pathlib import Path

import _settings  # noqa: F401 (first)
import numpy as np
from _stout_runs import Cost, Series, pyelastica_run, rodjax_run

UNTIL = 32.0  # [s]
WINDOW = 2.0  # [s]
COMPARED = ("writhe", "bending", "torsion", "kinetic")


def arguments(argv=None) -> argparse.Namespace:
    """Options of the command line, with the defaults that --quick changes."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--elements", type=int, metavar="N", help="default 100 (30 with --quick)")
    parser.add_argument("--tighter", type=float, default=2.0, metavar="K",
                        help="the preset's tolerances are divided by this; default 2")  # fmt: skip
    parser.add_argument("--peer-elements", type=int, metavar="M", help="PyElastica's; as rodjax's")
    parser.add_argument("--until", type=float, metavar="T", help="end [s]; default 32 (1)")
    parser.add_argument("--peer-dt", type=float, default=2.5e-5, metavar="DT", help="[s]")
    parser.add_argument("--quick", action="store_true", help="coarse and short, to try it out")
    parser.add_argument(
        "--out", type=Path, default=Path("results/stout_against_pyelastica"), metavar="DIR"
    )
    options = parser.parse_args(argv)
    if options.elements is None:
        options.elements = 30 if options.quick else 100
    if options.peer_elements is None:
        options.peer_elements = options.elements
    if options.until is None:
        options.until = 1.0 if options.quick else UNTIL
    for name in ("elements", "tighter", "peer_elements", "until", "peer_dt"):
        if not getattr(options, name) > 0:
            parser.error(f"--{name.replace('_', '-')}: must be positive")
    return options


def stored(path: Path, compute) -> tuple[Series, Cost]:
    """A run from its file, or computed and then stored there."""
    if path.exists():
        print(f"{path.name}: from its file")
        with np.load(path) as file:
            series = Series(*(file[name] for name in Series._fields))
            return series, Cost(*(file[name].item() for name in Cost._fields))
    series, cost = compute()
    np.savez(path, **series._asdict(), **cost._asdict())
    print(f"{path.name}: {cost.cpu_seconds:.1f} CPU s, {cost.steps} steps", flush=True)
    return series, cost


def window_means(series: Series, name: str, until: float) -> np.ndarray:
    """Means of a quantity over windows of 2 s (a quarter of a shorter run), by trapezoids."""
    width = min(WINDOW, until / 4)
    edges = width * np.arange(round(until / width) + 1)
    values = getattr(series, name)
    if not len(series.time) or series.time[-1] < until * (1 - 1e-9):
        return np.full(len(edges) - 1, np.nan)
    time_, values = series.time, np.asarray(values)
    means = []
    for begin, end in zip(edges[:-1], edges[1:], strict=True):
        inner = time_[(time_ > begin) & (time_ < end)]
        t = np.concatenate([[begin], inner, [end]])
        means.append(np.trapezoid(np.interp(t, time_, values), t) / (end - begin))
    return np.array(means)


def deviation(found: Series, fine: Series, until: float) -> dict[str, dict[str, float]]:
    """Rms and largest difference of the means; Wr in turns, energies over the largest mean."""
    result = {}
    for name in COMPARED:
        a, b = (window_means(series, name, until) for series in (found, fine))
        scale = 1.0 if name == "writhe" else np.max(np.abs(b))
        difference = np.abs(a - b) / scale
        rms = np.sqrt(np.mean(difference**2))
        result[name] = {"rms": float(rms), "largest": float(np.max(difference))}
    return result


def draw(runs: dict[str, tuple[Series, Cost]], until: float, path: Path) -> None:
    """Wr over Lk and the energies of all runs."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(2, 2, figsize=(11, 7.5), layout="constrained")
    styles = ("C0-", "C0:", "C1-", "C1:")
    for (label, (series, _)), style in zip(runs.items(), styles, strict=True):
        axes[0, 0].plot(series.turns, series.writhe, style, label=label, lw=1.4)
        for part, name in zip(axes.flat[1:], ("bending", "torsion", "kinetic"), strict=True):
            part.plot(series.time, 1e3 * getattr(series, name), style, label=label, lw=1.4)
            part.set(xlabel="t [s]", ylabel=f"{name} energy [mJ]", xlim=(0, until))
    axes[0, 0].set(xlabel="Lk [turns applied]", ylabel="Wr [turns]")
    largest = max(1e3 * np.max(series.kinetic) for series, _ in runs.values())
    axes[1, 1].set(yscale="log", ylim=(1e-6 * largest, 2 * largest))
    axes[0, 0].legend()
    for part in axes.flat:
        part.grid(alpha=0.3)
    figure.suptitle("Stout rod, D = 10 mm (assumed), penalty contact")
    figure.savefig(path, dpi=150)
    plt.close(figure)


def main(argv=None) -> int:
    """All four runs, compared; the exit status is 0 if they ran to the end."""
    options = arguments(argv)
    if importlib.util.find_spec("elastica") is None:
        print("PyElastica is not installed: pip install '.[peers]'", file=sys.stderr)
        return 1
    options.out.mkdir(parents=True, exist_ok=True)
    n, m, until, dt = options.elements, options.peer_elements, options.until, options.peer_dt
    coarse, fine = (n, options.tighter), (2 * n, 2 * options.tighter)
    jobs = {
        f"rodjax, {n} elements": (
            "rodjax_{}_{:g}.npz".format(*coarse),
            lambda: rodjax_run(until, *coarse),
        ),
        f"rodjax, {2 * n} elements": (
            "rodjax_{}_{:g}.npz".format(*fine),
            lambda: rodjax_run(until, *fine),
        ),
        f"PyElastica, {m} elements": (
            f"pyelastica_{m}.npz",
            lambda: pyelastica_run(until, m, dt, near=False),
        ),
        f"PyElastica, {2 * m} elements": (
            f"pyelastica_{2 * m}.npz",
            lambda: pyelastica_run(until, 2 * m, dt / 2, near=True),
        ),
    }
    runs = {name: stored(options.out / file, job) for name, (file, job) in jobs.items()}
    (ours, cost), (ours_fine, _), (theirs, peer_cost), (theirs_fine, _) = runs.values()
    errors = {
        "rodjax": deviation(ours, ours_fine, until),
        "PyElastica": deviation(theirs, theirs_fine, until),
        "refined runs, of each other": deviation(ours_fine, theirs_fine, until),
    }
    lines = [
        f"{'deviation of 2 s means':32}"
        + "".join(f"{name + ' rms, largest':>24}" for name in COMPARED)
    ]
    for who, found in errors.items():
        cells = "".join(f"{found[q]['rms']:15.2e} {found[q]['largest']:8.1e}" for q in COMPARED)
        lines.append(f"{who:32}{cells}")
    lines.append("Wr in turns, energies relative to their largest mean")
    for name, (series, c) in runs.items():
        lines.append(
            f"{name:28} {c.cpu_seconds:9.1f} CPU s {c.steps:9d} steps   Wr at the end"
            f" {series.writhe[-1]:7.4f}, Tw + Wr - Lk at most"
            f" {np.max(np.abs(series.twist + series.writhe - series.turns)):.1e}"
        )
    ratio = peer_cost.cpu_seconds / cost.cpu_seconds
    lines.append(
        f"PyElastica at {m} elements takes {ratio:.1f} times the CPU seconds of rodjax at {n}"
    )
    table = "\n".join(lines)
    print(table)
    (options.out / "table.txt").write_text(table + "\n")
    finished = all(series.time[-1] >= until * (1 - 1e-9) for series, _ in runs.values())
    summary = {
        "elements": n,
        "tighter": options.tighter,
        "peer_elements": m,
        "until": until,
        "peer_dt": dt,
        "finished": finished,
        "cpu_seconds": {name: c.cpu_seconds for name, (_, c) in runs.items()},
        "wall_seconds": {name: c.wall_seconds for name, (_, c) in runs.items()},
        "steps": {name: c.steps for name, (_, c) in runs.items()},
        "writhe_end": {name: float(series.writhe[-1]) for name, (series, _) in runs.items()},
        "deviations": errors,
        "cpu_ratio": ratio,
    }
    (options.out / "summary.json").write_text(json.dumps(summary, indent=2) + "\n")
    draw(runs, until, options.out / "comparison.png")
    print(f"results in {options.out}")
    return 0 if finished else 1


if __name__ == "__main__":
    sys.exit(main())
