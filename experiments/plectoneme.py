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

Compared is the uniform ply of Clauvelin, Audoly & Neukirch (Biophys. J. 96, 3716, 2009): two
strands of bending stiffness A that touch without friction, of contour length l together, wound
about each other at the angle theta to their axis, between tails under T and M. The ply turns the
ends by l sin(2 theta)/(2 R) and brings them l nearer, so the energy
A sin^4(theta) l/(2 R^2) + T l - M l sin(2 theta)/(2 R) is stationary in theta and in l (the ply
grows at the tails' expense, whatever its loop), and its slope in R is the contact's:

    M = 2 A sin^3(theta) cos(theta)/(R cos 2 theta)
    T = (A/R^2) sin^4(theta) (1/2 + 1/cos 2 theta)
    p = A sin^4(theta)/(R^3 cos 2 theta)

These hold at the radius measured: contact that gives way makes R a little less than D/2. M and T go
with the eighth to tenth power of the angle here, so a hundredth of an angle is a tenth of them. The
three measures of the angle part by what a grid leaves open: a uniform ply made of elements h long
is off by about (tau h)^2, tau the rod's twist; `--finer` brings the end onto a finer grid.

Writes run.h5, snapshots.png, ply.png and summary.json; the exit status is 0 if the run came to its
end without a passage.
"""

import argparse
import dataclasses
import json
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

import _settings  # noqa: F401 (first)
import jax
import matplotlib.pyplot as plt
import numpy as np
from intertwine import CHUNK, Recorder, run_adaptive
from scipy.interpolate import CubicSpline
from scipy.optimize import brentq

import rodjax as rx
from rodjax import energy, measures, plot, storage
from rodjax.dynamics.adaptive import compile_adaptive_rollout
from rodjax.measuring.reactions import reactions
from rodjax.rods.strains import curvature

LENGTH, RADIUS = 0.5, 1.55e-3  # [m]
YOUNGS_MODULUS, DENSITY = 1.3e6, 1200.0  # [Pa], [kg/m^3]; Poisson's ratio 1/2
NEARER = 0.3  # ends, of the length
RATE = 0.25  # [turns/s]
HOLD = 10.0  # after each stage [s]
SEED_CURVATURE = 0.02  # natural, about a_1 [1/m]
DRAG = (0.05, 0.05, 1e-7)  # normal, tangential [N s/m^2], rotational [N s]
RELAXATION = 1e-3  # of the contact, which takes the bounces from strands that meet [s]
MAX_STEP = 0.2  # [s]
AXIS = (0.0, 0.0, 1.0)
TOUCHING = 1.02  # distance of strands that count as touching [D]


class Size(NamedTuple):
    """How large the experiment is."""

    elements: int
    turns: tuple[float, ...]  # at which the drive is held
    force: float  # between crossing strands [N], see `Contact.solid`
    indentation: float  # at this force [D]
    segments: int  # of the contact


FULL = Size(400, (8.0, 12.0, 16.0, 20.0), 0.1, 0.03, 640)
QUICK = Size(120, (10.0,), 0.05, 0.1, 240)


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


def arch(elements: int) -> tuple[np.ndarray, np.ndarray]:
    """Nodes and frames of a planar arch between clamps, its tangents at angles a sin(2 pi s/L)."""
    step = LENGTH / elements
    wave = np.sin(2 * np.pi * np.arange(elements + 1) / elements)
    wave[[0, -1]] = 0.0  # ends along the axis, to the last bit

    def nodes(amplitude):
        angle = 0.5 * amplitude * (wave[1:] + wave[:-1])
        chords = step * np.stack([np.sin(angle), np.zeros_like(angle), np.cos(angle)], -1)
        return np.concatenate([np.zeros((1, 3)), np.cumsum(chords, 0)])

    chord = (1 - NEARER) * LENGTH
    amplitude = brentq(lambda a: nodes(a)[-1, 2] - chord, 0.1, 2.4)
    half, none = 0.5 * amplitude * wave, np.zeros_like(wave)
    return nodes(amplitude), np.stack([np.cos(half), none, np.sin(half), none], -1)


def rod(elements: int) -> rx.Rod:
    """The rod, straight but for its seed of curvature, placed as an arch."""
    section = rx.circular_section(
        2 * RADIUS, YOUNGS_MODULUS, shear_modulus=YOUNGS_MODULUS / 3, density=DENSITY
    )
    seed = (SEED_CURVATURE, 0.0, 0.0)
    straight = rx.straight_rod(LENGTH, elements, section, direction=AXIS, natural_curvature=seed)
    position, quaternion = arch(elements)
    return dataclasses.replace(straight, position=position, quaternion=quaternion)


def holds(turns: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Times at which the drive stops and goes on [s], one row a stage; and the knots of both."""
    wound = np.array(turns) / RATE
    stops = wound + HOLD * np.arange(len(turns))
    rows = np.stack([stops, stops + HOLD], -1)
    return rows, np.repeat(turns, 2)


def contact(whole: rx.Rod, size: Size) -> rx.Contact:
    """Contact of solid strands, on segments short beside the bends of a ply.

    Contact points lie on chords between the segments' ends, inside of a bend kappa = sin^2(theta)/R
    by kappa l^2/12 on average. So the strands are kept kappa l^2/6 farther apart, and since that
    goes with the angle too, M is l^2 sin^2(theta)/(12 R^2 cos 2 theta) above the theory's (half a
    hundredth here, 4 % with as few segments as `Contact.solid` chooses) and T about as much.
    """
    solid = rx.Contact.solid(whole, size.force, indentation=size.indentation, relaxation=RELAXATION)
    points = int(np.ceil(solid.segments * solid.points_per_segment / size.segments))
    return dataclasses.replace(solid, segments=size.segments, points_per_segment=points)


def scene(size: Size) -> rx.Scene:
    """The rod between its clamps, that of s = 0 turned so that Lk grows."""
    rows, turns = holds(size.turns)
    # and one hold more, for `settled`
    times = np.concatenate([[0.0], rows.ravel(), [rows[-1, 1] + HOLD]])
    angle = rx.PiecewiseLinear(times, -2 * np.pi * np.concatenate([[0.0], turns, turns[-1:]]))
    whole = rod(size.elements)
    return rx.Scene(
        whole,
        first_end=rx.Clamped(rotation=rx.Turn(AXIS, angle)),
        last_end=rx.Clamped(),
        loads=(rx.LinearDrag(*DRAG),),
        contact=contact(whole, size),
    )


class Strands(NamedTuple):
    """Nodes of one strand of the ply, from the tails to the loop, and the nearest places opposite.

    Attributes:
        node: numbers.
        opposite: arc length of the nearest place on the other strand [m].
        distance: of the centrelines [m].
        angle: of the strands to their axis, by the curvature of a helix [rad].
        between_lines: half the angle between the centrelines [rad].
        between_normals: half the angle between the normals of the cross-sections [rad].
    """

    node: np.ndarray
    opposite: np.ndarray
    distance: np.ndarray
    angle: np.ndarray
    between_lines: np.ndarray
    between_normals: np.ndarray


def fine_line(rod: rx.Rod, state, pieces: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Arc lengths, places and tangents between the nodes too, on the spline through the nodes."""
    nodes = LENGTH / rod.elements * np.arange(rod.elements + 1)
    line = CubicSpline(nodes, np.asarray(state.position))
    s = LENGTH / (rod.elements * pieces) * np.arange(rod.elements * pieces + 1)
    return s, line(s), unit(line(s, 1))


def unit(vectors: np.ndarray) -> np.ndarray:
    """Vectors over their lengths."""
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def touching(rod: rx.Rod, state, pieces: int = 8) -> Strands:
    """Where strands are within `TOUCHING` of each other, listed on the one that comes first."""
    step = LENGTH / rod.elements
    s, places, directions = fine_line(rod, state, pieces)
    nodes = np.arange(rod.elements + 1)
    gap = np.sum((places[None] - places[nodes * pieces][:, None]) ** 2, -1)
    # a loop as tight as rods can make comes back to itself beyond two diameters
    gap[s[None] < step * nodes[:, None] + 4 * RADIUS] = np.inf
    near = np.clip(np.argmin(gap, 1), 1, len(places) - 2)
    before, at, after = (gap[nodes, near + k] for k in (-1, 0, 1))
    known = np.isfinite(before) & np.isfinite(at) & (before > at) & (after >= at)
    nodes, near, before, at, after = (v[known] for v in (nodes, near, before, at, after))
    shift = 0.5 * (before - after) / (before - 2 * at + after)
    distance = np.sqrt(at - 0.25 * (before - after) * shift)
    keep = distance < 2 * RADIUS * TOUCHING
    node, near, shift, distance = (v[keep] for v in (nodes, near, shift, distance))
    opposite = s[near] + shift * s[1]
    half = lambda one, other: 0.5 * np.arccos(np.clip(-np.sum(one * other, 1), -1, 1))
    normals = CubicSpline(s[::pieces], np.asarray(tangents(state.quaternion)))
    bent = np.linalg.norm(np.asarray(curvature(rod, state.quaternion))[:, :2], axis=1)
    bent = 0.5 * (bent[node - 1] + bent[node])
    return Strands(
        node,
        opposite,
        distance,
        np.arcsin(np.sqrt(np.clip(0.5 * distance * bent, 0, 1))),
        half(directions[node * pieces], directions[near]),
        half(normals(s[node * pieces]), unit(normals(opposite))),
    )


tangents = jax.vmap(rx.rotations.tangent_director)


class Theory(NamedTuple):
    """Torque [N m], tension [N] and contact force per length [N/m] of a uniform ply."""

    torque: float
    tension: float
    pressure: float


def closed_form(stiffness: float, radius: float, angle: float) -> Theory:
    """Clauvelin, Audoly & Neukirch: see the head of this file."""
    sine, cosine, double = np.sin(angle), np.cos(angle), np.cos(2 * angle)
    return Theory(
        float(2 * stiffness * sine**3 * cosine / (radius * double)),
        float(stiffness / radius**2 * sine**4 * (0.5 + 1 / double)),
        float(stiffness / radius**3 * sine**4 / double),
    )


def angle_of(stiffness: float, radius: float, torque: float) -> float:
    """Angle of the uniform ply of a radius under a torque [rad]."""
    gap = lambda angle: closed_form(stiffness, radius, angle).torque - torque
    return float(brentq(gap, 0.0, 0.25 * np.pi - 1e-9))


def middle(strands: Strands) -> Strands | None:
    """The middle half of the arc on which strands touch; None where they hardly do."""
    count = len(strands.node)
    if count < 8:
        return None
    arc = strands.node[-1] - strands.node[0]
    low, high = strands.node[0] + 0.25 * arc, strands.node[-1] - 0.25 * arc
    inside = (strands.node >= low) & (strands.node <= high)
    return Strands(*(values[inside] for values in strands))


class At(NamedTuple):
    """What is measured at the end of a hold; `ply` is None where strands hardly touch."""

    turns: float
    torque: float
    torque_of_other_clamp: float
    tension: float
    kinetic_over_strain: float
    ply: dict[str, Any] | None


def ply_of(whole: rx.Scene, state, torque: float, tension: float) -> dict[str, Any] | None:
    """The ply of a state at rest, beside the theory."""
    strands = touching(whole.rod, state)
    inner = middle(strands)
    if inner is None:
        return None
    stiffness, step = float(whole.rod.stiffness[0, 0]), LENGTH / whole.rod.elements
    radius, angle = 0.5 * float(np.mean(inner.distance)), float(np.mean(inner.angle))
    force = np.linalg.norm(energy.contact_wrench(whole, state)[:, :3], axis=1)
    pressure = float(np.mean((force / np.asarray(whole.rod.node_length))[inner.node]))
    found = Theory(torque, tension, pressure)
    contour = 2 * step * float(strands.node[-1] - strands.node[0])  # one of two strands is listed
    others = {name: float(np.mean(getattr(inner, name))) for name in OTHER_ANGLES}
    # the radius and the torque alone, whatever the angle
    expected = angle_of(stiffness, radius, torque)
    return {
        "contour": contour,
        "crossings": float(np.sin(angle) * contour / (2 * np.pi * radius)),
        "radius": radius,
        "radius_deviation": 0.5 * float(np.std(inner.distance)),
        "radius_over_rods": radius / RADIUS,
        "angle_degrees": float(np.degrees(angle)),
        "angle_deviation_degrees": float(np.degrees(np.std(inner.angle))),
        "other_angles_degrees": {name: float(np.degrees(v)) for name, v in others.items()},
        "pressure": pressure,
        "theory": closed_form(stiffness, radius, angle)._asdict(),
        "ratio": ratios(found, closed_form(stiffness, radius, angle)),
        "ratio_by_other_angles": {
            name: ratios(found, closed_form(stiffness, radius, v)) for name, v in others.items()
        },
        "angle_of_radius_and_torque_degrees": float(np.degrees(expected)),
        "ratio_by_radius_and_torque": ratios(found, closed_form(stiffness, radius, expected)),
    }


OTHER_ANGLES = ("between_lines", "between_normals")


def ratios(found: Theory, expected: Theory) -> dict[str, float]:
    """What was measured over the theory."""
    return {
        name: float(value) / float(getattr(expected, name))
        for name, value in found._asdict().items()
    }


def at_hold(whole: rx.Scene, state, turns: float) -> At:
    """The clamps and the ply of a state at rest."""
    held = reactions(whole, state)
    first, last = (float(moment @ np.array(AXIS)) for moment in held.torque)
    tension = float(held.force[1] @ np.array(AXIS))
    motion = energy.kinetic_energy(whole, state) / (
        energy.bending_energy(whole, state) + energy.torsion_energy(whole, state)
    )
    ply = ply_of(whole, state, -first, tension)
    return At(turns, -first, last, tension, float(motion), ply)


@rx.jit
def clamp_series(whole: rx.Scene, states):
    """Torque and tension at the clamps of many states."""

    def one(state):
        held = reactions(whole, state)
        return -held.torque[0, 2], held.force[1, 2]

    return jax.lax.map(one, states)


def draw(out: Path, whole: rx.Scene, run: rx.Run, linking, found: list[At]) -> None:
    """The rod at several times; torque, tension, ratios to the theory, the ply along itself."""
    rows, _ = holds(tuple(one.turns for one in found))
    touch = float(run.times[int(np.argmax(np.asarray(linking.writhe) > 1.0))])
    states = [run.state(0), run.nearest(touch), *(run.nearest(end) for _, end in rows)]
    plot.snapshots(
        whole.rod,
        states,
        [energy.strain_energy_density(whole.rod, state) for state in states],
        title=f"D = {2e3 * RADIUS:g} mm, ends {NEARER:.0%} nearer",
        stripe_first=False,
    ).savefig(out / "snapshots.png", dpi=200)

    figure, axes = plt.subplots(2, 2, figsize=(11, 8), layout="constrained")
    some = jax.tree.map(lambda leaf: leaf[:: max(1, len(run.times) // 400)], run.states)
    torque, tension = (np.asarray(v) for v in clamp_series(whole, some))
    applied = np.interp(some.time, run.times, linking.turns)
    plied = [one for one in found if one.ply is not None]
    turns = [one.turns for one in plied]
    curves = ((torque, "torque", "torque [mN m]"), (tension, "tension", "tension [mN]"))
    for one, (values, name, label) in zip(axes[0], curves, strict=True):
        one.plot(applied, 1e3 * values, lw=1, label="at the clamps")
        theory = [1e3 * at.ply["theory"][name] for at in plied]
        one.plot(turns, theory, "ko", mfc="none", label="uniform ply, of the R and angle measured")
        one.set(xlabel="turns applied", ylabel=label)
        one.legend()
    axes[0, 1].set_ylim(1.1e3 * min(0.0, np.min(tension)), 1.15e3 * tension[-1])
    for name, style in (("torque", "o"), ("tension", "s"), ("pressure", "^")):
        axes[1, 0].plot(turns, [at.ply["ratio"][name] for at in plied], f"C0{style}-", label=name)
        for other, color in zip(OTHER_ANGLES, ("C1", "C2"), strict=True):
            values = [at.ply["ratio_by_other_angles"][other][name] for at in plied]
            axes[1, 0].plot(turns, values, f"{color}{style}:", mfc="none", ms=4)
    axes[1, 0].axhspan(0.97, 1.03, color="0.9")
    axes[1, 0].set(xlabel="turns applied", ylabel="measured over theory")
    axes[1, 0].set_title("dotted: angle between lines (orange), normals (green)", fontsize=9)
    axes[1, 0].legend()
    if plied:
        strands = touching(whole.rod, run.final)
        inner = middle(strands)
        s = 1e3 * LENGTH / whole.rod.elements * strands.node
        axes[1, 1].plot(s, np.degrees(strands.angle), "C0.-", label="angle [degrees]")
        other = axes[1, 1].twinx()
        other.plot(s, 0.5 * strands.distance / RADIUS, "C1.-")
        other.set_ylabel("R over half a diameter", color="C1")
        if inner is not None:
            ends = 1e3 * LENGTH / whole.rod.elements * inner.node[[0, -1]]
            axes[1, 1].axvspan(*ends, color="0.9")
        axes[1, 1].set(xlabel="s of the first strand [mm]; grey: where measured")
        axes[1, 1].set_ylabel("ply angle [degrees]", color="C0")
        axes[1, 1].set_title(f"the ply at {found[-1].turns:g} turns")
    for one in axes.flat[:3]:
        one.grid(alpha=0.3)
    figure.savefig(out / "ply.png", dpi=150)
    plt.close(figure)


def printed(found: list[At]) -> None:
    """A table of the holds."""
    print(
        f"{'turns':>5} {'M [mN m]':>9} {'T [mN]':>8} {'crossings':>9} {'R/(D/2)':>8} {'theta':>7}"
        f" {'lines':>7} {'normals':>7} {'of R, M':>7}  {'M':>6} {'T':>6} {'p':>6} over theory"
    )
    for at in found:
        row = f"{at.turns:5g} {1e3 * at.torque:9.5f} {1e3 * at.tension:8.3f}"
        if at.ply is not None:
            ply = at.ply
            angles = (ply["angle_degrees"], *ply["other_angles_degrees"].values())
            angles += (ply["angle_of_radius_and_torque_degrees"],)
            row += f" {ply['crossings']:9.2f} {ply['radius_over_rods']:8.4f}"
            row += "".join(f" {v:7.3f}" for v in angles) + " "
            row += "".join(f" {v:6.4f}" for v in ply["ratio"].values())
        print(row)


def settled(whole: rx.Scene, state, elements: int, size: Size) -> tuple[rx.Scene, rx.Run]:
    """The state at rest on another grid, with contact segments in proportion."""
    segments = round(size.segments * elements / size.elements)
    other = scene(size._replace(elements=elements, segments=segments))
    new = rx.regrid(state, other.rod)
    first = rx.start(
        other,
        position=new.position,
        quaternion=new.quaternion,
        velocity=new.velocity,
        angular_velocity=new.angular_velocity,
        time=new.time,
    )
    control = rx.StepControl(max_step=MAX_STEP, first_step=0.01 * MAX_STEP)
    run = rx.adaptive_rollout(other, first, float(state.time) + HOLD, control=control, throw=False)
    return other, run


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
