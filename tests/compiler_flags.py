"""Flags of the tests' compiler, set on import, which must come before that of jax.

Most of the tests' time is compilation; numerics/compilation.py says what the first two flags are
for (the second went with 0.12). Without LLVM's optimisation a program compiles in three quarters of
the time; bits may then differ between programs that should agree in them, so where tests are chosen
by their marks (`-m slow`, `-m ''`) all run as users' programs do. Workers inherit what is set by
the process that starts them.
"""

import importlib.metadata
import os
import sys

FLAGS = ["--xla_disable_hlo_passes=tree_reduction_rewriter"]
if tuple(map(int, importlib.metadata.version("jaxlib").split(".")[:2])) < (0, 12):
    FLAGS.append("--xla_cpu_use_fusion_emitters=false")
if not any(argument.startswith("-m") for argument in sys.argv[1:]):
    FLAGS.append("--xla_backend_optimization_level=0")
if "PYTEST_XDIST_WORKER" not in os.environ:
    os.environ["XLA_FLAGS"] = " ".join([os.environ.get("XLA_FLAGS", ""), *FLAGS])
    # the solves are small: LAPACK's threads would only compete with the tests of the other worker
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
