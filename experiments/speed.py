"""What a Newton iteration, a step and their compilation cost, beside SciPy's banded solver.

    python experiments/speed.py [--elements N ...] [--repeats K] [--quick] [--out DIR]

Writes DIR/summary.json and DIR/speed.png. Every timing is the median of interleaved repeats, and
its ratio to a yardstick of the same repeat is given, so that a busy machine shifts both.
"""

import argparse
import importlib.metadata
import json
import platform
from pathlib import Path

import _settings  # noqa: F401 (first)
import jax
import matplotlib.pyplot as plt
import numpy as np
from _memory import peak_mib
from _speed_costs import compile_costs, iteration_costs, ply_costs
from speed_scenes import ladder

jax.config.update("jax_enable_compilation_cache", False)

DRAWN = (
    "newton", "iteration", "elimination", "correction", "block_solve", "jacobian", "residual",
    "search", "banded_solve",
)  # fmt: skip


def arguments(argv=None) -> argparse.Namespace:
    """Options of the command line."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--elements", type=int, nargs="+", metavar="N")
    parser.add_argument("--repeats", type=int, metavar="K", help="default 15 (3 with --quick)")
    parser.add_argument("--quick", action="store_true", help="one small grid, to try it out")
    parser.add_argument("--out", type=Path, default=Path("results/speed"), metavar="DIR")
    options = parser.parse_args(argv)
    options.elements = options.elements or ([60] if options.quick else [100, 200, 400, 1000, 3200])
    options.repeats = options.repeats or (3 if options.quick else 15)
    return options


def slope(elements, seconds) -> float:
    """Exponent of a power law fitted to costs."""
    return float(np.polyfit(np.log(elements), np.log(seconds), 1)[0])


def draw(rows: dict[str, dict[int, dict]], out: Path) -> None:
    """Costs of an iteration against the number of elements."""
    figure, both = plt.subplots(1, 2, figsize=(12, 4), sharey=True, layout="constrained")
    for axes, (title, found) in zip(both, rows.items(), strict=True):
        n = list(found)
        for name in DRAWN:
            if name in found[n[0]]:
                style = "k--" if name == "banded_solve" else "o-"
                label = "SciPy's banded solve" if name == "banded_solve" else name.replace("_", " ")
                axes.loglog(n, [1e3 * found[k][name] for k in n], style, label=label, ms=4)
        axes.set(title=title.replace("_", " "), xlabel="elements")
        axes.grid(which="both", alpha=0.3)
    both[0].set_ylabel("median time [ms]")
    handles, labels = both[1].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right center")
    figure.savefig(out / "speed.png", dpi=150)


def main(argv=None) -> None:
    """Measure, print, draw and write."""
    options = arguments(argv)
    options.out.mkdir(parents=True, exist_ok=True)
    rows: dict[str, dict[int, dict]] = {"without_contact": {}, "plectoneme_in_contact": {}}
    print(
        f"{'elements':>8} {'contact':>8} {'residual':>9} {'jacobian':>9} {'solve':>9} {'SciPy':>9}"
        f" {'iteration':>9} {'solve/SciPy':>11} {'it./SciPy':>9}   [ms]"
    )
    for elements in options.elements:
        for title, contact in zip(rows, (False, True), strict=True):
            found = iteration_costs(elements, contact, options.repeats)
            rows[title][elements] = found
            parts = ("residual", "jacobian", "block_solve", "banded_solve", "iteration")
            times = " ".join(f"{1e3 * found[part]:9.3f}" for part in parts)
            note = (
                f"   {found['pairs']} pairs, {found['joints']} of {found['segments'] + 1} joints in"
                f" contact, elimination {1e3 * found['elimination']:.2f}, correction"
                f" {1e3 * found['correction']:.2f}, search {1e3 * found['search']:.2f}"
                if contact
                else ""
            )
            print(
                f"{elements:8d} {contact!s:>8} {times} {found['block_solve_over_banded']:11.2f}"
                f" {found['iteration_over_banded']:9.2f}{note}",
                flush=True,
            )
            jax.clear_caches()
    slopes = {}
    for title, found in rows.items():
        large = [n for n in found if n >= 400]
        if len(large) > 1:
            slopes[title] = slope(large, [found[n]["iteration"] for n in large])
            print(
                f"{title.replace('_', ' ')}: cost of an iteration grows as elements to the power"
                f" {slopes[title]:.2f} from {large[0]} to {large[-1]}"
            )
    plies: dict[int, dict] = {}
    print(f"\n{'ply':>8} {'solve':>9} {'increment':>9} {'search':>9} {'incr./solve':>11}   [ms]")
    for elements in options.elements:
        found = plies[elements] = ply_costs(elements, options.repeats)
        times = " ".join(f"{1e3 * found[k]:9.3f}" for k in ("block_solve", "increment", "search"))
        ratio = found["increment_over_block_solve"]
        print(f"{elements:8d} {times} {ratio:11.2f}   {found['pairs']} pairs", flush=True)
        jax.clear_caches()
    large = [n for n in plies if n >= 200]
    if len(large) > 1:
        slopes["ply"] = slope(large, [plies[n]["increment"] for n in large])
        print(
            f"ply: cost of an increment grows as elements to the power {slopes['ply']:.2f}"
            f" from {large[0]} to {large[-1]}"
        )
    rungs = ladder(40 if options.quick else 200)
    compiled = []
    print(
        f"\n{'scene':36} {'operations':>10} {'fusions':>8} {'trace':>6} {'compile':>8}"
        f" {'rollout':>8} {'adaptive':>8} {'start':>6} [s] {'step':>8} [ms]"
    )
    for rung in rungs[:1] if options.quick else rungs:
        found = compile_costs(rung, options.repeats)
        compiled.append(found)
        rollout = found["rollout_trace_seconds"] + found["rollout_compile_seconds"]
        print(
            f"{rung.name:36} {found['step_operations']:10d} {found['step_fusions']:8d}"
            f" {found['step_trace_seconds']:6.2f}"
            f" {found['step_compile_seconds']:8.2f} {rollout:8.2f} {found['adaptive_seconds']:8.2f}"
            f" {found['start_seconds']:6.2f}     {1e3 * found['step_seconds']:8.3f}",
            flush=True,
        )
    peak = peak_mib()
    print(f"\npeak resident memory of the process: {peak:.0f} MiB")
    draw(rows, options.out)
    summary = {
        "machine": {
            "processor": platform.processor() or platform.machine(),
            "devices": [str(device) for device in jax.devices()],
            "versions": {
                name: importlib.metadata.version(name) for name in ("jax", "scipy", "numpy")
            },
        },
        "iteration_seconds": rows,
        "ply_seconds": plies,
        "slope": slopes,
        "compilation": compiled,
        "peak_resident_mebibytes": peak,
    }
    (options.out / "summary.json").write_text(json.dumps(summary, indent=2) + "\n")
    print(f"results in {options.out}")


if __name__ == "__main__":
    main()
