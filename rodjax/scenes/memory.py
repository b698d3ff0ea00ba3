"""What a scene remembers of the motion before: begun at a start, carried on by accepted steps."""

import dataclasses

import jax
import jax.numpy as jnp

from rodjax.rods.constitution import seen_by_material
from rodjax.rods.material import AbstractMaterial
from rodjax.rods.state import Memory, NodeMotion, State, node_motion
from rodjax.scenes.scene import Scene


def first_memory(scene: Scene, motion: NodeMotion) -> Memory | None:
    """What is remembered at a start; None where nothing is."""
    if not scene.remembers:
        return None
    loads, own = tuple(load.first_memory(scene.rod, motion) for load in scene.loads), None
    material = _that_remembers(scene)
    if material is not None:
        own = material.first_memory(seen_by_material(scene.rod, motion))
    return Memory(loads, own)


def next_memory(scene: Scene, motion: NodeMotion) -> Memory | None:
    """What is remembered after an accepted step, asked of `Scene.recalling` the step's start."""
    if not scene.remembers:
        return None
    loads, own = tuple(load.next_memory(scene.rod, motion) for load in scene.loads), None
    material = _that_remembers(scene)
    if material is not None:
        own = material.next_memory(seen_by_material(scene.rod, motion))
    return Memory(loads, own)


def _that_remembers(scene: Scene) -> AbstractMaterial | None:
    """The material, if it remembers anything."""
    material = scene.rod.material
    return material if material is not None and material.remembers else None


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
