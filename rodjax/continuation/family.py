"""Scenes along a parameter, and their equations at rest."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.continuation.bordered_solve import Free
from rodjax.equations.equations import Equations
from rodjax.equations.schemes import AtRest, rest_on_path
from rodjax.equilibria.motion_norms import moving_weight
from rodjax.equilibria.path_following import near_strands
from rodjax.interactions.screening import NearPairs
from rodjax.interactions.self_contact import FoundContact
from rodjax.interactions.sites import sites_of
from rodjax.numerics import rotations
from rodjax.rods.balance import Internal
from rodjax.rods.state import State
from rodjax.scenes.holds import impose, rows_at
from rodjax.scenes.scene import Found, Scene

Rows = Float[Array, "rows 9"]
Parameter = Float[Array, "..."]  # a number, or along a curve of critical points two

# What the resistance makes of an eigenvalue that is zero, in mean bending stiffness over the length
# squared.
_RESISTANCE = 1e-6

# How motions are resisted that nothing else resists, in the same unit.
_HELD = 10.0

# How far a node may turn in one increment [rad].
_TURN = 0.6


class Place(NamedTuple):
    """An equilibrium, whatever time it is."""

    position: Float[Array, "nodes 3"]
    quaternion: Float[Array, "nodes 4"]
    force: Float[Array, "n 3"]
    joints: Float[Array, "j 6"] | None

    @classmethod
    def of(cls, state: State) -> "Place":
        """Of a state."""
        return cls(state.position, state.quaternion, state.force, state.joints)


class Family(eqx.Module):
    """The scenes of a parameter, and the state from which their schedules count.

    Attributes:
        scene_of: gives for a parameter a scene, or a scene and the time at which its schedules are
            evaluated.
        origin: where these begin.
    """

    scene_of: Callable[[Parameter], Any]
    origin: State

    def at(self, parameter: Parameter) -> tuple[Scene, Float[Array, ""]]:
        """The scene, and when its schedules are evaluated."""
        found = self.scene_of(parameter)
        if isinstance(found, tuple):
            scene, time = found
            return scene, jnp.asarray(time, self.origin.time.dtype)
        return found, self.origin.time

    def first(self, parameter: Parameter) -> Place:
        """Where the origin is, as all other places are given: what is the same is compiled once."""
        place, scene = Place.of(self.origin), self.at(parameter)[0]
        if place.joints is None and scene.joints:
            zero = jnp.zeros((len(scene.joints), 6), place.position.dtype)
            place = place._replace(joints=zero)
        return place

    def equations(
        self, parameter: Parameter, place: Place, pairs: NearPairs | None = None
    ) -> Equations[AtRest]:
        """What a place must solve, increments counted from it.

        Args:
            pairs: strands known to be near each other; None: looked for wherever the rod is.
        """
        scene, time = self.at(parameter)
        return self._at_rest(scene, time, place, pairs)

    def pairs(self, parameter: Parameter, place: Place, x: Rows) -> NearPairs | None:
        """Strands near each other at x, found once for all that asks there."""
        return near_strands(self.equations(parameter, place), x)

    def derivative(
        self, parameter: Parameter, place: Place, x: Rows, pairs: NearPairs | None
    ) -> "Derivative":
        """Their derivative at x, by increments as `Equations.lift` takes them."""
        scene, time = self.at(parameter)
        resistance = resistance_of(scene) * moving_weight(scene)
        equations = self._at_rest(scene, time, place, pairs, resistance)
        system = equations.linearize(x)
        return Derivative(equations, system, system.eliminate(), x)

    def _at_rest(self, scene, time, place: Place, pairs, resistance=None) -> Equations[AtRest]:
        zero = jnp.zeros_like(place.position)
        rest = rest_on_path(
            (place.position, place.quaternion),
            jnp.full((), _TURN, zero.dtype),
            jnp.ones((), zero.dtype),
            Internal(zero, zero, jnp.zeros_like(place.force)),
            resistance,
        )
        equations = Equations.of(scene, rest, self.origin, time)
        scene = equations.scene
        if pairs is None or scene.contact is None:
            return equations
        # where they touch may depend on the parameter, which of them are near does not
        contact = FoundContact(sites_of(scene.contact, scene.rod, scene.closed), pairs)
        return dataclasses.replace(equations, found=Found((), contact))

    def guess(self, parameter: Parameter, place: Place) -> Rows:
        """The unknowns of the place itself."""
        return self.equations(parameter, place).guess(place.force, place.joints)

    def place(self, parameter: Parameter, place: Place, x: Rows) -> Place:
        """Where unknowns have come to."""
        equations = self.equations(parameter, place)
        motion = equations.motion(x)
        quaternion = rotations.normalize(motion.quaternion)
        return Place(motion.position, quaternion, equations.force(x), equations.joints(x))

    def residual(
        self, parameter: Parameter, place: Place, x: Rows, pairs: NearPairs | None
    ) -> tuple[Rows, Rows]:
        """The residual at x, and its derivative by the parameter."""
        residual = lambda p: self.equations(p, place, pairs).residual(x)
        return jax.jvp(residual, (parameter,), (jnp.ones_like(parameter),))

    def state(self, parameter: Parameter, place: Place) -> State:
        """The place as a state of its scene."""
        scene, time = self.at(parameter)
        zero = jnp.zeros_like(self.origin.rate)
        frames = place.position, place.quaternion
        breaks = scene.rod.breaks
        state = State(time, *frames, zero, zero, zero, place.force, breaks=breaks)
        return dataclasses.replace(state, joints=place.joints)


def function_of(scene_of) -> Any:
    """What `Family` takes, of what functions of paths are given: a scene is one at all times."""
    if isinstance(scene_of, Scene):
        return jax.tree_util.Partial(_at_time, scene_of)
    return scene_of


def _at_time(scene: Scene, time: Parameter):
    return scene, time


class Derivative(eqx.Module):
    """The derivative of equations at rest, solved with a resistance that it does not have.

    A symmetry of a scene makes it singular for good (a buckled isotropic rod turns about its axis,
    a ring everts). A little resistance to all motions keeps solutions from being moved along such
    orbits by rounding. What it changes besides, a refinement by `multiply` takes back.
    """

    equations: Equations[AtRest]  # resisted
    system: Any
    factors: Any  # of the system, for several right sides
    x: Rows

    def multiply(self, v: Rows) -> Rows:
        """Matrix times vector, without resistance."""
        resistance = self.equations.scheme.resistance
        assert resistance is not None
        moved = self.equations.change(self.equations.lift(self.x, v))
        return self.system.multiply(v) - balanced(self.equations, resistance * moved, v)

    def multiply_transpose(self, v: Rows) -> Rows:
        """Transposed matrix times vector, without resistance."""
        return jax.linear_transpose(self.multiply, v)(v)[0]

    def solve(self, right: Rows) -> Rows:
        """Solution, with resistance."""
        return self.factors.solve(right)

    def solve_transpose(self, right: Rows) -> Rows:
        """Solution of the transposed system, with resistance."""
        return self.system.solve_transpose(right)


def balanced(equations: Equations[AtRest], wrench: Float[Array, "nodes 6"], like: Rows) -> Rows:
    """Rows of a right side: a wrench on the nodes [N, N m], nothing where they are held."""
    rows = wrench / equations.scales.wrench[None]
    held = equations.projectors, equations.scene.held_nodes
    rows = impose(rows, jnp.zeros_like(rows_at(rows, held[1])), *held)
    rows = jnp.concatenate([jnp.zeros_like(rows[:, :3]), rows], 1)
    return jnp.pad(rows, ((0, like.shape[0] - rows.shape[0]), (0, 0)))


def of_motion(columns: Float[Array, "nodes 6"], like: Rows) -> Rows:
    """Rows of unknowns whose displacements and rotations are these columns, without forces."""
    still = jnp.zeros_like(columns[:, :3])
    rows = jnp.concatenate([columns[:, :3], still, columns[:, 3:]], 1)
    return jnp.pad(rows, ((0, like.shape[0] - rows.shape[0]), (0, 0)))


def resistance_of(scene: Scene) -> Float[Array, ""]:
    """What is added to every eigenvalue where a `Derivative` is solved [N]."""
    return _RESISTANCE * elastic_of(scene)


def elastic_of(scene: Scene) -> Float[Array, ""]:
    """The unit of eigenvalues, mean bending stiffness over the length squared [N]."""
    return scene.rod.mean_bending / jnp.sum(scene.rod.length) ** 2


def motion_weight(equations: Equations[AtRest], x: Rows) -> Rows:
    """Weights of the squares of unknowns in the mean square of spins and displacements over L."""
    scene = equations.scene
    weight = moving_weight(scene) / jnp.sum(scene.rod.length)
    weight = weight * equations.scales.motion[None] ** 2
    return of_motion(weight, x)


def held(equations: Equations[AtRest], motions: Float[Array, "k nodes 6"], x: Rows) -> Free:
    """What resists motions of unit norm that nothing else resists; zeros are none.

    Without it increments would go along them as far as rounding says.
    """
    weight = moving_weight(equations.scene)
    stiff = _HELD * elastic_of(equations.scene)
    columns = stiff * jax.vmap(lambda one: balanced(equations, weight * one, x))(motions)
    rows = jax.vmap(lambda one: of_motion(weight * equations.scales.motion[None] * one, x))(motions)
    return Free(columns, rows)
