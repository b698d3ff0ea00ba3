"""A molecule between two handles, one held, one pulled and turned, in a heat bath.

The rod goes on beyond both of its ends, and is held straight there: a loop that would slip over an
end must be pulled open to the handle's length first, against the force.
"""

import time

import jax
import jax.numpy as jnp
import numpy as np
from _molecule import BATH, CHARGES, DRAG, EXCLUSION, A, C, molecule

import rodjax as rx

SPACING = 5.0  # [nm]
HANDLE = 9  # elements of each handle, of which every third node is held
UP = (0.0, 0.0, 1.0)


def turned(force: float, elements: int, most: float, duration: float, blocks: int) -> dict:
    """The molecule with one end held and the other pulled and turned by `most` turns."""
    scene, angle = _scene(force, elements, most, duration)
    dt = 0.5 * float(rx.relaxation_times(scene)[-1])
    steps = max(int(duration / dt / blocks / 10) * 10, 10)
    molecule_nodes = slice(HANDLE, HANDLE + elements + 1)
    yields = force * float(scene.rod.compliance[0, 0]) * SPACING * elements

    def seen(state):
        curvature = rx.measures.curvature(scene.rod, state.quaternion)
        twist = jnp.mean(curvature[HANDLE : HANDLE + elements, 2])
        height = state.position[molecule_nodes, 2]
        return {"extension": height[-1] - height[0] - yields, "torque": C * twist}

    moving, result = rx.thermal_start(scene, jax.random.key(1)), rx.Result.SUCCESS
    began, rows, off = time.perf_counter(), [], 0.0
    for block in range(blocks):
        run = rx.thermal_rollout(
            scene, moving, BATH, dt, steps, measure=seen, measure_every=10, throw=False
        )
        result = rx.Result(int(run.result))
        if result is not rx.Result.SUCCESS:
            break
        off = max(off, float(np.max(np.abs(rx.measures.linking(scene, run.run).error))))
        if off > 0.5:  # a strand has passed through another, or a loop over an end
            break
        moving, mean = run.final, run.averages.mean
        rows.append(_row(moving.state, mean, angle, 0.5 * dt * steps))
        if block % max(blocks // 10, 1) == 0:
            row, spent = rows[-1], time.perf_counter() - began
            print(
                f"  {force:g} pN, {row['time']:.0f} us: {row['turns']:.2f} turns,"
                f" {row['extension']:.0f} nm, {row['torque']:.1f} pN nm; {spent:.0f} s",
                flush=True,
            )
    found = {
        "force": force,
        "dt": dt,
        "elements": elements,
        "result": result.name,
        "linking_error": off,
        # turns in the longest relaxation time of the straight chain
        "turns_a_relaxation": most / (0.9 * duration)
        * DRAG[0] * (SPACING * elements / np.pi) ** 2 / force,
        "seconds": time.perf_counter() - began,
        **_told(rows, force, SPACING * elements),
        "rows": rows,
        "shape": np.asarray(moving.state.position).tolist(),
    }  # fmt: skip
    print(
        f"{force:5.2f} pN: torque at most {found['largest_torque']:.1f} pN nm, at"
        f" {found['jump_at_turns']:.2f} turns, with a fall of {found['jump']:.1f} nm; from a fifth"
        f" of a turn later {found['plateau']:.1f} +- {found['plateau_error']:.1f} (cold coexistence"
        f" near {found['cold_coexistence_torque']:.1f}, instability"
        f" {found['cold_instability_torque']:.1f}); {found['nm_a_turn']:.0f} nm a turn; Tw + Wr off"
        f" by {off:.1e}; {found['result']}, {found['seconds']:.0f} s",
        flush=True,
    )
    return found


def _scene(force: float, elements: int, most: float, duration: float):
    """What is turned, and the angle in time: none for the first tenth."""
    angle = rx.PiecewiseLinear([0.0, 0.1 * duration, duration], [0.0, 0.0, 2 * np.pi * most])
    turning = rx.Slider(UP, rotation=rx.Turn(UP, angle))
    first, last, end = HANDLE, HANDLE + elements, elements + 2 * HANDLE
    held = [rx.Support(node, rx.Clamped()) for node in range(3, first + 1, 3)]
    guided = [rx.Support(node, turning) for node in range(last, end, 3)]
    scene = rx.Scene(
        molecule(SPACING * end, end, stiffer=4.0),
        rx.Clamped(),
        turning,
        loads=(
            rx.LinearDrag(*DRAG),
            rx.PointLoad(last, force=rx.Constant((0.0, 0.0, force))),
        ),
        contact=rx.Contact(
            CHARGES, segments=end, cutoff=14.0, exclusion=EXCLUSION, pairs_per_segment=16
        ),
        supports=(*held, *guided),
    )
    return scene, angle


def _row(state, mean: dict, angle, half: float) -> dict:
    """What is kept of a block."""
    now, position = float(state.time), np.asarray(state.position)[HANDLE:-HANDLE]
    first, last = knot(position)
    return {
        "turns": float(angle(now - half)) / (2 * np.pi),
        "time": now,
        "extension": float(mean["extension"]),
        "torque": float(mean["torque"]),
        "plectoneme_length": (last - first) * SPACING,
        "plectoneme_middle": 0.5 * (first + last) * SPACING if last > first else None,
    }


def _told(rows: list[dict], force: float, length: float) -> dict:
    """Where it buckled, the torque that was left, and how much each further turn takes.

    It buckles where the torque is largest. What comes after less than a third of the length is left
    is not looked at: the plectoneme has no more to take.
    """
    pick = lambda name: np.array([row[name] for row in rows])
    turns, extension, torque = pick("turns"), pick("extension"), pick("torque")
    # means of three blocks, as single ones are noisy
    smooth = lambda values: np.convolve(values, np.ones(3) / 3, mode="same")[1:-1]
    spent = np.nonzero(smooth(extension) < length / 3)[0]
    end = int(spent[0]) + 1 if len(spent) else len(rows)
    jump = int(np.argmax(smooth(torque[:end]))) + 1
    fall = smooth(extension)[jump - 1] - smooth(extension)[min(jump + 2, len(rows) - 3)]
    # the torque has fallen a fifth of a turn later
    after = (turns > turns[jump] + 0.2) & (np.arange(len(rows)) < end)
    parts = int(np.sum(after)) // 3
    many = parts >= 2
    means = [np.mean(part) for part in np.array_split(torque[after], parts)] if many else []
    slope = np.polyfit(turns[after], extension[after], 1)[0] if many else np.nan
    return {
        "jump_at_turns": float(turns[jump]),
        "jump": float(fall),
        "largest_torque": float(smooth(torque[:end])[jump - 1]),
        "plateau": float(np.mean(means)) if many else np.nan,
        "plateau_error": float(np.std(means, ddof=1) / np.sqrt(parts)) if many else np.nan,
        "used_up_at_turns": float(turns[end - 1]) if len(spent) else None,
        "nm_a_turn": -float(slope),
        "cold_coexistence_torque": float(np.sqrt(2 * A * force)),
        "cold_instability_torque": float(2 * np.sqrt(A * force)),
    }


def knot(position: np.ndarray) -> tuple[int, int]:
    """First and last node of the longest stretch whose ends are within 12 nm of each other."""
    apart = np.linalg.norm(position[:, None] - position[None], axis=-1)
    first, last = np.nonzero(np.triu(apart < 12.0, 6))
    if len(first) == 0:
        return 0, 0
    longest = int(np.argmax(last - first))
    return int(first[longest]), int(last[longest])
