"""The alarm for strands that passed through each other unseen: Tw + Wr against the turns applied.

The steps themselves look at pairs of segments in reach of contact. What they cannot see (strands
nearer along the rod than contact's `exclusion`, a loop smaller than a segment, an end that slides
through the other) still changes the linking number by 2.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rodjax.numerics import rotations
from rodjax.numerics.compilation import compiled
from rodjax.rods.state import State
from rodjax.rods.winding import twist, writhe_of
from rodjax.scenes.scene import Scene, projectors

# A passage changes Lk by 2, an element folded by more than half a turn its polygon's Lk by 1,
# rounding by far less; so far may it be off [turns].
_ALLOWED = 0.5

# Cosine beyond which the ends run side by side, where Wr of infinite extensions has no limit.
_SIDE_BY_SIDE = -0.99


@compiled
def linking_number(scene: Scene, state: State) -> Float[Array, ""]:
    """Lk = Tw + Wr of a state, extended straight at both ends unless the rod is a ring [turns]."""
    return twist(state) + writhe_of(scene.closed, state)


def passed_unseen(scene: Scene, before: State, after: State) -> bool:
    """Whether Lk changed otherwise than by the drives between two states (not in traced code).

    It says no where Lk is not prescribed: without contact, with an end that may turn or is turned
    about another axis than its tangent, or with ends that run side by side. A rod that swings
    across the line beyond one of its ends, where its support would be, counts as passed too.
    """
    if scene.contact is None:
        return False
    applied = 0.0
    tangents = np.asarray(rotations.tangent_director(after.quaternion[jnp.asarray([0, -1])]))
    if tangents[0] @ tangents[1] < _SIDE_BY_SIDE and not bool(scene.closed):
        return False
    for time in (before.time, after.time):
        turning = np.asarray(projectors(scene, time))[:, 3:, 3:]
        if not np.allclose(turning, np.eye(3)):
            return False
    for end, tangent, sign in zip(scene.ends, tangents, (-1, 1), strict=True):
        if end.rotation is None:
            continue
        along = float(np.asarray(end.rotation.axis) @ tangent)
        if abs(along) < 1 - 1e-3:
            return False
        angle = end.rotation.angle(after.time) - end.rotation.angle(before.time)
        applied += sign * along * float(angle) / (2 * np.pi)
    change = float(linking_number(scene, after)) - float(linking_number(scene, before))
    return abs(change - applied) > _ALLOWED


def first_passage(scene: Scene, states: State) -> int | None:
    """Index of the first saved state between which and the start Lk changed so; None if none did.

    Looked for by halving, once the last one tells.
    """
    at = lambda index: jax.tree.map(lambda leaf: leaf[index], states)
    low, high = 0, states.time.shape[0] - 1
    if not passed_unseen(scene, at(low), at(high)):
        return None
    while high - low > 1:
        middle = (low + high) // 2
        passed = passed_unseen(scene, at(0), at(middle))
        low, high = (low, middle) if passed else (middle, high)
    return high
