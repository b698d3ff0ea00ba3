"""Compiled programs kept between processes, by JAX's persistent cache."""

import hashlib
import os
import platform
from pathlib import Path

import jax
import jaxlib.version
from jax.experimental.compilation_cache import compilation_cache

# Programs that compile faster are compiled again [s]. From a disk even the smallest is read in a
# third of the time, and a run has a hundred of them; a bucket's address may be far away.
_ON_DISK, _FAR_AWAY, _OF_JAX = 0.0, 0.3, 1.0


def keep_compiled(folder: str | os.PathLike | None = None) -> str:
    """Keep compiled programs in a folder, for later processes to take from there.

    Switches on JAX's persistent cache, for all that this process compiles from now on (the import
    of rodjax changes nothing of JAX). A second process then starts a scene of the same structure
    and size in a fraction of the time; numbers may differ.

    On some Intel processors jaxlib then says of every program, in lines that begin with E, that
    "Target machine feature +prefer-no-gather is not supported": it takes a hint to its compiler
    for an instruction (jax issue 38445). The programs are read and right. Start Python with
    `TF_CPP_MIN_LOG_LEVEL=3` in its environment to read no such lines.

    Args:
        folder: where; it is made. None means what JAX has been told already
            (`JAX_COMPILATION_CACHE_DIR`, which stays as it is), or else a folder for this version
            of jaxlib and this kind of processor in the user's cache folder: `~/.cache/rodjax` on
            Linux, `~/Library/Caches/rodjax` on macOS, `%LOCALAPPDATA%\\rodjax\\Cache` on Windows.
            It grows without bound, some megabytes for each scene of a new structure or size; empty
            it at will. Programs are read from there and run: give no folder that others may write,
            and none to processors of different kinds.

    Returns:
        The folder.

    Raises:
        ValueError: `folder` is no path.
        OSError: the folder cannot be made.

    Example:
        >>> folder = rx.keep_compiled()  # doctest: +SKIP
    """
    if folder is not None and not isinstance(folder, str | os.PathLike):
        raise ValueError(
            f"folder: give a path, or None for the user's cache folder; got {folder!r}"
        )
    told = getattr(jax.config, "jax_compilation_cache_dir", None)
    if folder is None and told:  # perhaps no path at all, but a bucket's address
        place = str(told)
    else:
        path = _of_the_user() if folder is None else Path(folder).expanduser().absolute()
        path.mkdir(parents=True, exist_ok=True)
        place = str(path)
        jax.config.update("jax_compilation_cache_dir", place)
    if getattr(jax.config, "jax_persistent_cache_min_compile_time_secs", None) == _OF_JAX:
        least = _FAR_AWAY if "://" in place else _ON_DISK
        jax.config.update("jax_persistent_cache_min_compile_time_secs", least)
    # what was compiled before would have settled that there is no cache
    compilation_cache.reset_cache()
    return place


def _of_the_user() -> Path:
    """A folder for programs that run here: a home may be shared by machines that differ."""
    from platformdirs import user_cache_path

    kind = f"{platform.machine()} {platform.processor()}"
    about = Path("/proc/cpuinfo")
    if about.exists():
        lines = about.read_text(errors="replace").splitlines()
        kind += next((line for line in lines if line.lower().startswith(("flags", "features"))), "")
    digest = hashlib.sha256(kind.encode()).hexdigest()[:8]
    return user_cache_path("rodjax", appauthor=False) / f"{jaxlib.version.__version__}-{digest}"
