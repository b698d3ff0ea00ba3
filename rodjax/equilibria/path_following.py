"""Steps along a load path: each solved by Newton's method, and kept on the branch it follows.

What an end turns can be told from fewer turns only below half a turn, and an element that both
ends wind up turns by what they do together. So no end turns by more than a quarter of a turn in a
step of the path: longer steps are cut before they are solved.

Newton's method finds any equilibrium, unstable ones too, so that a step past a critical load may
land on a branch that no rod would take. A step in which the number of unstable modes grows is
halved; where that does not help, the rod descends from where the path had come to (see `descent`
below), as it would, and the path goes on from there.

The descent is that of a rod in honey: steps of the implicit Euler method for motion resisted by
sigma times the weights of `motion_norms.resisting_weight`, each of which minimises the energy plus
sigma/2 |motion|^2. The resistance sigma is kept within 1.5 to 3 times what makes that convex
(`unstable_modes` tells), and falls to zero where the energy itself is.

A spin of the rod about itself that no end holds is resisted at node 0 in every step, and the last
step repeated until it rests: a spin that costs no energy stays what it is, and one that does turns
to where it is balanced. So are turns of bodies about their joints.
"""

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from rodjax.equations.equations import Equations
from rodjax.equations.imbalance import lacking
from rodjax.equations.rigid_motions import Hold
from rodjax.equations.schemes import AtRest, Reference, rest_on_path
from rodjax.equilibria.motion_norms import moving_weight, resisting_weight
from rodjax.equilibria.passages_at_rest import passages
from rodjax.equilibria.unstable_modes import count_below, neutral
from rodjax.interactions.screening import NearPairs
from rodjax.numerics import newton, results, rotations
from rodjax.numerics.results import Result
from rodjax.rods.rod import Rod
from rodjax.rods.state import Memory
from rodjax.rods.strains import element_rotation, wound
from rodjax.scenes import drives
from rodjax.scenes.memory import next_memory
from rodjax.scenes.scene import Scene

# How often the path's step may be halved before the path is given up, and before the rod descends.
_HALVINGS, _NEAR = 12, 3

# What an end may turn in a step of the path [rad].
_TURN = 0.5 * jnp.pi

# Motion in a step of the descent [rad]: none that a mode was excited by, and little.
_UNEXCITED, _SMALL = 1e-6, 0.1

# Steps of one descent, disturbances of it, and the size of one [rad].
_DESCENT, _DISTURBANCES, _DISTURBANCE = 400, 3, 1e-2

# How often the last step is repeated at most for a spin that no end holds.
_REPEATS = 100

# Increments that may fail to shrink in an attempt with contact. Strands that touch slide along each
# other, and by turns make up for what that costs in length: Newton's method needs few iterations,
# but not ever smaller ones, and a shorter step of the path would not change that. (Without contact
# so much patience may lead to a branch far away.)
_PATIENCE = 12

# Number of unstable modes before any was counted: of the start, and of states that are not.
_UNKNOWN, _NOT_COUNTED = 2**30, -1

# How a path behaves at unstable equilibria: takes them, leaves those that something excites it to
# leave, leaves all.
ACCEPT, LEAVE_EXCITED, LEAVE = 0, 1, 2


# Of the elements, and of the joints: None without.
Forces = tuple[Float[Array, "n 3"], Float[Array, "j 6"] | None]


class Path(NamedTuple):
    """Where the path has come to: x solves the equations at `reached` from `reference`."""

    step: Float[Array, ""]
    reference: Reference
    x: Float[Array, "rows 9"]
    result: Int[Array, ""]
    iterations: Int[Array, ""]
    accepted: Int[Array, ""]
    rejected: Int[Array, ""]
    reached: Float[Array, ""]
    unstable: Int[Array, ""]  # modes at x; -1 if they were not counted
    repeats: Int[Array, ""]  # steps at the end of the path until the spin rests
    memory: Memory | None  # before the step to x


class _Descent(NamedTuple):
    """A descent under way from where the path has come to."""

    active: Bool[Array, ""]
    target: Float[Array, ""]
    reference: Reference
    forces: Forces
    resistance: Float[Array, ""]  # sigma [N]
    free: Bool[Array, ""]  # whether the next step is without resistance
    steps: Int[Array, ""]
    disturbed: Int[Array, ""]
    all_steps: Int[Array, ""]  # of all descents


def follow(
    scene, state, stop, load_steps, tolerance, max_iterations, max_rotation, leave, hold: Hold
) -> tuple[Path, Int[Array, ""]]:
    """The equilibrium at the end of the path, by steps of at most 1/load_steps.

    `leave` is one of the constants above; a rod that loads hold descends (swings) also where
    Newton's method fails. Also the number of steps of descents.
    """
    at_start = lacking(scene, state)
    first = 1 / load_steps
    smallest, near = first * 0.5 ** (_HALVINGS + 0.5), first * 0.5 ** (_NEAR + 0.5)
    when = lambda reached: state.time + reached * (stop - state.time)
    weight, norm = resisting_weight(scene), moving_weight(scene)
    patience = newton.PATIENCE if scene.contact is None else _PATIENCE
    elastic = scene.rod.mean_bending / jnp.sum(scene.rod.length) ** 2
    spinning = spin_resistance(scene, hold)

    def equations(
        target,
        reference,
        memory: Memory | None,
        sigma: Array | float = 0.0,
        repeats: Array | float = 0.0,
    ):
        resistance = sigma * weight
        if hold.spin or hold.bodies:
            # what does not rest at once costs energy, and needs the less resistance
            resistance = resistance + spinning * jnp.exp2(-2.0 * jnp.minimum(repeats, 10.0))
        rest = rest_on_path(reference, max_rotation, target, at_start, resistance)
        return Equations.of(scene, rest, replace(state, memory=memory), when(target))

    def unfinished(carry):
        path, _ = carry
        going = path.reached < 1
        if hold.spin:
            going = going | (jnp.abs(path.x[0, 8]) > 10 * tolerance)
        if hold.bodies:
            turns = path.x[np.array(scene.rod.bodies), 6:]
            going = going | (jnp.max(jnp.abs(turns)) > 10 * tolerance)
        return going & (path.step > smallest)

    def attempt(carry):
        path, descent = carry
        # no sliver of a step at the end
        whole = lambda step: jnp.where(
            path.reached + step > 1 - 1e-3 * first, 1.0, path.reached + step
        )
        opening = path.unstable == _UNKNOWN
        step, driven = path.step, jnp.asarray(False)
        if drives.turning(scene):
            now, frames = when(path.reached), path.reference[1]
            far = lambda step: drives.too_fast(scene, now, when(whole(step)), frames, _TURN)
            halving = lambda step: far(step) & (step > smallest)
            step = lax.while_loop(halving, lambda step: 0.5 * step, step)
            driven = far(step)
            assert driven is not None  # something turns
        pick = lambda a, b: jax.tree.map(lambda a, b: jnp.where(descent.active, a, b), a, b)
        target = jnp.where(opening, path.reached, pick(descent.target, whole(step)))
        behind = equations(path.reached, path.reference, path.memory)
        here = _configuration(behind, path.x)
        memory = None if path.memory is None else next_memory(behind.scene, behind.motion(path.x))
        reference, forces = pick((descent.reference, descent.forces), here)
        sigma = jnp.where(descent.active & ~descent.free, descent.resistance, 0.0)
        trial = equations(target, reference, memory, sigma, path.repeats.astype(path.x.dtype))
        # the first time round only the start's modes are counted
        most = jnp.where(opening, 0, max_iterations)
        # a body hangs by the force of its joint alone, which must be there from the first
        guess = trial.guess(*forces)
        if trial.scene.rubs:
            x, solved = newton.iterate_dual(trial, guess, tolerance, most)
        else:
            x, solved = newton.iterate(trial, guess, tolerance, most, patience)
        code = lambda bad, which: jnp.where(bad, which, Result.SUCCESS)
        result = results.join(
            solved.result,
            code(
                _astray(scene.rod, reference[1], trial.motion(x).quaternion, trial.of_nodes(x)),
                Result.ROTATION_TOO_LARGE,
            ),
            code(driven, Result.DRIVE_TOO_FAST),
            overflow(near_strands(trial, x)),
            *passages(
                lambda: (scene, when(pick(descent.target, path.reached))),
                (trial.scene, trial.time),
                reference[0],
                trial.motion(x).position,
            ),
        )
        converged = result == Result.SUCCESS
        least = neutral(scene, trial.force(x))
        level = least * norm
        resisted = jnp.stack([level, sigma * weight + level, sigma / 3 * weight + level])
        # at the end of the path modes are counted for the result, before it to stay on the branch
        once = opening | (converged & ((leave != ACCEPT) | (target == 1)))
        wanted = jnp.where(descent.active & converged, 3, once.astype(jnp.int32))
        unstable, convex, easily = count_below(trial, x, resisted, wanted)
        on_branch = (unstable <= path.unstable) | (leave == ACCEPT)
        moved = trial.size(x.at[:, 3:6].set(0.0))

        # in a descent
        good = descent.active & converged & (convex == 0)
        settled = good & descent.free
        stuck = good & ~descent.free & (easily > 0) & (moved < _UNEXCITED)
        disturb = stuck & (leave == LEAVE)
        endless = (descent.steps >= _DESCENT) | (descent.disturbed > _DISTURBANCES)
        endless = endless | (descent.all_steps >= 5 * _DESCENT)
        failed = (descent.active & endless & ~settled) | (path.repeats > _REPEATS)
        # nothing excites its modes: the path goes on through the unstable state
        stay = stuck & ~disturb

        # on the path
        taken = ~descent.active & converged & on_branch
        may_descend = (leave != ACCEPT) & ((leave == LEAVE) | converged) & ~driven
        if hold.loads:
            may_descend = may_descend | ~driven
        refused = ~descent.active & ~taken & ~opening
        begin = refused & may_descend & (0.5 * step < near)
        halve = refused & ~begin

        advance = taken | settled
        start = jnp.where(opening & (leave == LEAVE), 0, unstable)
        keep = lambda new, old: jax.tree.map(lambda a, b: jnp.where(advance, a, b), new, old)
        next_step = jnp.where(halve, 0.5 * step, step)
        next_step = jnp.where(taken, jnp.minimum(2 * step, first), next_step)
        new_path = Path(
            jnp.where(failed, 0.0, next_step),
            keep(reference, path.reference),
            keep(x, path.x),
            jnp.where(failed & converged, Result.NEWTON_FAILED, result),
            path.iterations + solved.iterations,
            path.accepted + advance.astype(jnp.int32),
            path.rejected + halve.astype(jnp.int32),
            keep(target, path.reached),
            jnp.where(stay | advance | opening, start, path.unstable),
            path.repeats + (path.reached == 1).astype(jnp.int32),
            keep(memory, path.memory),
        )
        ahead = _configuration(trial, x)
        ahead = jax.tree.map(lambda a, b: jnp.where(good, a, b), ahead, (reference, forces))
        ahead = jax.tree.map(
            lambda a, b: jnp.where(disturb, a, b), (_disturbed(ahead[0]), ahead[1]), ahead
        )
        gentler = jnp.where(easily == 0, 0.5, 1.0) * jnp.where(unstable == 0, 0.5, 1.0)
        resistance = sigma * jnp.where(good, gentler, 4.0)
        resistance = jnp.where(descent.free, 2.0 * descent.resistance, resistance)
        return new_path, _Descent(
            active=begin | (descent.active & ~advance & ~stay),
            target=jnp.where(begin, target, descent.target),
            reference=ahead[0],
            forces=ahead[1],
            resistance=jnp.where(begin, elastic, resistance),
            free=good & ~descent.free & (unstable == 0) & (moved < _SMALL),
            steps=jnp.where(begin, 0, descent.steps + 1),
            disturbed=jnp.where(begin, 0, descent.disturbed + disturb.astype(jnp.int32)),
            all_steps=descent.all_steps + descent.active.astype(jnp.int32),
        )

    none = jnp.zeros((), jnp.int32)
    no = jnp.asarray(False)
    nowhere = jnp.zeros_like(first)
    reference = state.position, state.quaternion
    x = equations(nowhere, reference, state.memory).guess(state.force, state.joints)
    unstable = jnp.where(leave == ACCEPT, _NOT_COUNTED, _UNKNOWN).astype(jnp.int32)
    path = Path(first, reference, x, none, none, none, none, nowhere, unstable, none, state.memory)
    forces = _configuration(equations(nowhere, reference, state.memory), x)[1]
    descent = _Descent(no, nowhere, reference, forces, nowhere, no, none, none, none)
    path, descent = lax.while_loop(unfinished, attempt, (path, descent))
    return path, descent.all_steps


def spin_resistance(scene: Scene, hold: Hold) -> Float[Array, "nodes 6"]:
    """Resistance to the spin of node 0 about its tangent, and to turns of bodies by themselves,
    where conventions hold them [N m], of the order of A/L.
    """
    rod = scene.rod
    amount = rod.mean_bending / jnp.sum(rod.length)
    resistance = jnp.zeros((rod.elements + 1, 6), amount.dtype)
    if hold.spin:
        resistance = resistance.at[0, 5].set(amount)
    if hold.bodies:
        resistance = resistance.at[np.array(rod.bodies), 3:].set(amount)
    return resistance


def spin_is_neutral(equations: Equations[AtRest], x: Float[Array, "rows 9"]) -> Bool[Array, ""]:
    """Whether nothing but its resistance c holds the spin of node 0: a torque turns it by 1/c."""
    resistance = equations.scheme.resistance
    assert resistance is not None
    given = resistance[0, 5] / equations.scales.wrench[5]
    turn = equations.linearize(x).solve(jnp.zeros_like(x).at[0, 8].set(given))[0, 8]
    return jnp.abs(turn - 1) < 1e3 * jnp.sqrt(jnp.finfo(x.dtype).eps)


def near_strands(equations: Equations[AtRest], x) -> NearPairs | None:
    """Strands near each other at x; None without contact."""
    if equations.scene.contact is None:
        return None
    return equations.scene.find_contact(equations.motion(x).position).pairs


def overflow(pairs: NearPairs | None) -> Int[Array, ""]:
    """A code that tells whether pairs in contact were left out."""
    if pairs is None:
        return results.as_code(Result.SUCCESS)
    return jnp.where(pairs.overflow, Result.CAPACITY_OVERFLOW, Result.SUCCESS).astype(jnp.int32)


def _configuration(equations: Equations[AtRest], x) -> tuple[Reference, Forces]:
    motion = equations.motion(x)
    forces = equations.force(x), equations.joints(x)
    return (motion.position, rotations.normalize(motion.quaternion)), forces


def _disturbed(reference: Reference) -> Reference:
    """The configuration with its nodes turned a little, in no symmetric way."""
    position, quaternion = reference
    along = jnp.linspace(0.0, jnp.pi, quaternion.shape[0], dtype=quaternion.dtype)[:, None]
    rate, phase = jnp.asarray([[[2.3, 3.7, 5.1]], [[0.4, 1.1, 2.0]]], quaternion.dtype)
    turn = _DISTURBANCE * jnp.sin(rate * along + phase)
    return position, rotations.multiply(quaternion, rotations.exponential(turn))


def _astray(
    rod: Rod,
    before: Float[Array, "nodes 4"],
    after: Float[Array, "nodes 4"],
    x: Float[Array, "rows 9"],
) -> Bool[Array, ""]:
    """Whether a node or an element turned by more than can be told from less, or is wound up.

    The rotation vector of an element that passes a full turn jumps to the other side, by more than
    half a turn, which no element turns by in a step.
    """
    turned = jnp.max(jnp.sum(x[:, 6:] ** 2, 1)) > jnp.pi**2
    strain = lambda quaternion: rotations.logarithm(element_rotation(rod, quaternion))
    old, new = jax.vmap(strain)(jnp.stack([before, after]))
    jumped = jnp.max(jnp.sum((new - old) ** 2, 1)) > jnp.pi**2
    return turned | jumped | wound(rod, after)
