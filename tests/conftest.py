"""Settings of every test: double precision, no implicit rank promotion, no display."""

import os

import jax

os.environ.setdefault("MPLBACKEND", "Agg")

jax.config.update("jax_enable_x64", True)
