"""What a scene remembers of the motion before: begun at a start, carried on by accepted steps."""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp

from rodjax.rods.constitution import seen_by_material
from rodjax.rods.state import Memory, NodeMotion, State, node_motion
from rodjax.scenes.scene import Scene


def first_memory(scene: Scene, motion: NodeMotion) -> Memory | None:
    """What is remembered at a start; None where nothing is."""
    return _memory(scene, motion, lambda one: one.first_memory)


def next_memory(scene: Scene, motion: NodeMotion) -> Memory | None:
    """What is remembered after an accepted step, asked of `Scene.recalling` the step's start."""
    return _memory(scene, motion, lambda one: one.next_memory)


def _memory(scene: Scene, motion: NodeMotion, asked: Callable) -> Memory | None:
    """What is asked of all loads, and of the material if it remembers anything."""
    if not scene.remembers:
        return None
    loads = tuple(asked(load)(scene.rod, motion) for load in scene.loads)
    material = scene.rod.material
    if material is None or not material.remembers:
        return Memory(loads, None)
    return Memory(loads, asked(material)(seen_by_material(scene.rod, motion)))


def remembering(scene: Scene, state: State) -> State:
    """The state with the memory that a run of the scene needs, begun anew where it has none.

    Raises:
        ValueError: what it remembers is not of this scene.
    """
    if not scene.remembers:
        return state if state.memory is None else dataclasses.replace(state, memory=None)
    begun = lambda: first_memory(scene, node_motion(state))
    if state.memory is None:
        return dataclasses.replace(state, memory=begun())
    shapes = lambda memory: jax.tree.map(jnp.shape, memory)
    if shapes(state.memory) != shapes(jax.eval_shape(begun)):
        raise ValueError(
            "state: remembers what happened in another scene; let it begin to remember anew by"
            " dataclasses.replace(state, memory=None)"
        )
    return state
