"""How fast rods in a heat bath are stepped: replicas of one rod, on whatever device JAX has.

    python experiments/thermal_rate.py [--elements N] [--replicas R ...] [--single] [--seconds S]
        [--implicit] [--contact] [--quick] [--out DIR]

A DNA molecule of 64 elements of 5 nm (or as many as asked) is stepped under a pull of 1 pN, one
call of a compiled loop after the other, for S seconds of each number of replicas. One line of JSON
each: microseconds per step and node of one replica, nodes stepped in a second in all, the time of
the first call with its compilation, the device. Writes them to DIR/summary.json.
"""

import argparse
import json
import time
from pathlib import Path

import _settings  # noqa: F401 (first)
import jax
import jax.numpy as jnp

import rodjax as rx

KT = 4.114  # [pN nm]
A, C = 50 * KT, 100 * KT  # [pN nm^2]
SPACING, DIAMETER = 5.0, 2.0  # [nm]
STEPS = 50  # of a call


def scene_of(elements: int, contact: bool) -> rx.Scene:
    """A clamped DNA molecule that is pulled at its other end, with charges or without."""
    section = rx.Section(stiffness=(A, A, C), diameter=DIAMETER)
    rod = rx.yielding(rx.straight_rod(SPACING * elements, elements, section), 10.0)
    water = rx.LinearDrag(3e-3, 1.5e-3, 0.025)  # [pN us/nm^2, pN us]
    pull = rx.PointLoad(-1, force=rx.Constant((0.0, 0.0, 1.0)))
    charges = None
    if contact:
        law = rx.DebyeHueckel(strength=70.0, screening=1.0, floor=0.5)
        charges = rx.Contact(law, segments=elements, cutoff=8.0, exclusion=20.0)
    return rx.Scene(rod, rx.Clamped(), loads=(water, pull), contact=charges)


def rate(scene: rx.Scene, replicas: int, seconds: float, implicit: bool) -> dict:
    """One line of the table."""
    bath, dt = rx.Bath(KT, implicit=implicit), jnp.asarray(5e-5)
    keys = jax.random.split(jax.random.key(0), replicas)
    starts = jax.vmap(lambda key: rx.thermal_start(scene, key))(keys)

    def advance(starts):
        def one(start):
            run = rx.thermal_rollout(scene, start, bath, dt, STEPS, throw=False)
            return run.final, run.result

        return jax.vmap(one)(starts)

    advance = rx.jit(advance)
    began = time.perf_counter()
    starts, codes = jax.block_until_ready(advance(starts))
    first = time.perf_counter() - began
    calls, began = 0, time.perf_counter()
    while calls == 0 or time.perf_counter() - began < seconds:
        starts, codes = jax.block_until_ready(advance(starts))
        calls += 1
    each = (time.perf_counter() - began) / (calls * STEPS)
    nodes = scene.rod.elements + 1
    device = jax.devices()[0]
    return {
        "device": f"{device.platform} {device.device_kind}",
        "precision": str(starts.state.position.dtype),
        "method": "implicit" if implicit else "explicit",
        "contact": scene.contact is not None,
        "elements": scene.rod.elements,
        "replicas": replicas,
        "seconds_a_step": each,
        "us_per_step_and_node": 1e6 * each / nodes / replicas,
        "node_steps_per_second": nodes * replicas / each,
        "first_call_seconds": first,
        "steps": calls * STEPS,
        "result": rx.Result(int(jnp.max(codes))).name,
    }


def main(argv=None) -> int:
    """Run the experiment."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--elements", type=int, default=64, metavar="N")
    parser.add_argument("--replicas", type=int, nargs="+", metavar="R")
    parser.add_argument("--single", action="store_true", help="single precision")
    parser.add_argument("--seconds", type=float, metavar="S", help="of each, 3 (0.5 with --quick)")
    parser.add_argument("--implicit", action="store_true", help="by the midpoint rule")
    parser.add_argument("--contact", action="store_true", help="with screened charges")
    parser.add_argument("--quick", action="store_true", help="1 and 8 replicas of 20 elements")
    parser.add_argument("--out", type=Path, default=Path("results/thermal_rate"), metavar="DIR")
    options = parser.parse_args(argv)
    if options.single:
        jax.config.update("jax_enable_x64", False)
    replicas = options.replicas or ([1, 8] if options.quick else [1, 64, 1024, 4096])
    elements = 20 if options.quick else options.elements
    seconds = options.seconds or (0.5 if options.quick else 3.0)
    scene = scene_of(elements, options.contact)
    lines = []
    for count in replicas:
        lines.append(rate(scene, count, seconds, options.implicit))
        print(json.dumps(lines[-1]), flush=True)
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / "summary.json").write_text(json.dumps(lines, indent=1))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
