"""What a user's material must keep to, probed by numbers when a scene is made."""

import jax
import jax.numpy as jnp
import numpy as np

from rodjax.inputs.validation import all_known
from rodjax.rods.constitution import seen_by_material
from rodjax.rods.material import mixes_rows
from rodjax.rods.rod import Rod
from rodjax.rods.state import at_rest

# Kinds of materials that have passed; few, for they keep alive what a law has around it.
_PASSED: dict = {}
_KEPT = 32


def check_law(rod: Rod) -> None:
    """Raise ValueError unless the law gives a moment an element and its derivative.

    Once for a kind of material; skipped where rod or material are traced.
    """
    material = rod.material
    if material is None or not all_known(rod):
        return
    kind = jax.tree.structure(material)
    if kind in _PASSED:
        return
    title = f"material ({type(material).__name__})"
    generator = np.random.default_rng(0)
    with jax.ensure_compile_time_eval():
        motion = at_rest(jnp.zeros((), rod.position.dtype), rod.position, rod.quaternion)
        at = seen_by_material(rod, motion)
        size = 0.5 / np.asarray(rod.gauge_length)[:, None]
        draw = lambda: jnp.asarray(
            size * generator.normal(size=(rod.elements, 3)), rod.length.dtype
        )
        at = at._replace(curvature=draw(), rate=draw() if material.viscous else at.rate)
        moment = material.moment(at)
        if jnp.shape(moment) != (rod.elements, 3):
            raise ValueError(
                f"{title}: moment(at) must give {(rod.elements, 3)}, a row an element; got shape"
                f" {jnp.shape(moment)}"
            )
        if bool(mixes_rows(material, at)):
            raise ValueError(
                f"{title}: its slopes are not the derivative of its moment; where jax takes them,"
                " the moment of an element changes with another element's motion: use each"
                " element's own row only (no mean, sum or shift along the rod)"
            )
    _PASSED[kind] = None
    if len(_PASSED) > _KEPT:
        del _PASSED[next(iter(_PASSED))]
