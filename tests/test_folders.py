"""Data flows one way through the folders, and README names them as they are."""

import ast
import importlib
from pathlib import Path

import pytest

import rodjax

FOLDER = Path(rodjax.__file__).parent
# from what knows least to what knows most
ORDER = [
    "inputs",
    "numerics",
    "rods",
    "interactions",
    "constraints",
    "scenes",
    "equations",
    "equilibria",
    "dynamics",
    "measuring",
    "continuation",
    "fitting",
    "files",
    "viewing",
    "exchange",
    "harness",
    "reference",
]
# siblings that do not know each other
APART = [("interactions", "constraints"), ("fitting", "measuring"), ("files", "measuring")]


def needed(path: Path) -> set[str]:
    """Folders that a file imports from."""
    modules = []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            modules += [f"{node.module}.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.Import):
            modules += [alias.name for alias in node.names]
    return {m.split(".")[1] for m in modules if m.startswith("rodjax.")}


def test_every_module_is_in_a_folder_under_a_name_of_its_own():
    names = [p.stem for p in FOLDER.glob("*/*.py") if p.stem != "__init__"]
    assert len(set(names)) == len(names)  # files name classes by module, not by folder
    assert {p.name for p in FOLDER.glob("*.py")} == {"__init__.py"}
    assert {p.parent.name for p in FOLDER.glob("*/*.py")} == set(ORDER)


@pytest.mark.parametrize("folder", ORDER)
def test_a_folder_needs_none_below(folder):
    below = set(ORDER[ORDER.index(folder) + 1 :])
    below |= {b for a, b in APART if a == folder} | {a for a, b in APART if b == folder}
    for path in (FOLDER / folder).glob("*.py"):
        assert not needed(path) & below, path


def test_readme_shows_the_folders_in_order():
    text = (FOLDER.parent / "README.md").read_text()
    lines = []
    for folder in ORDER:
        said = importlib.import_module(f"rodjax.{folder}").__doc__
        lines.append(f"    {folder:13} {said[0].lower()}{said[1:].rstrip('.')}\n")
    assert "".join(lines) in text
