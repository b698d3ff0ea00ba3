"""Settings of every test: double precision, no implicit rank promotion, no display."""

import gc
import importlib.metadata
import os

# the solves are small: LAPACK's threads would only compete with the tests of the other worker
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# most of the tests' time is compilation: see rodjax/compilation.py (the first flag went with 0.12)
os.environ.setdefault("XLA_FLAGS", "")
os.environ["XLA_FLAGS"] += " --xla_disable_hlo_passes=tree_reduction_rewriter"
if tuple(map(int, importlib.metadata.version("jaxlib").split(".")[:2])) < (0, 12):
    os.environ["XLA_FLAGS"] += " --xla_cpu_use_fusion_emitters=false"

import jax

# tracing makes many objects that stay: looking through them for garbage takes a quarter of its time
gc.set_threshold(200_000, 50, 100)

os.environ.setdefault("MPLBACKEND", "Agg")

jax.config.update("jax_enable_x64", True)
