"""DNA in magnetic tweezers at room temperature: force against extension, and the hat curve.

    python experiments/tweezers.py [--only pull|turn] [--quick] [--out DIR]

A molecule with A = 50 nm kT and C = 100 nm kT moves in water without inertia, shaken by thermal
noise. First it is pulled at both ends, half of the replicas straight at first and half crumpled,
and the mean tangent of its middle third is compared with theory: of elements of this length (their
transfer operator), at two element lengths and, of the longer ones, two steps; and, for elements of
no length, of the wormlike chain. Then it is held between two handles, pulled and turned; extension,
torque (C <kappa_3>) and the plectoneme are followed, and twist and writhe are compared with the
turns after every block. Writes DIR/tweezers.png and DIR/summary.json, which keep the other part
with `--only`. About 25 minutes of one core.
"""

import argparse
import json
from pathlib import Path

import _settings  # noqa: F401 (first)
import matplotlib.pyplot as plt
import numpy as np
from _molecule import KT, PERSISTENCE
from _pulled import pulls
from _turned import turned
from _wormlike import exact, marko_siggia

# force [pN], turns, duration [us]; of a molecule of so many elements
TURNED, ELEMENTS = ((0.5, 3.0, 140.0), (1.0, 3.5, 120.0), (2.0, 4.0, 120.0)), 30


def figure(path: Path, extensions: list[dict], turns: list[dict]) -> None:
    """Force against extension; extension, torque and plectoneme against turns."""
    fig, axes = plt.subplots(2, 2, figsize=(11, 8), layout="constrained")
    force = np.geomspace(0.1, 6, 60)
    axes[0, 0].semilogy([exact(f, PERSISTENCE, KT) for f in force], force, "k-", label="exact")
    interpolated = [marko_siggia(f, PERSISTENCE, KT) for f in force]
    axes[0, 0].semilogy(interpolated, force, "C1--", label="Marko-Siggia's interpolation")
    if extensions:
        axes[0, 0].errorbar(
            [one["extension"] for one in extensions],
            [one["force"] for one in extensions],
            xerr=[2 * one["error"] for one in extensions],
            fmt="o",
            ms=4,
            capsize=3,
            label="measured, less what elements add (2 standard errors)",
        )
    axes[0, 0].set(xlabel="extension over length", ylabel="force [pN]")
    axes[0, 0].legend(fontsize=8)
    for color, one in zip(("C0", "C2", "C3"), turns, strict=False):
        number = [row["turns"] for row in one["rows"]]
        pick = lambda name, one=one: [row[name] for row in one["rows"]]
        label = f"{one['force']:g} pN"
        axes[0, 1].plot(number, pick("extension"), color=color, label=label)
        axes[1, 0].plot(number, pick("torque"), color=color, label=label)
        axes[1, 0].axhline(one["cold_coexistence_torque"], color=color, ls=":", lw=1)
        middle = [(t, m) for t, m in zip(pick("time"), pick("plectoneme_middle"), strict=True) if m]
        if middle:
            axes[1, 1].plot(*np.array(middle).T, ".", color=color, label=f"{label}, middle")
        axes[1, 1].plot(pick("time"), pick("plectoneme_length"), color=color, lw=1, label=label)
    axes[0, 1].set(xlabel="turns", ylabel="extension [nm]")
    axes[1, 0].set(xlabel="turns", ylabel="torque [pN nm]", title="dotted: cold coexistence")
    axes[1, 1].set(xlabel="time [us]", ylabel="plectoneme: length and middle [nm]")
    for one in axes.flat[1:]:
        if turns:
            one.legend(fontsize=8)
        else:
            one.set_visible(False)
    fig.savefig(path, dpi=100)
    plt.close(fig)


def main(argv=None) -> int:
    """Run the experiment."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--only", choices=("pull", "turn"), help="a part of it")
    parser.add_argument("--quick", action="store_true", help="coarse and short, to try it out")
    parser.add_argument("--out", type=Path, default=Path("results/tweezers"), metavar="DIR")
    options = parser.parse_args(argv)
    options.out.mkdir(parents=True, exist_ok=True)
    kept = options.out / "summary.json"
    summary = {"pulled": [], "extensions": [], "turned": []}
    if options.only and kept.exists():
        summary = json.loads(kept.read_text())
    if options.only != "turn":
        summary["pulled"], summary["extensions"] = pulls(options.quick)
    if options.only != "pull":
        if options.quick:
            summary["turned"] = [turned(1.0, 16, 1.0, 0.5, 8)]
        else:
            summary["turned"] = [
                turned(force, ELEMENTS, turns, time, 80) for force, turns, time in TURNED
            ]
    figure(options.out / "tweezers.png", summary["extensions"], summary["turned"])
    kept.write_text(json.dumps(summary, indent=1))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
