"""Measures over the saved states of a run, by programs that fit runs of any length.

A program over all the states of a run is another for every number of them. Outside traced code
states are handed on in blocks of one size instead, the last filled up and worked through as far as
it is in use: what has been compiled for a scene once serves all its runs, in later processes too
(`rodjax.keep_compiled`).
"""

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from rodjax.inputs.validation import all_known
from rodjax.numerics.compilation import compiled

BLOCK = 64  # states of a block


def scan_states(step: Callable) -> Callable:
    """A scan over states: `step(carry, state, *others) -> (carry, out)` from one to the next.

    Returns:
        A function of the first carry, the stacked states and `others`, which gives the last carry
        and the stacked outs.
    """
    one = eqx.filter_jit(step)  # so that its shapes and the loop come of one trace

    @compiled
    def block(carry, states, count, *others):
        first = jax.tree.map(lambda leaf: leaf[0], states)
        shapes = eqx.filter_eval_shape(one, carry, first, *others)[1]
        outs = jax.tree.map(lambda leaf: jnp.zeros((BLOCK, *leaf.shape), leaf.dtype), shapes)

        def body(index, loop):
            carry, outs = loop
            state = jax.tree.map(lambda leaf: leaf[index], states)
            carry, out = one(carry, state, *others)
            return carry, jax.tree.map(lambda all, new: all.at[index].set(new), outs, out)

        return lax.fori_loop(0, count, body, (carry, outs))

    @functools.wraps(step)
    def scan(carry, states, *others):
        if not all_known(carry, states, others):
            return lax.scan(lambda carry, state: step(carry, state, *others), carry, states)
        states = jax.tree.map(np.asarray, states)
        size, pieces = len(jax.tree.leaves(states)[0]), []
        for begin in range(0, size, BLOCK):
            part = jax.tree.map(lambda leaf, begin=begin: _filled(leaf[begin:]), states)
            count = min(size - begin, BLOCK)
            carry, outs = block(carry, part, np.asarray(count, np.int32), *others)
            pieces.append(jax.tree.map(lambda leaf, n=count: np.asarray(leaf)[:n], outs))
        # put, not converted: that would compile a program for every shape
        join = lambda *leaves: jax.device_put(np.concatenate(leaves))
        return carry, jax.tree.map(join, *pieces)

    return scan


def over_states(function: Callable[..., Any]) -> Callable[..., Any]:
    """A measure of each of many states: `function(state, *others)`, over stacked states.

    Also as a decorator. Like all that `rodjax.jit` compiles it takes pytrees, and numbers of Python
    among `others` are compiled in. Derivatives pass.

        @over_states
        def angles(state, axis):
            return measures.apex_angle(state, axis)

        angles(run.states, axis)
    """
    scan = scan_states(lambda carry, state, *others: (carry, function(state, *others)))

    @functools.wraps(function)
    def call(states, *others):
        return scan((), states, *others)[1]

    return call


def _filled(leaf: np.ndarray) -> np.ndarray:
    """The first block of a leaf, its last entry repeated where there are not enough."""
    leaf = leaf[:BLOCK]
    more = BLOCK - len(leaf)
    return np.concatenate([leaf, np.repeat(leaf[-1:], more, 0)]) if more else leaf
