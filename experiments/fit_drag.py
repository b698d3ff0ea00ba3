"""Drag coefficients recovered from the centreline, through buckling and the growth of the loop.

    python experiments/fit_drag.py [--elements N] [--seed S] [--quick] [--out DIR]

Normal and tangential coefficient of Morison's drag in `timeline`, each started a factor of 3 off,
from markers seen between buckling and first contact. The imperfection is fitted with them, as in
an experiment, where nobody knows it: when the rod buckles depends on it far more than on drag, and
also on the grid. Writes DIR/summary.json and DIR/fit.png.
"""

import dataclasses
import sys

import _settings  # noqa: F401 (first)
import numpy as np
import recovery
from example import PRESETS, scene

import rodjax as rx

SEED = PRESETS["timeline"].seed_curvature


def replaced(base, parameters):
    """The scene with these drag coefficients and imperfection."""
    drag = dataclasses.replace(
        base.loads[0],
        normal_coefficient=parameters["normal_coefficient"],
        tangential_coefficient=parameters["tangential_coefficient"],
    )
    rod = base.rod
    curvature = parameters["seed_curvature"] / SEED * rod.natural_curvature
    rod = dataclasses.replace(rod, natural_curvature=curvature)
    return dataclasses.replace(base, rod=rod, loads=(drag,))


def main(argv=None) -> int:
    """Fit and report."""
    options = recovery.arguments("fit_drag", __doc__, (200, 20), argv)
    rx.keep_compiled()
    end, count, seen = (26.0, 130, 5) if options.quick else (28.0, 400, 10)
    observed = np.linspace(0.5 * end, end, seen)
    # nothing touches before 29 s
    settings = [
        recovery.Setting(base, rx.start(base), observed)
        for base in (
            scene(PRESETS["timeline"], n, contact=False)
            for n in (options.elements, 2 * options.elements)
        )
    ]
    truth = {"normal_coefficient": 0.1, "tangential_coefficient": 0.01, "seed_curvature": SEED}
    guess = {
        "normal_coefficient": 0.3,
        "tangential_coefficient": 0.01 / 3,
        "seed_curvature": 1.5 * SEED,
    }
    steps = np.linspace(0.0, end, count + 1)[1:]
    task = recovery.Task(truth, guess, rx.Positive(), replaced, *settings, steps)
    recovery.recover(task, options)
    return 0


if __name__ == "__main__":
    sys.exit(main())
