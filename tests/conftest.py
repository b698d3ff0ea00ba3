"""Settings of every test: double precision, nothing promoted unsaid, no display."""

import gc
import os
from pathlib import Path

import compiler_flags  # noqa: F401
import jax
import jaxtyping
import pytest

# tracing makes many objects that stay: looking through them for garbage takes a quarter of its time
gc.set_threshold(200_000, 50, 100)

os.environ.setdefault("MPLBACKEND", "Agg")

jax.config.update("jax_enable_x64", True)


@pytest.fixture(autouse=True, scope="module")
def _few_programs():
    """Let go of compiled programs before the system's limit of 65,530 maps of memory is reached.

    Each program holds several; without it a worker dies by a signal after some thousand of them.
    """
    yield
    maps = Path("/proc/self/maps")
    if maps.exists() and maps.read_bytes().count(b"\n") > 20_000:
        jax.clear_caches()


@pytest.fixture
def unchecked():
    """Without the tests' run-time type checks, which would come before the package's own."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


@pytest.fixture
def bent(request):
    """`helpers.moving_hairpin` of 24 elements, or of as many as the test's parameter says."""
    from helpers import moving_hairpin

    return moving_hairpin(getattr(request, "param", 24))


@pytest.fixture(autouse=True, scope="module")
def _strict_promotions():
    with jax.numpy_rank_promotion("raise"), jax.numpy_dtype_promotion("strict"):
        yield
