"""Linking numbers of the rods of a scene with each other."""

import itertools

import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.dynamics.run import Run
from rodjax.measuring.blocks import over_states
from rodjax.rods import topology
from rodjax.scenes.closure import welded
from rodjax.scenes.scene import Scene


def mutual_linking(scene: Scene, run: Run) -> Float[Array, "k r r"]:
    """Linking numbers of a scene's rods with each other at every saved time of a run.

    Of two rings whole numbers, which only a passage changes; of open rods, which end where they
    end, the Gauss integral (see `topology.mutual_linking`). Nothing on the diagonal.

    Raises:
        ValueError: the scene has one rod.
    """
    if len(scene.rod.strands) < 2:
        raise ValueError("scene: it has one rod; its own twist and writhe are those of `linking`")
    return _mutual(run.states, scene)


@over_states
def _mutual(state, scene):
    lines, rings = [], []
    for i, part in enumerate(scene.rod.strands):
        ring = welded(scene, i)
        # the last node of a ring is where the first is
        lines.append(state.position[part.nodes][:-1] if ring else state.position[part.nodes])
        rings.append(ring)
    count = len(lines)
    found = jnp.zeros((count, count), state.position.dtype)
    for i, j in itertools.combinations(range(count), 2):
        both = rings[i], rings[j]
        value = topology.mutual_linking(lines[i], lines[j], closed=both)
        found = found.at[[i, j], [j, i]].set(value)
    return found
