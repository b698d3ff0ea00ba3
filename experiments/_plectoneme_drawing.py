"""Pictures of `plectoneme.py`: the rod at several times, the clamps, the ply beside the theory."""

from pathlib import Path

import jax
import matplotlib.pyplot as plt
import numpy as np
from _plectoneme_holds import OTHER_ANGLES, At
from _plectoneme_scene import LENGTH, NEARER, RADIUS, holds
from _plectoneme_strands import middle, touching

import rodjax as rx
from rodjax import energy, plot
from rodjax.measuring.reactions import reactions


def draw(out: Path, whole: rx.Scene, run: rx.Run, linking, found: list[At]) -> None:
    """The rod at several times; torque, tension, ratios to the theory, the ply along itself."""
    snapshots(out / "snapshots.png", whole, run, linking, found)
    figure, axes = plt.subplots(2, 2, figsize=(11, 8), layout="constrained")
    plied = [one for one in found if one.ply is not None]
    of_clamps(axes[0], whole, run, linking, plied)
    of_ratios(axes[1, 0], plied)
    if plied:
        along_the_ply(axes[1, 1], whole, run.final, found[-1].turns)
    for one in axes.flat[:3]:
        one.grid(alpha=0.3)
    figure.savefig(out / "ply.png", dpi=150)
    plt.close(figure)


def snapshots(path: Path, whole: rx.Scene, run: rx.Run, linking, found: list[At]) -> None:
    """The rod at its start, when it first crosses itself, and at the end of every hold."""
    rows, _ = holds(tuple(one.turns for one in found))
    touch = float(run.times[int(np.argmax(np.asarray(linking.writhe) > 1.0))])
    states = [run.state(0), run.nearest(touch), *(run.nearest(end) for _, end in rows)]
    plot.snapshots(
        whole.rod,
        states,
        [energy.strain_energy_density(whole.rod, state) for state in states],
        title=f"D = {2e3 * RADIUS:g} mm, ends {NEARER:.0%} nearer",
        stripe_first=False,
    ).savefig(path, dpi=200)


@rx.jit
def clamp_series(whole: rx.Scene, states):
    """Torque and tension at the clamps of many states."""

    def one(state):
        held = reactions(whole, state)
        return -held.torque[0, 2], held.force[1, 2]

    return jax.lax.map(one, states)


def of_clamps(axes, whole: rx.Scene, run: rx.Run, linking, plied: list[At]) -> None:
    """Torque and tension at the clamps against the turns applied, an axis each."""
    some = jax.tree.map(lambda leaf: leaf[:: max(1, len(run.times) // 400)], run.states)
    torque, tension = (np.asarray(v) for v in clamp_series(whole, some))
    applied = np.interp(some.time, run.times, linking.turns)
    turns = [one.turns for one in plied]
    curves = ((torque, "torque", "torque [mN m]"), (tension, "tension", "tension [mN]"))
    for one, (values, name, label) in zip(axes, curves, strict=True):
        one.plot(applied, 1e3 * values, lw=1, label="at the clamps")
        theory = [1e3 * at.ply["theory"][name] for at in plied]
        one.plot(turns, theory, "ko", mfc="none", label="uniform ply, of the R and angle measured")
        one.set(xlabel="turns applied", ylabel=label)
        one.legend()
    axes[1].set_ylim(1.1e3 * min(0.0, np.min(tension)), 1.15e3 * tension[-1])


def of_ratios(axis, plied: list[At]) -> None:
    """What was measured over the theory, by each of the three angles."""
    turns = [one.turns for one in plied]
    for name, style in (("torque", "o"), ("tension", "s"), ("pressure", "^")):
        axis.plot(turns, [at.ply["ratio"][name] for at in plied], f"C0{style}-", label=name)
        for other, color in zip(OTHER_ANGLES, ("C1", "C2"), strict=True):
            values = [at.ply["ratio_by_other_angles"][other][name] for at in plied]
            axis.plot(turns, values, f"{color}{style}:", mfc="none", ms=4)
    axis.axhspan(0.97, 1.03, color="0.9")
    axis.set(xlabel="turns applied", ylabel="measured over theory")
    axis.set_title("dotted: angle between lines (orange), normals (green)", fontsize=9)
    axis.legend()


def along_the_ply(axis, whole: rx.Scene, state: rx.State, turns: float) -> None:
    """Angle and radius along the first strand."""
    strands = touching(whole.rod, state)
    inner = middle(strands)
    step = 1e3 * LENGTH / whole.rod.elements
    s = step * strands.node
    axis.plot(s, np.degrees(strands.angle), "C0.-", label="angle [degrees]")
    other = axis.twinx()
    other.plot(s, 0.5 * strands.distance / RADIUS, "C1.-")
    other.set_ylabel("R over half a diameter", color="C1")
    if inner is not None:
        axis.axvspan(*(step * inner.node[[0, -1]]), color="0.9")
    axis.set(xlabel="s of the first strand [mm]; grey: where measured")
    axis.set_ylabel("ply angle [degrees]", color="C0")
    axis.set_title(f"the ply at {turns:g} turns")
