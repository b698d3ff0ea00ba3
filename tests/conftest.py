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

# Files not yet tried with strict promotions, or whose own arithmetic still promotes. In all others
# ranks and types that are not written out are refused, in the test and in the library under it.
PROMOTING = [
    "anchored",
    "arguments",
    "balance",
    "block_tridiagonal",
    "bounds",
    "branches",
    "check",
    "contact",
    "contact_derivatives",
    "contact_laws",
    "contact_newton",
    "convergence",
    "damaged_files",
    "descent",
    "docstrings",
    "drives",
    "equilibrium",
    "error_vs_runtime",
    "experiments",
    "extrapolation",
    "failure",
    "fit",
    "fit_data",
    "fit_failures",
    "fit_priors",
    "fit_settings",
    "fit_starts",
    "follower_loads",
    "free_motion",
    "free_units",
    "fuzz_constructors",
    "fuzz_runs",
    "hung_cables",
    "imperfection",
    "interruption",
    "loads",
    "measures",
    "observations",
    "paper_scheme",
    "passages",
    "peers",
    "probing",
    "recorder",
    "regridding",
    "resolution",
    "retraces",
    "rod",
    "rollouts",
    "rotations",
    "rough_start",
    "schedules_ends",
    "screening",
    "semidiscrete",
    "stability_map",
    "starts",
    "static_contact",
    "step",
    "storage",
    "sweep",
    "topology",
    "traced_geometry",
    "turns_at_rest",
    "unstable_modes",
    "validation",
    "windows",
    "writhe",
]


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
def _strict_promotions(request):
    if request.module.__name__.removeprefix("test_") in PROMOTING:
        yield
        return
    with jax.numpy_rank_promotion("raise"), jax.numpy_dtype_promotion("strict"):
        yield
