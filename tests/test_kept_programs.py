"""Compiled programs are kept for a second process, in the folder that is asked for."""

import os
import subprocess
import sys
from pathlib import Path

import jax
import jaxlib.version
import pytest
from jax.experimental.compilation_cache import compilation_cache

import rodjax as rx

CODE = """
import sys
import jax, jax.monitoring, jax.numpy as jnp
taken = []
jax.monitoring.register_event_listener(lambda name, **_: taken.append(name))
jax.block_until_ready(jax.jit(lambda x: jnp.sin(x) + 1)(jnp.ones(3)))  # before it is switched on
import rodjax as rx
assert jax.config.jax_compilation_cache_dir is None
folder = rx.keep_compiled(*sys.argv[1:])
program = rx.jit(lambda x: jnp.linalg.solve(jnp.outer(x, x) + jnp.eye(4), jnp.cos(x)))
jax.block_until_ready(program(jnp.arange(4.0)))
print(folder, "/jax/compilation_cache/cache_hits" in taken)
"""


def run(*arguments, **environment):
    command = [sys.executable, "-c", CODE, *map(str, arguments)]
    hidden = {"JAX_COMPILATION_CACHE_DIR", "JAX_ENABLE_COMPILATION_CACHE"}
    hidden.add("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS")
    kept = {k: v for k, v in os.environ.items() if k not in hidden}
    said = subprocess.run(
        command, capture_output=True, text=True, check=False, env=kept | environment
    )
    assert said.returncode == 0, said.stderr
    return said.stdout.split()


def test_a_second_process_takes_what_the_first_compiled(tmp_path):
    folder = tmp_path / "deeper" / "programs"
    assert run(folder) == [str(folder), "False"]
    assert any(folder.iterdir())
    assert run(folder) == [str(folder), "True"]


@pytest.mark.skipif(sys.platform != "linux", reason="the folder is named otherwise")
def test_the_default_is_the_users_cache_folder(tmp_path):
    found = Path(run(XDG_CACHE_HOME=str(tmp_path))[0])
    assert found.parent == tmp_path / "rodjax"
    assert found.name.startswith(jaxlib.version.__version__)


def test_what_jax_was_told_stays(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    before = jax.config.jax_compilation_cache_dir
    seconds = jax.config.jax_persistent_cache_min_compile_time_secs
    try:
        for told in (str(tmp_path / "told"), "gs://bucket/programs"):
            jax.config.update("jax_compilation_cache_dir", told)
            jax.config.update("jax_persistent_cache_min_compile_time_secs", 7.0)
            assert rx.keep_compiled() == told == jax.config.jax_compilation_cache_dir
            assert jax.config.jax_persistent_cache_min_compile_time_secs == 7.0
        assert not list(tmp_path.iterdir())
    finally:
        jax.config.update("jax_compilation_cache_dir", before)
        jax.config.update("jax_persistent_cache_min_compile_time_secs", seconds)
        compilation_cache.reset_cache()


def test_what_is_no_path_is_refused(unchecked):
    with pytest.raises(ValueError, match="^folder: give a path"):
        rx.keep_compiled(3)
