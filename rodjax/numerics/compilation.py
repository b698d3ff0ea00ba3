"""Compilation of the library's own top-level programs.

XLA's newer fusion emitters for CPUs take about twice as long to compile a step as the older ones,
for code that is no faster, and its splitting of sums into trees a seventh more. The programs that
the library itself compiles (steps, measures, fits), and those that a caller puts under `jit` of
this module (not under `jax.jit`), do without them where the backend knows these options (that on
emitters went with jaxlib 0.12).
"""

import functools
from typing import Any

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp

_OPTIONS = {
    "xla_cpu_use_fusion_emitters": False,
    "xla_disable_hlo_passes": "tree_reduction_rewriter",
}


@functools.cache
def _options() -> dict[str, Any]:
    """Compiler options that this backend knows."""
    if jax.default_backend() != "cpu":
        return {}
    return {name: value for name, value in _OPTIONS.items() if _known({name: value})}


def _known(options: dict[str, Any]) -> bool:
    try:
        jax.jit(lambda x: x + 1, compiler_options=options)(jnp.zeros(()))
    except Exception:
        return False
    return True


def jit(function):
    """Compile a function as the library compiles its own: `jax.jit` for pytrees of any leaves.

    The compiler options of this module, where the backend knows them (elsewhere none), make a
    program that steps a rod compile in about half the time; results agree to rounding. Also as a
    decorator, and around transformations: `rx.jit(jax.grad(loss))`.

    Args:
        function: takes and gives pytrees. Arrays in them are traced; all other leaves (numbers and
            functions of Python, strings) are compiled in, so give a number that varies as an
            array. Called inside traced code, it becomes part of the program around it, which
            alone has options.

    Returns:
        The function, compiled at the first call with new shapes, types or static leaves.

    Example:
        >>> advance = rx.jit(lambda state: rx.step(scene, state, state.time + 0.01)[0])
        >>> float(advance(rx.start(scene)).time)
        0.01
    """

    @functools.cache
    def program():
        # what filter_jit hands on to jax.jit is missing in its type
        return eqx.filter_jit(function, compiler_options=_options())  # pyright: ignore

    inner = eqx.filter_jit(function)

    @functools.wraps(function)
    def call(*arguments, **named):
        leaves = jax.tree.leaves((arguments, named))
        if any(isinstance(leaf, jax.core.Tracer) for leaf in leaves):
            return inner(*arguments, **named)
        return program()(*arguments, **named)

    # for what is compiled later: `lower(...)` is the part that Python does, `.compile()` of what it
    # returns the backend's, without Python's lock; calls with such arguments then find the program
    lower = lambda *arguments, **named: program().lower(*arguments, **named)
    setattr(call, "lower", lower)  # noqa: B010 (an attribute that its type does not have)
    return call


compiled = jit  # so called where the library marks its own programs
