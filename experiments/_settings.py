"""Settings that must precede the import of numpy and jax; every experiment imports this first."""

import gc
import os

# the dense systems of contact are small: LAPACK's threads would only compete with XLA's
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# with programs kept between runs jaxlib takes two hints to the compiler for instructions that some
# processors lack, and says so a hundred times (jax issue 38445); what fails is raised all the same
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")

import jax

jax.config.update("jax_enable_x64", True)

# tracing makes many objects that stay: looking through them for garbage takes a quarter of its time
gc.set_threshold(200_000, 50, 100)
