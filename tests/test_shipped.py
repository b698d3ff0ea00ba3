"""What the repository tracks and what its packages hold: text, and the docs' pictures alone."""

import fnmatch
import os
import re
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

import rodjax

ROOT = Path(__file__).parents[1]
PICTURES = {"docs/*.png": b"\x89PNG", "docs/*.gif": b"GIF89a"}
PICTURE_BYTES = 2**20


def _tracked(root: Path) -> list[str]:
    """Files that git tracks; where there is no git, those in the tree that it would not ignore."""
    found = _of_git(root)
    return _of_tree(root) if found is None else found


def _of_git(root: Path) -> list[str] | None:
    git = ["git", "-C", str(root)]
    try:
        top = subprocess.run(
            [*git, "rev-parse", "--show-toplevel"], capture_output=True, text=True, check=True
        ).stdout.strip()
        if Path(top).resolve() != root.resolve():  # a copy inside somebody else's repository
            return None
        listed = subprocess.run([*git, "ls-files", "-z"], capture_output=True, check=True).stdout
    except (OSError, subprocess.CalledProcessError):
        return None
    return [name for name in os.fsdecode(listed).split("\0") if name and (root / name).is_file()]


def _of_tree(root: Path) -> list[str]:
    lines = [line.strip() for line in (root / ".gitignore").read_text().splitlines()]
    ignored = [line for line in lines if line and not line.startswith("#")]

    def ignores(path: Path, folder: bool) -> bool:
        name = path.relative_to(root).as_posix()
        names = (name, path.name)
        patterns = [p.rstrip("/") for p in ignored if folder or not p.endswith("/")]
        return any(fnmatch.fnmatch(one, pattern) for pattern in patterns for one in names)

    found = []
    for folder, folders, files in os.walk(root):
        here = Path(folder)
        folders[:] = [f for f in folders if f != ".git" and not ignores(here / f, folder=True)]
        kept = [here / f for f in files if f != ".git" and not ignores(here / f, folder=False)]
        found += [path.relative_to(root).as_posix() for path in kept]
    return found


def _is_text(content: bytes) -> bool:
    try:
        return "\0" not in content.decode()
    except UnicodeDecodeError:
        return False


def _foreign(root: Path, names: list[str]) -> list[str]:
    """Files that are neither text nor pictures of the docs of moderate size."""
    found = []
    for name in names:
        content = (root / name).read_bytes()
        picture = any(
            fnmatch.fnmatch(name, pattern) and content.startswith(magic)
            for pattern, magic in PICTURES.items()
        )
        if not (picture and len(content) <= PICTURE_BYTES) and not _is_text(content):
            found.append(name)
    return found


def test_no_binary_is_tracked_but_the_pictures_of_the_docs():
    names = _tracked(ROOT)
    assert "rodjax/__init__.py" in names
    assert _foreign(ROOT, names) == []


def _lay(root: Path) -> None:
    """A small tree of files that may be there, that are ignored, and four that may not be there."""
    pictures = b"\x89PNG\r\n\x1a\n\0\0"
    contents = {
        ".gitignore": (ROOT / ".gitignore").read_bytes(),
        "rodjax/__init__.py": b"",
        "docs/picture.png": pictures,
        ".venv/lib/thing.so": b"\x7fELF\0",
        "results/run/plot.png": pictures,
        "experiments/out.h5": b"\x89HDF\0",
        "rodjax/__pycache__/a.pyc": b"\0\xff",
        "library.so": b"\x7fELF\0",
        "docs/archive.png": b"PK\0\xff",
        "docs/huge.png": pictures + bytes(PICTURE_BYTES),
        "notebooks/plot.png": pictures,
    }
    for name, content in contents.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_bytes(content)


FOREIGN = ["docs/archive.png", "docs/huge.png", "library.so", "notebooks/plot.png"]


def test_binaries_are_found_in_a_copy_without_git(tmp_path):
    _lay(tmp_path)
    assert _of_git(tmp_path) is None
    assert sorted(_foreign(tmp_path, _tracked(tmp_path))) == FOREIGN


def test_binaries_that_git_tracks_against_its_own_rules_are_found(tmp_path):
    _lay(tmp_path)
    git = lambda *words: subprocess.run(["git", "-C", str(tmp_path), *words], check=True)
    try:
        git("init", "--quiet")
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("no git here")
    git("add", "--all")
    git("add", "--force", "experiments/out.h5")
    assert sorted(_foreign(tmp_path, _tracked(tmp_path))) == sorted(
        [*FOREIGN, "experiments/out.h5"]
    )


def _build(kind: str, out: Path) -> Path:
    """A package built without isolation and without network."""
    code = f"from hatchling import build; print(build.build_{kind}({str(out)!r}))"
    command = [sys.executable, "-c", code]
    run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    return out / run.stdout.split()[-1]


def test_source_package_holds_sources_alone(tmp_path):
    with tarfile.open(_build("sdist", tmp_path)) as archive:
        members = [member for member in archive.getmembers() if member.isfile()]
        contents = {
            member.name.partition("/")[2]: archive.extractfile(member).read() for member in members
        }
    assert [name for name, content in contents.items() if not _is_text(content)] == []
    folders = {name.partition("/")[0] for name in contents if "/" in name}
    assert folders == {"rodjax", "tests", "experiments", "notebooks", "docs"}
    modules = {path.relative_to(ROOT).as_posix() for path in (ROOT / "rodjax").rglob("*.py")}
    assert modules < set(contents)
    assert {"README.md", "LICENSE", "CHANGELOG.md", "pyproject.toml"} <= set(contents)


def test_wheel_is_typed_and_holds_the_library_alone(tmp_path):
    with zipfile.ZipFile(_build("wheel", tmp_path)) as archive:
        names = archive.namelist()
        metadata = archive.read(next(n for n in names if n.endswith("/METADATA"))).decode()
    assert "rodjax/py.typed" in names
    tops = {name.partition("/")[0] for name in names}
    assert tops == {"rodjax", f"rodjax-{rodjax.__version__}.dist-info"}
    page = {f"rodjax/viewing/page.{kind}" for kind in ("html", "css", "js")}
    assert page <= set(names)
    own = {name for name in names if name.startswith("rodjax/")} - page
    assert all(name.endswith((".py", "py.typed")) for name in own)
    url = next(line for line in metadata.splitlines() if line.startswith("Project-URL: Paper"))
    assert url.split(", ")[1] in (ROOT / "CITATION.cff").read_text()


def test_page_on_the_index_links_to_what_is_there(tmp_path):
    with zipfile.ZipFile(_build("wheel", tmp_path)) as archive:
        names = archive.namelist()
        metadata = archive.read(next(n for n in names if n.endswith("/METADATA"))).decode()
    assert "# rodjax" in metadata
    targets = re.findall(r"\]\(([^)]+)\)", metadata)
    assert [target for target in targets if not target.startswith("https://")] == []
    assert "```mermaid" not in metadata
