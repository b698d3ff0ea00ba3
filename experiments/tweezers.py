"""DNA in magnetic tweezers at room temperature: force against extension, and the hat curve.

    python experiments/tweezers.py [--only pull|turn] [--quick] [--out DIR]

A molecule with A = 50 nm kT and C = 100 nm kT moves in water without inertia, shaken by thermal
noise. First it is pulled at both ends, and the mean tangent of its middle third, far from the ends,
is compared with the wormlike chain: of elements of this length (what the code must give), and of no
length, once the chord of an element is taken for what a chain of its contour length has. Then one
end is held, the other pulled and turned, and extension, torque (C <kappa_3>) and the plectoneme are
followed, until a loop slips over the turned end (there is no bead in its way). Writes
DIR/tweezers.png and DIR/summary.json.
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
from _wormlike import discrete, exact, marko_siggia

import rodjax as rx

KT = 4.114  # [pN nm]
PERSISTENCE = 50.0  # [nm]
A, C = PERSISTENCE * KT, 2 * PERSISTENCE * KT  # [pN nm^2]
DIAMETER = 2.0  # [nm]
DRAG = (3e-3, 1.5e-3, 0.025)  # normal, tangential [pN us/nm^2], of spin [pN us]
BATH = rx.Bath(KT)
# salt of 100 mM: k_B T l_B (charges per length)^2 [pN], Debye length [nm]
CHARGES = rx.DebyeHueckel(strength=KT * 0.7 * 4.0**2, screening=1.0, floor=0.5)


def molecule(length: float, elements: int) -> rx.Rod:
    """A straight one along z, whose elements yield as thermal rods must."""
    section = rx.Section(stiffness=(A, A, C), diameter=DIAMETER)
    return rx.yielding(rx.straight_rod(length, elements, section), 10.0)


def step_of(scene: rx.Scene) -> float:
    """Half of the shortest relaxation time [us]."""
    return 0.5 * float(rx.relaxation_times(scene)[-1])


def pulled(force: float, spacing: float, elements: int, replicas: int, spans: float) -> dict:
    """The mean tangent under a pull, over so many of the longest relaxation times."""
    push = lambda node, sign: rx.PointLoad(node, force=rx.Constant((0.0, 0.0, sign * force)))
    rod = molecule(spacing * elements, elements)
    loads = (rx.LinearDrag(*DRAG), push(0, -1.0), push(-1, 1.0))
    scene = rx.Scene(rod, loads=loads)
    dt = step_of(scene)
    slowest = DRAG[0] * (spacing * elements / np.pi) ** 2 / force
    middle = slice(elements // 3, -(elements // 3))

    def along(state):
        chords = jnp.diff(state.position, axis=0)[middle, 2] / spacing
        return jnp.mean(chords) - force * rod.compliance[0, 0]  # less what the element yields

    @rx.jit
    def advance(starts, averages):
        def one(start, before):
            run = rx.thermal_rollout(
                scene, start, BATH, dt, 2000, measure=along, measure_every=10,
                averages=before, throw=False,
            )  # fmt: skip
            return run.final, run.averages, run.result

        return jax.vmap(one)(starts, averages)

    keys = jax.random.split(jax.random.key(round(1000 * force)), replicas)
    starts = jax.vmap(lambda key: rx.thermal_start(scene, key))(keys)
    empty = jax.vmap(lambda _: rx.Averages.of(jnp.zeros(())))(keys)
    calls = int(np.ceil(spans * slowest / dt / 2000))
    began = time.perf_counter()
    for _ in range(max(calls // 3, 1)):  # into equilibrium
        starts = advance(starts, empty)[0]
    averages, worst = empty, 0
    for _ in range(calls):
        starts, averages, codes = advance(starts, averages)
        worst = max(worst, int(jnp.max(codes)))
    mean, error = averages.pooled()
    own = np.sqrt(np.mean(np.asarray(averages.error) ** 2) / replicas)
    contour = spacing / PERSISTENCE
    chord = np.sqrt(2 * (contour - 1 + np.exp(-contour))) / contour
    found = {
        "force": force,
        "spacing": spacing,
        "elements": elements,
        "dt": dt,
        "extension_of_elements": float(mean),
        "error_by_replicas": float(error),
        "error_by_blocks": float(own),
        "theory_of_elements": discrete(force, A, spacing, KT),
        "extension": float(mean) * chord,
        "wormlike_chain": exact(force, PERSISTENCE, KT),
        "marko_siggia": marko_siggia(force, PERSISTENCE, KT),
        "result": rx.Result(worst).name,
        "seconds": time.perf_counter() - began,
    }
    off = found["extension_of_elements"] / found["theory_of_elements"] - 1
    print(
        f"{force:5.2f} pN: {mean:.4f} +- {error:.4f} of elements of {spacing:g} nm, theory"
        f" {found['theory_of_elements']:.4f} ({100 * off:+.2f} %); as a chain"
        f" {found['extension']:.4f}, exact {found['wormlike_chain']:.4f}, Marko-Siggia"
        f" {found['marko_siggia']:.4f}; {found['seconds']:.0f} s",
        flush=True,
    )
    return found


def turned(force: float, elements: int, most: float, duration: float, blocks: int) -> dict:
    """The molecule with one end held and the other pulled and turned by `most` turns."""
    spacing = 5.0
    rod = molecule(spacing * elements, elements)
    settle = 0.1 * duration
    angle = rx.PiecewiseLinear([0.0, settle, duration], [0.0, 0.0, 2 * np.pi * most])
    up = (0.0, 0.0, 1.0)
    contact = rx.Contact(CHARGES, segments=elements, cutoff=7.0, exclusion=25.0)
    scene = rx.Scene(
        rod,
        rx.Clamped(),
        rx.Slider(up, rotation=rx.Turn(up, angle)),
        loads=(rx.LinearDrag(*DRAG), rx.PointLoad(-1, force=rx.Constant((0.0, 0.0, force)))),
        contact=contact,
    )
    dt = step_of(scene)
    steps = max(int(duration / dt / blocks / 10) * 10, 10)

    def seen(state):
        frames = state.quaternion
        relative = rx.rotations.multiply(rx.rotations.conjugate(frames[:-1]), frames[1:])
        twist = jnp.mean(rx.rotations.logarithm(relative)[:, 2]) / spacing
        return {"extension": state.position[-1, 2], "torque": C * twist}

    moving = rx.thermal_start(scene, jax.random.key(1))
    began, rows, slipped = time.perf_counter(), [], None
    for _ in range(blocks):
        run = rx.thermal_rollout(
            scene, moving, BATH, dt, steps, measure=seen, measure_every=10, throw=False
        )
        if int(run.result) != 0:
            break
        # nothing but the rod itself is in the way of a loop at the bead: it may slip over the end
        if np.max(np.abs(rx.measures.linking(scene, run.run).error)) > 0.5:
            slipped = float(angle(run.final.state.time)) / (2 * np.pi)
            break
        moving, mean = run.final, run.averages.mean
        now = float(moving.state.time)
        first, last = knot(np.asarray(moving.state.position))
        rows.append(
            {
                "turns": float(angle(now - 0.5 * dt * steps)) / (2 * np.pi),
                "time": now,
                "extension": float(mean["extension"]),
                "torque": float(mean["torque"]),
                "plectoneme_length": (last - first) * spacing,
                "plectoneme_middle": 0.5 * (first + last) * spacing if last > first else None,
            }
        )
    drop = -np.diff([row["extension"] for row in rows])
    jump = int(np.argmax(drop)) + 1
    coexisting, unstable = np.sqrt(2 * A * force), 2 * np.sqrt(A * force)
    found = {
        "force": force,
        "dt": dt,
        "result": rx.Result(int(run.result)).name,
        "slipped_over_the_end_at_turns": slipped,
        "seconds": time.perf_counter() - began,
        "jump_at_turns": rows[jump]["turns"],
        "jump": float(drop[jump - 1]),
        "largest_torque": max(row["torque"] for row in rows),
        "last_torque": float(np.mean([row["torque"] for row in rows[-max(len(rows) // 6, 1) :]])),
        "cold_coexistence_torque": coexisting,
        "cold_instability_torque": unstable,
        "rows": rows,
        "shape": np.asarray(moving.state.position).tolist(),
    }
    print(
        f"{force:5.2f} pN: largest fall {found['jump']:.1f} nm at {found['jump_at_turns']:.2f}"
        f" turns, torque at the end {found['last_torque']:.1f} pN nm (cold coexistence near"
        f" {coexisting:.1f}, instability {unstable:.1f}); {found['result']},"
        f" {found['seconds']:.0f} s",
        flush=True,
    )
    return found


def knot(position: np.ndarray) -> tuple[int, int]:
    """First and last node of the longest stretch whose ends are within 8 nm of each other."""
    apart = np.linalg.norm(position[:, None] - position[None], axis=-1)
    first, last = np.nonzero(np.triu(apart < 8.0, 5))
    if len(first) == 0:
        return 0, 0
    longest = int(np.argmax(last - first))
    return int(first[longest]), int(last[longest])


def figure(path: Path, pulls: list[dict], turns: list[dict]) -> None:
    """Force against extension; extension, torque and plectoneme against turns."""
    fig, axes = plt.subplots(2, 2, figsize=(11, 8), layout="constrained")
    force = np.geomspace(0.1, 6, 60)
    axes[0, 0].semilogy([exact(f, PERSISTENCE, KT) for f in force], force, "k-", label="exact")
    interpolated = [marko_siggia(f, PERSISTENCE, KT) for f in force]
    axes[0, 0].semilogy(interpolated, force, "C1--", label="Marko-Siggia's interpolation")
    if pulls:
        axes[0, 0].errorbar(
            [one["extension"] for one in pulls],
            [one["force"] for one in pulls],
            xerr=[2 * one["error_by_replicas"] for one in pulls],
            fmt="o",
            label="measured (2 standard errors)",
        )
    axes[0, 0].set(xlabel="extension over length", ylabel="force [pN]")
    axes[0, 0].legend(fontsize=8)
    for color, one in zip(("C0", "C2", "C3"), turns, strict=False):
        number = [row["turns"] for row in one["rows"]]
        pick = lambda name, one=one: [row[name] for row in one["rows"]]
        label = f"{one['force']:g} pN"
        axes[0, 1].plot(number, pick("extension"), color=color, label=label)
        axes[1, 0].plot(number, pick("torque"), color=color, label=label)
        axes[1, 0].axhline(one["cold_coexistence_torque"], color=color, ls=":", lw=1)
        middle = [(t, m) for t, m in zip(pick("time"), pick("plectoneme_middle"), strict=True) if m]
        if middle:
            axes[1, 1].plot(*np.array(middle).T, ".", color=color, label=f"{label}, middle")
        axes[1, 1].plot(pick("time"), pick("plectoneme_length"), color=color, lw=1, label=label)
    axes[0, 1].set(xlabel="turns", ylabel="extension [nm]")
    axes[1, 0].set(xlabel="turns", ylabel="torque [pN nm], dotted: cold coexistence")
    axes[1, 1].set(xlabel="time [us]", ylabel="plectoneme: length and middle [nm]")
    for one in axes.flat[1:]:
        if turns:
            one.legend(fontsize=8)
        else:
            one.set_visible(False)
    fig.savefig(path, dpi=150)
    plt.close(fig)


def main(argv=None) -> int:
    """Run the experiment."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--only", choices=("pull", "turn"), help="a part of it")
    parser.add_argument("--quick", action="store_true", help="coarse and short, to try it out")
    parser.add_argument("--out", type=Path, default=Path("results/tweezers"), metavar="DIR")
    options = parser.parse_args(argv)
    options.out.mkdir(parents=True, exist_ok=True)
    pulls, turns = [], []
    if options.only != "turn":
        grid = ((0.25, 10.0), (0.5, 10.0), (1.0, 10.0), (2.0, 5.0), (4.0, 5.0))
        replicas, spans = 8, 9.0
        if options.quick:
            grid, replicas, spans = ((1.0, 10.0),), 4, 1.0
        elements = 12 if options.quick else 20
        pulls = [pulled(force, ds, elements, replicas, spans) for force, ds in grid]
    if options.only != "pull":
        for force in (1.0,) if options.quick else (0.5, 1.0, 2.0):
            size = (16, 1.0, 0.5, 5) if options.quick else (40, 4.0, 30.0, 100)
            turns.append(turned(force, *size))
    figure(options.out / "tweezers.png", pulls, turns)
    summary = {"pulled": pulls, "turned": turns}
    (options.out / "summary.json").write_text(json.dumps(summary, indent=1))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
