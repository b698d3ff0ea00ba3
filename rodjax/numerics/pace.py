"""Compiled loops in calls that return within about a second.

Nothing interrupts a compiled program: Ctrl-C is heard when a call returns. A loop that counts its
passes, and continues in the next call from what it carries, computes the same in calls of any
length, to the last bit.
"""

import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

# Durations of a call beyond which the next makes more or fewer passes [s].
_SHORT, _LONG = 0.2, 0.8


class Pace:
    """How many passes the next call makes, from 1 to `most`."""

    def __init__(self, most: int):
        self.most = most
        self.passes = min(4, most)  # few, until it is known what they take

    def call(self, loop: Callable[[Int[Array, ""]], object]):
        """What `loop(passes)` returns, waited for."""
        begun = time.monotonic()
        out = jax.block_until_ready(loop(jnp.asarray(self.passes, jnp.int32)))
        taken = time.monotonic() - begun
        if taken < _SHORT:
            self.passes = min(2 * self.passes, self.most)
        elif taken > _LONG:
            self.passes = max(self.passes // 2, 1)
        return out
