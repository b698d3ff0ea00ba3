"""The contact law recovered from the centreline of the plectoneme.

    python experiments/fit_contact_law.py [--elements N] [--seed S] [--quick] [--out DIR]

Strength, exponent and damping of Eq. (13) in `timeline`, each started a factor of 3 off, from
markers seen while the strands approach from the cut-off to where they settle. The strength is that
of the repulsion at a distance of 5 mm, since a factor on k1 means nothing while the exponent k2
moves; k1 follows from both. The damping is 1e5 times the paper's, which has no visible effect.
Writes DIR/summary.json and DIR/fit.png.
"""

import dataclasses
import json
import sys

import _settings  # noqa: F401 (first)
import numpy as np
import recovery
from example import PRESETS, scene

import rodjax as rx
from rodjax.contact_forces import report

GAP = 5e-3  # [m], of the pole to the point where the strength is given
K1, K2, K3 = 1e-7, 3.0, 1e-6 * 1e5
BEGIN, END = 26.0, 33.0  # [s]


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
    options = recovery.arguments("fit_contact_law", __doc__, (200, 20), argv)
    begin, end, count, seen = (BEGIN, 28.0, 20, 4) if options.quick else (BEGIN, END, 140, 28)
    observed = np.linspace(begin, end, seen + 1)[1:]
    settings = []
    for elements in (options.elements, 2 * options.elements):
        base = scene(PRESETS["timeline"], elements)
        # until then nothing touches, so the state there does not depend on the law
        first = recovery.to_time(base, begin, 0.2 if options.quick else 0.1)
        found = report(base.contact, base.rod, first.position, first.velocity)
        assert float(found.total) == 0, f"strands touch before {begin} s"
        settings.append(recovery.Setting(base, first, observed))
    truth = {"strength": K1 / GAP**K2, "k2": K2, "k3": K3}
    guess = {"strength": 3 * truth["strength"], "k2": K2 / 3, "k3": K3 / 3}
    bounds = {"strength": rx.Positive(), "k2": rx.Interval(0.5, 9.0), "k3": rx.Positive()}
    steps = recovery.steps_between(begin, end, count)
    # far from the right law its damping runs away to nothing, and is fitted again from there
    task = recovery.Task(truth, guess, bounds, replaced, *settings, steps, again=("k3",))
    summary = recovery.recover(task, options)
    for name, fit in summary["fits"].items():
        found = {key: value["fit"] for key, value in fit["parameters"].items()}
        fit["k1"] = found["strength"] * GAP ** found["k2"]
        print(f"{name}: k1 = {fit['k1']:.4g} (put in: {K1:g})")
    (options.out / "summary.json").write_text(json.dumps(summary, indent=2) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
