"""Settings that must precede the import of numpy and jax; every experiment imports this first."""

import gc
import os

# the dense systems of contact are small: LAPACK's threads would only compete with XLA's
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import jax

jax.config.update("jax_enable_x64", True)

# tracing makes many objects that stay: looking through them for garbage takes a quarter of its time
gc.set_threshold(200_000, 50, 100)
