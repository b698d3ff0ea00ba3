"""Seconds of a compiled program, and what an accelerator did in a call of it."""

import tempfile
import time
from pathlib import Path
from typing import Any

import jax


def seconds(program, arguments, patience: float = 4.0) -> tuple[float, Any]:
    """Least seconds of a call, after a first unless that took so long, and what it gave."""
    began = time.perf_counter()
    given = jax.block_until_ready(program(*arguments))
    best = first = time.perf_counter() - began
    for repeat in range(7 if first < patience else 0):
        now = time.perf_counter()
        jax.block_until_ready(program(*arguments))
        took = time.perf_counter() - now
        best = took if repeat == 0 else min(best, took)
        if time.perf_counter() - began > patience:
            break
    return best, given


def kernels(program, arguments) -> dict[str, Any]:
    """What an accelerator did in a call: kernels, their seconds, copies, the longest."""
    with tempfile.TemporaryDirectory() as folder:
        with jax.profiler.trace(folder):
            jax.block_until_ready(program(*arguments))
        (path,) = Path(folder).rglob("*.xplane.pb")
        data = jax.profiler.ProfileData.from_file(str(path))
        events = [
            (event.name, 1e-9 * event.duration_ns)
            for plane in data.planes
            if plane.name.startswith("/device:")
            for line in plane.lines
            if line.name.startswith("Stream")
            for event in line.events
        ]
    copying = lambda name: "memcpy" in name.lower() or "memset" in name.lower()
    copies = [one for one in events if copying(one[0])]
    launched = [one for one in events if not copying(one[0])]
    by_name: dict[str, list] = {}
    for name, took in launched:
        tally = by_name.setdefault(name[:60], [0, 0.0])
        tally[0], tally[1] = tally[0] + 1, tally[1] + took
    longest = sorted(by_name.items(), key=lambda item: -item[1][1])[:6]
    return {
        "kernels": len(launched),
        "copies": len(copies),
        "to_host": sum("dtoh" in name.lower() or "d2h" in name.lower() for name, _ in copies),
        "busy_seconds": sum(took for _, took in launched),
        "longest": {name: {"count": n, "seconds": took} for name, (n, took) in longest},
    }
