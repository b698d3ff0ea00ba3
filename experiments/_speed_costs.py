"""What `speed.py` times: a Newton iteration and its parts, a ply's increment, a compilation."""

import time
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from speed_scenes import Rung, plectoneme, ply

from rodjax.dynamics import consistency
from rodjax.dynamics.adaptive import compile_adaptive_rollout
from rodjax.dynamics.fixed_rollout import rollout
from rodjax.dynamics.stepping import prepare, step
from rodjax.equations.equations import step_equations
from rodjax.equations.generalized_alpha import GeneralizedAlpha
from rodjax.interactions.contact_forces import pair_forces
from rodjax.interactions.pair_points import vertices_of
from rodjax.interactions.self_contact import FoundContact
from rodjax.interactions.sites import interpolate
from rodjax.numerics.block_tridiagonal import BlockTridiagonal
from rodjax.numerics.compilation import compiled
from rodjax.numerics.results import Result
from rodjax.rods.state import State
from rodjax.scenes.scene import Found, Scene

STEP = 0.05  # [s], about what the example takes while it intertwines


def interleaved(jobs: dict[str, Any], repeats: int) -> dict[str, np.ndarray]:
    """Seconds of every job, called in turn `repeats` times after a first call."""
    for job in jobs.values():
        job()
    seconds: dict[str, list[float]] = {name: [] for name in jobs}
    for _ in range(repeats):
        for name, job in jobs.items():
            began = time.perf_counter()
            job()
            seconds[name].append(time.perf_counter() - began)
    return {name: np.array(values) for name, values in seconds.items()}


def banded(blocks: BlockTridiagonal) -> tuple[tuple[int, int], np.ndarray]:
    """The matrix in the diagonal ordered form of `scipy.linalg.solve_banded`, tight bandwidth."""
    lower, diagonal, upper = (np.asarray(x) for x in (blocks.lower, blocks.diagonal, blocks.upper))
    n, b, _ = diagonal.shape
    rows, columns, values = [], [], []
    local_row, local_column = np.meshgrid(np.arange(b), np.arange(b), indexing="ij")
    for shift, part in ((-1, lower[1:]), (0, diagonal), (1, upper[:-1])):
        node = np.arange(max(-shift, 0), n - max(shift, 0))[:, None, None]
        rows.append((b * node + local_row).ravel())
        columns.append((b * (node + shift) + local_column).ravel())
        values.append(part.ravel())
    row, column, value = (np.concatenate(x) for x in (rows, columns, values))
    row, column, value = (x[value != 0] for x in (row, column, value))
    below, above = int(np.max(row - column)), int(np.max(column - row))
    band = np.zeros((below + above + 1, n * b))
    band[above + row - column, column] = value
    return (below, above), band


class _Solved(NamedTuple):
    """A step's Newton solve, and the parts of one of its iterations, ready to be called."""

    jobs: dict[str, Any]
    iterations: int
    blocks: BlockTridiagonal
    right: jax.Array


def step_solve(whole: Scene, state: State, found: Found) -> _Solved:
    """What a step of STEP seconds does from this state, as `stepping.advance_to` does it.

    Without contact every iteration eliminates anew. Where pairs are near, the derivative is held
    while the increments shrink fast: `elimination` is done once or twice a step, `correction` (a
    residual and a solve with the factors) in every iteration.
    """
    method = GeneralizedAlpha()
    tolerance = method.newton_tolerance(state.position.dtype)
    equations = step_equations(whole, state, state.time + STEP, method.spectral_radius, found)
    guess = equations.limited(equations.guess(state.force))

    @compiled
    def solved(equations, x):
        return equations.iterate(x, tolerance, method.max_iterations)

    x, info = solved(equations, guess)
    assert int(info.result) == Result.SUCCESS, Result(int(info.result))
    linearized = compiled(lambda e, x: e.linearize(x).blocks)
    blocks, b = linearized(equations, x), jnp.ones_like(x)
    parts: dict[str, tuple] = {
        "residual": (compiled(lambda e, x: e.residual(x)), equations, x),
        "jacobian": (linearized, equations, x),
        "block_solve": (compiled(lambda a, b: a.solve(b)), blocks, b),
        "newton": (solved, equations, guess),
    }
    if whole.contact is None:
        parts["increment"] = (compiled(lambda e, x: e.newton_increment(x)), equations, x)
    else:
        eliminate = compiled(lambda e, x: e.linearize(x).eliminate())
        correct = compiled(lambda e, system, x: system.solve(-e.residual(x)))
        parts["elimination"] = (eliminate, equations, x)
        parts["correction"] = (correct, equations, eliminate(equations, x), x)
    jobs = {
        name: lambda f=f, rest=rest: jax.block_until_ready(f(*rest))
        for name, (f, *rest) in parts.items()
    }
    return _Solved(jobs, int(info.iterations), blocks, b)


def iteration_costs(elements: int, contact: bool, repeats: int) -> dict[str, Any]:
    """Seconds of a Newton iteration as steps take it, of its parts, and of the banded solve.

    `iteration` is a step's whole solve over the number of its iterations.
    """
    whole = plectoneme(elements, contact)
    state = consistency.start(whole)
    found_near, search = whole.find(state.position), None
    if contact:
        expected = STEP * state.velocity + 0.5 * STEP**2 * state.acceleration[:, :3]
        find = compiled(lambda scene, s: scene.find(s.position, expected))
        found_near = find(whole, state)
        search = lambda: jax.block_until_ready(find(whole, state))
    solve = step_solve(whole, state, found_near)
    bandwidth, band = banded(solve.blocks)
    right = np.asarray(solve.right).ravel()
    jobs = dict(solve.jobs)
    if search is not None:
        jobs["search"] = search
    jobs["banded_solve"] = lambda: scipy.linalg.solve_banded(bandwidth, band, right)
    solution, reference = np.asarray(jobs["block_solve"]()).ravel(), jobs["banded_solve"]()
    difference = float(np.max(np.abs(solution - reference)) / np.max(np.abs(reference)))
    seconds = interleaved(jobs, repeats)
    seconds["iteration"] = seconds["newton"] / solve.iterations
    found: dict[str, Any] = {name: float(np.median(s)) for name, s in seconds.items()}
    yardstick = seconds["banded_solve"]
    for name in ("block_solve", "iteration"):
        found[f"{name}_over_banded"] = float(np.median(seconds[name] / yardstick))
    found |= {"bandwidth": bandwidth, "solve_difference": difference}
    found["iterations"] = solve.iterations
    if contact:
        found |= contact_counts(whole, state, found_near.contact)
    return found


def contact_counts(
    whole: Scene, state: State, found_contact: FoundContact | None
) -> dict[str, int]:
    """Pairs near, their joints (which the solver eliminates), and those on which a force acts."""
    assert whole.contact is not None and found_contact is not None
    sites, pairs = found_contact
    vertices, velocities = (interpolate(sites, v) for v in (state.position, state.velocity))
    forces = pair_forces(whole.contact, sites, pairs, vertices, velocities).force
    count = int(pairs.count)
    listed = np.stack([np.asarray(index)[:count] for index in vertices_of(pairs)])
    return {
        "pairs": count,
        "joints_near": len(np.unique(listed)),
        "joints": int(np.sum(np.any(np.asarray(forces) != 0, axis=1))),
        "segments": whole.contact.segments,
        "level": int(pairs.capacity),
    }


def ply_costs(elements: int, repeats: int) -> dict[str, Any]:
    """Seconds of a Newton increment, evaluation and solve, of strands that touch all along."""
    whole = ply(elements)
    state = consistency.start(whole)
    find = compiled(lambda scene, s: scene.find(s.position))
    near_by = find(whole, state)
    equations = step_equations(
        whole, state, state.time + STEP, GeneralizedAlpha().spectral_radius, near_by
    )
    x = equations.guess(state.force)
    blocks = compiled(lambda e, x: e.linearize(x).blocks)(equations, x)
    parts = {
        "block_solve": (compiled(lambda a, b: a.solve(b)), blocks, jnp.ones_like(x)),
        "increment": (compiled(lambda e, x: e.newton_increment(x)), equations, x),
        "search": (find, whole, state),
    }
    jobs = {
        name: lambda f=f, rest=rest: jax.block_until_ready(f(*rest))
        for name, (f, *rest) in parts.items()
    }
    seconds = interleaved(jobs, repeats)
    assert np.all(np.isfinite(jobs["increment"]()))
    found: dict[str, Any] = {name: float(np.median(s)) for name, s in seconds.items()}
    ratio = np.median(seconds["increment"] / seconds["block_solve"])
    found["increment_over_block_solve"] = float(ratio)
    return found | contact_counts(whole, state, near_by.contact)


def compile_costs(rung: Rung, repeats: int) -> dict[str, Any]:
    """Traced operations, seconds to trace and to compile step and rollouts, seconds of a step."""
    found: dict[str, Any] = {"scene": rung.name}
    jax.clear_caches()
    began = time.perf_counter()
    state = prepare(rung.scene, consistency.start(rung.scene))
    found["start_seconds"] = time.perf_counter() - began
    stop = jnp.asarray(STEP)

    def compile_it(name, function, *rest):
        began = time.perf_counter()
        lowered = eqx.filter_jit(function).lower(*rest)
        traced = time.perf_counter()
        program = lowered.compile()
        found[f"{name}_trace_seconds"] = traced - began
        found[f"{name}_compile_seconds"] = time.perf_counter() - traced
        found[f"{name}_operations"] = lowered.as_text().count(" = ")
        found[f"{name}_fusions"] = program.compiled.as_text().count(" fusion(")
        return program

    program = compile_it("step", step, rung.scene, state, stop)
    times = STEP * jnp.arange(1.0, 11.0)
    compile_it("rollout", lambda s, x, t: rollout(s, x, t, throw=False), rung.scene, state, times)
    began = time.perf_counter()
    compile_adaptive_rollout(rung.scene, state)
    found["adaptive_seconds"] = time.perf_counter() - began
    run = lambda: jax.block_until_ready(program(rung.scene, state, stop))
    found["step_seconds"] = float(np.median(interleaved({"step": run}, repeats)["step"]))
    return found
