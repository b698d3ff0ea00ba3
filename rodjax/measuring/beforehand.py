"""Measures compiled before there is a run to measure."""

import contextlib

from rodjax.dynamics.adaptive import placeholder
from rodjax.dynamics.run import of_no_steps
from rodjax.measuring import energy, measures
from rodjax.scenes.scene import Scene


def compile_measures(scene: Scene) -> None:
    """Compile `energy.ledger`, `measures.linking` and `measures.contacts` for runs of this scene.

    Of any length. In a thread of its own it costs a run nothing, as `meanwhile` of
    `compile_adaptive_rollout`. What the scene does not have is left out.
    """
    run = of_no_steps(placeholder(scene))
    if scene.contact is not None:
        measures.contacts(scene, run)
    if scene.rod.mass is not None:
        energy.ledger(scene, run)
    with contextlib.suppress(ValueError):  # turned about other axes, it counts no turns
        measures.linking(scene, run)
