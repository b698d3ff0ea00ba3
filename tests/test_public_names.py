"""Every public name is there, under its own name, and means what its module says."""

import importlib
import inspect
import re
import subprocess
import sys
from pathlib import Path

import pytest

import rodjax as rx

MODULES = sorted(p.stem for p in Path(rx.__file__).parent.glob("*.py") if p.stem != "__init__")
SOURCE = Path(rx.__file__).read_text()


def test_listing_agrees_with_all():
    assert dir(rx) == sorted(rx.__all__) == list(rx.__all__)
    assert len(set(rx.__all__)) == len(rx.__all__)


def test_listing_holds_all_that_is_imported_by_name():
    written = re.findall(r"^from rodjax\.?\w* import \w+ as (\w+)", SOURCE, re.MULTILINE)
    assert len(written) > 60
    assert [name for name in written if name not in rx.__all__] == []


@pytest.mark.parametrize("name", rx.__all__)
def test_public_name_is_reachable(name):
    assert getattr(rx, name) is not None


def test_public_names_are_reachable_in_a_fresh_interpreter():
    # here the other tests have imported every module already
    code = (
        "import rodjax as rx, sys\n"
        "for name in rx.__all__: getattr(rx, name)\n"
        "assert 'matplotlib' not in sys.modules, 'figures load matplotlib when they are made'\n"
        "from rodjax import *\n"
        "storage.save, plot.snapshots, sweep.sweep, windows.cut, units.SI, jit\n"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr


def test_import_leaves_files_and_figures_for_later():
    code = "import rodjax, sys; print(*[m for m in ('h5py', 'matplotlib') if m in sys.modules])"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert run.stdout.strip() == "", run.stderr


def test_unknown_name_is_refused_as_in_any_module():
    with pytest.raises(AttributeError, match="has no attribute 'simulate'"):
        _ = rx.simulate
    assert not hasattr(rx, "step_equation")


@pytest.mark.parametrize("name", MODULES)
def test_no_module_is_shadowed(name):
    module = importlib.import_module(f"rodjax.{name}")
    assert inspect.ismodule(module)
    assert getattr(rx, name) is module, (
        f"rodjax.{name} is hidden by what is imported under its name"
    )


def test_docstring_names_what_is_there():
    assert rx.__doc__ is not None
    names = re.findall(r"`([a-zA-Z_]+)`", rx.__doc__)
    assert len(names) > 10
    assert [name for name in names if name not in rx.__all__] == []
