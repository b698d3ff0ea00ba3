"""The contact law recovered from the centreline of the plectoneme.

    python experiments/fit_contact_law.py [--elements N] [--seed S] [--quick] [--out DIR]

Strength, exponent and damping of Eq. (13) in `timeline`, each started a factor of 3 off, from
markers seen while the strands approach from the cut-off to where they settle. The strength is that
of the repulsion at a distance of 5 mm, since a factor on k1 means nothing while the exponent k2
moves; k1 follows from both. The damping is 1e5 times the paper's, which has no visible effect; it
is fitted last, since far from the right strength it would run away to nothing. When the collapse
comes depends on the grid, and is fitted too. The slider is never held.
Writes DIR/summary.json and DIR/fit.png.
"""

import dataclasses
import sys

import _settings  # noqa: F401 (first)
import numpy as np
import recovery
from example import PRESETS, scene

import rodjax as rx
from rodjax.interactions.contact_report import report

GAP = 5e-3  # [m], of the pole to the point where the strength is given
K1, K2, K3 = 1e-7, 3.0, 1e-6 * 1e5
BEGIN, END = 28.0, 35.0  # [s]
LONGEST_DELAY = 0.25  # [s]


def replaced(base, parameters):
    """The scene with this contact law."""
    law = dataclasses.replace(
        base.contact.law,
        k1=parameters["strength"] * GAP ** parameters["k2"],
        k2=parameters["k2"],
        k3=parameters["k3"],
    )
    return dataclasses.replace(base, contact=dataclasses.replace(base.contact, law=law))


def main(argv=None) -> int:
    """Fit and report."""
    options = recovery.arguments("fit_contact_law", __doc__, (200, 40), argv)
    rx.keep_compiled()
    begin, end, count, seen = (BEGIN, 31.5, 35, 7) if options.quick else (BEGIN, END, 140, 28)
    observed = np.linspace(begin, end, seen + 1)[1:]
    preset = dataclasses.replace(PRESETS["timeline"], hold_at=None)
    settings = []
    for elements in (options.elements, 2 * options.elements):
        base = scene(preset, elements)
        # until then nothing touches, so the state there does not depend on the law
        first = recovery.to_time(base, begin, 0.2 if options.quick else 0.1)
        found = report(base.contact, base.rod, first.position, first.velocity)
        assert float(found.total) == 0, f"strands touch before {begin} s"
        settings.append(recovery.Setting(base, first, observed))
    truth = {"strength": K1 / GAP**K2, "k2": K2, "k3": K3, "delay": 0.0}
    guess = {"strength": 3 * truth["strength"], "k2": K2 / 3, "k3": K3 / 3, "delay": 0.05}
    bounds = {
        "strength": rx.Positive(),
        "k2": rx.Interval(0.5, 9.0),
        "k3": rx.Positive(),
        "delay": rx.Interval(-LONGEST_DELAY, LONGEST_DELAY),
    }
    steps = np.linspace(begin, end + LONGEST_DELAY, count + 1)[1:]
    task = recovery.Task(truth, guess, bounds, replaced, *settings, steps, held_first=("k3",))
    summary = recovery.recover(task, options)
    for name, fit in summary["fits"].items():
        found = {key: value["fit"] for key, value in fit["parameters"].items()}
        print(f"{name}: k1 = {found['strength'] * GAP ** found['k2']:.4g} (put in: {K1:g})")
    return 0


if __name__ == "__main__":
    sys.exit(main())
