"""The notebooks: what each must be, and that it runs, compilation included."""

import ast
import importlib
import os
from pathlib import Path

import jupytext
import pytest
from nbclient import NotebookClient

import rodjax as rx

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "notebooks"
NAMES = sorted(path.stem for path in FOLDER.iterdir() if path.suffix in (".py", ".ipynb"))
# of each notebook at least so many, so that one that comes to show nothing is seen
PICTURES = {
    "bifurcation": 3,
    "first_rod": 3,
    "fitting": 2,
    "hockle": 2,
    "intertwining": 3,
    "neural_law": 2,
    "own_data": 3,
    "sensitivity": 3,
    "sweep_map": 2,
    "thermal_rod": 1,
    "tweezers": 1,
}


def test_they_are_kept_as_text():
    assert not list(FOLDER.glob("*.ipynb"))
    assert set(PICTURES) == set(NAMES)


@pytest.mark.parametrize("name", NAMES)
def test_it_is_a_page(name):
    notebook = jupytext.read(FOLDER / f"{name}.py")
    title, *rest = notebook.cells
    # the title, and what the problem is
    assert title.cell_type == "markdown"
    assert title.source.startswith("# ")
    assert len(title.source.split("\n\n")[1]) > 100
    assert not any(cell.source.startswith("# ") for cell in rest)
    assert not any(cell.get("outputs") for cell in notebook.cells)
    assert rest[-1].cell_type == "markdown"
    assert "## What to try\n" in "\n" + rest[-1].source
    assert rest[-1].source.rstrip().count("\n- ") >= 2
    # a wrong result fails
    assert any("assert " in cell.source for cell in rest if cell.cell_type == "code")
    assert notebook.metadata["kernelspec"]["name"] == "python3"


def _unknown(tree: ast.AST) -> list[str]:
    """What a notebook takes of the library that is not public."""
    found, package = [], {"rodjax"}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                if alias.name == "rodjax":
                    package.add(alias.asname or "rodjax")
                elif alias.name.startswith("rodjax."):
                    found.append(alias.name)
        elif isinstance(node, ast.ImportFrom) and (node.module or "").startswith("rodjax"):
            modules = {"rodjax", *(f"rodjax.{name}" for name in rx.__all__)}
            if node.module not in modules:
                found.append(node.module)
                continue
            public = rx.__all__ if node.module == "rodjax" else dir(_module(node.module))
            found += [alias.name for alias in node.names if alias.name not in public]
    for node in ast.walk(tree):
        match node:
            case ast.Attribute(value=ast.Name(id=name), attr=part) if name in package:
                found += [part] if part not in rx.__all__ else []
            case ast.Attribute(
                value=ast.Attribute(value=ast.Name(id=name), attr=outer), attr=part
            ) if name in package and outer in rx.__all__:
                whole = getattr(rx, outer)
                found += [] if hasattr(whole, part) and part[0] != "_" else [f"{outer}.{part}"]
    return found


def _module(name: str):
    return importlib.import_module(name)


@pytest.mark.parametrize("name", NAMES)
def test_it_uses_public_names_alone(name):
    tree = ast.parse((FOLDER / f"{name}.py").read_text(encoding="utf-8"))
    assert not _unknown(tree)


def test_names_that_are_not_public_are_found():
    lines = [
        "import rodjax as rx",
        "import rodjax.fitting",
        "from rodjax import Rod, nothing",
        "from rodjax.rods import rod",
        "from rodjax.measures import linking, curl",
        "rx.Scene, rx.scene, rx.energy.ledger, rx.energy._stored, rx.plot.curves",
    ]
    expected = ["rodjax.fitting", "nothing", "rodjax.rods", "curl", "scene"]
    assert _unknown(ast.parse("\n".join(lines))) == [*expected, "energy._stored", "plot.curves"]


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_it_runs(name):
    notebook = jupytext.read(FOLDER / f"{name}.py")
    path = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    client = NotebookClient(notebook, timeout=600, resources={"metadata": {"path": str(FOLDER)}})
    client.execute(env=os.environ | {"PYTHONPATH": path, "JAX_ENABLE_COMPILATION_CACHE": "0"})
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    shown = [output for output in outputs if "image/png" in output.get("data", {})]
    assert len(shown) >= PICTURES[name]
    size = sum(len(text) for output in outputs for text in output.get("data", {}).values())
    assert size < 2e6
