"""Which rodjax and which jax this is, as files keep it."""

from importlib import metadata

import jax

import rodjax


def version() -> str:
    """Version of rodjax."""
    try:
        return metadata.version("rodjax")
    except metadata.PackageNotFoundError:  # run from a source tree
        return getattr(rodjax, "__version__", "unknown")


def versions() -> dict[str, str]:
    """Versions of what a traced function and its results depend on."""
    return {"rodjax": version(), "jax": jax.__version__}
