"""Compiled programs kept between processes, by JAX's persistent cache."""

import os
from pathlib import Path

import jax
from jax.experimental.compilation_cache import compilation_cache

# Programs that compile faster are compiled again: reading them back would take about as long [s].
_WORTH_KEEPING = 0.3


def keep_compiled(folder: str | os.PathLike | None = None) -> Path:
    """Keep compiled programs in a folder, for later processes to take from there.

    Switches on JAX's persistent cache, for all that this process compiles from now on (the import
    of rodjax changes nothing of JAX). A second process then starts a scene of the same structure
    and size in a fraction of the time; numbers may differ. A program of another version of jax, of
    other options or of another kind of processor is never taken.

    Args:
        folder: where; it is made. None means the folder that JAX has been told
            (`JAX_COMPILATION_CACHE_DIR`), or else the user's cache folder: `~/.cache/rodjax` on
            Linux, `~/Library/Caches/rodjax` on macOS, `%LOCALAPPDATA%\\rodjax\\Cache` on Windows.
            It grows without bound, some megabytes for each scene of a new structure or size; empty
            it at will. Programs are read from there and run: give no folder that others may write.

    Returns:
        The folder.

    Raises:
        ValueError: `folder` is no path.
        OSError: the folder cannot be made.
    """
    from platformdirs import user_cache_path

    if folder is None:
        told = getattr(jax.config, "jax_compilation_cache_dir", None)
        folder = told or user_cache_path("rodjax", appauthor=False)
    if not isinstance(folder, str | os.PathLike):
        raise ValueError(
            f"folder: give a path, or None for the user's cache folder; got {folder!r}"
        )
    place = Path(folder).expanduser().absolute()
    place.mkdir(parents=True, exist_ok=True)
    jax.config.update("jax_compilation_cache_dir", str(place))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", _WORTH_KEEPING)
    # what was compiled before would have settled that there is no cache
    compilation_cache.reset_cache()
    return place
