"""PyElastica on the problems of `peer_problems.py`. In the extra `peers`, imported when run."""

import importlib.util
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from peer_problems import Bend, CannotRun, Outcome, Problem, held_grid, sampled


class Elastica(NamedTuple):
    """PyElastica's simulator with one rod, ready to step."""

    simulator: Any
    rod: Any
    arc_length: np.ndarray
    first: np.ndarray  # place of the first node, (3, 1)


def pyelastica_system(
    problem: Problem, elements: int, penalty: tuple[float, float] | None = None, law=None
) -> Elastica:
    """The problem in PyElastica.

    `penalty` (k [N/m], nu [N s/m]) switches its self-contact on, `law` is the class of that
    (default `RodSelfContact`).
    """
    import elastica
    from numba import njit

    class Simulator(
        elastica.BaseSystemCollection, elastica.Constraints, elastica.Forcing, elastica.Contact
    ):
        pass

    class Held(elastica.ConstraintBase):
        """Both ends: the first clamped or turned, the last sliding if the problem says so."""

        def __init__(self, *held, **kwargs):
            super().__init__(**kwargs)
            rod = self.system
            self.first = rod.position_collection[:, 0].copy()
            self.last = rod.position_collection[:, -1].copy()
            self.frames = rod.director_collection[:, :, [0, -1]].copy()
            self.knots, self.turns = np.array(problem.turns or ((0.0, 0.0), (1.0, 0.0))).T
            self.rates = np.append(np.diff(self.turns) / np.diff(self.knots), 0.0)
            self.axis = np.array(problem.direction)

        def constrain_values(self, system, time):
            angle = -2 * np.pi * np.interp(time, self.knots, self.turns)
            _values(system.position_collection, system.director_collection, self.first, self.last,
                    self.frames, self.axis, angle, problem.slides)  # fmt: skip

        def constrain_rates(self, system, time):
            piece = np.searchsorted(self.knots, time, "right") - 1
            spin = -2 * np.pi * self.rates[piece]
            _rates(system.velocity_collection, system.omega_collection, self.axis, spin,
                   problem.slides)  # fmt: skip

    @njit
    def _values(position, frame, first, last, frames, axis, angle, slides):
        position[:, 0] = first
        # about the third director, which is the axis: a_1 and a_2 turn in their plane
        c, s = np.cos(angle), np.sin(angle)
        for k in range(3):
            frame[0, k, 0] = c * frames[0, k, 0] + s * frames[1, k, 0]
            frame[1, k, 0] = c * frames[1, k, 0] - s * frames[0, k, 0]
            frame[2, k, 0] = frames[2, k, 0]
        if slides:
            moved = 0.0
            for k in range(3):
                moved += (position[k, -1] - last[k]) * axis[k]
            for k in range(3):
                position[k, -1] = last[k] + moved * axis[k]
            frame[:, :, -1] = frames[:, :, 1]

    @njit
    def _rates(velocity, omega, axis, spin, slides):
        velocity[:, 0] = 0.0
        omega[0, 0] = omega[1, 0] = 0.0
        omega[2, 0] = spin
        if slides:
            along = 0.0
            for k in range(3):
                along += velocity[k, -1] * axis[k]
            for k in range(3):
                velocity[k, -1] = along * axis[k]
            omega[:, -1] = 0.0

    class Morison(elastica.NoForces):
        """Drag on the nodes; the tangent of a node is the mean of its elements'."""

        def __init__(self, drag, diameter):
            super().__init__()
            self.drag, self.diameter = drag, diameter

        def apply_forces(self, system, time=0.0):
            drag = self.drag
            scale = 0.5 * drag.fluid_density * self.diameter
            _drag(system.tangents, system.velocity_collection, system.external_forces,
                  scale, drag.normal, drag.tangential)  # fmt: skip

    @njit
    def _drag(tangents, velocity, force, scale, normal, tangential):
        nodes = velocity.shape[1]
        for i in range(nodes):
            before, after = max(i - 1, 0), min(i, nodes - 2)
            x = tangents[0, before] + tangents[0, after]
            y = tangents[1, before] + tangents[1, after]
            z = tangents[2, before] + tangents[2, after]
            size = np.sqrt(x * x + y * y + z * z)
            x, y, z = x / size, y / size, z / size
            vx, vy, vz = velocity[0, i], velocity[1, i], velocity[2, i]
            along = vx * x + vy * y + vz * z
            nx, ny, nz = vx - along * x, vy - along * y, vz - along * z
            speed = normal * np.sqrt(nx * nx + ny * ny + nz * nz)
            tangent = np.pi * tangential * abs(along) * along
            force[0, i] -= scale[i] * (speed * nx + tangent * x)
            force[1, i] -= scale[i] * (speed * ny + tangent * y)
            force[2, i] -= scale[i] * (speed * nz + tangent * z)

    nodes = held_grid(problem, elements)
    middles = 0.5 * (nodes[1:] + nodes[:-1])
    axis = np.array(problem.direction)
    normal = np.eye(3)[np.argmin(np.abs(axis))]
    diameter = problem.diameter_at(middles)
    rod = elastica.CosseratRod.straight_rod(
        elements,
        nodes[0] * axis,
        axis,
        normal,
        nodes[-1] - nodes[0],
        0.5 * diameter,
        problem.density,
        youngs_modulus=problem.youngs_modulus,
        shear_modulus=problem.shear_modulus,
        position=axis[:, None] * nodes,
    )
    rod.rest_kappa[0] = problem.seed_curvature
    simulator = Simulator()
    simulator.append(rod)
    simulator.constrain(rod).using(
        Held, constrained_position_idx=(0, -1), constrained_director_idx=(0, -1)
    )
    if problem.gravity is not None:
        gravity = np.array(problem.gravity)
        simulator.add_forcing_to(rod).using(elastica.GravityForces, acc_gravity=gravity)
    if problem.drag is not None:
        amount = 0.5 * diameter * np.diff(nodes)
        simulator.add_forcing_to(rod).using(
            Morison, problem.drag, np.append(amount, 0.0) + np.append(0.0, amount)
        )
    if penalty is not None:
        k, nu = penalty
        simulator.detect_contact_between(rod, rod).using(law or elastica.RodSelfContact, k=k, nu=nu)
    simulator.finalize()
    return Elastica(simulator, rod, nodes, nodes[0] * axis[:, None])


def near_self_contact(margin: float, every: int):
    """PyElastica's `RodSelfContact` over a list of near pairs of elements: the same forces sooner.

    The list holds pairs that could touch after either rod has moved by half of `margin` [m]; it is
    made anew every so many calls, and a rod that moved further in between is an error. For
    refined runs whose cost is not compared.
    """
    import elastica
    from elastica.contact_utils import _find_min_dist
    from numba import njit

    @njit
    def _pairs(x, radius, length, margin):
        found = []
        n = radius.size
        for i in range(n):
            skip = int(1 + np.ceil(0.8 * np.pi * radius[i] / length[i]))
            for j in range(i - skip, -1, -1):
                apart = 0.0
                for k in range(3):
                    apart += (x[k, i] - x[k, j]) ** 2
                reach = radius[i] + radius[j] + length[i] + length[j] + margin
                if apart < reach * reach:
                    found.append((i, j))
        return np.array(found) if found else np.zeros((0, 2), np.int64)

    @njit
    def _push(pairs, x, radius, length, tangent, velocity, force, k, nu):
        last = radius.size - 1
        for pair in range(pairs.shape[0]):
            i, j = pairs[pair]
            xi, xj = x[:, i], x[:, j]
            if np.linalg.norm(xi - xj) >= radius[i] + radius[j] + length[i] + length[j]:
                continue
            chord_i, chord_j = length[i] * tangent[:, i], length[j] * tangent[:, j]
            between, _, _ = _find_min_dist(xi, chord_i, xj, chord_j)
            distance = np.sqrt(np.sum(between * between))
            depth = radius[i] + radius[j] - distance
            if depth <= 0:
                continue
            normal = between / distance
            mean = 0.5 * (velocity[:, i] + velocity[:, i + 1] - velocity[:, j] - velocity[:, j + 1])
            half = 0.5 * (k * depth + nu * np.sum(mean * normal)) * normal
            to_i = (4 / 3, 2 / 3) if i == last else (1.0, 1.0)
            to_j = (2 / 3, 4 / 3) if j == 0 else (1.0, 1.0)
            for end in range(2):
                force[:, i + end] -= to_i[end] * half
                force[:, j + end] += to_j[end] * half

    class Near(elastica.RodSelfContact):
        calls = 0

        def apply_contact(self, system_one, system_two, time=0.0):
            rod = system_one
            x = rod.position_collection
            if self.calls % every == 0:
                if self.calls and np.max(np.abs(x - self.listed)) > 0.25 * margin:
                    raise RuntimeError(f"the rod outran its list of pairs before t = {time:g} s")
                self.listed = x.copy()
                self.pairs = _pairs(x, rod.radius, rod.lengths, margin)
            self.calls += 1
            if len(self.pairs):
                _push(self.pairs, x, rod.radius, rod.lengths, rod.tangents,
                      rod.velocity_collection, rod.external_forces, self.k, self.nu)  # fmt: skip

    return Near


def pyelastica_steps(
    system: Elastica, times, dt: float, look: Callable[[Any, float], None]
) -> tuple[float, float, int]:
    """CPU seconds, wall seconds and steps to the last of `times`, where `look(rod, t)` looks on.

    The steps between two times are equal and at most `dt`.
    """
    from elastica import PositionVerlet

    stepper = PositionVerlet()
    now, steps = 0.0, 0
    cpu = wall = 0.0
    for stop in times:
        count = max(1, int(np.ceil((stop - now) / dt * (1 - 1e-9))))
        size, begin = (stop - now) / count, now
        before = time.process_time(), time.perf_counter()
        for i in range(count):
            stepper.step(system.simulator, begin + i * size, size)
        cpu += time.process_time() - before[0]
        wall += time.perf_counter() - before[1]
        now, steps = stop, steps + count
        reached = np.max(np.linalg.norm(system.rod.position_collection - system.first, axis=0))
        if not reached <= 2 * system.rod.rest_lengths.sum():
            raise FloatingPointError(f"PyElastica diverged before t = {stop:g} s; take a less dt")
        look(system.rod, stop)
    return cpu, wall, steps


def run_pyelastica(problem: Problem | Bend, elements: int, dt: float) -> Outcome | CannotRun:
    """PyElastica by position Verlet, undamped."""
    if importlib.util.find_spec("elastica") is None:
        return CannotRun("not installed: pip install '.[peers]'")
    if isinstance(problem, Bend):
        return CannotRun("has no static solver, only explicit dynamics")
    positions = []

    def look(rod, _):
        positions.append(sampled(system.arc_length, rod.position_collection.T, problem.length))

    system = pyelastica_system(problem, elements)
    pyelastica_steps(system, (2 * dt,), dt, lambda *_: None)  # numba compiles
    system = pyelastica_system(problem, elements)
    try:
        cost = pyelastica_steps(system, problem.times, dt, look)
    except FloatingPointError as problem_found:
        return CannotRun(str(problem_found))
    return Outcome(np.array(problem.times), np.stack(positions), *cost)
