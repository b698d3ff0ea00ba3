"""Every public name is there, under its own name, and means what its module says."""

import importlib
import inspect
import re
import subprocess
import sys
from pathlib import Path

import pytest

import rodjax as rx

FOLDER = Path(rx.__file__).parent
MODULES = sorted(
    ".".join(p.relative_to(FOLDER).with_suffix("").parts)
    for p in FOLDER.glob("*/*.py")
    if p.stem != "__init__"
)
SOURCE = Path(rx.__file__).read_text()


def test_listing_agrees_with_all():
    assert dir(rx) == sorted(rx.__all__) == list(rx.__all__)
    assert len(set(rx.__all__)) == len(rx.__all__)


def test_listing_holds_all_that_is_imported_by_name():
    written = re.findall(r"^ *from rodjax[\w.]* import \w+ as (\w+)", SOURCE, re.MULTILINE)
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


def test_import_leaves_files_figures_fits_and_searches_for_later():
    later = ("h5py", "matplotlib", "optax", "optimistix", "scipy.spatial")
    code = f"import rodjax, sys; print(*[m for m in {later} if m in sys.modules])"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert run.stdout.strip() == "", run.stderr


def test_public_modules_are_imported_by_that_name_too():
    code = (
        "import rodjax.storage as storage, rodjax.units, sys\n"
        "import rodjax as rx\n"
        "from rodjax.sweep import sweep\n"
        "from rodjax.files import storage as own\n"
        "assert storage is rx.storage is own and sweep is rx.sweep.sweep\n"
        "assert storage.__spec__.name == storage.__name__ == 'rodjax.files.storage'\n"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    with pytest.raises(ModuleNotFoundError, match="No module named 'rodjax.simulate'"):
        importlib.import_module("rodjax.simulate")


def test_modules_are_found_where_they_were():
    with pytest.warns(DeprecationWarning, match="rodjax.strains is rodjax.rods.strains now"):
        module = importlib.import_module("rodjax.strains")
    assert module.__spec__.name == "rodjax.rods.strains"
    with pytest.raises(ModuleNotFoundError):  # would hide the function
        importlib.import_module("rodjax.placing")
    with pytest.warns(DeprecationWarning, match="rodjax.fit is rodjax.fitting.fit now"):
        assert rx.fit.least_squares is rx.least_squares


def test_unknown_name_is_refused_as_in_any_module():
    with pytest.raises(AttributeError, match="has no attribute 'integrate'"):
        _ = rx.integrate
    assert not hasattr(rx, "step_equation")


@pytest.mark.parametrize("name", MODULES)
def test_no_module_is_shadowed(name):
    module = importlib.import_module(f"rodjax.{name}")
    assert inspect.ismodule(module)
    folder, own = name.split(".")
    assert getattr(getattr(rx, folder), own) is module, (
        f"rodjax.{name} is hidden by what is imported under its name"
    )
    if own in rx._FOLDERS:
        assert getattr(rx, own) is module


def test_docstring_names_what_is_there():
    assert rx.__doc__ is not None
    names = re.findall(r"`([a-zA-Z_]+)`", rx.__doc__)
    assert len(names) > 10
    assert [name for name in names if name not in rx.__all__] == []
