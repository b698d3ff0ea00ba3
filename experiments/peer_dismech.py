"""dismech-newton on the problems of `peer_problems.py`. In the extra `peers`, imported when run."""

import importlib.util
import time
from typing import Any, NamedTuple

import numpy as np
from peer_problems import Bend, CannotRun, Drag, Outcome, Problem, held_grid, sampled

ITERATIONS = 5  # Newton iterations a step; its solver takes a fixed number
STATIC_STEP = 1e4  # [s] so long that inertia is of no influence


def import_dismech():
    """The modules newton, warp and dismech_newton.

    On Python before 3.14 its import evaluates `Struct | None` of a warp struct, which is a
    TypeError: there, warp's class is given an `|` for the time of the import.
    """
    import warp
    from warp._src.codegen import Struct

    warp.config.quiet = True
    lacking = "__or__" not in vars(Struct)
    if lacking:
        Struct.__or__ = lambda self, other: object
    try:
        import dismech_newton
        import newton
    finally:
        if lacking:
            del Struct.__or__
    return newton, warp, dismech_newton


class Dismech(NamedTuple):
    """dismech-newton's solver, two states to step between, and the grid."""

    solver: Any
    states: tuple[Any, Any]
    arc_length: np.ndarray
    nodes: int


def dismech_system(problem: Problem | Bend, elements: int, theta: float) -> Dismech:
    """A problem in dismech-newton, on the CPU; `theta` 1/2 is the midpoint rule, 1 Euler's."""
    newton, warp, dismech = import_dismech()
    bend = isinstance(problem, Bend)
    if bend:
        size = problem.radius * problem.angle / (elements - 0.5)
        arc = size * (np.arange(elements + 1) - 0.5)
        along = 0.5 * (arc[1:] + arc[:-1]) / problem.radius
        tangent = np.stack([np.cos(along), np.sin(along), 0 * along], 1)
        points = np.concatenate([np.zeros((1, 3)), np.cumsum(size * tangent, 0)])
        points += arc[0] * tangent[0]
        radius, density = np.sqrt(1 / np.pi), 1.0
        stiff = problem.bend_stiffness
        rigidities = (problem.stretch_stiffness, stiff, stiff)
        gravity = (0.0, 0.0, 0.0)
    else:
        arc = held_grid(problem, elements)
        points = arc[:, None] * np.array(problem.direction)
        radius, density = 0.5 * problem.diameter, problem.density
        area = np.pi * radius**2
        second = 0.25 * area * radius**2
        modulus = problem.youngs_modulus
        rigidities = (modulus * area, modulus * second, 2 * problem.shear_modulus * second)
        gravity = problem.gravity or (0.0, 0.0, 0.0)
    stretch, bending, twisting = rigidities
    builder = newton.ModelBuilder()
    dismech.register_custom_attributes(builder)
    rod = newton.Rod(
        points,
        radius=radius,
        stretch_rigidity=stretch,
        shear_rigidity=stretch,  # asked for; the solver has no shear
        bend_rigidity=bending,
        twist_rigidity=twisting,
    )
    config = newton.ModelBuilder.ShapeConfig(density=density)
    edges = dismech.add_rod(builder, rod, cfg=config, proxies=False)
    dismech.fix_segment(builder, edge=edges[0])
    model = builder.finalize(device="cpu")
    model.set_gravity(warp.vec3(*gravity))
    solver = dismech.DiSMechSolver(
        model, iterations=ITERATIONS, exact=True, self_contact=False, theta=theta
    )
    if not bend:
        rest = solver.triplets.rest.numpy()
        # its second curvature is about minus the first director
        rest[:, 3] -= problem.seed_curvature * 0.5 * (arc[2:] - arc[:-2])
        solver.triplets.rest.assign(rest)
        if problem.slides:  # the last edge stays on the axis and does not turn
            held = solver.fixed.numpy()
            across = np.flatnonzero(np.abs(problem.direction) < 0.5)
            for node in (elements - 1, elements):
                held[3 * node + across] = 1
            held[3 * (elements + 1) + elements - 1] = 1
            solver.fixed.assign(held)
    return Dismech(solver, (model.state(), model.state()), arc, elements + 1)


def run_dismech(problem: Problem | Bend, elements: int, dt: float) -> Outcome | CannotRun:
    """dismech-newton: the implicit midpoint rule, or for statics Euler's with very long steps.

    Drag is a force given at the start of each step. The bend takes its load in ten parts and then
    rests for ten steps; `dt` is not used for it.
    """
    if importlib.util.find_spec("dismech_newton") is None:
        return CannotRun("not installed: pip install '.[peers]'")
    try:
        import_dismech()
    except Exception as reason:
        return CannotRun(f"its import fails: {type(reason).__name__}: {reason}")
    static = isinstance(problem, Bend)
    if not static and problem.neck is not None:
        return CannotRun("one diameter a rod")
    length = problem.radius * problem.angle if static else problem.length
    system = dismech_system(problem, elements, theta=1.0 if static else 0.5)
    solver, (now, after), arc, nodes = system
    times, rests = ((0.0,), 20) if static else (problem.times, None)
    amount = None
    if not static and problem.drag is not None:
        half = 0.5 * problem.diameter * np.diff(arc)
        amount = np.append(half, 0.0) + np.append(0.0, half)
    positions, steps = [], 0
    before = None
    clock = 0.0
    for stop in times:
        count = rests or max(1, int(np.ceil((stop - clock) / dt * (1 - 1e-9))))
        size = STATIC_STEP if static else (stop - clock) / count
        begin = clock
        for i in range(count):
            if static:
                force = np.zeros((nodes, 3))
                force[-1, 2] = problem.load * min(1.0, (i + 1) / 10)
                now.particle_f.assign(force)
            elif amount is not None:
                now.particle_f.assign(
                    morison(problem.drag, amount, now.particle_q.numpy(), now.particle_qd.numpy())
                )
            if not static and problem.turns is not None and steps:
                knots, turns = np.array(problem.turns).T
                angle = -2 * np.pi * np.interp(begin + (i + 1) * size, knots, turns)
                now.dismech.q.numpy()[3 * nodes] = angle
            solver.step(now, after, None, None, size)
            now, after = after, now
            steps += 1
            if before is None:  # the first step compiles: it is not in the cost
                before = time.process_time(), time.perf_counter()
        clock = stop
        found = now.particle_q.numpy().astype(float)
        if not np.max(np.linalg.norm(found - found[0], axis=1)) <= 2 * (arc[-1] - arc[0]):
            return CannotRun(f"diverged before t = {stop:g} s; take a less dt")
        positions.append(sampled(arc, found, length))
    cost = time.process_time() - before[0], time.perf_counter() - before[1]
    return Outcome(np.array(times), np.stack(positions), *cost, steps)


def morison(drag: Drag, diameter: np.ndarray, position: np.ndarray, velocity: np.ndarray):
    """Drag on nodes (n+1, 3); `diameter` is lumped to them [m^2]."""
    tangent = np.gradient(position, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    along = np.sum(velocity * tangent, 1, keepdims=True)
    across = velocity - along * tangent
    speed = np.linalg.norm(across, axis=1, keepdims=True)
    rate = drag.normal * speed * across + np.pi * drag.tangential * np.abs(along) * along * tangent
    return -0.5 * drag.fluid_density * diameter[:, None] * rate
