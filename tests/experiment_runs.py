"""Experiments as a user starts them: a process each."""

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]


def run_experiment(script: str, *arguments: str) -> str:
    """What the script prints; it must exit with 0."""
    return run_script(ROOT / "experiments" / script, *arguments)


def run_script(path: Path, *arguments: str) -> str:
    """What any script prints; it must exit with 0."""
    found = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    done = subprocess.run(
        [sys.executable, str(path), *arguments],
        env=os.environ | {"PYTHONPATH": found, "JAX_ENABLE_COMPILATION_CACHE": "0"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout
