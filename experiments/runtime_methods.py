"""The methods of `error_vs_runtime.py`: how each solves a problem, and what a run of it costs.

`METHODS` is the registry: a method says with which settings it runs a problem (`cases`, none where
it cannot) and measures one of them (`measure`). Another integrator is a `Timed` with a job of its
own.

Seconds are those of the warm run alone: the scene built, its consistent start found and the program
compiled before, the record read off after. CPU seconds are `time.process_time`, all threads;
wall seconds run until the arrays are there (`block_until_ready`).
"""

import dataclasses
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import _settings  # noqa: F401 (first)
import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from runtime_scenes import Problem, Record, at_points
from scipy.interpolate import CubicSpline

from rodjax import energy, measures, semidiscrete
from rodjax.dynamics.adaptive import adaptive_rollout
from rodjax.dynamics.consistency import start
from rodjax.dynamics.fixed_rollout import rollout
from rodjax.dynamics.run import Run
from rodjax.dynamics.step_control import StepControl
from rodjax.equations.generalized_alpha import GeneralizedAlpha
from rodjax.equilibria.load_path import equilibrium
from rodjax.fitting.observations import positions_at
from rodjax.numerics.compilation import compiled
from rodjax.numerics.results import Result
from rodjax.reference.paper_scheme import paper_rollout
from rodjax.scenes.placing import placing
from rodjax.scenes.scene import Scene

LONG = 10.0  # warm seconds after which a case is not repeated again


class Case(NamedTuple):
    """One setting of a method."""

    elements: int
    steps: int | None = None  # fixed steps in all
    tolerance: float | None = None  # of a step control: a factor of the default, or absolute


class Outcome(NamedTuple):
    """What a run found."""

    record: Record
    steps: int
    iterations: int | None  # of Newton
    result: str = "SUCCESS"


class Measured(NamedTuple):
    """A run and its cost."""

    outcome: Outcome
    cpu_seconds: Sequence[float]  # of the warm repeats
    wall_seconds: Sequence[float]
    compile_seconds: float | None  # wall time of the first call beyond that of a warm one


class Job(NamedTuple):
    """A run that can be repeated, and what is read off its result."""

    run: Callable[[], Any]
    read: Callable[[Any], Outcome]


class CannotRun(NamedTuple):
    """Why a method cannot run a case."""

    reason: str


def timed(job: Job, repeats: int) -> Measured:
    """Cost of a job: a first call, which compiles, then the warm ones (fewer if they are long)."""
    began = time.perf_counter()
    found = jax.block_until_ready(job.run())
    first = time.perf_counter() - began
    cpu, wall = [], []
    for _ in range(repeats):
        before = time.process_time(), time.perf_counter()
        found = jax.block_until_ready(job.run())
        cpu.append(time.process_time() - before[0])
        wall.append(time.perf_counter() - before[1])
        if sum(wall) > LONG:
            break
    return Measured(job.read(found), cpu, wall, max(first - float(np.median(wall)), 0.0))


@dataclasses.dataclass(frozen=True)
class Timed:
    """A method that is timed here.

    Args:
        label: for tables and figures.
        cases: settings for a problem; () where the method cannot run it.
        job: the run of a case.
    """

    label: str
    cases: Callable[[Problem], Sequence[Case]]
    job: Callable[[Problem, Case], Job]

    def measure(self, problem: Problem, case: Case, repeats: int) -> Measured | CannotRun:
        """What the run finds and costs."""
        return timed(self.job(problem, case), repeats)


# Records


@compiled
def _scalars(scene: Scene, states) -> dict[str, jax.Array]:
    one = lambda state: {
        "writhe": measures.writhe(state),
        "bending_energy": energy.bending_energy(scene, state),
        "torsion_energy": energy.torsion_energy(scene, state),
    }
    return lax.map(one, states)


def read_run(problem: Problem, scene: Scene, run: Run) -> Outcome:
    """Positions by the cubic through saved positions and velocities, scalars by a cubic spline."""
    reached = Result(int(run.result))
    steps = int(np.sum(np.asarray(run.infos.iterations) > 0))
    iterations = int(np.sum(run.infos.iterations)) + int(run.wasted_iterations)
    if reached != Result.SUCCESS:
        return Outcome(Record(np.full((0,), np.nan), {}), steps, iterations, reached.name)
    wanted = np.array(problem.times)
    positions = at_points(np.asarray(positions_at(run, jnp.asarray(wanted))))
    scalars = {}
    if problem.writhe:
        states, known = run.states, np.asarray(run.times)
        nearest = np.argmin(np.abs(known[:, None] - wanted), axis=0)
        if np.allclose(known[nearest], wanted, rtol=0, atol=1e-9 * wanted[-1]):
            # fixed steps end there; writhe is too dear to be found at all of them
            states, known = jax.tree.map(lambda leaf: leaf[nearest], states), wanted
        values = _scalars(scene, states)
        scalars = {k: CubicSpline(known, np.asarray(v))(wanted) for k, v in values.items()}
    return Outcome(Record(positions, scalars), steps, iterations)


# Default scheme


def given_steps(
    problem: Problem, case: Case, integrate: Callable[..., Run], dtype=jnp.float64
) -> Job:
    """Any integrator (scene, state, times) -> Run, at equal steps."""
    cast = lambda leaf: leaf.astype(dtype) if eqx.is_inexact_array(leaf) else leaf
    scene = jax.tree.map(cast, problem.build(case.elements))
    first = start(scene)
    times = jnp.linspace(0.0, problem.times[-1], case.steps + 1, dtype=dtype)[1:]
    return Job(lambda: integrate(scene, first, times), lambda run: read_run(problem, scene, run))


def fixed_steps(problem: Problem, case: Case, rho: float = 0.5, dtype=jnp.float64) -> Job:
    """The default scheme."""
    integrate = partial(rollout, method=GeneralizedAlpha(rho), throw=False)
    return given_steps(problem, case, integrate, dtype)


def chosen_steps(problem: Problem, case: Case) -> Job:
    """The adaptive rollout, its tolerances multiplied by that of the case."""
    scene = problem.build(case.elements)
    first = start(scene)
    default = StepControl()
    control = StepControl(
        relative=case.tolerance * default.relative,
        absolute=case.tolerance * default.absolute,
        twisting=case.tolerance * default.twisting,
    )
    return Job(
        lambda: adaptive_rollout(scene, first, problem.times[-1], control=control, throw=False),
        lambda run: read_run(problem, scene, run),
    )


def static(problem: Problem, case: Case) -> Job:
    """The equilibrium under the full load."""
    scene = problem.build(case.elements)
    first = placing(scene)

    def read(found):
        state, info = found
        record = Record(at_points(np.asarray(state.position))[None], {})
        result = Result(int(info.result)).name
        return Outcome(record, int(info.load_steps), int(info.iterations), result)

    return Job(lambda: equilibrium(scene, first, throw=False), read)


def on_ladder(problem: Problem) -> Sequence[Case]:
    """Grid and step halved together, and once more with steps four times as small."""
    if problem.static:
        return ()
    together = [Case(n, steps) for n, steps in problem.ladder]
    return (*together, *(Case(n, 4 * steps) for n, steps in problem.ladder))


def on_kirchhoff_ladder(problem: Problem) -> Sequence[Case]:
    """Grid and step halved together, of inextensible rods."""
    return () if problem.compliant else tuple(Case(n, steps) for n, steps in problem.ladder)


def on_coarse_ladder(problem: Problem) -> Sequence[Case]:
    """Grid and step halved together, without the finest grid."""
    return tuple(Case(n, steps) for n, steps in problem.ladder[:-1])


def on_tolerances(problem: Problem) -> Sequence[Case]:
    """The default tolerances, then those for which the error of the step falls with the grid's."""
    if problem.static:
        return ()
    finer = [Case(n, None, 4.0**-k) for k, n in enumerate(problem.grids)]
    return (*finer, *(Case(n, None, 4.0**-k / 4) for k, n in enumerate(problem.grids)))


def on_grids(problem: Problem) -> Sequence[Case]:
    """Statics on every grid."""
    return tuple(Case(n) for n in problem.grids) if problem.static else ()


# The rod as a differential equation


@eqx.filter_jit
def _solve(scene, y0, times, solver, tolerance, max_steps):
    return diffrax.diffeqsolve(
        diffrax.ODETerm(semidiscrete.vector_field),
        solver,
        0.0,
        times[-1],
        1e-5,
        y0,
        args=scene,
        saveat=diffrax.SaveAt(ts=times),
        stepsize_controller=diffrax.PIDController(rtol=tolerance, atol=tolerance),
        max_steps=max_steps,
        throw=False,
    )


def differential_equation(problem: Problem, case: Case, solver, max_steps: int) -> Job:
    """diffrax with its step control; the tolerance serves as relative and absolute one."""
    scene = problem.build(case.elements)
    y0, times = semidiscrete.initial_value(scene), jnp.asarray(problem.times)
    tolerance = jnp.asarray(case.tolerance)

    def read(found):
        good = bool(found.result == diffrax.RESULTS.successful)
        positions = at_points(np.asarray(found.ys.position))
        steps = int(found.stats["num_steps"])
        return Outcome(Record(positions, {}), steps, None, "SUCCESS" if good else "MAX_STEPS")

    return Job(lambda: _solve(scene, y0, times, solver, tolerance, max_steps), read)


EXPLICIT_TOLERANCES = (1e-5, 1e-5, 1e-5)  # on the coarsest grids


def explicit_cases(problem: Problem) -> Sequence[Case]:
    """Its steps are bounded by stability: the tolerance only matters when small."""
    if problem.static or not problem.compliant:
        return ()
    return tuple(Case(n, None, t) for n, t in zip(problem.grids, EXPLICIT_TOLERANCES, strict=False))


def stiff_cases(problem: Problem) -> Sequence[Case]:
    """Dense Jacobians, so the coarsest grid only.

    The waves of the start ring on undamped, and its step control follows them: at 20 elements and
    a tolerance of 1e-4 it had not ended after a minute of CPU time. It is given up at 2000 steps.
    """
    if problem.static or not problem.compliant:
        return ()
    return (Case(problem.grids[0], None, 1e-3),)


METHODS = dict(
    fixed=Timed("fixed steps, rho 0.5 (default)", on_ladder, fixed_steps),
    adaptive=Timed("adaptive steps (default)", on_tolerances, chosen_steps),
    fixed_rho_08=Timed("fixed steps, rho 0.8", on_ladder, partial(fixed_steps, rho=0.8)),
    fixed_rho_0=Timed("fixed steps, rho 0", on_ladder, partial(fixed_steps, rho=0.0)),
    static=Timed("equilibrium (default)", on_grids, static),
    float32=Timed(
        "fixed steps, float32",
        on_coarse_ladder,
        partial(fixed_steps, dtype=jnp.float32),
    ),
    ode_explicit=Timed(
        "diffrax, Tsit5",
        explicit_cases,
        partial(differential_equation, solver=diffrax.Tsit5(), max_steps=1_000_000),
    ),
    ode_stiff=Timed(
        "diffrax, Kvaerno5",
        stiff_cases,
        partial(differential_equation, solver=diffrax.Kvaerno5(), max_steps=2000),
    ),
    paper=Timed(
        "the paper's scheme",
        on_kirchhoff_ladder,
        partial(given_steps, integrate=partial(paper_rollout, throw=False)),
    ),
)

DEFAULTS = ("fixed", "adaptive", "static")  # what is rodjax's default for a problem
EXTRAPOLATED = ("fixed", "fixed_rho_08", "static")  # measured with Richardson's extrapolation too
