"""A molecule pulled at both ends in a heat bath: the mean tangent of its middle third."""

import dataclasses
import time
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from _molecule import BATH, DRAG, KT, PERSISTENCE, A, C, molecule
from _wormlike import crumpled, elements_under, exact, marko_siggia

import rodjax as rx

# force [pN], contour length [nm] (7 to 8 of the lengths sqrt(A/F) over which ends are felt), two
# element lengths [nm] (to be drawn on to none), how many of its longest relaxation times
GRID = (
    (0.25, 200.0, (20.0, 10.0), 20.0),
    (0.5, 160.0, (20.0, 10.0), 20.0),
    (1.0, 120.0, (15.0, 7.5), 20.0),
    (2.0, 90.0, (10.0, 5.0), 20.0),
    (4.0, 60.0, (10.0, 5.0), 50.0),
)
BURNED = 5.0  # relaxation times thrown away first
REPLICAS = 32
STEPS = 2000  # of a call
PART = 0.5  # the step, of the shortest relaxation time


def slowest(force: float, length: float) -> float:
    """Longest relaxation time of a pulled chain of free ends [us], but for its bending."""
    return DRAG[0] * (length / np.pi) ** 2 / force


def pulled(
    force: float, spacing: float, elements: int, replicas: int, spans: float, part: float = PART
) -> dict:
    """The mean tangent under a pull, over so many of the longest relaxation times.

    Half of the replicas start straight, half crumpled, as without a pull: if what was thrown away
    was enough, both say the same.

    Args:
        part: the step, of the shortest relaxation time.
    """
    push = lambda node, sign: rx.PointLoad(node, force=rx.Constant((0.0, 0.0, sign * force)))
    rod = molecule(spacing * elements, elements, stiffer=3.0)
    scene = rx.Scene(rod, loads=(_drag(spacing), push(0, -1.0), push(-1, 1.0)))
    dt = part * float(rx.relaxation_times(scene)[-1])
    longest = slowest(force, spacing * elements)
    advance = rx.jit(partial(_advance, scene, dt, partial(_tangents, rod, force)))
    states = _starts(scene, replicas, round(1000 * force))
    empty = jax.vmap(lambda _: rx.Averages.of({"edges": jnp.zeros(()), "frames": jnp.zeros(())}))(
        jnp.arange(replicas)
    )
    began = time.perf_counter()
    for _ in range(int(np.ceil(BURNED * longest / dt / STEPS))):
        states = advance(states, empty)[0]
    averages, worst = empty, 0
    for _ in range(int(np.ceil(spans * longest / dt / STEPS))):
        states, averages, codes = advance(states, averages)
        worst = max(worst, int(jnp.max(codes)))
    found = {
        "force": force,
        "spacing": spacing,
        "elements": elements,
        "replicas": replicas,
        "dt": dt,
        "time": spans * longest,
        "thrown_away": BURNED * longest,
        **_compared(averages),
        "part": part,
        "theory": elements_under(force, (A, C), spacing, KT, elements),
        "theory_of_infinite": elements_under(force, (A, C), spacing, KT),
        "result": rx.Result(worst).name,
        "seconds": time.perf_counter() - began,
    }
    off, error = found["tangent"] - found["theory"], found["error"]
    print(
        f"{force:5.2f} pN, elements of {spacing:g} nm, steps of {part:g}:"
        f" {found['tangent']:.4f} +- {error:.4f},"
        f" theory of them {found['theory']:.4f} ({100 * off / found['theory']:+.2f} %,"
        f" {off / error:+.1f} standard errors); straight starts less crumpled"
        f" {found['straight_less_crumpled']:+.4f} +- {found['its_error']:.4f};"
        f" {found['seconds']:.0f} s",
        flush=True,
    )
    return found


def _drag(spacing: float) -> rx.LinearDrag:
    """Drag with which all fast modes are about equally fast.

    Averages of equilibrium do not depend on it, and steps are up to sixteen times as long as in
    water, where twist relaxes much faster than anything else. The slowest modes, which are those
    across the pull, keep their time.
    """
    return rx.LinearDrag(DRAG[0], DRAG[0], 0.4 * DRAG[0] * spacing**2)


def _tangents(rod: rx.Rod, force: float, state) -> dict:
    """Means of the middle third along the pull: edges less what they yield, and frames."""
    middle = slice(rod.elements // 3, rod.elements - rod.elements // 3)
    edges = jnp.diff(state.position, axis=0)[:, 2] / rod.length
    frames = state.quaternion
    relative = rx.rotations.multiply(rx.rotations.conjugate(frames[:-1]), frames[1:])
    half = rx.rotations.exponential(0.5 * rx.rotations.logarithm(relative))
    tangents = rx.rotations.tangent_director(rx.rotations.multiply(frames[:-1], half))
    return {
        "edges": jnp.mean(edges[middle]) - force * rod.compliance[0, 0],
        "frames": jnp.mean(tangents[middle, 2]),
    }


def _advance(scene, dt, measure, starts, averages):
    """All replicas by `STEPS` steps."""

    def one(start, before):
        run = rx.thermal_rollout(
            scene, start, BATH, dt, STEPS, measure=measure, measure_every=20,
            averages=before, throw=False,
        )  # fmt: skip
        return run.final, run.averages, run.result

    return jax.vmap(one)(starts, averages)


def _starts(scene: rx.Scene, replicas: int, seed: int):
    """Thermal states, the first half of them straight, the others crumpled."""
    straight, spacing = rx.placing(scene), float(scene.rod.length[0])
    begun = []
    for index, key in enumerate(jax.random.split(jax.random.key(seed), replicas)):
        state = straight
        if index >= replicas // 2:
            places = crumpled(scene.rod.elements, (A, C), spacing, KT, seed + index)
            position, frames = (jnp.asarray(one) for one in places)
            state = dataclasses.replace(state, position=position, quaternion=frames)
        begun.append(rx.thermal_start(scene, key, state))
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *begun)


def _compared(averages: rx.Averages) -> dict:
    """What the replicas say, and whether their starts, their errors and both measures agree."""
    (mean, error), each = averages.pooled(), averages.mean["frames"]
    count = each.shape[0]
    own = float(np.sqrt(np.mean(np.asarray(averages.error["frames"]) ** 2) / count))
    halves = np.asarray(each[: count // 2]), np.asarray(each[count // 2 :])
    scatter = np.hypot(*(np.std(one, ddof=1) / np.sqrt(len(one)) for one in halves))
    return {
        "tangent": float(mean["frames"]),
        "error": max(float(error["frames"]), own),
        "error_by_replicas": float(error["frames"]),
        "error_by_blocks": own,
        "tangent_by_edges": float(mean["edges"]),
        "straight_less_crumpled": float(np.mean(halves[0]) - np.mean(halves[1])),
        "its_error": max(float(scatter), 2 * own),
    }


def of_chain(force: float, measured: list[dict]) -> dict:
    """What two element lengths say of elements of no length, in two ways.

    Drawn on, an error of first order is taken away; or from the shorter elements is taken what
    theory says that they and the ends add, which leaves the smaller error.
    """
    coarse, fine = measured
    ratio = coarse["spacing"] / fine["spacing"]
    on = lambda name: (ratio * fine[name] - coarse[name]) / (ratio - 1)
    error = float(np.hypot(ratio * fine["error"], coarse["error"])) / (ratio - 1)
    chain = exact(force, PERSISTENCE, KT)
    found = {
        "force": force,
        "extension": fine["tangent"] - (fine["theory"] - chain),
        "error": fine["error"],
        "drawn_on": on("tangent"),
        "drawn_on_error": error,
        "theory_drawn_on": on("theory_of_infinite"),
        "wormlike_chain": chain,
        "marko_siggia": marko_siggia(force, PERSISTENCE, KT),
    }
    percent = lambda name: 100 * (found["extension"] / found[name] - 1)
    print(
        f"{force:5.2f} pN, elements of no length: {found['extension']:.4f} +- {found['error']:.4f},"
        f" wormlike chain {chain:.4f} ({percent('wormlike_chain'):+.2f} %), Marko-Siggia"
        f" {found['marko_siggia']:.4f} ({percent('marko_siggia'):+.2f} %); drawn on"
        f" {found['drawn_on']:.4f} +- {error:.4f}, theory alike {found['theory_drawn_on']:.4f}",
        flush=True,
    )
    return found


def pulls(quick: bool) -> tuple[list[dict], list[dict]]:
    """All forces: what was measured with each element length, and what they say.

    Two element lengths, and the longer ones again with a quarter of the step.
    """
    grid = ((1.0, 120.0, (20.0, 10.0), 4.0),) if quick else GRID
    replicas = 8 if quick else REPLICAS
    measured, extensions = [], []
    for force, length, spacings, spans in grid:
        one = lambda spacing, part, force=force, length=length, spans=spans: pulled(
            force, spacing, round(length / spacing), replicas, spans, part
        )
        both = [one(spacing, PART) for spacing in spacings]
        measured += [*both, one(spacings[0], 0.25 * PART)]
        extensions.append(of_chain(force, both))
    return measured, extensions
