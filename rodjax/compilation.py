"""Compilation of the library's own top-level programs.

XLA's newer fusion emitters for CPUs take about twice as long to compile a step as the older ones,
for code that is no faster, and its splitting of sums into trees a seventh more. The programs that
the library itself compiles (steps, measures, fits; not what a caller puts under `jax.jit`) do
without them where the backend knows these options (that on emitters went with jaxlib 0.12).
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


def compiled(function):
    """`eqx.filter_jit` with these options; inside traced code (a caller's jit) without."""

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

    return call
