"""A dense plectoneme: a rod of 160 diameters turned 20 times, beside the theory of the ply.

    python experiments/plectoneme.py [--elements N] [--turns K] [--finer N] [--quick]
                                    [--out DIR]

A rod of rubber, its ends 30 % nearer each other than when straight (a planar arch), is turned at
one end by a quarter turn a second: the arch goes out of plane, makes a loop, whose legs meet, and
winds up on itself. At some numbers of turns the drive is held until the rod rests, and measured are

    R      half the distance of the strands' centrelines, a mean, as all of the ply, over the
           middle half of the arc on which they touch (standard deviations stand beside);
    theta  the strands' angle to the axis of the ply, by the curvature of a helix, which is
           sin^2(theta)/R; and, for comparison, half the angle between the strands' centrelines
           (cos 2 theta = -t . t') or between their cross-sections' normals;
    M, T   torque about the axis and tension along it at the clamps; the tails that lead there are
           straight, and without friction the torque in the rod is M all along;
    p      force of contact per length of a strand.

Compared is the uniform ply of Clauvelin, Audoly & Neukirch (Biophys. J. 96, 3716, 2009), whose M, T
and p follow from R and theta: `_plectoneme_theory.py`.

These hold at the radius measured: contact that gives way makes R a little less than D/2. M and T go
with the eighth to tenth power of the angle here, so a hundredth of an angle is a tenth of them. The
three measures of the angle part by what a grid leaves open: a uniform ply made of elements h long
is off by about (tau h)^2, tau the rod's twist; `--finer` brings the end onto a finer grid.

Writes run.h5, snapshots.png, ply.png and summary.json; the exit status is 0 if the run came to its
end without a passage.
"""

import argparse
import json
import sys
import time
from pathlib import Path

import _settings  # noqa: F401 (first)
import numpy as np
from _plectoneme_drawing import draw
from _plectoneme_holds import at_hold, printed
from _plectoneme_scene import FULL, MAX_STEP, QUICK, holds, scene, settled
from intertwine import CHUNK, Recorder, run_adaptive

import rodjax as rx
from rodjax import measures, storage
from rodjax.dynamics.adaptive import compile_adaptive_rollout


def arguments(argv=None) -> argparse.Namespace:
    """Options of the command line, with the defaults that --quick changes."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--elements", type=int, metavar="N", help="default 400 (120 with --quick)")
    parser.add_argument("--turns", type=float, metavar="K", help="at the end; default 20 (10)")
    parser.add_argument("--finer", type=int, metavar="N", help="for the end; default 600; 0: none")
    parser.add_argument("--quick", action="store_true", help="coarse and short, to try it out")
    parser.add_argument("--out", type=Path, default=Path("results/plectoneme"), metavar="DIR")
    options = parser.parse_args(argv)
    size = QUICK if options.quick else FULL
    options.elements = size.elements if options.elements is None else options.elements
    options.turns = size.turns[-1] if options.turns is None else options.turns
    if options.finer is None:
        options.finer = 0 if options.quick else 600
    if options.elements < 20:
        parser.error(f"--elements: at least 20, got {options.elements}")
    if options.finer and options.finer < 20:
        parser.error(f"--finer: at least 20, or 0 for none, got {options.finer}")
    if not options.turns > 0:
        parser.error(f"--turns: must be positive, got {options.turns:g}")
    stages = (*(k for k in size.turns if k < options.turns), options.turns)
    options.size = size._replace(elements=options.elements, turns=stages)
    return options


def main(argv=None) -> int:
    """Run, measure, draw; the exit status is 0 if it came to the end without a passage."""
    options = arguments(argv)
    rx.keep_compiled()
    options.out.mkdir(parents=True, exist_ok=True)
    whole = scene(options.size)
    rows, _ = holds(options.size.turns)
    method, control = rx.GeneralizedAlpha(), rx.StepControl(max_step=MAX_STEP)
    began = time.perf_counter()
    compile_adaptive_rollout(whole, method=method, chunk=CHUNK)
    first, until = rx.start(whole), float(rows[-1, 1])
    compiling, recorder = time.perf_counter() - began, Recorder(first, until)
    try:
        outcome = run_adaptive(whole, first, until, method, control, recorder)
    finally:  # what has been computed is always stored
        recorder.bar.close()
        if recorder.run is not None:
            path = options.out / "run.h5"
            storage.save(path, whole, recorder.run, method=method, control=control)
    run = outcome.run
    reached = float(run.times[-1])
    linking = measures.linking(whole, run)
    ended = [(k, end) for k, (_, end) in zip(options.size.turns, rows, strict=True)]
    found = [at_hold(whole, run.nearest(end), k) for k, end in ended if end <= reached * (1 + 1e-9)]
    finer, fine = None, []
    code = rx.Result(int(run.result))
    if options.finer and code is rx.Result.SUCCESS:
        finer, rest = settled(whole, run.final, options.finer, options.size)
        code = rx.Result(int(rest.result))
        fine = [at_hold(finer, rest.final, options.turns)]
    findings = rx.check(whole, run)
    summary = {
        "elements": options.elements,
        "turns": options.turns,
        "result": code.name,
        "end_time": reached,
        "steps": len(run.times) - 1,
        "rejected": int(run.rejected),
        "newton_iterations": int(np.sum(run.infos.iterations)),
        "compile_seconds": compiling,
        "run_seconds": outcome.run_seconds,
        "linking_error_max": float(np.max(np.abs(linking.error))),
        "twist_end": float(linking.twist[-1]),
        "writhe_end": float(linking.writhe[-1]),
        "holds": [at._asdict() for at in found],
        "finer_elements": options.finer,
        "finer": [at._asdict() for at in fine],
        "check": [str(one) for one in findings.found],
    }
    (options.out / "summary.json").write_text(json.dumps(summary, indent=2) + "\n")
    printed(found)
    if fine:
        print(f"the last on {options.finer} elements:")
        printed(fine)
    print(
        f"{code.name} at t = {reached:g} s: {summary['steps']} steps,"
        f" {summary['rejected']} rejected, {outcome.run_seconds:.0f} s;"
        f" Tw = {summary['twist_end']:.4f}, Wr = {summary['writhe_end']:.4f},"
        f" |Tw + Wr - turns| <= {summary['linking_error_max']:.1e}"
    )
    print(findings)
    if found:
        draw(options.out, whole, run, linking, found)
        print(f"results in {options.out}")
    return 0 if code is rx.Result.SUCCESS else 1


if __name__ == "__main__":
    sys.exit(main())
