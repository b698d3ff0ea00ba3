"""Scenarios of cosseratbench as scenes: rods, ends, loads, obstacles, contact.

A scenario is read by the names of its fields alone, so nothing here needs that package.
"""

import dataclasses
import math
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rodjax.constraints.ends import AbstractEnd, Clamped, Free, Pinned, Slider, Turn
from rodjax.harness.frames_at_rest import frames_at_rest
from rodjax.inputs.schedules import Constant, PiecewiseLinear
from rodjax.interactions.contact import Contact
from rodjax.interactions.friction import Friction, SlidingFriction
from rodjax.interactions.loads import DistributedLoad, Gravity, PointLoad
from rodjax.interactions.obstacles import Obstacle
from rodjax.interactions.shapes import Plane, SignedDistance
from rodjax.rods.builders import straight_rod
from rodjax.rods.rod import Rod
from rodjax.rods.section import circular_section
from rodjax.rods.state import NodeMotion
from rodjax.scenes.scene import Scene

# What is kept of the inertia of what shall come to rest.
_INERTIA_AT_REST = 0.25


@dataclasses.dataclass(frozen=True)
class Settings:
    """Numbers that a scenario leaves to its solver.

    Attributes:
        inertia: what is kept of mass and rotary inertia; weights stay whole. Where equilibria are
            wanted and nothing touches less is kept: what is left moves, and rests, sooner.
        slowest: frequency of the slowest motion with that inertia [rad/s].
        damping_rate: of all motion, by its momentum; 0 for none [1/s].
        force: largest that contact is expected to carry [N].
        sink: how far what touches sinks in under it, in radii.
        slip_speed: below which rods creep on each other where they should hold [m/s].
    """

    inertia: float
    slowest: float
    damping_rate: float
    force: float
    sink: float
    slip_speed: float


def settings_of(scenario: Any, sink: float = 0.05) -> Settings:
    """Those of a scenario: of its weights, its loads, and what bends its rods."""
    rods, gravity = scenario.rods, float(np.linalg.norm(scenario.gravity))
    weight = sum(rod.material.density * rod.area * rod.length * gravity for rod in rods)
    loads = sum(float(np.linalg.norm(load.force)) for rod in rods for load in rod.loads)
    bending = max(
        rod.material.youngs_modulus * rod.second_moment_of_area / rod.length**2 for rod in rods
    )
    inertia = _INERTIA_AT_REST if scenario.quasi_static and not touching(scenario) else 1.0
    slowest = scenario.slowest_frequency() / math.sqrt(inertia)
    rate = 2.0 * slowest if scenario.quasi_static else 0.0
    shortest = min(rod.length for rod in rods)
    return Settings(inertia, slowest, rate, max(weight, loads, bending), sink, 1e-4 * shortest)


def touching(scenario: Any) -> bool:
    """Whether anything can touch in a scenario."""
    return bool(scenario.obstacles) or scenario.self_contact or len(scenario.rods) > 1


def scene_of(scenario: Any, elements: int, settings: Settings) -> Scene:
    """The scene of a scenario, with so many elements a rod.

    Raises:
        NotImplementedError: it asks for what this library has not.
    """
    rods = tuple(_rod(rod, elements, settings.inertia) for rod in scenario.rods)
    until = scenario.duration
    first, last = (
        tuple(_end(rod, end, until) for rod in scenario.rods) for end in ("start", "end")
    )
    loads = []
    if any(scenario.gravity):
        loads.append(Gravity(np.asarray(scenario.gravity, float) / settings.inertia))
    for index, rod in enumerate(scenario.rods):
        for load in rod.loads:
            node = index * (elements + 1) + (0 if load.at.value == "start" else elements)
            loads.append(PointLoad(node, Constant(np.asarray(load.force, float))))
    if settings.damping_rate > 0:
        loads.append(_damping(rods, settings.damping_rate))
    loads += [_obstacle(one, scenario, elements, settings) for one in scenario.obstacles]
    scene = Scene(rods=rods, first_end=first, last_end=last, loads=tuple(loads))
    if scenario.self_contact or len(rods) > 1:
        scene = dataclasses.replace(scene, contact=_contact(scenario, scene.rod, settings))
    return scene


def _rod(rod: Any, elements: int, inertia: float) -> Rod:
    """A rod as it is placed at the start, straight and unstretched at rest."""
    material = rod.material
    ratio = 0.5 * material.youngs_modulus / material.shear_modulus - 1
    # Timoshenko's factor of a solid circle
    factor = 6 * (1 + ratio) ** 2 / (7 + 12 * ratio + 4 * ratio**2)
    section = circular_section(
        2 * rod.radius,
        material.youngs_modulus,
        material.shear_modulus,
        material.density * inertia,
        extensible=True,
        shear_factor=factor,
    )
    straight = straight_rod(rod.length, elements, section)
    position = rod.nodes(elements)
    quaternion = frames_at_rest(straight, position, rod.directors(elements)[0])
    placed = jnp.asarray(position), jnp.asarray(quaternion)
    return dataclasses.replace(straight, position=placed[0], quaternion=placed[1])


def _end(rod: Any, which: str, until: float) -> AbstractEnd:
    """What holds one end of a rod, `start` or `end`."""
    kind, motion = getattr(rod, which).value, getattr(rod, f"{which}_motion")
    if kind == "free":
        return Free()
    if kind == "pinned":
        return Pinned()
    if motion is None:
        return Clamped()
    # it rests after the last knot; one knot more for any duration, as another number of them
    # would be another program
    times = np.append(motion.times, motion.times[-1] + until)
    held = lambda rows: np.concatenate([rows, rows[-1:]])
    shift = held(np.asarray(motion.displacement, float))
    moved = PiecewiseLinear(times, shift) if np.any(shift) else None
    turn = _turn(times, held(np.asarray(motion.rotation, float)))
    if motion.slides_along is None:
        return Clamped(displacement=moved, rotation=turn)
    return Slider(axis=motion.axis, displacement=moved, rotation=turn)


def _turn(times: Float[np.ndarray, " k"], vectors: Float[np.ndarray, "k 3"]) -> Turn | None:
    """A rotation by vectors of one direction; None where they are zero."""
    sizes = np.linalg.norm(vectors, axis=1)
    if not np.any(sizes):
        return None
    axis = vectors[np.argmax(sizes)] / np.max(sizes)
    angles = vectors @ axis
    if np.any(np.abs(vectors - angles[:, None] * axis) > 1e-9 * np.max(sizes)):
        raise NotImplementedError("a clamp that turns about more than one axis")
    return Turn(axis, PiecewiseLinear(times, angles))


def _drag(parameters: Any, s: Float[Array, " nodes"], motion: NodeMotion) -> Array:
    """-c m v and -c I omega per length."""
    return -parameters * jnp.concatenate([motion.velocity, motion.angular_velocity], 1)


def _damping(rods: tuple[Rod, ...], rate: float) -> DistributedLoad:
    """Damping of all motion at one rate: a force and a moment that go with mass and inertia."""
    rows = []
    for rod in rods:
        assert rod.mass is not None and rod.rotary_inertia is not None
        mass = np.repeat(np.asarray(rod.mass)[:1, None], 3, 1)
        row = np.concatenate([mass, np.asarray(rod.rotary_inertia)[:1]], 1)
        rows.append(np.repeat(row, rod.elements + 1, 0))
    return DistributedLoad(_drag, rate * np.concatenate(rows))


def _capped_cylinder(parameters: Any, point: Float[Array, "3"]) -> Float[Array, ""]:
    """Signed distance from a cylinder with flat ends."""
    centre, axis, radius, half = parameters
    arm = point - centre
    along = jnp.sum(arm * axis)
    across = arm - along * axis
    squared = jnp.sum(across**2)
    middle = squared == 0
    beyond = jnp.where(middle, 0.0, jnp.sqrt(jnp.where(middle, 1.0, squared))) - radius
    over = jnp.abs(along) - half
    corner = (beyond > 0) & (over > 0)
    edge = jnp.sqrt(jnp.where(corner, beyond, 1.0) ** 2 + jnp.where(corner, over, 0.0) ** 2)
    return jnp.where(corner, edge, jnp.maximum(beyond, over))


def _obstacle(obstacle: Any, scenario: Any, elements: int, settings: Settings) -> Obstacle:
    """A floor or a cylinder."""
    if obstacle.kind == "plane":
        shape = Plane(np.asarray(obstacle.point, float), obstacle.unit_normal)
    elif obstacle.kind == "cylinder":
        centre = np.asarray(obstacle.center, float)
        numbers = centre, obstacle.unit_axis, float(obstacle.radius), 0.5 * obstacle.length
        shape = SignedDistance(_capped_cylinder, numbers)
    else:
        raise NotImplementedError(f"an obstacle of the kind {obstacle.kind}")
    mu = {max(obstacle.friction, rod.friction) for rod in scenario.rods}
    if len(mu) > 1:
        raise NotImplementedError("rods that rub differently on one obstacle")
    (coefficient,) = mu
    thin = min(scenario.rods, key=lambda rod: rod.radius)
    element = thin.length / elements
    stiffness = settings.force / (element * settings.sink * thin.radius)
    mass = thin.material.density * thin.area
    return Obstacle(
        shape,
        stiffness,
        Friction(coefficient) if coefficient > 0 else None,
        relaxation=2 * np.sqrt(mass / stiffness),  # critical of a rod on it
    )


def _contact(scenario: Any, rod: Rod, settings: Settings) -> Contact:
    """Contact of rods with each other, and with themselves."""
    mu = {one.friction for one in scenario.rods}
    if len(mu) > 1:
        raise NotImplementedError("rods that rub differently on each other")
    (coefficient,) = mu
    friction = SlidingFriction(coefficient, settings.slip_speed) if coefficient > 0 else None
    return Contact.solid(rod, settings.force, indentation=0.5 * settings.sink, friction=friction)
