"""Formatting, lint and types of the whole tree."""

import subprocess
import sys
from pathlib import Path

import pytest
from helpers import slow

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize(
    "command",
    [
        ["ruff", "format", "--check", "--diff", "."],
        ["ruff", "check", "."],
        slow(["pyright", "--pythonpath", sys.executable]),
    ],
    ids=["format", "lint", "types"],
)
def test_style(command):
    run = subprocess.run(
        [sys.executable, "-m", *command], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert run.returncode == 0, run.stdout + run.stderr
