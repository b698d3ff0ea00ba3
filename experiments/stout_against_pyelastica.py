"""The stout rod intertwining by rodjax and by PyElastica: what either costs, and how far off it is.

    python experiments/stout_against_pyelastica.py [--elements N] [--tighter K] [--peer-elements M]
                                                   [--until T] [--peer-dt DT] [--quick] [--out DIR]

The rod of the preset `stout` (D = 10 mm, necked), turned 4.5 times in 32 s at one end, the other
sliding along its axis, in both codes with the same drag, shear and extension and with
PyElastica's penalty law of self-contact. Each code's error is its deviation from its own run on
twice the elements with half the tolerances or steps: of Wr(Lk) and of the energies, as means over
2 s. Every run is stored in DIR and used again if it is there; remove a file to repeat its run.
Writes comparison.png, table.txt and summary.json. Needs the extra `peers`.

PyElastica's law gives each pair of elements nearer than D the force k (D - d) + nu d', whatever
their length: it belongs to a grid. Strands side by side, elements ds long, have two such pairs an
element, 2 k x / ds per length at the depth x = D - d; so on the finer grid k and nu are halved with
ds. rodjax's `Penalty` is a density over both strands and pushes them by (4/3) K x sqrt(2 D x) per
length, on any grid; K and its relaxation time nu / k are taken so that both are equal at the depth
`DEPTH`. The laws differ at other depths (x^3/2 against x), where strands cross at an angle
(pi K D x^2 / sin(angle) against k x), and in the short quadratic beginning that Newton needs.
"""

import argparse
import importlib.util
import json
import sys
import time
from pathlib import Path
from typing import NamedTuple

import _settings  # noqa: F401 (first)
import example
import jax
import jax.numpy as jnp
import numpy as np
import peer_problems
import peer_pyelastica
from jax import lax

from rodjax import energy, measures, topology
from rodjax.dynamics.adaptive import adaptive_rollout, compile_adaptive_rollout
from rodjax.dynamics.consistency import start
from rodjax.dynamics.run import Run
from rodjax.dynamics.step_control import StepControl
from rodjax.interactions.contact import Contact
from rodjax.interactions.contact_laws import Penalty
from rodjax.numerics.compilation import compiled
from rodjax.numerics.results import Result
from rodjax.scenes.scene import Scene

PRESET = example.PRESETS["stout"]
UNTIL = 32.0  # [s]
RECORD = 0.1  # [s]
WINDOW = 2.0  # [s]
SPRING, DASHPOT = 1e4, 10.0  # PyElastica's k [N/m] and nu [N s/m] at 100 elements
DEPTH = 2.5e-4  # where the laws of both codes are equal [m]: about where the strands settle
SOFTNESS = 5e-3  # in diameters
PAIR_MARGIN = 0.01  # [m], of the list of near pairs in the refined run
PAIR_CALLS = 40


class Series(NamedTuple):
    """What is compared, over time; energies in joules."""

    time: np.ndarray
    turns: np.ndarray  # applied
    twist: np.ndarray
    writhe: np.ndarray
    bending: np.ndarray
    torsion: np.ndarray
    stretch: np.ndarray  # of axial stretch and shear
    kinetic: np.ndarray


COMPARED = ("writhe", "bending", "torsion", "kinetic")


class Cost(NamedTuple):
    """Of the warm integration loop."""

    cpu_seconds: float
    wall_seconds: float
    steps: int


def arguments(argv=None) -> argparse.Namespace:
    """Options of the command line, with the defaults that --quick changes."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--elements", type=int, metavar="N", help="default 100 (30 with --quick)")
    parser.add_argument("--tighter", type=float, default=2.0, metavar="K",
                        help="the preset's tolerances are divided by this; default 2")  # fmt: skip
    parser.add_argument("--peer-elements", type=int, metavar="M", help="PyElastica's; as rodjax's")
    parser.add_argument("--until", type=float, metavar="T", help="end [s]; default 32 (1)")
    parser.add_argument("--peer-dt", type=float, default=2.5e-5, metavar="DT", help="[s]")
    parser.add_argument("--quick", action="store_true", help="coarse and short, to try it out")
    parser.add_argument(
        "--out", type=Path, default=Path("results/stout_against_pyelastica"), metavar="DIR"
    )
    options = parser.parse_args(argv)
    if options.elements is None:
        options.elements = 30 if options.quick else 100
    if options.peer_elements is None:
        options.peer_elements = options.elements
    if options.until is None:
        options.until = 1.0 if options.quick else UNTIL
    for name in ("elements", "tighter", "peer_elements", "until", "peer_dt"):
        if not getattr(options, name) > 0:
            parser.error(f"--{name.replace('_', '-')}: must be positive")
    return options


def problem(until: float) -> peer_problems.Problem:
    """The preset as a problem for every code, recorded every `RECORD`."""
    last = PRESET.drive[-1]
    turns = last[1] + PRESET.rate_after * (example.LAST_TIME - last[0])
    return peer_problems.Problem(
        example.LOADING_AXIS,
        tuple(RECORD * np.arange(1, round(until / RECORD) + 1)),
        diameter=PRESET.diameter,
        neck=(*example.NECK, 0.9),
        seed_curvature=PRESET.seed_curvature,
        turns=(*PRESET.drive, (example.LAST_TIME, turns)),
        slides=True,
        drag=peer_problems.Drag(1000.0, 0.1, 0.01),
    )


def penalty(elements: int) -> Contact:
    """rodjax's contact, equal to PyElastica's between parallel strands at `DEPTH`.

    Its points resolve the law, 1 mm apart at 100 elements: half of sqrt(2 D x) at the depth x.
    Segments half as long as the elements cost least, half of those as long (whose search lists
    twice the pairs of points).
    """
    width = np.sqrt(2 * PRESET.diameter * DEPTH)
    stiffness = 1.5 * SPRING / (example.LENGTH / 100 * width)
    cutoff, aperture, segments = 1.2 * PRESET.diameter, 2 * np.pi / 3, 2 * elements
    reach = cutoff * np.sin(aperture / 2) / (example.LENGTH / segments)
    return Contact(
        Penalty(stiffness, softness=SOFTNESS, relaxation=DASHPOT / SPRING),
        segments=segments,
        points_per_segment=5,
        cutoff=cutoff,
        edge=0.1,
        aperture=aperture,
        pairs_per_segment=max(4, int(np.ceil(reach)) + 1),
    )


def applied_turns(times, until: float) -> np.ndarray:
    """Turns of the drive."""
    knots, turns = np.array(problem(until).turns).T
    return np.interp(times, knots, turns)


@compiled
def _linking(positions, frames):
    """Twist and writhe of framed polygons."""
    one = lambda shape: (topology.twist(*shape), topology.writhe(shape[0]))
    return lax.map(one, (positions, frames))


def pyelastica_run(until: float, elements: int, dt: float, near: bool) -> tuple[Series, Cost]:
    """PyElastica; `near` lists near pairs of elements for the same contact forces sooner."""
    whole, scale = problem(until), 100 / elements
    law = peer_pyelastica.near_self_contact(PAIR_MARGIN, PAIR_CALLS) if near else None
    build = lambda: peer_pyelastica.pyelastica_system(
        whole, elements, (scale * SPRING, scale * DASHPOT), law
    )
    peer_pyelastica.pyelastica_steps(build(), (2 * dt,), dt, lambda *_: None)  # numba compiles
    seen = []

    def look(rod, now):
        moment = 0.5 * np.einsum("iik,ik->ik", rod.bend_matrix, (rod.kappa - rod.rest_kappa) ** 2)
        moment = moment @ rod.rest_voronoi_lengths
        moving = rod.compute_translational_energy() + rod.compute_rotational_energy()
        energies = (moment[0] + moment[1], moment[2], rod.compute_shear_energy(), moving)
        frames = rod.director_collection.transpose(2, 1, 0).copy()  # body to inertial
        seen.append((now, rod.position_collection.T.copy(), frames, energies))
        if len(seen) % 10 == 0:
            print(f"PyElastica, {elements} elements: t = {now:.1f} s", file=sys.stderr, flush=True)

    cost = Cost(*peer_pyelastica.pyelastica_steps(build(), whole.times, dt, look))
    times, positions, frames, energies = (np.array(part) for part in zip(*seen, strict=True))
    return pyelastica_series(until, times, positions, frames, energies), cost


def pyelastica_series(until: float, times, positions, frames, energies) -> Series:
    """The series from nodes (k, n+1, 3), frames (k, n, 3, 3) body to inertial and energies."""
    from scipy.spatial.transform import Rotation

    quaternions = Rotation.from_matrix(frames.reshape(-1, 3, 3)).as_quat()[:, [3, 0, 1, 2]]
    quaternions = quaternions.reshape(*frames.shape[:2], 4)
    twist, writhe = _linking(jnp.asarray(positions), jnp.asarray(quaternions))
    columns = (times, applied_turns(times, until), twist, writhe)
    return Series(*map(np.asarray, columns), *energies.T)


def rodjax_run(until: float, elements: int, tighter: float) -> tuple[Series, Cost]:
    """rodjax, by adaptive steps with the preset's tolerances divided by `tighter`."""
    scene = peer_problems.rodjax_scene(problem(until), elements, penalty(elements))
    relative, absolute = (tolerance / tighter for tolerance in PRESET.tolerances)
    control = StepControl(relative, absolute, PRESET.max_step)
    compile_adaptive_rollout(scene)
    first = start(scene)
    before = time.process_time(), time.perf_counter()

    def report(part):
        reached = f"t = {part.states.time[-1]:.2f} s" if len(part.states.time) else "no step more"
        said = f"rodjax, {elements} elements: {reached}, {int(part.rejected)} rejected"
        print(said, file=sys.stderr, flush=True)

    run = adaptive_rollout(scene, first, until, control=control, on_chunk=report, throw=False)
    jax.block_until_ready(run.states)
    cost = Cost(
        time.process_time() - before[0],
        time.perf_counter() - before[1],
        len(run.times) - 1 + int(run.rejected),
    )
    if int(run.result) != Result.SUCCESS:
        print(f"rodjax, {elements} elements: failed at t = {float(run.times[-1]):g} s by"
              f" {Result(int(run.result)).name}", file=sys.stderr)  # fmt: skip
    return rodjax_series(scene, run), cost


def rodjax_series(scene: Scene, run: Run) -> Series:
    """The series at the accepted steps of a run."""

    @compiled
    def energies(scene, states):
        parts = (energy.bending_energy, energy.torsion_energy, energy.axial_energy,
                 energy.kinetic_energy)  # fmt: skip
        return lax.map(lambda state: jnp.stack([part(scene, state) for part in parts]), states)

    linking = measures.linking(scene, run)
    found = np.asarray(energies(scene, run.states))
    columns = (run.times, linking.turns, linking.twist, linking.writhe)
    return Series(*map(np.asarray, columns), *found.T)


def stored(path: Path, compute) -> tuple[Series, Cost]:
    """A run from its file, or computed and then stored there."""
    if path.exists():
        print(f"{path.name}: from its file")
        with np.load(path) as file:
            series = Series(*(file[name] for name in Series._fields))
            return series, Cost(*(file[name].item() for name in Cost._fields))
    series, cost = compute()
    np.savez(path, **series._asdict(), **cost._asdict())
    print(f"{path.name}: {cost.cpu_seconds:.1f} CPU s, {cost.steps} steps", flush=True)
    return series, cost


def window_means(series: Series, name: str, until: float) -> np.ndarray:
    """Means of a quantity over windows of 2 s (a quarter of a shorter run), by trapezoids."""
    width = min(WINDOW, until / 4)
    edges = width * np.arange(round(until / width) + 1)
    values = getattr(series, name)
    if not len(series.time) or series.time[-1] < until * (1 - 1e-9):
        return np.full(len(edges) - 1, np.nan)
    time_, values = series.time, np.asarray(values)
    means = []
    for begin, end in zip(edges[:-1], edges[1:], strict=True):
        inner = time_[(time_ > begin) & (time_ < end)]
        t = np.concatenate([[begin], inner, [end]])
        means.append(np.trapezoid(np.interp(t, time_, values), t) / (end - begin))
    return np.array(means)


def deviation(found: Series, fine: Series, until: float) -> dict[str, dict[str, float]]:
    """Rms and largest difference of the means; Wr in turns, energies over the largest mean."""
    result = {}
    for name in COMPARED:
        a, b = (window_means(series, name, until) for series in (found, fine))
        scale = 1.0 if name == "writhe" else np.max(np.abs(b))
        difference = np.abs(a - b) / scale
        rms = np.sqrt(np.mean(difference**2))
        result[name] = {"rms": float(rms), "largest": float(np.max(difference))}
    return result


def draw(runs: dict[str, tuple[Series, Cost]], until: float, path: Path) -> None:
    """Wr over Lk and the energies of all runs."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(2, 2, figsize=(11, 7.5), layout="constrained")
    styles = ("C0-", "C0:", "C1-", "C1:")
    for (label, (series, _)), style in zip(runs.items(), styles, strict=True):
        axes[0, 0].plot(series.turns, series.writhe, style, label=label, lw=1.4)
        for part, name in zip(axes.flat[1:], ("bending", "torsion", "kinetic"), strict=True):
            part.plot(series.time, 1e3 * getattr(series, name), style, label=label, lw=1.4)
            part.set(xlabel="t [s]", ylabel=f"{name} energy [mJ]", xlim=(0, until))
    axes[0, 0].set(xlabel="Lk [turns applied]", ylabel="Wr [turns]")
    largest = max(1e3 * np.max(series.kinetic) for series, _ in runs.values())
    axes[1, 1].set(yscale="log", ylim=(1e-6 * largest, 2 * largest))
    axes[0, 0].legend()
    for part in axes.flat:
        part.grid(alpha=0.3)
    figure.suptitle("Stout rod, D = 10 mm (assumed), penalty contact")
    figure.savefig(path, dpi=150)
    plt.close(figure)


def main(argv=None) -> int:
    """All four runs, compared; the exit status is 0 if they ran to the end."""
    options = arguments(argv)
    if importlib.util.find_spec("elastica") is None:
        print("PyElastica is not installed: pip install '.[peers]'", file=sys.stderr)
        return 1
    options.out.mkdir(parents=True, exist_ok=True)
    n, m, until, dt = options.elements, options.peer_elements, options.until, options.peer_dt
    coarse, fine = (n, options.tighter), (2 * n, 2 * options.tighter)
    jobs = {
        f"rodjax, {n} elements": (
            "rodjax_{}_{:g}.npz".format(*coarse),
            lambda: rodjax_run(until, *coarse),
        ),
        f"rodjax, {2 * n} elements": (
            "rodjax_{}_{:g}.npz".format(*fine),
            lambda: rodjax_run(until, *fine),
        ),
        f"PyElastica, {m} elements": (
            f"pyelastica_{m}.npz",
            lambda: pyelastica_run(until, m, dt, near=False),
        ),
        f"PyElastica, {2 * m} elements": (
            f"pyelastica_{2 * m}.npz",
            lambda: pyelastica_run(until, 2 * m, dt / 2, near=True),
        ),
    }
    runs = {name: stored(options.out / file, job) for name, (file, job) in jobs.items()}
    (ours, cost), (ours_fine, _), (theirs, peer_cost), (theirs_fine, _) = runs.values()
    errors = {
        "rodjax": deviation(ours, ours_fine, until),
        "PyElastica": deviation(theirs, theirs_fine, until),
        "refined runs, of each other": deviation(ours_fine, theirs_fine, until),
    }
    lines = [
        f"{'deviation of 2 s means':32}"
        + "".join(f"{name + ' rms, largest':>24}" for name in COMPARED)
    ]
    for who, found in errors.items():
        cells = "".join(f"{found[q]['rms']:15.2e} {found[q]['largest']:8.1e}" for q in COMPARED)
        lines.append(f"{who:32}{cells}")
    lines.append("Wr in turns, energies relative to their largest mean")
    for name, (series, c) in runs.items():
        lines.append(
            f"{name:28} {c.cpu_seconds:9.1f} CPU s {c.steps:9d} steps   Wr at the end"
            f" {series.writhe[-1]:7.4f}, Tw + Wr - Lk at most"
            f" {np.max(np.abs(series.twist + series.writhe - series.turns)):.1e}"
        )
    ratio = peer_cost.cpu_seconds / cost.cpu_seconds
    lines.append(
        f"PyElastica at {m} elements takes {ratio:.1f} times the CPU seconds of rodjax at {n}"
    )
    table = "\n".join(lines)
    print(table)
    (options.out / "table.txt").write_text(table + "\n")
    finished = all(series.time[-1] >= until * (1 - 1e-9) for series, _ in runs.values())
    summary = {
        "elements": n,
        "tighter": options.tighter,
        "peer_elements": m,
        "until": until,
        "peer_dt": dt,
        "finished": finished,
        "cpu_seconds": {name: c.cpu_seconds for name, (_, c) in runs.items()},
        "wall_seconds": {name: c.wall_seconds for name, (_, c) in runs.items()},
        "steps": {name: c.steps for name, (_, c) in runs.items()},
        "writhe_end": {name: float(series.writhe[-1]) for name, (series, _) in runs.items()},
        "deviations": errors,
        "cpu_ratio": ratio,
    }
    (options.out / "summary.json").write_text(json.dumps(summary, indent=2) + "\n")
    draw(runs, until, options.out / "comparison.png")
    print(f"results in {options.out}")
    return 0 if finished else 1


if __name__ == "__main__":
    sys.exit(main())
