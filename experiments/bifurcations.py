"""Paths of equilibria against theory: thresholds, the elastica, localised buckles, jumps, rings.

    python experiments/bifurcations.py [--elements N] [--parts NAME ...] [--quick] [--out DIR]

Parts, each in its own file `_bifurcations_*.py`:
    thresholds  clamped column, clamped rod under torsion, the paper's necked rod, refined grids
    elastica    the buckled column against the closed form, far beyond its threshold
    localised   a long rod under tension and torque against Coyne's localised buckle
    profile     diameters that raise the critical turns at fixed mass, by gradients of `rx.critical`
    compressed  torque and thrust together at which a clamped rod buckles
    writhing    a rod turned and brought nearer: jumps, against shooting, and into contact
    ring        a closed ring past Michell's threshold, to the figure 8 and into contact

Writes DIR/bifurcations.png and DIR/summary.json.
"""

import argparse
import json
from pathlib import Path

import _bifurcations_compressed as compressed
import _bifurcations_elastica as elastica
import _bifurcations_localised as localised
import _bifurcations_profile as profile
import _bifurcations_ring as ring
import _bifurcations_thresholds as thresholds
import _bifurcations_writhing as writhing
import _settings  # noqa: F401 (first)
import matplotlib.pyplot as plt

PARTS = {
    "thresholds": thresholds,
    "elastica": elastica,
    "localised": localised,
    "profile": profile,
    "compressed": compressed,
    "writhing": writhing,
    "ring": ring,
}
SHORT = ("thresholds", "localised", "compressed")


def figure(path: Path, found: dict) -> None:
    """What was found, a panel each."""
    drawn = [(part.draw, found[name]) for name, part in PARTS.items() if name in found]
    columns = min(2, len(drawn))
    rows = -(-len(drawn) // columns)
    size = 4.7 * columns, 4.0 * rows
    fig, axes = plt.subplots(rows, columns, figsize=size, layout="constrained", squeeze=False)
    for axis, (draw, own) in zip(axes.ravel(), drawn, strict=False):
        draw(axis, own)
    for axis in axes.ravel()[len(drawn) :]:
        axis.remove()
    fig.savefig(path, dpi=100)
    plt.close(fig)


def main(argv=None) -> int:
    """Run the experiment."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--elements", type=int, metavar="N", help="128 (24 with --quick)")
    parser.add_argument("--parts", nargs="+", choices=PARTS, help="all of them")
    parser.add_argument("--quick", action="store_true", help="coarse and short, to try it out")
    parser.add_argument("--out", type=Path, default=Path("results/bifurcations"), metavar="DIR")
    options = parser.parse_args(argv)
    elements = options.elements or (24 if options.quick else 128)
    parts = options.parts or (SHORT if options.quick else PARTS)
    options.out.mkdir(parents=True, exist_ok=True)
    found: dict = {"elements": elements}
    for part in parts:
        found[part] = PARTS[part].find(elements, options.quick)
        (options.out / "summary.json").write_text(json.dumps(found, indent=1))
    figure(options.out / "bifurcations.png", found)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
