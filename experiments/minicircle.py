"""A DNA minicircle at room temperature: how its writhe is distributed, by its linking number.

    python experiments/minicircle.py [--quick] [--out DIR]

A ring of 336 base pairs (A = 50 nm kT, C = 100 nm kT) that is naturally straight is closed with so
many turns and shaken by thermal noise in water, in replicas that start alike. Twist and writhe sum
to the turns whatever happens; how they share them fluctuates. A ring closed without turns is as
often one way as the other: its mean writhe is zero (detailed balance), in the mean of all and over
time. Each distribution is compared with that of samples by Metropolis' method (`_ring_samples`),
which has no steps of time. Writes DIR/minicircle.png and DIR/summary.json.
"""

import argparse
import json
import time
from pathlib import Path

import _settings  # noqa: F401 (first)
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from _molecule import BATH, CHARGES, DIAMETER, DRAG, EXCLUSION, KT, A, C
from _ring_samples import writhes

import rodjax as rx
from rodjax.rods.winding import writhe_of

LENGTH = 114.0  # [nm]
EDGES = np.linspace(-2.5, 2.5, 51)  # of the histogram of the writhe


def ring_of(turns: float, elements: int) -> rx.Scene:
    """The ring of so many turns in water, with its charges."""
    section = rx.Section(stiffness=(A, A, C), diameter=DIAMETER)
    rod = rx.yielding(rx.ring(LENGTH, elements, section, turns=turns), 10.0)
    return rx.Scene(
        rod,
        loads=(rx.LinearDrag(*DRAG),),
        contact=rx.Contact(
            CHARGES, segments=elements, cutoff=14.0, exclusion=EXCLUSION, pairs_per_segment=16
        ),
        joints=(rx.Weld(rx.Point(0), rx.Point(-1)),),
    )


def seen(state):
    """Writhe of the closed polygon, its square and its place in the histogram, and the twist."""
    writhe = writhe_of(True, state)
    edges = jnp.asarray(EDGES)
    inside = (writhe >= edges[:-1]) & (writhe < edges[1:])
    return {
        "writhe": writhe,
        "square": writhe**2,
        "histogram": inside.astype(writhe.dtype),
        "twist": rx.measures.twist(state),
    }


def shaken(turns: float, elements: int, replicas: int, duration: float) -> dict:
    """The writhe of rings of so many turns, over so long a time [us]."""
    scene = ring_of(turns, elements)
    dt = 0.4 * float(rx.relaxation_times(scene)[-1])
    calls = 10
    steps = max(int(duration / dt / calls / 20) * 20, 20)

    @rx.jit
    def advance(starts):
        def one(start):
            run = rx.thermal_rollout(
                scene, start, BATH, dt, steps, measure=seen, measure_every=20, throw=False
            )
            return run.final, run.averages, run.result

        return jax.vmap(one)(starts)

    keys = jax.random.split(jax.random.key(round(100 * turns)), replicas)
    starts = jax.vmap(lambda key: rx.thermal_start(scene, key))(keys)
    began, means, histogram, worst = time.perf_counter(), [], 0.0, 0
    for call in range(calls + calls // 2):
        starts, averages, codes = advance(starts)
        worst = max(worst, int(jnp.max(codes)))
        if call >= calls // 2:  # in equilibrium
            means.append({name: np.asarray(averages.mean[name]) for name in seen_names()})
            histogram = histogram + np.mean(np.asarray(averages.mean["histogram"]), 0) / calls
    writhe = np.array([one["writhe"] for one in means])  # (calls, replicas)
    each = writhe.mean(0)
    late, early = writhe[calls // 2 :].mean(0), writhe[: calls // 2].mean(0)
    over = lambda values: float(np.std(values, ddof=1) / np.sqrt(len(values)))
    linking = np.array([one["writhe"] + one["twist"] for one in means])
    found = {
        "turns": turns,
        "dt": dt,
        "elements": elements,
        "replicas": replicas,
        "duration": calls * steps * dt,
        "writhe": float(each.mean()),
        "writhe_error": over(each),
        **_deviation(np.array([one["square"] for one in means]), writhe),
        "drift": float(np.mean(late - early)),
        "drift_error": over(late - early),
        "linking_error": float(np.max(np.abs(linking - turns))),
        "histogram": histogram.tolist(),
        "result": rx.Result(worst).name,
        "seconds": time.perf_counter() - began,
        "shape": np.asarray(starts.state.position[0]).tolist(),
    }
    print(
        f"{turns:.2f} turns: Wr {found['writhe']:+.3f} +- {found['writhe_error']:.3f}, deviation"
        f" {found['deviation']:.3f} +- {found['deviation_error']:.3f},"
        f" drift {found['drift']:+.3f} +- {found['drift_error']:.3f}, Tw + Wr off by"
        f" {found['linking_error']:.1e}; {found['result']}, {found['seconds']:.0f} s",
        flush=True,
    )
    return found


def _deviation(squares: np.ndarray, writhe: np.ndarray) -> dict:
    """Deviation of the writhe and its error, of means (calls or sweeps, replicas) of Wr^2, Wr."""
    mean = writhe.mean()
    each = squares.mean(0) - 2 * mean * writhe.mean(0) + mean**2  # of each replica, about the mean
    found = float(np.sqrt(each.mean()))
    error = float(np.std(each, ddof=1) / np.sqrt(len(each)) / (2 * found))
    return {"deviation": found, "deviation_error": error}


def sampled(turns: float, elements: int, chains: int, sweeps: int) -> dict:
    """The writhe by Metropolis' method."""
    began = time.perf_counter()
    writhe = writhes(ring_of(turns, elements), KT, chains, sweeps, round(100 * turns))
    each = writhe.mean(0)
    found = {
        "writhe": float(each.mean()),
        "writhe_error": float(np.std(each, ddof=1) / np.sqrt(chains)),
        **_deviation(writhe**2, writhe),
        "histogram": (np.histogram(writhe, EDGES)[0] / writhe.size).tolist(),
        "seconds": time.perf_counter() - began,
    }
    print(
        f"  by Metropolis' method: Wr {found['writhe']:+.3f} +- {found['writhe_error']:.3f},"
        f" deviation {found['deviation']:.3f} +- {found['deviation_error']:.3f};"
        f" {found['seconds']:.0f} s",
        flush=True,
    )
    return found


def seen_names() -> tuple[str, ...]:
    """What is kept of every call."""
    return "writhe", "square", "twist"


def figure(path: Path, rings: list[dict]) -> None:
    """Distributions of the writhe, and how its mean and deviation grow with the turns."""
    fig, (left, right) = plt.subplots(1, 2, figsize=(11, 4.2), layout="constrained")
    width = EDGES[1] - EDGES[0]
    for color, one in zip(("C0", "C2", "C3"), rings, strict=False):
        label = f"{one['turns']:g} turns"
        left.stairs(np.array(one["histogram"]) / width, EDGES, color=color, label=label)
        samples = np.array(one["sampled"]["histogram"]) / width
        left.stairs(samples, EDGES, color=color, ls=":", lw=2)
    left.set(xlabel="writhe", ylabel="probability density", xlim=(-0.5, 1.5))
    left.set_title("dotted: Metropolis' method", fontsize=10)
    left.legend(fontsize=8)
    turns = np.array([one["turns"] for one in rings])
    for shift, fmt, label, of in (
        (-0.02, "o", "heat bath, mean and deviation", rings),
        (0.02, "s", "Metropolis' method", [one["sampled"] for one in rings]),
    ):
        mean, deviation = ([one[name] for one in of] for name in ("writhe", "deviation"))
        right.errorbar(turns + shift, mean, yerr=deviation, fmt=fmt, capsize=3, label=label)
    right.plot(turns, turns, "k:", label="all of the turns")
    right.set(xlabel="linking number", ylabel="writhe")
    right.legend(fontsize=8)
    fig.savefig(path, dpi=100)
    plt.close(fig)


def main(argv=None) -> int:
    """Run the experiment."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--quick", action="store_true", help="coarse and short, to try it out")
    parser.add_argument("--out", type=Path, default=Path("results/minicircle"), metavar="DIR")
    options = parser.parse_args(argv)
    options.out.mkdir(parents=True, exist_ok=True)
    elements, replicas, duration = (24, 4, 0.1) if options.quick else (24, 16, 2.5)
    chains, sweeps = (8, 200) if options.quick else (32, 2000)
    rings = []
    for turns in (0.0,) if options.quick else (0.0, 1.0, 2.0):
        found = shaken(turns, elements, replicas, duration)
        rings.append({**found, "sampled": sampled(turns, elements, chains, sweeps)})
    figure(options.out / "minicircle.png", rings)
    (options.out / "summary.json").write_text(json.dumps(rings, indent=1))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
