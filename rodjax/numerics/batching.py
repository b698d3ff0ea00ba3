"""How control flow behaves under `vmap`.

There a `cond` whose predicate differs from lane to lane runs both branches, and a loop whose length
differs copies what it carries in every pass. Small loops share the largest of their counts
(`largest`), rare work is done if any lane needs it (`only_where`), and on CPUs the costly parts of
contact one lane after the other (`one_by_one`), each in its own time and in cache, unless no lane
is in contact. An accelerator takes all lanes together: one lane leaves it idle.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Int


@jax.custom_batching.custom_vmap
def largest(count: Int[Array, ""]) -> Int[Array, ""]:
    """The count; under `vmap` the largest of the batch, the same for all lanes."""
    return count


@largest.def_vmap
def _largest_of_batch(axis_size, in_batched, count):
    return (jnp.max(count), False) if in_batched[0] else (count, False)


def only_where(needed: Bool[Array, ""], function: Callable, otherwise: Callable, operand):
    """`function` of the operand where needed, else `otherwise`, as by `lax.cond`.

    Under `vmap` the function is not evaluated unless some lane needs it.
    """

    def some(operand):
        pick = lambda one, other: jnp.where(needed, one, other)
        return jax.tree.map(pick, function(operand), otherwise(operand))

    return lax.cond(largest(needed.astype(jnp.int32)) > 0, some, otherwise, operand)


def one_by_one(function: Callable, together: tuple[Callable, Callable] | None = None) -> Callable:
    """A function of pytrees whose lanes are mapped in turn where its FIRST argument is batched.

    Where only the others are (several right sides of one system) they are mapped together as usual,
    which leaves what depends on the first alone to be done once. So are all where the default
    backend is not the CPU: there the function is left as it is, but for `together`.

    Args:
        together: (holds, jointly), both of the function's arguments. If `holds` in every lane, they
            are mapped together by `jointly`, which then gives the same.
    """
    # a rule of its own would fail in a `cond` of which lanes take different branches: all that the
    # branches use is batched there, constants of the function as well
    at_once = function if together is None else _unless_all_hold(function, *together)
    in_turn = _by_rule(function, together)

    def call(*arguments):
        # asked where it is called: an import starts no backend
        return (in_turn if jax.default_backend() == "cpu" else at_once)(*arguments)

    return call


def _by_rule(function: Callable, together: tuple[Callable, Callable] | None) -> Callable:
    """`one_by_one` on CPUs."""
    inner = jax.custom_batching.custom_vmap(function)

    @inner.def_vmap
    def _rule(axis_size, in_batched, *arguments):
        axes = jax.tree.map(lambda batched: 0 if batched else None, in_batched)
        if not any(jax.tree.leaves(in_batched[0])):
            # wrapped again for a `vmap` further out
            out = _by_rule(jax.vmap(function, axes), None)(*arguments)
        elif together is None:
            out = _in_turn(inner, in_batched, arguments)
        else:
            holds, jointly = (jax.vmap(part, axes) for part in together)
            out = lax.cond(
                jnp.all(holds(*arguments)),
                lambda arguments: jointly(*arguments),
                lambda arguments: _in_turn(inner, in_batched, arguments),
                arguments,
            )
        return out, jax.tree.map(lambda _: True, out)

    return inner


def _unless_all_hold(function: Callable, holds: Callable, jointly: Callable) -> Callable:
    """The function, but `jointly` if that holds in all lanes: see `one_by_one`."""

    def either(*arguments):
        fails = jnp.logical_not(holds(*arguments)).astype(jnp.int32)
        return lax.cond(largest(fails) > 0, function, jointly, *arguments)

    return either


def _in_turn(function, in_batched, arguments):
    """The function of one lane after the other."""
    leaves, structure = jax.tree.flatten(arguments)
    mapped = jax.tree.leaves(in_batched)
    lanes = [leaf for leaf, batched in zip(leaves, mapped, strict=True) if batched]

    def one(lane):
        rest = iter(lane)
        whole = [
            next(rest) if batched else leaf for leaf, batched in zip(leaves, mapped, strict=True)
        ]
        return function(*structure.unflatten(whole))

    return lax.map(one, lanes)
