"""What a newcomer meets first: the import, the public names, the version, the two commands."""

import inspect
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import rodjax

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]

RUN_COMMAND = (
    "python3 -m venv .venv && .venv/bin/pip install . && .venv/bin/python experiments/intertwine.py"
)
TEST_COMMAND = (
    "python3 -m venv .venv && .venv/bin/pip install '.[test]' && .venv/bin/python -m pytest"
)

IMPORT_AND_COMPARE = """
import jax
from jax._src import xla_bridge

before = dict(jax.config.values)
import rodjax
changed = {name for name, value in jax.config.values.items() if before.get(name, value) != value}
assert not changed, f"importing rodjax changed {changed}"
assert not jax.config.jax_enable_x64
assert not xla_bridge.backends_are_initialized(), "importing rodjax started a jax backend"
"""


def test_import_has_no_side_effect():
    run = subprocess.run(
        [sys.executable, "-c", IMPORT_AND_COMPARE],
        cwd=ROOT,
        env={name: value for name, value in os.environ.items() if not name.startswith("JAX_")},
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 0, run.stderr
    assert run.stdout == ""


def test_version_is_the_same_everywhere():
    assert "version" in PROJECT["dynamic"]  # read from the package
    version = rodjax.__version__
    assert f"\nversion: {version}\n" in (ROOT / "CITATION.cff").read_text()
    assert f"\n## [{version}] - 20" in (ROOT / "CHANGELOG.md").read_text()


def test_public_names_are_sorted():
    assert list(rodjax.__all__) == sorted(rodjax.__all__)


@pytest.mark.parametrize("name", rodjax.__all__)
def test_public_name_has_docstring(name):
    doc = inspect.getdoc(getattr(rodjax, name))
    assert doc
    assert not doc.startswith(f"{name}("), "only the signature that dataclasses write by themselves"


def test_readme_gives_exactly_two_commands():
    # .ci/run takes the second of them from the README.
    readme = (ROOT / "README.md").read_text()
    assert re.findall(r"python3 -m venv[^`\n]*", readme) == [RUN_COMMAND, TEST_COMMAND]


def test_base_depends_on_what_the_package_imports_alone():
    source = "\n".join(p.read_text() for p in (ROOT / "rodjax").rglob("*.py"))
    needed = [re.split(r"[^\w-]", line)[0] for line in PROJECT["dependencies"]]
    assert len(needed) > 5
    idle = [name for name in needed if not re.search(rf"^\s*(from|import) {name}\b", source, re.M)]
    assert idle == []
