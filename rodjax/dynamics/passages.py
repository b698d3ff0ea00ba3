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
from rodjax.scenes import drives
from rodjax.scenes.closure import welded
from rodjax.scenes.scene import Scene, projectors

# A passage changes Lk by 2, an element folded by more than half a turn its polygon's Lk by 1,
# rounding by far less; so far may it be off [turns].
_ALLOWED = 0.5

# Cosine beyond which the ends run side by side, where Wr of infinite extensions has no limit.
_SIDE_BY_SIDE = -0.99

# So far a projector may be off the identity where an end holds all of a rotation.
_HELD = 1e-5


@compiled
def unexplained(scene: Scene, before: State, after: State) -> Float[Array, ""]:
    """Change of Lk = Tw + Wr between two states less what the drives have turned [turns].

    Not a number where Lk is not prescribed: with an end that may turn or is turned about another
    axis than its tangent, or with ends that run side by side. Wr is that of the rod extended
    straight at both ends, unless it is a ring.
    """
    tangents = rotations.tangent_director(after.quaternion[jnp.asarray([0, -1])])
    side_by_side = jnp.sum(tangents[0] * tangents[1]) < _SIDE_BY_SIDE
    prescribed = ~side_by_side | scene.closed
    eye = jnp.eye(3, dtype=tangents.dtype)[None]
    for time in (before.time, after.time):
        turning = projectors(scene, time)[:2, 3:, 3:]  # of the ends
        prescribed = prescribed & jnp.all(jnp.abs(turning - eye) < _HELD)
    both = jax.tree.map(lambda *leaves: jnp.stack(leaves), before, after)
    linking = jax.vmap(lambda state: twist(state) + writhe_of(scene.closed, state))(both)
    change = linking[1] - linking[0]
    if welded(scene, 0):  # a ring, whatever its ends do
        turned = [drives.turns_of_ring(scene, state.time) for state in (before, after)]
        return change - (turned[1] - turned[0])
    for end, tangent, sign in zip(scene.ends, tangents, (-1.0, 1.0), strict=True):
        if end.rotation is None:
            continue
        along = jnp.sum(end.rotation.axis.astype(tangent.dtype) * tangent)
        prescribed = prescribed & (jnp.abs(along) >= 1 - 1e-3)
        angle = end.rotation.angle(after.time) - end.rotation.angle(before.time)
        change = change - sign * along * angle.astype(along.dtype) / (2 * np.pi)
    return jnp.where(prescribed, change, jnp.nan)


def passed_unseen(scene: Scene, before: State, after: State) -> bool:
    """Whether Lk changed otherwise than by the drives between two states (not in traced code).

    It says no without contact, of several rods, and where Lk is not prescribed, see `unexplained`.
    A rod that swings across the line beyond one of its ends, where its support would be, counts as
    passed too.
    """
    if scene.contact is None or scene.rod.breaks:
        return False
    return abs(float(unexplained(scene, before, after))) > _ALLOWED


def first_passage(scene: Scene, states: State) -> int | None:
    """Index of the first saved state between which and the start Lk changed so; None if none did.

    Looked for by halving, once the last one tells.
    """
    at = lambda index: jax.tree.map(lambda leaf: np.asarray(leaf)[index], states)
    low, high = 0, states.time.shape[0] - 1
    if not passed_unseen(scene, at(low), at(high)):
        return None
    while high - low > 1:
        middle = (low + high) // 2
        passed = passed_unseen(scene, at(0), at(middle))
        low, high = (low, middle) if passed else (middle, high)
    return high
