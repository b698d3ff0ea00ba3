"""The paper's own scheme: Eq. (12) for velocities, moment and force, stepped in time and space.

An independent check of the default scheme, with which it shares rod, ends, loads and measures but
neither unknowns nor equations. The twelve fields at the nodes, in body components, are
Y = (v, omega, q, f); the moment q stands for the paper's kappa = kappa0 + B^-1 q, because q and
not kappa is continuous where B(s) jumps. With the time rates on the right, Eqs. (8) to (11) are

    v'     = omega x t - kappa x v                            (10)
    omega' = B^-1 q_t - kappa x omega                         (11)
    q'     = I omega_t + omega x I omega + f x t - Q - kappa x q    (9)
    f'     = m (v_t + omega x v) - F - kappa x f              (8)

Both in time and along s the first-order generalised-alpha method steps, each with a spectral
radius rho (Jansen, Whiting & Hulbert 2000, after Chung & Hulbert 1993):

    Y^n = Y^{n-1} + dt ((1 - g) Y_t^{n-1} + g Y_t^n),
    Y_i = Y_{i-1} + ds ((1 - g) Y'_{i-1} + g Y'_i),
    equations at rates (1 - a_m) new + a_m old and fields (1 - a_k) new + a_k old,
    a_m = (3 rho - 1)/(2 (rho + 1)),  a_k = rho/(rho + 1),  g = 1/(1 + rho).

What the paper leaves open, and is chosen here:
- Eq. (10) has no rate. It is imposed at t_n, since at the weighted level an error of the start
  would ring on as (-rho)^n. f has none either, but as the multiplier of (10) it needs the weighted
  level to be second order.
- Products are taken of the weighted fields (in the manner of the midpoint rule).
- Where properties jump, Y' jumps by what the equations say of the two sides; carried over as it
  is, it would make the scheme first order. At s = 0 it is what they say there.
- The ends' velocities, not their positions, are imposed at t_n.
- The configuration follows from the curvatures, integrated along s from the end s = 0, whose
  motion is integrated in time (exact where it is prescribed). So the rod stays unstretched, and
  its frames fit its edges, as measures and topology take for granted; integrated in time node by
  node, it stretches, by 8 % in the example with dt = 0.05 s. The discretisation error shows
  at the end s = L instead, which drifts off what holds it at second order.
- Loads see the frames of the step's start, turned by the nodes' own angular velocities.
- Contact is lagged: its forces are those of the step's start (first order in dt, and a stiff
  contact bounds the step). The default scheme has it implicit.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from rodjax.constraints import ends
from rodjax.dynamics.fixed_rollout import check_times
from rodjax.dynamics.given_steps import onto_switches, until_failure
from rodjax.dynamics.run import Run
from rodjax.dynamics.stepping import StepInfo, no_info
from rodjax.inputs.validation import as_float, check_positive, known
from rodjax.interactions import contact_report
from rodjax.interactions.loads import Gravity, LinearDrag, MorisonDrag
from rodjax.numerics import newton, results, rotations
from rodjax.numerics.compilation import compiled
from rodjax.numerics.failure import not_a_number
from rodjax.numerics.results import Result, join
from rodjax.reference.paper_equations import Fields, PaperEquations, weights
from rodjax.reference.paper_solvers import AbstractSolver, BlockSolve
from rodjax.rods.chain import check_alone
from rodjax.rods.rod import Rod, check_linear
from rodjax.rods.state import State
from rodjax.rods.strains import curvature
from rodjax.scenes.scene import Scene, projectors


class PaperScheme(eqx.Module):
    """Settings of the paper's own scheme; the numbers are traced.

    Args:
        rho_time, rho_space: spectral radii in [0, 1] of the two generalised-alpha methods (the
            paper does not say which it used): 1 damps nothing, 0 most. Below 1 in time, errors of
            the start die out. Along s, 1 is the box scheme, the only one stable for all steps:
            below, the scheme damps towards s = L whichever way a wave runs, so those that come
            back grow, once dt resolves them (`experiments/paper_scheme.py` shows where).
        tolerance: predicted error after the last Newton update, in units of `PaperEquations`.
        max_iterations: Newton iterations allowed in a step.
        solver: `BlockSolve()` or, as in the paper, `Shooting()`.
    """

    rho_time: Float[Array, ""] = eqx.field(converter=as_float, default=0.5)
    rho_space: Float[Array, ""] = eqx.field(converter=as_float, default=1.0)
    tolerance: Float[Array, ""] = eqx.field(converter=as_float, default=1e-9)
    max_iterations: Int[Array, ""] = eqx.field(
        converter=lambda n: jnp.asarray(n, jnp.int32), default=20
    )
    solver: AbstractSolver = BlockSolve()

    def __check_init__(self):
        for name in ("rho_time", "rho_space"):
            value = getattr(self, name)
            if known(value) and not 0 <= float(value) <= 1:
                raise ValueError(f"{name}: must be in [0, 1], got {value}")
        check_positive(tolerance=self.tolerance, max_iterations=self.max_iterations)


def check_scene(scene: Scene) -> None:
    """Raise ValueError where the scene has what this scheme does not support."""
    rod = scene.rod
    check_linear(rod, "the paper's scheme")
    check_alone(rod, "the paper's scheme")
    if scene.joints:
        raise ValueError("joints: the paper's scheme holds a rod at its ends only")
    if rod.compliance is not None:
        raise ValueError(
            "compliance: the paper's scheme is for inextensible, unshearable rods; pass"
            " compliance=None"
        )
    if rod.mass is None or rod.rotary_inertia is None:
        raise ValueError("rotary_inertia, mass: the paper's scheme needs both; Eqs. (8) and (9)")
    if rod.lumps:
        raise ValueError("lumps: the paper's scheme has rods alone; use rodjax.rollout")
    if scene.supports:
        raise ValueError("supports: the paper's scheme holds a rod at its ends only")
    for load in scene.loads:
        if not isinstance(load, Gravity | LinearDrag | MorisonDrag) or load.inertia:
            raise ValueError(
                f"loads: the paper's scheme takes Gravity, LinearDrag and MorisonDrag without"
                f" added mass, not this {type(load).__name__}"
            )


def fields_of(scene: Scene, state: State) -> Fields:
    """The fields of a scene's state, its elements' moments and forces interpolated to the nodes."""
    state = dataclasses.replace(state, settling=None, jerk=None)
    rod, frame = scene.rod, state.quaternion
    kappa = curvature(rod, frame)
    spin = state.angular_velocity
    velocity = rotations.rotate_inverse(frame, state.velocity)
    # Eq. (11) on the elements, for the rate of the moment
    rise = (spin[1:] - spin[:-1]) / rod.length[:, None]
    kappa_rate = rise + jnp.cross(kappa, 0.5 * (spin[1:] + spin[:-1]))
    moment = rod.stiffness * (kappa - rod.natural_curvature)
    value = [velocity, spin, _to_nodes(rod, moment), _to_nodes(rod, state.force)]
    acceleration = rotations.rotate_inverse(frame, state.acceleration[:, :3])
    rate = [
        acceleration - jnp.cross(spin, velocity),
        state.acceleration[:, 3:],
        _to_nodes(rod, rod.stiffness * kappa_rate),
    ]
    return Fields(state, jnp.concatenate(value, 1), jnp.concatenate(rate, 1))


def _to_nodes(rod: Rod, values: Float[Array, "n 3"]) -> Float[Array, "nodes 3"]:
    """Values at the nodes on straight lines through those at the element centres."""
    distance = 0.5 * (rod.length[1:] + rod.length[:-1])[:, None]
    slope = (values[1:] - values[:-1]) / distance
    half = 0.5 * rod.length[:, None]
    return jnp.concatenate(
        [
            values[:1] - slope[:1] * half[:1],
            values[:-1] + slope * half[:-1],
            values[-1:] + slope[-1:] * half[-1:],
        ]
    )


def paper_step(
    scene: Scene, fields: Fields, stop: Float[Array, ""], method: PaperScheme
) -> tuple[Fields, StepInfo]:
    """Advance a scene's fields to `stop` by this method; `StepInfo.result` reports a failed step.

    No local error is estimated: of `StepInfo` only `result` and `iterations` are set.
    """
    state, rod = fields.state, scene.rod
    push, code = jnp.zeros_like(state.position), jnp.asarray(Result.SUCCESS, jnp.int32)
    if scene.contact is not None:
        at = state.position, state.velocity
        found = contact_report.report(scene.contact, rod, *at, scene.closed)
        push = found.force / rod.node_length[:, None]
        code = jnp.where(found.overflow, Result.CAPACITY_OVERFLOW, Result.SUCCESS)
    equations = PaperEquations(
        scene, fields, stop, method.rho_time, method.rho_space, push, method.solver
    )
    x, solved = newton.iterate(
        equations, equations.guess(), method.tolerance, method.max_iterations
    )
    value = x * equations.units[None]
    rate = equations.new_rate(value)
    new = _configuration(scene, equations, value, rate)
    info = no_info(state.position.dtype)._replace(
        result=join(solved.result, code), iterations=solved.iterations
    )
    return Fields(new, value, rate), info


def _configuration(scene: Scene, equations: PaperEquations, value, rate) -> State:
    """The state at the step's end: see the module's text on the configuration."""
    rod, old = scene.rod, equations.fields.state
    velocity, spin, moment, force = jnp.split(value, 4, axis=1)
    turn = equations.turn(value)[0]
    frame = rotations.multiply(old.quaternion[0], rotations.exponential(turn))
    shift = 0.5 * equations.dt * (old.velocity[0] + rotations.rotate(frame, velocity[0]))
    increment = jnp.concatenate([shift, turn])
    prescribed = ends.increments(scene.first_end, old.time, equations.stop, old.quaternion[0])
    projector = projectors(scene, old.time)[0]
    increment = increment + projector @ (prescribed - increment)
    first = rotations.multiply(old.quaternion[0], rotations.exponential(increment[3:]))

    kappa = rod.natural_curvature + 0.5 * (moment[1:] + moment[:-1]) / rod.stiffness
    phi = rod.length[:, None] * kappa

    def along(frame, turn):
        following = rotations.normalize(rotations.multiply(frame, turn))
        return following, following

    _, frames = lax.scan(along, first, rotations.exponential(phi))
    frames = jnp.concatenate([first[None], frames])
    middle = rotations.multiply(frames[:-1], rotations.exponential(0.5 * phi))
    edges = rod.length[:, None] * rotations.tangent_director(middle)
    origin = old.position[0] + increment[:3]
    position = origin[None] + jnp.concatenate([jnp.zeros_like(edges[:1]), jnp.cumsum(edges, 0)])
    # the algorithmic rates stand for an earlier time: carried on to the step's end
    w = weights(equations.rho_time)
    rate = rate + (w.alpha_k - w.alpha_m) * (rate - equations.fields.rate)
    acceleration = rotations.rotate(frames, rate[:, :3] + jnp.cross(spin, velocity))
    acceleration = jnp.concatenate([acceleration, rate[:, 3:6]], 1)
    return State(
        equations.stop,
        position,
        frames,
        jnp.concatenate([rotations.rotate(frames, velocity), spin], 1),
        acceleration,
        acceleration,
        0.5 * (force[1:] + force[:-1]),
    )


def paper_rollout(
    scene: Scene,
    state: State,
    times: Float[Array, " k"],
    method: PaperScheme | None = None,
    *,
    throw: bool = True,
) -> Run:
    """Step from one given time to the next by the paper's own scheme, as `rollout` does.

    The states of the run are ordinary ones, for measures, energies, topology and plots. A time at
    which a constraint changes must be among `times`; its jolt is left to the scheme's damping.

    Args:
        scene, state: what is run, and from where.
        times: ends of the steps, increasing [s].
        method: default `PaperScheme()`.
        throw: raise `SimulationError` if a step fails.

    Raises:
        ValueError: the scene has what the scheme does not support, or times do not fit.
        SimulationError: a step failed.
    """
    method = PaperScheme() if method is None else method
    check_scene(scene)
    times = jnp.asarray(times, state.position.dtype)
    if times.ndim != 1 or times.shape[0] < 1:
        raise ValueError(f"times: give at least one, along one axis; got shape {times.shape}")
    check_times(scene, state, times)
    run = _paper_rollout(scene, state, times, method)
    if throw:
        good = until_failure(run)
        results.raise_if_failed(run.result, f"after t = {float(good.times[-1]):g}", good)
    return run


@compiled
def _paper_rollout(scene, state, times, method):
    def one(carry, stop):
        before, failed = carry
        left = jnp.where(failed == Result.SUCCESS, method.max_iterations, 0)
        limited = dataclasses.replace(method, max_iterations=left)
        after, info = paper_step(scene, before, stop, limited)
        code = jnp.where(failed == Result.SUCCESS, info.result, failed)
        good = code == Result.SUCCESS
        after = jax.tree.map(lambda new, old: jnp.where(good, new, old), after, before)
        return (after, code), (after.state, info._replace(result=code))

    times = onto_switches(scene, state.time, times)
    zero = jnp.asarray(0, jnp.int32)
    fields = fields_of(scene, state)
    (_, code), (states, infos) = lax.scan(one, (fields, zero), times)
    join = lambda first, rest: jnp.concatenate([first[None], rest])
    states = jax.tree.map(join, fields.state, states)
    failed = jnp.append(False, infos.result != Result.SUCCESS)
    given = jnp.append(fields.state.time, times)
    states = eqx.tree_at(lambda s: s.time, not_a_number(states, failed), given)
    return Run(states, infos, code, zero, zero)
