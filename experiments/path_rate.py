"""How long a path of equilibria takes: the example's rod, from where it buckles, through its loop.

    python experiments/path_rate.py [--elements N] [--points K] [--repeats R] [--quick] [--out DIR]

The branch that leaves the straight rod is followed for so many points, without contact and with it,
R times after a first that compiles. One line of JSON each: seconds of the first and of the others,
where the path came to, what it met. Writes them to DIR/summary.json.
"""

import argparse
import dataclasses
import json
import time
from pathlib import Path

import _settings  # noqa: F401 (first)
import example
import example_path

import rodjax as rx

FAR = 4.6  # turns at which the path would end


def rate(scene: rx.Scene, points: int, repeats: int) -> dict:
    """One line of the table."""
    straight = rx.path(scene, rx.placing(scene), 0.0, 2.2, longest_step=0.5)
    buckles = next(one for one in straight.critical if one.kind == "branch")
    measures = {"shortening": example_path.shortening}
    seconds = []
    for _ in range(repeats + 1):
        began = time.perf_counter()
        bent = rx.branch(scene, buckles, (0.0, FAR), points=points, measures=measures, throw=False)
        seconds.append(time.perf_counter() - began)
    return {
        "contact": scene.contact is not None,
        "elements": scene.rod.elements,
        "points": len(bent),
        "first_call_seconds": seconds[0],
        "seconds": seconds[1:],
        "turns": float(bent.parameters[-1]),
        "shortening": float(bent.measures["shortening"][-1]),
        "critical": [(one.kind, float(one.parameter)) for one in bent.critical],
        "result": rx.Result(bent.result).name,
    }


def main(argv=None) -> int:
    """Run the experiment."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--elements", type=int, metavar="N", help="200 (24 with --quick)")
    parser.add_argument("--points", type=int, metavar="K", help="100 (12 with --quick)")
    parser.add_argument("--repeats", type=int, default=3, metavar="R")
    parser.add_argument("--quick", action="store_true", help="coarse and short, to try it out")
    parser.add_argument("--out", type=Path, default=Path("results/path_rate"), metavar="DIR")
    options = parser.parse_args(argv)
    elements = options.elements or (24 if options.quick else 200)
    points = options.points or (12 if options.quick else 100)
    touching = example_path.at_rest(example.PRESETS["timeline"], elements, crooked=False)
    lines = []
    for scene in (dataclasses.replace(touching, contact=None), touching):
        lines.append(rate(scene, points, 1 if options.quick else options.repeats))
        print(json.dumps(lines[-1]), flush=True)
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / "summary.json").write_text(json.dumps(lines, indent=1))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
