"""Other rod codes on rodjax's problems: the same physics, each by its own means, timed alike.

    outcome = run(peer, scene, elements, dt)

`PROBLEMS` states each scene once; `rodjax_scene` and the runners of the peers build it from there.
The peers are in the extra `peers` and are imported only when they run; one that cannot run says
why (`CannotRun`).

What is matched: geometry, elastic and shear stiffness (PyElastica's shear factor 27/28 in rodjax
too), mass lumped to the nodes, weight, drag, drives; no damping is added. What is not:
- PyElastica and dismech-newton hold the frame of an end at the middle of the end's element. Held
  at s = 0 this would make them first order in the element length: here their rod is half an
  element longer at a held end, so that the middle of the end's element is the end of the rod.
  The half element more at a sliding end moves, and weighs, half an element's mass too much.
- PyElastica gives rotary inertia to elements, rodjax to nodes (half of either element's);
  it divides moments by the cube of the stretch, rodjax keeps B constant.
- dismech-newton computes in single precision, has no shear and no rotary inertia across the axis.
"""

import dataclasses
import importlib.util
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

SHEAR_FACTOR = 27 / 28  # fixed in PyElastica
POINTS = 11  # recorded, equally spaced from end to end


class Outcome(NamedTuple):
    """What a code found, and what the warm integration loop cost."""

    times: np.ndarray  # (k,) [s]
    positions: np.ndarray  # (k, POINTS, 3) at equal arc lengths [m]
    cpu_seconds: float
    wall_seconds: float
    steps: int


class CannotRun(NamedTuple):
    """Why a code cannot run a problem."""

    reason: str


@dataclasses.dataclass(frozen=True)
class Drag:
    """Morison drag, as `rodjax.loads.MorisonDrag`."""

    fluid_density: float
    normal: float
    tangential: float


@dataclasses.dataclass(frozen=True)
class Problem:
    """A rod of circular section, held at s = 0, from rest; SI units.

    Args:
        direction: of the straight rod from s = 0.
        neck: (begin, end, ratio): where the diameter is less, and to what part.
        seed_curvature: natural curvature about a_1 [1/m].
        gravity: acceleration; None for none.
        turns: knots (time, turns) of the rotation of the end s = 0 by minus the turns about its
            tangent, linear between them; None: it is clamped.
        slides: whether the other end slides along the rod's axis without turning; if not it is
            free.
        times: to be recorded, the last ending the run.
    """

    direction: tuple[float, float, float]
    times: tuple[float, ...]
    length: float = 1.0
    diameter: float = 0.01
    youngs_modulus: float = 1.25e7
    shear_modulus: float = 5e6
    density: float = 1500.0
    neck: tuple[float, float, float] | None = None
    seed_curvature: float = 0.0
    gravity: tuple[float, float, float] | None = None
    turns: tuple[tuple[float, float], ...] | None = None
    slides: bool = False
    drag: Drag | None = None

    @property
    def jumps(self) -> tuple[float, ...]:
        """Arc lengths where the diameter jumps."""
        return () if self.neck is None else self.neck[:2]

    def diameter_at(self, s: np.ndarray) -> np.ndarray:
        """Diameter at arc lengths."""
        if self.neck is None:
            return np.full(np.shape(s), self.diameter)
        begin, end, ratio = self.neck
        return np.where((s > begin) & (s < end), ratio, 1.0) * self.diameter


def _until(end: float, count: int) -> tuple[float, ...]:
    return tuple(float(t) for t in np.linspace(0.0, end, count + 1)[1:])


@dataclasses.dataclass(frozen=True)
class Bend:
    """The static 45-degree bend of Bathe & Bolourchi (1979): dead load normal to its plane [N].

    A stress-free eighth of a circle, clamped at s = 0 along x, its centre on the y axis.
    """

    load: float = 600.0
    radius: float = 100.0
    angle: float = np.pi / 4
    bend_stiffness: float = 1e7 / 12  # A1 = A2 = C of the unit square section, E = 1e7
    stretch_stiffness: float = 1e7


PROBLEMS: dict[str, Problem | Bend] = {
    "cantilever": Problem((1.0, 0.0, 0.0), _until(1.0, 20), gravity=(0.0, 0.0, -9.81)),
    "bend": Bend(),
    # it buckles at 4 s and has drawn itself into a loop at 4.8 s; without contact its strands pass
    # through each other just after
    "buckling": Problem(
        (0.0, 0.0, 1.0),
        _until(8.0, 40),
        seed_curvature=0.1,
        turns=((0.0, 0.0), (6.0, 3.0), (1000.0, 3.0)),
        slides=True,
        drag=Drag(1000.0, 0.1, 0.01),
    ),
}


def rodjax_scene(problem: Problem, elements: int, contact=None, extensible: bool = True):
    """The problem as a rodjax scene; `extensible=False` leaves Kirchhoff's constraints."""
    import rodjax as rx

    section = rx.circular_section(
        problem.diameter_at,
        problem.youngs_modulus,
        problem.shear_modulus,
        problem.density,
        extensible=extensible,
        shear_factor=SHEAR_FACTOR,
    )
    rod = rx.straight_rod(
        problem.length,
        elements,
        section,
        direction=problem.direction,
        natural_curvature=(problem.seed_curvature, 0.0, 0.0),
        jumps=problem.jumps,
    )
    drive = None
    if problem.turns is not None:
        knots, turns = np.array(problem.turns).T
        drive = rx.Turn(problem.direction, rx.PiecewiseLinear(knots, -2 * np.pi * turns))
    loads = () if problem.gravity is None else (rx.Gravity(problem.gravity),)
    if problem.drag is not None:
        drag = problem.drag
        loads += (rx.MorisonDrag(drag.fluid_density, drag.normal, drag.tangential),)
    last = rx.Slider(problem.direction) if problem.slides else rx.Free()
    return rx.Scene(rod, rx.Clamped(rotation=drive), last, loads, contact)


def held_grid(problem: Problem, elements: int) -> np.ndarray:
    """Arc lengths of nodes of which held ends lie in the middle of the first or last element.

    Jumps of the properties are nodes; elements are equal between them.
    """
    marks = np.array([0.0, *problem.jumps, problem.length])
    spans = np.diff(marks)
    outside = np.zeros(len(spans))  # of elements, beyond the ends of the rod
    outside[0] += 0.5
    if problem.slides:
        outside[-1] += 0.5
    count = np.maximum(1, np.round(spans * (elements - outside.sum()) + outside)).astype(int)
    count[len(count) // 2] += elements - count.sum()
    size = spans / (count - outside)
    first = -0.5 * size[0]
    lengths = np.repeat(size, count)
    return first + np.concatenate([[0.0], np.cumsum(lengths)])


def sampled(arc_length: np.ndarray, position: np.ndarray, length: float) -> np.ndarray:
    """Positions (n+1, 3) of nodes at `POINTS` equal arc lengths, by a cubic spline (4th order)."""
    from scipy.interpolate import CubicSpline

    return CubicSpline(arc_length, position)(np.linspace(0.0, length, POINTS))


def run(peer: str, scene: str, elements: int, dt: float) -> Outcome | CannotRun:
    """A problem by a peer: `elements` of equal length, steps of `dt` [s]."""
    return PEERS[peer](PROBLEMS[scene], elements, dt)


# PyElastica ------------------------------------------------------------------------------------


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


# dismech-newton --------------------------------------------------------------------------------

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


PEERS: dict[str, Callable[[Any, int, float], Outcome | CannotRun]] = {
    "pyelastica": run_pyelastica,
    "dismech-newton": run_dismech,
}
