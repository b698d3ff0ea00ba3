"""What README and docs show runs when pasted, page by page.

Blocks marked ```py are read beside what a command wrote, and do not run by themselves.
"""

import re
import subprocess
import sys
from pathlib import Path

import pytest

import rodjax as rx
from rodjax.numerics.results import MESSAGES

ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted(
    page
    for page in [ROOT / "README.md", *(ROOT / "docs").glob("*.md")]
    if "```python" in page.read_text(encoding="utf-8")
)
BLOCK = re.compile(r"^```python\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def _blocks(page: Path) -> list[str]:
    return BLOCK.findall(page.read_text(encoding="utf-8"))


def test_pages_are_found():
    assert len(PAGES) > 8
    assert all(_blocks(page) for page in PAGES)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_blocks_are_whole(page):
    for block in _blocks(page):
        compile(block, page.name, "exec")


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_page_runs_as_pasted(page, tmp_path):
    # block by block in one process, as a reader would paste them; README's begin anew
    joined = ["\n".join(_blocks(page))] if page.stem != "README" else _blocks(page)
    for number, code in enumerate(joined):
        script = tmp_path / f"{page.stem}_{number}.py"
        script.write_text(code, encoding="utf-8")
        run = subprocess.run(
            [sys.executable, "-W", "error::UserWarning", script.name],
            cwd=tmp_path,
            capture_output=True,
            text=True,
            check=False,
        )
        assert run.returncode == 0, run.stderr[-3000:]


def test_every_public_name_has_its_place_in_the_reference():
    pages = "\n".join(page.read_text(encoding="utf-8") for page in (ROOT / "docs/api").glob("*.md"))
    listed = re.findall(r"^\.\. auto\w+:: rodjax\.(\w+)$", pages, re.MULTILINE)
    assert sorted(listed) == sorted(rx.__all__)


def test_every_page_and_notebook_is_in_the_contents():
    contents = (ROOT / "docs/index.md").read_text(encoding="utf-8")
    pages = {page.stem for page in (ROOT / "docs").glob("*.md")} - {"index"}
    books = {f"notebooks/{page.stem}" for page in (ROOT / "notebooks").glob("*.py")}
    listed = set(re.findall(r"^([\w/]+)$", contents, re.MULTILINE)) - {"api/index"}
    assert listed == pages | books


def test_messages_that_the_questions_quote_are_those_of_the_library():
    page = (ROOT / "docs/questions.md").read_text(encoding="utf-8")
    quoted = re.findall(r"^\*\*\"([^\"]+)\".*\(`(\w+)`\)$", page, re.MULTILINE)
    assert len(quoted) >= 3
    for words, name in quoted:
        assert words.replace("...", "") in MESSAGES[rx.Result[name]]
    assert all(name in rx.Result.__members__ for name in re.findall(r"`([A-Z]+_[A-Z_]+)`", page))
