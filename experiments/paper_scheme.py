"""The paper's own scheme beside the default: orders, agreement, shooting, damping along s.

    python experiments/paper_scheme.py [--quick] [--out DIR]

1. A smoothly driven rod (units of its length, bending stiffness and mass): differences of
   successive refinements of dt and of ds, and the difference of the two schemes as both are
   refined together.
2. One step of a moving rod of the paper's materials, D = 2 mm, by single shooting and by the block
   solve, as dt is refined.
3. How many steps the driven rod takes with spectral radii along s below 1.

Writes DIR/summary.json, DIR/orders.png and DIR/shooting.png.
"""

import argparse
import json
import sys
from pathlib import Path

import _settings  # noqa: F401 (first)
import equinox as eqx
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from jax import lax

import rodjax as rx
from rodjax.numerics.results import Result
from rodjax.reference.paper_scheme import PaperScheme, fields_of, paper_step
from rodjax.reference.paper_solvers import Shooting

FIELDS = {"position": "position", "rate": "velocities", "force": "internal force"}
NAMES = {"paper": "paper's scheme", "default": "default scheme"}
END = 0.4  # of the driven rod's motion
DIAMETER = 2e-3  # of the rod that is shot at [m]
COARSEST = 8  # elements; states are compared at the nodes of this grid


def driven(elements: int) -> rx.Scene:
    """A rod between a clamp that shifts and turns smoothly and a slider, in a fluid."""
    section = rx.Section((1.0, 1.3, 0.8), mass=1.0, rotary_inertia=(0.02, 0.02, 0.04), diameter=0.1)
    rod = rx.straight_rod(1.0, elements, section)
    pulse = lambda t: jnp.sin(1.5 * t) ** 6
    shift = rx.Function(lambda t: pulse(t) * jnp.asarray([0.4, -0.2, 0.8]))
    turn = rx.Turn((0.0, 0.0, 1.0), rx.Function(lambda t: 4 * pulse(t)))
    loads = (rx.MorisonDrag(1.0, 2.0, 0.5), rx.Gravity((0.0, 0.0, 1.0)))
    return rx.Scene(rod, rx.Clamped(shift, turn), rx.Slider((0.0, 0.0, 1.0)), loads)


def thin(elements: int) -> rx.Scene:
    """A rod of the paper's materials, shaken and turned at one end, sliding at the other."""
    section = rx.circular_section(DIAMETER, 1.25e7, 5e6, 1500.0)
    rod = rx.straight_rod(1.0, elements, section, direction=(0.0, 1.0, 0.0))
    pulse = lambda t: jnp.sin(0.5 * jnp.pi * t) ** 6
    shift = rx.Function(lambda t: pulse(t) * jnp.asarray([0.05, -0.1, 0.03]))
    turn = rx.Turn((0.0, 1.0, 0.0), rx.Function(lambda t: 6 * pulse(t)))
    drag = rx.MorisonDrag(1000.0, 0.1, 0.01)
    return rx.Scene(rod, rx.Clamped(shift, turn), rx.Slider((0.0, 1.0, 0.0)), (drag,))


@eqx.filter_jit
def advance(scene, motion, end, count, method):
    """Motion after `count` equal steps, the worst result, and how many steps succeeded.

    All numbers are traced: one compilation serves every step size.
    """
    paper = isinstance(method, PaperScheme)
    begin = motion.state.time if paper else motion.time
    take = paper_step if paper else rx.step

    def one(i, carry):
        now, worst, good = carry
        now, info = take(scene, now, begin + (end - begin) * ((i + 1) / count), method)
        worst = jnp.maximum(worst, info.result)
        return now, worst, good + (worst == Result.SUCCESS).astype(good.dtype)

    zero = jnp.asarray(0, jnp.int32)
    return lax.fori_loop(0, count, one, (motion, zero, zero))


def run(scene, end, count, method, motion=None):
    """Motion, worst result and number of steps that succeeded, from rest or from a motion."""
    if motion is None:
        motion = rx.start(scene)
        motion = fields_of(scene, motion) if isinstance(method, PaperScheme) else motion
    motion, worst, good = advance(scene, motion, jnp.asarray(end), jnp.asarray(count), method)
    return motion, Result(int(worst)), int(good)


METHODS = {"paper": PaperScheme(tolerance=1e-11), "default": rx.GeneralizedAlpha(tolerance=1e-12)}


def final(scheme: str, elements: int, count: int) -> dict[str, np.ndarray]:
    """Fields at the end of the driven motion, at the nodes of the coarsest grid."""
    motion, worst, _ = run(driven(elements), END, count, METHODS[scheme])
    assert worst is Result.SUCCESS, worst
    state = motion.state if scheme == "paper" else motion
    every = elements // COARSEST
    force = 0.5 * (state.force[1:] + state.force[:-1])
    return {
        "position": np.asarray(state.position)[::every],
        "rate": np.asarray(state.rate)[::every],
        "force": np.asarray(force)[every - 1 :: every],
    }


def gap(a: dict, b: dict) -> dict[str, float]:
    """Largest differences, relative to the largest entries."""
    return {k: float(np.max(np.abs(a[k] - b[k])) / np.max(np.abs(b[k]))) for k in FIELDS}


def slope(sizes, errors) -> float:
    """Observed order by least squares."""
    return float(np.polyfit(np.log(sizes), np.log(errors), 1)[0])


def refined(name, sizes, gaps) -> dict:
    """Table of differences with their observed orders, printed."""
    columns = {k: [g[k] for g in gaps] for k in FIELDS}
    orders = {k: slope(sizes, v) for k, v in columns.items()}
    print(f"{name}: " + ", ".join(f"{FIELDS[k]} {orders[k]:.3f}" for k in FIELDS), flush=True)
    return {"sizes": list(map(float, sizes)), "differences": columns, "orders": orders}


def convergence(quick: bool) -> dict:
    """Part 1."""
    elements = COARSEST * 2 ** np.arange(3 if quick else 5)
    counts = 40 * 2 ** np.arange(4 if quick else 5)
    found = {}
    for scheme in METHODS:
        states = [final(scheme, COARSEST, int(n)) for n in counts]
        gaps = [gap(a, b) for a, b in zip(states, states[1:], strict=False)]
        found[f"{scheme}, dt"] = refined(f"order in dt, {NAMES[scheme]}", END / counts[:-1], gaps)
        states = [final(scheme, int(n), 100) for n in elements]
        gaps = [gap(a, b) for a, b in zip(states, states[1:], strict=False)]
        found[f"{scheme}, ds"] = refined(f"order in ds, {NAMES[scheme]}", 1 / elements[:-1], gaps)
    gaps = [gap(*(final(scheme, int(n), 10 * int(n)) for scheme in METHODS)) for n in elements]
    found["between"] = refined("the two schemes, dt and ds together", 1 / elements, gaps)
    return found


def shooting(quick: bool) -> dict:
    """Part 2.

    Over an element of ds the box scheme multiplies exp(z), z = k ds, by |(1 + z/2) / (1 - z/2)|, at
    most 1 + sqrt(2): on a grid that does not resolve the waves of a step the march grows less.
    """
    elements = 60 if quick else 100
    scene = thin(elements)
    moving, worst, _ = run(scene, 0.5, 50, PaperScheme())
    assert worst is Result.SUCCESS, worst
    stiffness, mass = float(scene.rod.stiffness[0, 0]), float(scene.rod.mass[0])
    rows = []
    for dt in [0.1, 0.05, 0.03, 0.02, 0.01, 0.007, 0.005, 0.003]:
        block, worst, _ = run(scene, 0.5 + dt, 1, PaperScheme(), moving)
        shot, code, _ = run(scene, 0.5 + dt, 1, PaperScheme(solver=Shooting()), moving)
        force, expected = shot.value[:, 9:], block.value[:, 9:]
        growth = (mass / (stiffness * (0.5 * dt) ** 2)) ** 0.25 / 2**0.5
        half = 0.5 * growth * (1 + 1j) / elements
        on_grid = elements * float(np.log(abs((1 + half) / (1 - half))))
        difference = float(jnp.max(jnp.abs(force - expected)) / jnp.max(jnp.abs(expected)))
        row = {
            "dt": dt,
            "exponent": growth,
            "exponent_on_grid": on_grid,
            "difference": difference if np.isfinite(difference) else None,
            "shooting": code.name,
            "block": worst.name,
        }
        rows.append(row)
        shown = "not a number" if row["difference"] is None else f"{difference:.1e}"
        print(
            f"dt = {dt:g} s, growth e^{growth:.1f}, on the grid e^{on_grid:.1f}:"
            f" block {worst.name}, shooting {code.name}, internal forces differ by {shown}",
            flush=True,
        )
    return {"elements": elements, "diameter": DIAMETER, "rows": rows}


def damping(quick: bool) -> list[dict]:
    """Part 3."""
    elements, count = 32, 200 if quick else 400
    scene, rows = driven(elements), []
    for dt in (0.02, 0.004, 0.001):
        for rho in (0.0, 0.25, 0.5, 0.75, 1.0):
            _, _, good = run(scene, count * dt, count, PaperScheme(rho_space=rho))
            rows.append({"dt": dt, "rho_space": rho, "steps": good, "of": count})
        told = ", ".join(f"{row['steps']} at {row['rho_space']:g}" for row in rows[-5:])
        print(f"dt = {dt:g}: of {count} steps succeeded, by rho_space: {told}", flush=True)
    return rows


def plot_orders(found: dict, path: Path) -> None:
    """Differences of refinements of both schemes, and between them."""
    figure, axes = plt.subplots(1, 3, figsize=(11, 5.5), sharey=True, layout="constrained")
    colors = dict(zip(FIELDS, ("C0", "C1", "C2"), strict=True))
    panels = zip(axes, ("dt", "ds"), ("step dt", "element length ds"), strict=False)
    for axis, by, label in panels:
        for scheme, marker in (("paper", "o-"), ("default", "s--")):
            table = found[f"{scheme}, {by}"]
            for k, color in colors.items():
                text = f"{NAMES[scheme]}, {FIELDS[k]}: {table['orders'][k]:.2f}"
                axis.loglog(
                    table["sizes"], table["differences"][k], marker, color=color, label=text
                )
        axis.set(xlabel=label, title=f"Refinement of {by}, and its order")
    axes[0].set_ylabel("relative difference")
    for k, color in colors.items():
        table = found["between"]
        text = f"{FIELDS[k]}: {table['orders'][k]:.2f}"
        axes[2].loglog(table["sizes"], table["differences"][k], "o-", color=color, label=text)
    axes[2].set(xlabel="ds = 25 dt", title="Between the two schemes")
    for axis, table in zip(axes, ("paper, dt", "paper, ds", "between"), strict=True):
        sizes = found[table]["sizes"]
        axis.set_xticks(sizes, [f"{size:.3g}" for size in sizes])
        axis.set_xticks([], minor=True)
        axis.legend(fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.15))
        axis.grid(alpha=0.3)
    figure.savefig(path, dpi=150)
    plt.close(figure)


def plot_shooting(found: dict, path: Path) -> None:
    """Difference of shooting from the block solve against dt."""
    figure, axis = plt.subplots(figsize=(6, 5), layout="constrained")
    good = [r for r in found["rows"] if r["shooting"] == "SUCCESS"]
    failed = [r["dt"] for r in found["rows"] if r["shooting"] != "SUCCESS"]
    axis.loglog([r["dt"] for r in good], [r["difference"] for r in good], "o-", label="shooting")
    axis.loglog(failed, np.ones(len(failed)), "rx", label="Newton failed (put at 1)")
    dt = np.array([r["dt"] for r in found["rows"]])
    loss = np.finfo(float).eps * np.exp([r["exponent_on_grid"] for r in found["rows"]])
    axis.loglog(
        dt, np.minimum(loss, 1), "k:", label="round-off times growth of the march, at most 1"
    )
    axis.set(
        xlabel="step dt [s]",
        ylabel="difference of f from the block solve",
        title=f"One step, D = {1e3 * found['diameter']:g} mm, {found['elements']} elements",
    )
    axis.legend(loc="upper center", bbox_to_anchor=(0.5, -0.15))
    axis.grid(alpha=0.3)
    figure.savefig(path, dpi=150)
    plt.close(figure)


def main(argv=None) -> int:
    """Run the parts, each saved as soon as it is done."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--quick", action="store_true", help="coarse grids, to try it out")
    parser.add_argument("--out", type=Path, default=Path("results/paper_scheme"), metavar="DIR")
    options = parser.parse_args(argv)
    options.out.mkdir(parents=True, exist_ok=True)
    summary = {"quick": options.quick}
    parts = {"shooting": shooting, "convergence": convergence, "damping": damping}
    for name, part in parts.items():
        summary[name] = part(options.quick)
        (options.out / "summary.json").write_text(json.dumps(summary, indent=2) + "\n")
    plot_orders(summary["convergence"], options.out / "orders.png")
    plot_shooting(summary["shooting"], options.out / "shooting.png")
    return 0


if __name__ == "__main__":
    sys.exit(main())
